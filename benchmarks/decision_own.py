# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recordings of the package's own simulator, with what the loop must say of each."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

from decision_judge import Expected, TICKS
import numpy as np
from numpy.typing import NDArray
import sa_jitter_ros as sa
from sa_jitter_ros.simulation import (
    AdditiveNoise, band_limited, DeclaredJitter, Gearbox, Keyphasor, make_effects, mesh)
import trace_confusion
import yaml

Array = NDArray[np.float64]
CHANNELS = 'inner', 'outer'
_CYCLES, _REVOLUTIONS = 20, 425  # of an average, and of a recording of the plain gear
_QUIET = 1e6  # Hz: a keyphasor whose errors no vibration shows


@dataclass(frozen=True)
class Drawn:
    """
    A recording or several (fields of `.npz` files), what is declared, and what must come out.

    With `again`, what the report declares is declared, and the loop closed once more: `expected`
    is of the second report. With `page`, the text of `report.html` counts, too.
    """

    recordings: tuple[Mapping[str, Any], ...]
    declared: str
    expected: Expected
    again: bool = False
    page: bool = False


def parameter_text(model: Mapping[str, Any]) -> str:
    """Return the parameter file of `jitter_predictor` that declares a model."""
    return str(yaml.safe_dump({'jitter_predictor': {'ros__parameters': dict(model)}},
                              sort_keys=False))


def traced(effects: Mapping[str, Mapping[str, Any]]) -> Expected:
    """Return what must come out where effects with their parameters are missing."""
    sizes = {f'{name}.{key}': value for name, parameters in effects.items()
             for key, value in parameters.items()}
    return Expected(('traced',), (frozenset(effects),), sizes=sizes)


UNEXPLAINED = Expected(('unexplained',))


# --- the machine of the tutorial -----------------------------------------------------------------

_FLUCTUATES = 0.1, 2.0  # Hz
_SHOWS = 0.003  # relative fluctuation, which turns order 57 by 0.15 rad inside a trigger cycle


def tutorial(seed: int, *, seconds: float, fluctuation: float, declared: bool = True) -> Drawn:
    """
    Return the recording of docs/tutorial.md, the pulses detected as section 2 does.

    What is `declared` is right; else it is what section 4 declares, without the noise. A speed
    that fluctuates so much that averages show it may be named, by its true numbers.
    """
    ratio, noise = 183 / 76, 0.3
    machine = Gearbox(
        mesh('input', 19, harmonics=(1.0, 0.5, 0.25)), 10000.0, shafts={'input': ratio},
        speed=[(0.0, 16.6)], keyphasor=Keyphasor(rate=5000.0),
        fluctuation=band_limited(std=fluctuation, band=_FLUCTUATES, seed=seed, name='speed'),
        effects=[AdditiveNoise(noise, 'noise')], seed=seed)
    tach = machine.tach_waveform(0, round(5000 * seconds))
    fields = {'vibration': machine.vibration(0, round(10000 * seconds)), 'sample_rate': 10000.0,
              'pulse_times': sa.detect_pulses(tach, 5000.0, interpolate=False), 'ratio': ratio,
              'channel_names': ['housing'], 'units': ['g']}
    model = {'keyphasor_rate': 5000.0, 'trigger_speed': 16.6, 'trigger_cycles': 40, 'ratio': ratio,
             'orders': [19.0, 38.0, 57.0]}
    if not declared:
        return Drawn((fields,), parameter_text(model), Expected(
            changes={'noise.noise_std': noise}))
    low, high = _FLUCTUATES
    slope = 2.0 * np.pi * math.sqrt((low**2 + low * high + high**2) / 3.0)  # 1/s, RMS
    expected = Expected() if fluctuation < _SHOWS else Expected(
        ('none', 'traced'), optional=frozenset(('speed_fluctuation',)), sizes={
            'speed_fluctuation.acceleration_std': 2.0 * np.pi * 16.6 * fluctuation * slope,
            'speed_fluctuation.bandwidth': high / 16.6})
    return Drawn((fields,), parameter_text({**model, 'noise_std': noise}), expected)


def loop_example(seed: int) -> Drawn:
    """Return the recording of docs/closing_the_loop.md: 80 us of jitter that nobody declared."""
    machine = Gearbox(
        mesh('shaft', 8, harmonics=(1.0, 0.8, 0.6)), 5e3, speed=[(0.0, 25.0)], seed=seed,
        effects=[DeclaredJitter('normal', 8e-5), AdditiveNoise(0.02)])
    fields = {'vibration': machine.vibration(0, 36_000), 'sample_rate': 5e3,
              'pulse_times': machine.pulses(0.0, 7.2).times}
    model = {'keyphasor_rate': 20e3, 'trigger_speed': 25.0, 'trigger_cycles': 20,
             'orders': [8.0, 16.0, 24.0], 'noise_std': 0.02}
    return Drawn((fields,), parameter_text(model), traced({
        'excess_jitter': {'std': math.sqrt(8e-5**2 - (1 / 20e3)**2 / 12)}}))


