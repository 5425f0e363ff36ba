# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `machine_simulator`: publishes the signals of a simulated gearbox."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
import math
from typing import Any

import numpy as np
from sa_jitter_ros.declaration import MODEL_PARAMETERS
from sa_jitter_ros.effects import enabled_effects
from sa_jitter_ros.effects.parameters import effect_parameters
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes.base import run_node
from sa_jitter_ros.nodes.playback import PlaybackNode, Portion
from sa_jitter_ros.parameters import (
    fixed, Parameter, PULSES_PER_REVOLUTION, PULSES_PER_TRIGGER, require_shaft_names, Values)
from sa_jitter_ros.recordings.channel_units import scale_of
from sa_jitter_ros.samples import SampleBlock
from sa_jitter_ros.simulation import (
    AdditiveNoise, band_limited, ChippedTooth, Component, DeclaredJitter, Effect, Gearbox,
    Keyphasor, make_effects, mesh, Torsion)
from sa_jitter_ros.simulation.effects import JITTER_DISTRIBUTIONS
from sa_jitter_ros.simulation.random_streams import ZERO

_DECLARED = {item.name: item for item in MODEL_PARAMETERS}
PARAMETERS = (
    fixed('seed', 0, 'seed of all random numbers', minimum=0),
    fixed('start_time', 0.0, 'time of the first sample', unit='s'),
    fixed('duration', 0.0, 'machine time to simulate; 0: no end', unit='s', minimum=0.0),
    fixed('sample_rate', 20000.0, 'sampling rate of the vibration', unit='Hz', above=0.0),
    fixed('channel_gains', [1.0], 'gain of each vibration channel'),
    fixed('shafts', ['shaft'], 'names of the shafts'),
    fixed('speed', 25.0, 'speed of the tach shaft', unit='Hz', above=0.0),
    fixed('speed_profile', [], 'instead of speed: time (s), speed (Hz), time, speed, ...; linear '
          'between', minimum=0.0),
    fixed('speed_fluctuation_std', 0.0, 'standard deviation of a random speed fluctuation, '
          'relative', minimum=0.0, maximum=0.1),
    fixed('speed_fluctuation_band', [0.1, 2.0], 'lowest and highest frequency of the fluctuation',
          unit='Hz', above=0.0),
    fixed('torsion_order', 2.0, 'torsional oscillations per tach revolution', minimum=0.0),
    fixed('torsion_amplitude', 0.0, 'amplitude of the torsional oscillation', unit='rad',
          minimum=0.0),
    Parameter('noise_std', 0.1, 'declared white noise per vibration sample', minimum=0.0),
    fixed('tach', 'pulses', 'output of the keyphasor',
          choices=('pulses', 'waveform', 'both', 'none')),
    replace(PULSES_PER_REVOLUTION, read_only=True),
    replace(PULSES_PER_TRIGGER, read_only=True),
    _DECLARED['keyphasor_rate'],
    Parameter('jitter_distribution', 'uniform', 'distribution of the declared pulse error; '
              'sampled: times rounded up to ticks of keyphasor_rate',
              choices=(*JITTER_DISTRIBUTIONS, 'sampled', 'none')),
    _DECLARED['jitter_std'],
    _DECLARED['jitter_table'],
    fixed('waveform', 'ttl', 'shape of the tach waveform', choices=('ttl', 'sine')),
    fixed('waveform_rate', 50000.0, 'sampling rate of the tach waveform', unit='Hz', above=0.0),
    fixed('waveform_rise_time', 0.0, 'rise time of a ttl edge', unit='s', minimum=0.0),
    fixed('waveform_noise_std', 0.0, 'standard deviation of noise on the tach waveform of 0 to 5 '
          'V', unit='V', minimum=0.0),
)
# Sizes at which an effect is significant as soon as it is enabled.
EFFECT_DEFAULTS = {
    'excess_jitter.std': 2e-5, 'correlated_jitter.std': 2e-5, 'correlated_jitter.correlation': 0.8,
    'target_geometry.pulse_angles': [0.0, 0.005], 'clock_skew.skew': 1e-5,
    'keyphasor_quantisation.clock_rate': 5000.0, 'missing_pulses.probability': 0.02,
    'speed_fluctuation.acceleration_std': 10.0, 'phase_wander.std': 0.01,
    'amplitude_modulation.std': 0.2, 'additive_noise.std': 0.5,
    'interfering_tone.frequency': 100.0, 'interfering_tone.amplitude': 0.5,
    'jitter_scale.scale': 2.0, 'path_delay.delay': 1e-3,
}


def simulated_shaft_parameters(shaft: str) -> tuple[Parameter, ...]:
    """Return the parameters of one shaft."""
    return (
        fixed(f'{shaft}.ratio', 1.0, 'speed over that of the tach shaft', above=0.0),
        fixed(f'{shaft}.teeth', 23, 'teeth of its gear: the mesh order', minimum=1),
        fixed(f'{shaft}.harmonics', [1.0, 0.5, 0.25], 'peak amplitudes of the mesh order and its '
              'multiples', minimum=0.0),
        fixed(f'{shaft}.sidebands', 0.2, 'relative amplitude of sidebands one order beside each '
              'multiple', minimum=0.0),
        Parameter(f'{shaft}.chipped_tooth', 0.0, 'amplitude of the burst of a chipped tooth, once '
                  'a revolution'),
    )


