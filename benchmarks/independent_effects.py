# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Effects on the machines of `independent_machines`, at a size that matters.

These are the effects of the package, and others that it does not know. An effect on the mean grows
until it changes the mean attenuation by a drawn RMS over the orders, which is computed from the
pulses of the machine; an effect on the scatter grows until the amplitude scatters a drawn number
of times more than declared.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from independent_machines import (Array, attenuation, band, Disturbance, draw_machine, Generator,
                                  Machine, Waves)
import numpy as np
from scipy import signal

Sized = Callable[[float], tuple[Disturbance, Mapping[str, Any]]]
_RMS, _SCATTER = (0.02, 0.25), (2.2, 5.0)
_STEPS = 40


@dataclass(frozen=True)
class Case:
    """A machine, what happens to it, and the true parameters by effect."""

    machine: Machine
    what: Disturbance
    truth: Mapping[str, Mapping[str, Any]]


def excess_jitter(rng: Generator, machine: Machine) -> Sized:
    """Return electrical noise on the pulses."""
    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        return Disturbance(errors=lambda draw, _, true: size * draw.standard_normal(
            true.size)), {'std': size}
    return sized


def correlated_jitter(rng: Generator, machine: Machine) -> Sized:
    """Return a trigger level that wanders, correlated from trigger pulse to trigger pulse."""
    rho = rng.uniform(0.3, 0.95)

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        pole = rho ** (1.0 / machine.pulses_per_trigger)

        def errors(draw: Generator, _: Machine, true: Array) -> Array:
            noise = np.sqrt(1.0 - pole**2) * draw.standard_normal(true.size)
            noise[0] /= np.sqrt(1.0 - pole**2)
            return np.asarray(size * signal.lfilter([1.0], [1.0, -pole], noise))
        return Disturbance(errors=errors), {'std': size, 'correlation': rho}
    return sized


def target_geometry(rng: Generator, machine: Machine) -> Sized:
    """Return marks off their even places."""
    marks = rng.standard_normal(machine.pulses_per_revolution)
    marks -= marks.mean()

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        late = 2.0 * np.pi * machine.speed * size * marks
        return Disturbance(marks=late), {'pulse_angles': late}
    return sized


def speed_fluctuation(rng: Generator, machine: Machine) -> Sized:
    """Return a random acceleration that lasts about a trigger cycle or longer."""
    width = rng.uniform(0.25, 0.6)
    waves = band(rng, 0.05 / machine.trigger_period, width / machine.trigger_period)

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        acceleration = size * machine.speed / machine.trigger_period**2
        ripple = Waves(waves.rate, waves.size * acceleration / (2.0 * np.pi * waves.rate) ** 2,
                       waves.phase)
        return Disturbance(ripple=ripple), {
            'acceleration_std': 2.0 * np.pi * acceleration, 'bandwidth': min(width, 0.5)}
    return sized


def clock_skew(rng: Generator, machine: Machine) -> Sized:
    """Return a keyphasor clock that is fast or slow."""
    sign = rng.choice([-1.0, 1.0])

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        skew = float(sign * size / machine.average)
        return Disturbance(skew=skew), {'skew': skew}
    return sized


def phase_wander(rng: Generator, machine: Machine) -> Sized:
    """Return torsion between tach and gears."""
    width = rng.uniform(0.15, 0.45)
    waves = band(rng, 0.0, width / machine.trigger_period)

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        cycles = size * machine.speed * machine.ratio
        return Disturbance(wander=waves.scaled(cycles)), {
            'std': 2.0 * np.pi * cycles, 'bandwidth': width}
    return sized


def keyphasor_quantisation(rng: Generator, machine: Machine) -> Sized:
    """Return the clock that the declared jitter stands for."""
    return lambda size: (Disturbance(clock=machine.keyphasor_rate),
                         {'clock_rate': machine.keyphasor_rate})


def missing_pulses(rng: Generator, machine: Machine) -> Sized:
    """Return a keyphasor that now and then gives no pulse."""
    lost = float(rng.uniform(0.004, 0.04))
    return lambda size: (Disturbance(lost=lost), {'probability': lost})


def interpolation_loss(rng: Generator, machine: Machine) -> Sized:
    """Return a record that was resampled linearly from another clock's samples."""
    beat = rng.uniform(0.06, 0.45) / machine.trigger_period
    offset = float(rng.choice([-1.0, 1.0]) * beat / machine.sample_rate)
    return lambda size: (Disturbance(resampled=offset), {'method': 'linear'})