# --- the machine of the confusion matrix ---------------------------------------------------------

def confusion(seed: int, names: Sequence[str], *, acquisitions: int = 24,
              declare_clock: bool = True) -> Drawn:
    """
    Return a machine of `trace_confusion`, with effects or with what no module knows.

    A clock that is declared is no missing effect.
    """
    marks, ticks = 'target_geometry' in names, 'keyphasor_quantisation' in names
    pulses, ratio = (4, 4.0) if marks else (1, 1.0)
    known = {name: dict(trace_confusion.EFFECTS[name]) for name in names
             if name in trace_confusion.EFFECTS}
    unknown = [trace_confusion.UNKNOWN[name]() for name in names if name not in known]
    gearbox = trace_confusion.machine(
        (*make_effects(known), *unknown), seed=seed, pulses=pulses, ratio=ratio, jitter=not ticks)
    model = trace_confusion.model(pulses=pulses, ratio=ratio)
    seconds = (acquisitions * model.trigger_cycles + 3) / trace_confusion.SPEED
    fields = {
        'vibration': gearbox.vibration(0, round(seconds * gearbox.sample_rate)),
        'sample_rate': gearbox.sample_rate, 'pulse_times': gearbox.pulses(0.0, seconds).times,
        'pulses_per_revolution': pulses, 'pulses_per_trigger': 1, 'ratio': ratio}
    rate = model.keyphasor_rate
    known.get('keyphasor_quantisation', {}).pop('period_std', None)
    if ticks and declare_clock:
        rate = known.pop('keyphasor_quantisation')['clock_rate']
    text = parameter_text({
        'keyphasor_rate': rate, 'trigger_speed': model.trigger_speed, 'ratio': ratio,
        'trigger_cycles': model.trigger_cycles, 'orders': list(model.orders),
        'pulses_per_revolution': pulses, 'pulses_per_trigger': 1, 'noise_std': model.noise_std,
        'sample_rate': model.sample_rate})
    expected = UNEXPLAINED if unknown else traced(_with_defaults(known)) if known else Expected()
    if ticks and declare_clock:
        expected = replace(expected, changes={TICKS: math.nan})
    return Drawn((fields,), text, expected)


def _with_defaults(effects: Mapping[str, Mapping[str, Any]]) -> Mapping[str, Mapping[str, Any]]:
    """Return effects with the bandwidths that the simulator takes where none is given."""
    usual = {'speed_fluctuation': {'bandwidth': 0.2}, 'phase_wander': {'bandwidth': 0.4},
             'amplitude_modulation': {'bandwidth': 0.4}}
    return {name: {**usual.get(name, {}), **parameters} for name, parameters in effects.items()}


# --- a plain gear, and what one may do to its recording ------------------------------------------

@dataclass
class Plain:
    """
    A gear on two channels and its keyphasor, all drawn; `clean` (channel, sample) has no noise.

    `true` and `pulses` are true and measured times in s, `turns` (sample,) the angle of the shaft
    of interest in revolutions, `model` what is declared.
    """

    rng: np.random.Generator
    rate: float
    time: Array
    turns: Array
    clean: Array
    true: Array
    pulses: Array
    noise: float
    model: dict[str, Any]
    expected: Expected = field(default_factory=Expected)
    page: bool = False

    @property
    def orders(self) -> list[float]:
        """Return the declared orders, the mesh first."""
        return list(self.model['orders'])

    @property
    def revolution(self) -> float:
        """Return the mean time of a revolution of the tach shaft in s."""
        return 1.0 / float(self.model['trigger_speed'])

    @property
    def top(self) -> float:
        """Return the frequency of the highest declared order in Hz."""
        return max(self.orders) * float(self.model['ratio']) / self.revolution


Change = Callable[[Plain], Any]


def plain(seed: int, *changes: Change, quiet: bool = False, wander: float | None = None) -> Drawn:
    """
    Return a plain gear after some changes, the noise added at the end.

    `quiet` pulses err too little to show; `wander` is the relative variation of the speed, drawn
    if it is not given.
    """
    made = _plain(np.random.default_rng([seed, 37]), seed, quiet, wander)
    for change in changes:
        change(made)
    noisy = made.clean + made.noise * made.rng.standard_normal(made.clean.shape)
    fields = {'vibration': noisy, 'sample_rate': made.rate, 'pulse_times': made.pulses,
              'ratio': made.model['ratio'], 'channel_names': list(CHANNELS)}
    return Drawn((fields,), parameter_text(made.model), made.expected, page=made.page)