def simulated_effects(values: Values) -> tuple[Effect, ...]:
    """Return declared jitter and noise and the enabled effects; raises `ParameterError`."""
    options = {effect.name: dict(effect.values) for effect in enabled_effects(values)}
    declared: list[Effect] = [AdditiveNoise(values['noise_std'], 'declared_noise')]
    distribution, rate = values['jitter_distribution'], values['keyphasor_rate']
    if distribution == 'sampled' and 'keyphasor_quantisation' not in options:
        options['keyphasor_quantisation'] = {'clock_rate': rate}
    elif distribution in JITTER_DISTRIBUTIONS and 'keyphasor_quantisation' not in options:
        declared.append(DeclaredJitter(
            distribution, values['jitter_std'] or 1.0 / (math.sqrt(12.0) * rate),
            tuple(values['jitter_table'])))
    return (*declared, *make_effects(options))


def machine_of(values: Values) -> Gearbox:
    """Return the gearbox that the parameters describe; raises `ParameterError`."""
    gains, seed, profile = values['channel_gains'], values['seed'], values['speed_profile']
    if len(profile) % 2:
        raise ParameterError(f'speed_profile has {len(profile)} numbers: give pairs of time and '
                             'speed')
    band = values['speed_fluctuation_band']
    if len(band) != 2:
        raise ParameterError(f'speed_fluctuation_band is {band}: give two frequencies')
    std = values['speed_fluctuation_std']
    components: list[Component] = []
    faults = []
    for shaft in values['shafts']:
        teeth, depth = values[f'{shaft}.teeth'], values[f'{shaft}.chipped_tooth']
        components += mesh(shaft, teeth, harmonics=values[f'{shaft}.harmonics'],
                           channel_gains=gains, sidebands={1.0: values[f'{shaft}.sidebands']},
                           seed=seed)
        if depth:
            faults.append(ChippedTooth(shaft, teeth, tuple(depth * gain for gain in gains),
                                       width=min(0.5 / teeth, 0.15)))
    return Gearbox(
        components, values['sample_rate'],
        shafts={shaft: values[f'{shaft}.ratio'] for shaft in values['shafts']},
        speed=list(zip(profile[::2], profile[1::2])) or [(0.0, values['speed'])],
        fluctuation=band_limited(std=std, band=tuple(band), seed=seed, name='fluctuation')
        if std else ZERO,
        torsion=(Torsion(values['torsion_order'], values['torsion_amplitude']),)
        if values['torsion_amplitude'] else (),
        keyphasor=Keyphasor(
            pulses_per_revolution=values['pulses_per_revolution'],
            pulses_per_trigger=values['pulses_per_trigger'] or None,
            rate=values['waveform_rate'], waveform=values['waveform'],
            rise_time=values['waveform_rise_time'], noise_std=values['waveform_noise_std']),
        faults=faults, effects=simulated_effects(values), seed=seed)


class MachineSimulator(PlaybackNode):
    """Publishes vibration and keyphasor of the simulated gearbox `machine`."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('machine_simulator', PARAMETERS, **node_kwargs)
        self.parameters.declare(tuple(effect_parameters(EFFECT_DEFAULTS)))
        shafts = self.parameters.values()['shafts']
        require_shaft_names('shafts', shafts)
        for shaft in shafts:
            self.parameters.declare(simulated_shaft_parameters(shaft))
        named = self.parameters.declare_channels()
        self._values = values = self.parameters.values()
        self.machine = machine_of(values)
        self._volts = scale_of(named, self.machine.channels)
        rate, channels = self.machine.sample_rate, self.machine.channels
        self._samples = round(values['duration'] * rate)
        self._pulses = values['tach'] in ('pulses', 'both')
        self._with_waveform = values['tach'] in ('waveform', 'both')
        self._done = 0
        self.begin(rate, channels, pulses=self._pulses, waveform=self._with_waveform)
        self.get_logger().info(f'started: {channels} channels at {rate:g} Hz, shafts '
                               f'{", ".join(shafts)}')

    def check(self, values: Values) -> None:
        """Raise ParameterError for parameters that no machine can have."""
        machine_of(values)

    def apply(self, values: Values) -> None:
        """Apply changed values; the signals of the changed machine continue those before."""
        if any(values[key] != self._values[key] for key in values
               if key not in ('playing', 'rate')):
            self.machine = machine_of(values)
        self._values = values
        super().apply(values)

    def portions(self) -> Iterator[Portion]:
        """Return signals that continue those sent before, for `duration` if it is set."""
        first = self._done
        blocks = (range(first, first + self._samples, self._block) if self._samples
                  else count(first, self._block))
        for start in blocks:
            stop = start + self._block
            if self._samples:
                stop = min(stop, first + self._samples)
            self._done = stop
            yield self._portion(start, stop)

    def _portion(self, start: int, stop: int) -> Portion:
        machine, origin = self.machine, self._values['start_time']
        rate, tach_rate = machine.sample_rate, machine.keyphasor.rate
        vibration = SampleBlock(machine.vibration(start, stop) * self._volts.divisor,
                                origin + start / rate, rate, start)
        waveform: tuple[SampleBlock, ...] = ()
        if self._with_waveform:
            low, high = round(start / rate * tach_rate), round(stop / rate * tach_rate)
            if high > low:
                waveform = (SampleBlock(machine.tach_waveform(low, high)[None],
                                        origin + low / tach_rate, tach_rate, low),)
        pulses = machine.pulses(start / rate, stop / rate).times if self._pulses else np.empty(0)
        return Portion((stop - start) / rate, (vibration,), waveform, origin + pulses)

    def progress(self, sent: float) -> str:
        """Return how much machine time was simulated."""
        total = f' of {self._samples / self.machine.sample_rate:.1f}' if self._samples else ''
        return f'{sent:.1f}{total} s sent'


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(MachineSimulator, args)


if __name__ == '__main__':
    raise SystemExit(main())