def additive_noise(rng: Generator, machine: Machine) -> Sized:
    """Return white noise beyond the declared."""
    level = float(np.median(machine.levels))

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        std = level * size * np.sqrt(0.5 * machine.sample_rate * machine.average)
        return Disturbance(noise=float(std)), {'std': float(std)}
    return sized


def amplitude_modulation(rng: Generator, machine: Machine) -> Sized:
    """Return a load that varies slowly, and all orders with it."""
    width = rng.uniform(0.3, 3.0)
    waves = band(rng, 0.0, width / machine.average)
    time = machine.start_time + machine.average * (np.arange(machine.acquisitions)[:, None]
                                                   + np.linspace(0.0, 1.0, 40))
    share = float(waves(time).mean(axis=1).std())

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        return Disturbance(gain=waves.scaled(size / share)), {
            'std': size / share, 'bandwidth': width / machine.trigger_cycles}
    return sized


def interfering_tone(rng: Generator, machine: Machine) -> Sized:
    """Return a tone a few lines of the average from an order."""
    which = int(rng.integers(machine.orders.size))
    off = float(rng.choice([-1.0, 1.0]) * rng.choice([0.4, 0.6, 1.5, 2.5]) + rng.uniform(-.1, .1))
    frequency = machine.orders[which] * machine.ratio * machine.speed + off / machine.average
    level = float(np.median(machine.levels[:, which]))

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        amplitude = float(np.sqrt(2.0) * size * level / abs(np.sinc(off)))
        return Disturbance(tone=(frequency, amplitude)), {
            'frequency': frequency, 'amplitude': amplitude}
    return sized


def following_level(rng: Generator, machine: Machine) -> Sized:
    """Return a trigger level that follows a hunting speed: late when slow."""
    rate = 1.0 / rng.uniform(4.0, 9.0) / machine.trigger_period
    phase = rng.uniform(0.0, 2.0 * np.pi)
    hunting = Waves(np.array([rate]), np.array([2e-4 * machine.speed / (2.0 * np.pi * rate)]),
                    np.array([phase]))

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        return Disturbance(ripple=hunting, errors=lambda draw, _, true: -size * np.sqrt(
            2.0) * np.cos(2.0 * np.pi * rate * true + phase)), {}
    return sized


def late_recovery(rng: Generator, machine: Machine) -> Sized:
    """Return a sensor that drops out now and then and comes late until it has recovered."""
    often, lasts = rng.uniform(0.02, 0.06), rng.uniform(2.0, 6.0)

    def sized(size: float) -> tuple[Disturbance, Mapping[str, Any]]:
        def errors(draw: Generator, _: Machine, true: Array) -> Array:
            step = machine.pulses_per_trigger
            hit = (draw.uniform(size=true.size) < often / step) * draw.uniform(0.5, 1.5, true.size)
            return np.asarray(size * signal.lfilter([1.0], [1.0, -np.exp(-1.0 / lasts / step)],
                                                    hit))
        return Disturbance(errors=errors), {}
    return sized


def two_paths(rng: Generator, machine: Machine) -> Sized:
    """Return a vibration that reaches the sensors on one of two paths, by turns."""
    shape = machine.peaks.shape
    step = rng.uniform(0.15, 0.5) * np.exp(2j * np.pi * rng.uniform(size=shape))
    paths = np.stack((1.0 + step, 1.0 - step), axis=-1)
    dwell = rng.uniform(2.0, 10.0) * machine.trigger_period
    return lambda size: (Disturbance(paths=paths, dwell=dwell), {})


def resonance(rng: Generator, machine: Machine) -> Sized:
    """Return a resonance that one order crosses as the speed drifts."""
    order = float(rng.choice(machine.orders))
    drift = machine.relative_drift
    natural = order * machine.ratio * machine.speed * (1.0 + rng.uniform(-1.0, 1.0) * drift)
    return lambda size: (Disturbance(resonance=(natural, drift * rng.uniform(0.5, 1.5))), {})


MEAN = (excess_jitter, correlated_jitter, target_geometry, speed_fluctuation, clock_skew,
        phase_wander, following_level, late_recovery)