def _plain(rng: np.random.Generator, seed: int, quiet: bool, wander: float | None) -> Plain:
    speed, ratio = float(rng.uniform(16.0, 28.0)), float(rng.choice([1.0, 1.375, 0.85]))
    teeth, rate = int(rng.integers(13, 26)), 12800.0
    drift = float(10.0 ** rng.uniform(-3.5, -2.5)) if wander is None else wander
    gearbox = Gearbox(
        (*mesh('shaft', teeth, harmonics=(1.0, 0.6, 0.3), channel_gains=(1.0, 0.7),
               sidebands={1.0: 0.12}, seed=seed),
         *mesh('shaft', 1, harmonics=(0.2, 0.1), channel_gains=(0.5, 1.0), seed=seed)),
        rate, shafts={'shaft': ratio}, speed=((0.0, speed),), seed=seed,
        fluctuation=band_limited(std=drift, band=(0.1, 2.0), seed=seed, name='speed'))
    samples = int(_REVOLUTIONS / speed * rate)
    time = np.arange(samples) / rate
    orders = [float(teeth * k) for k in (1, 2, 3)]
    clock = _QUIET if quiet else orders[-1] * ratio * speed / float(rng.uniform(0.1, 0.5))
    true = gearbox.pulses(0.0, float(time[-1])).true_times
    noise = float(10.0 ** rng.uniform(-1.7, -0.7))
    return Plain(rng, rate, time, gearbox.angle(time, 'shaft'), gearbox.vibration(0, samples),
                 true, true + rng.uniform(-0.5, 0.5, true.size) / clock, noise, {
                     'keyphasor_rate': clock, 'trigger_speed': speed, 'ratio': ratio,
                     'trigger_cycles': _CYCLES, 'orders': orders, 'noise_std': noise})


def lose_samples(count: int) -> Change:
    """Lose so many samples unnoticed, on all channels, in the middle third of the recording."""
    def change(made: Plain) -> None:
        at = int(made.time.size * made.rng.uniform(0.35, 0.65))
        kept = np.delete(np.arange(made.time.size), slice(at, at + count))
        made.clean, made.time, made.turns = made.clean[:, kept], made.time[kept], made.turns[kept]
        made.expected = replace(
            UNEXPLAINED, steps=((at / made.rate, count / made.rate),), cycle=made.revolution)
    return change


def load_step(made: Plain) -> None:
    """Let all orders lose 20 to 25 % at once."""
    share, place = made.rng.uniform(0.2, 0.25), made.rng.uniform(0.3, 0.7)
    made.clean = made.clean * np.where(made.time > place * made.time[-1], 1.0 - share, 1.0)
    made.expected = replace(UNEXPLAINED, unsteady=tuple((order, '') for order in made.orders))


def channel_step(made: Plain) -> None:
    """Let one channel lose 20 to 25 % at once."""
    share, place = made.rng.uniform(0.2, 0.25), made.rng.uniform(0.3, 0.7)
    step = np.where(made.time > place * made.time[-1], 1.0 - share, 1.0)
    made.clean = made.clean * np.stack((np.ones_like(step), step))
    made.expected = replace(
        UNEXPLAINED, unsteady=tuple((order, CHANNELS[1]) for order in made.orders))


def fading_path(made: Plain) -> None:
    """Let a second path of the mesh order come and go on one channel: 24 % of its amplitude."""
    fade = [band_limited(std=0.24, band=(0.02 / made.revolution / _CYCLES,
                                         0.4 / made.revolution / _CYCLES),
                         seed=int(made.rng.integers(1 << 30)), name=name).value(made.time)
            for name in ('in phase', 'beside')]
    wave = np.exp(2j * np.pi * made.orders[0] * made.turns)
    made.clean = made.clean + np.stack((
        np.real((fade[0] + 1j * fade[1]) * wave), np.zeros(made.time.size)))
    made.expected = replace(UNEXPLAINED, unsteady=((made.orders[0], CHANNELS[0]),))


def second_shaft(made: Plain) -> None:
    """Add the strong mesh of another shaft, order 6.52 of this one, and declare weak orders."""
    made.model['orders'] = [1.0, 2.0, *made.orders]
    for k, size in ((1, 1.0), (2, 0.5)):
        phases = made.rng.uniform(0.0, 2.0 * np.pi, (2, 1))
        made.clean = made.clean + size * np.cos(2.0 * np.pi * 6.52 * k * made.turns + phases)
    made.expected = Expected(never=('a tone that no shaft makes',))


def skew(size: float) -> Change:
    """Let the clock of the keyphasor be fast."""
    def change(made: Plain) -> None:
        made.pulses = made.pulses * (1.0 + size)
        made.page = True
        made.expected = traced({'clock_skew': {'skew': size}})
    return change


def ticks(made: Plain) -> None:
    """Let the declared clock time the pulses."""
    rate = made.model['keyphasor_rate']
    made.pulses = np.ceil(made.true * rate) / rate
    made.expected = replace(made.expected, changes={**made.expected.changes, TICKS: math.nan})


def no_noise(made: Plain) -> None:
    """Declare no noise, of which there is much."""
    made.noise = float(made.rng.uniform(0.1, 0.4))
    del made.model['noise_std']
    made.expected = replace(made.expected, changes={
        **made.expected.changes, 'noise.noise_std': made.noise})


def nothing_shown(made: Plain) -> None:
    """Let a sensor hang loose: noise, and no order of the machine."""
    made.clean = np.zeros_like(made.clean)
    made.expected = Expected(untested=True)