AS_THEY_ARE = (keyphasor_quantisation, missing_pulses, interpolation_loss, two_paths, resonance)
SCATTER = (additive_noise, amplitude_modulation, interfering_tone)
KNOWN = ('excess_jitter', 'keyphasor_quantisation', 'correlated_jitter', 'target_geometry',
         'speed_fluctuation', 'clock_skew', 'phase_wander', 'missing_pulses',
         'interpolation_loss', 'additive_noise', 'amplitude_modulation', 'interfering_tone')
UNKNOWN = ('following_level', 'late_recovery', 'two_paths', 'resonance')
_MAKERS = {item.__name__: item for item in MEAN + AS_THEY_ARE + SCATTER}


def draw_case(names: tuple[str, ...], seed: int, *, only_declared: bool = False,
              share: float = 1.0) -> Case:
    """
    Draw a machine and what of `names` happens to it; no name: the declared model is right.

    A machine of `only_declared` orders has neither sidebands nor other shafts. Effects that have
    a size are `share` times as large as drawn.
    """
    for attempt in range(200):
        rng = np.random.default_rng([seed, attempt, *(ord(c) for c in '+'.join(names))])
        machine = _machine(rng, names)
        if only_declared:
            count = machine.orders.size
            machine = replace(machine, components=machine.orders, peaks=machine.peaks[:, :count])
        what, truth = Disturbance(), {}
        for name in names:
            one = _sized(rng, name, machine, share)
            if one is None:
                break
            what = replace(what, **{item.name: getattr(one[0], item.name) for item in fields(what)
                                    if getattr(one[0], item.name) is not item.default})
            truth[name] = one[1]
        else:
            return Case(machine, what, truth)
    raise RuntimeError(f'no machine shows {names}')


def _machine(rng: Generator, names: tuple[str, ...]) -> Machine:
    options: dict[str, Any] = {}
    scatters = {item.__name__ for item in SCATTER}
    if scatters.intersection(names) or not names:
        options['white'] = True
    if scatters.intersection(names):
        options['width'] = 0.1, 0.3
    if 'target_geometry' in names:
        options['marks'] = True
    if 'keyphasor_quantisation' in names:
        options.update(steady=True, waveform=False)
    if 'interpolation_loss' in names:
        options['top'] = 0.1, 0.3
    machine = draw_machine(rng, **options)
    if 'resonance' in names and machine.relative_drift < 1e-3:
        machine = replace(machine, drift=machine.drift.scaled(1e-3 / machine.relative_drift),
                          relative_drift=1e-3)
    return machine


def _sized(rng: Generator, name: str, machine: Machine, share: float
           ) -> tuple[Disturbance, Mapping[str, Any]] | None:
    """Return an effect of a size that matters, None where the machine does not let it."""
    make = _MAKERS[name](rng, machine)
    seed = int(rng.integers(1 << 30))

    def mean(what: Disturbance) -> Array:
        return np.asarray(attenuation(machine, what, np.random.default_rng(seed)).mean(axis=0))

    if name == 'keyphasor_quantisation':
        changes = [attenuation(machine, make(1.0)[0], np.random.default_rng(seed + i)).mean(axis=0)
                   - mean(Disturbance()) for i in range(4)]
        return make(1.0) if np.sqrt(np.mean(np.square(changes), axis=1)).min() > _RMS[0] else None
    if _MAKERS[name] in AS_THEY_ARE:
        return make(1.0)
    if _MAKERS[name] in SCATTER:
        times = rng.uniform(*_SCATTER)
        timing = attenuation(machine, Disturbance(), np.random.default_rng(seed)).var(axis=0)
        noise = 2.0 * machine.noise_std**2 / machine.sample_rate / machine.average
        before = float(np.median(np.sqrt(timing + noise / machine.levels**2)))
        size = before * np.sqrt(times**2 - 1.0)
        what, truth = make(share * size)
        worst = max(float(np.sum(what.gain.size**2)), what.tone[1] / machine.levels.max() / 3.0,
                    what.noise**2 / np.sum(machine.levels**2, axis=1).max() / 10.0)
        return (what, truth) if worst < 0.25 else None
    target = np.exp(rng.uniform(*np.log(_RMS)))
    base = mean(Disturbance())
    size = 0.02 / machine.top
    for _ in range(_STEPS):
        size *= 1.15
        change = mean(make(size)[0]) - base
        if np.sqrt(np.mean(change**2)) > target:
            return make(share * size)
    return None
