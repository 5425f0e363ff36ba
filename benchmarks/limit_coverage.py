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
How often the 95 % limit of an effect covers its true size.

`python benchmarks/limit_coverage.py` draws what the inference reads: of effects on the timing the
pulses of a shaft and what a recovery makes of their errors (`machine`), of others the lines
(`lines`) or the missing pulses. It finds the median limit where the effect is not there, and puts
the effect in with half, once and twice that size. A limit that holds covers 95 % of them.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.effects.band import ACCELERATION_BAND, SLOW_BAND
from sa_jitter_ros.effects.evidence import Evidence, LineEvidence
from sa_jitter_ros.effects.lattice import Clock
from sa_jitter_ros.effects.speed_fluctuation import SpeedFluctuation
from sa_jitter_ros.effects.timing import Setting, SOURCE
from sa_jitter_ros.inference.limits import EffectLimit, limits
from sa_jitter_ros.inference.timing import read_timing
from sa_jitter_ros.inference.timing_data import steering, Stretch
from sa_jitter_ros.prediction.influence import AveragePulses
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import special
from scipy.signal import lfilter

Array = np.ndarray[Any, Any]
PERIOD, SHAFT_MARKS = 0.02, 4
MODEL = DeclaredModel(
    keyphasor_rate=20e3, trigger_speed=1.0 / PERIOD / SHAFT_MARKS, trigger_cycles=20,
    orders=(20.0, 40.0), ratio=SHAFT_MARKS, pulses_per_revolution=SHAFT_MARKS,
    pulses_per_trigger=1)
#: Standard deviation of the declared jitter in s.
UNIT = float(np.sqrt(MODEL.distribution.variance))
#: What recovered errors are wrong by, in parts of the declared jitter.
NOISE = 0.05
#: Pulses, correlation of those with memory, relative swing of the speed of a run-up and down.
_COUNT, _MEMORY, _SWING = 400, 0.7, 2e-3
_MARKS = np.array([0.5, -0.3, 0.2, -0.4]) / np.sqrt(0.135)
#: Acquisitions, cycles and lines, and what noise of a line is measured from.
_ACQUISITIONS, _CYCLES, _LINES, _SQUARES = 20, 20, 5, 20
_SIZES = 0.5, 1.0, 2.0
_ROUNDED = 1e-3  # of a tick: to what numbers hold pulse times


def machine(seed: int | Sequence[int], *, count: int = _COUNT, scale: float = 1.0,
            excess: float = 0.0, rho: float = 0.0, wander: float = 0.0, skew: float = 0.0,
            marks: Sequence[float] | None = None, delay: float = 0.0, shocks: float = 0.0,
            hum: float = 0.0, noise: float = NOISE, swing: float = 0.0, walk: float = 5e-5,
            shake: float = 0.0, band: tuple[float, float] | None = None, clock: float = 0.0,
            sway: float = 0.0) -> Stretch:
    """
    Return the stretch of a shaft whose speed walks at random; sizes in units of the jitter.

    Pulses have the declared jitter times `scale`, `excess` normal errors of correlation `rho`,
    uneven `marks`, `shocks` that fade, and `hum`; the source moves by `wander`, flat in a `band`
    or else slower; the clock has a `skew` and ticks of a rate `clock`, the path a `delay` in s.
    The speed has steps of `walk`, a `swing`, and a `sway` in the `band`, its bends inside the
    cycles those of a `shake`.
    """
    rng = np.random.default_rng([29, *np.atleast_1d(seed)])
    index = np.arange(count)
    speed = walk * lfilter([1.0], [1.0, -0.99], rng.standard_normal(count))
    slow = swing * np.sin(2.0 * np.pi * index / count)
    if sway and band:
        speed += sway * flat(rng, count, band)
    motion = PERIOD * np.cumsum(1.0 + speed + slow)
    errors = scale * rng.uniform(-0.5, 0.5, count) / MODEL.keyphasor_rate
    drawn = rng.standard_normal(count) * np.sqrt(1.0 - rho**2)
    errors += excess * UNIT * lfilter([1.0], [1.0, -rho], drawn)
    if marks is not None:
        errors += UNIT * np.asarray(marks)[index % len(marks)]
    errors += shocks * UNIT * lfilter([1.0], [1.0, -0.7], rng.uniform(size=count) < 0.03)
    errors += hum * UNIT * np.cos(2.0 * np.pi * 0.1371 * index)
    times = motion + errors
    if clock:
        times = np.ceil(times * clock) / clock
    shape = np.hanning(17) / np.sqrt(np.sum(np.hanning(17) ** 2))
    source = wander * UNIT * recovered_source(flat(rng, count, band) if band else np.convolve(
        rng.standard_normal(count + 16), shape, 'valid'))
    late = errors + source[0] + skew * (motion - motion[0]) + delay
    wrong, bends = recovery_noise(rng, count)
    late = late + noise * UNIT * wrong
    # the vibration shows all but a turn, which takes longer where the speed is low
    late -= late.mean() * np.gradient(motion) * (count - 1) / (motion[-1] - motion[0])
    bends = noise * UNIT * bends
    shaken = shake * UNIT * flat(rng, count, ACCELERATION_BAND) if shake else 0.0
    setting = Setting(MODEL, UNIT, index, times, times - late, times[0], times)
    return Stretch(setting, np.ones(count, np.bool_), late, noise * UNIT, np.inf,
                   (bends + shaken + source[1] + np.gradient(np.gradient(motion)) / 2.0)[:-1],
                   noise * UNIT * bend_noise(), np.inf)


def flat(rng: np.random.Generator, count: int, band: tuple[float, float]) -> Array:
    """Return some values of a unit motion whose spectrum is flat in a band."""
    frequency = np.fft.rfftfreq(8 * count)
    inside = (frequency >= band[0]) & (frequency <= band[1])
    drawn = np.fft.irfft(inside * np.fft.rfft(rng.standard_normal(8 * count)), 8 * count)
    return np.asarray(drawn[:count] / np.sqrt(2.0 * (band[1] - band[0])))


def recovered_source(source: Array) -> Array:
    """Return the errors and bends (2, pulse) that a fit makes of a source that moves in time."""
    even = np.concatenate([source, source[::-1]])  # without a step where it begins again
    frequency = np.fft.rfftfreq(even.size)
    seen = steering(SOURCE, frequency, frequency)[:, 1:3].T * np.fft.rfft(even)
    return np.fft.irfft(seen, even.size)[:, :source.size]


def recovery_noise(rng: np.random.Generator, count: int) -> Array:
    """
    Return what errors and bends (2, count) of a least squares fit to white noise are wrong by.

    The fit is that of hat functions and of u (1 - u) and u (1 - u) (2 u - 1); errors have size 1.
    """
    u = (np.arange(64) + 0.5) / 64
    frequency = np.fft.rfftfreq(count)
    hat = 1.0 - u + u * np.exp(2j * np.pi * frequency)[:, None]
    bend = np.broadcast_to(u * (1.0 - u), hat.shape)
    shapes = np.stack([hat, bend, bend * (2.0 * u - 1.0)], axis=-1)
    inverse = np.linalg.inv(np.einsum('fui,fuj->fij', shapes.conj(), shapes) / u.size)
    inverse /= np.fft.irfft(inverse[:, 0, 0], count)[0]
    root = np.linalg.cholesky(inverse)
    drawn = np.fft.rfft(rng.standard_normal((3, count))).T
    return np.asarray(np.fft.irfft(np.einsum('fij,fj->fi', root, drawn), count, axis=0)[:, :2].T)


def lines(seed: int | Sequence[int], *, std: float = 0.0, gain: float = 0.0, lost: float = 0.0
          ) -> Evidence:
    """
    Return lines with noise of 1, of which `std` is not declared, and a common slow `gain`.

    Of the pulses a share `lost` is missing.
    """
    rng = np.random.default_rng([31, *np.atleast_1d(seed)])
    shape = _ACQUISITIONS, _CYCLES, _LINES
    density = np.sqrt((1.0 + std**2) * rng.chisquare(_SQUARES, (_ACQUISITIONS, _LINES)) / _SQUARES)
    fine = flat(rng, 4 * _ACQUISITIONS * _CYCLES, (SLOW_BAND[0] / 4.0, SLOW_BAND[1] / 4.0))
    modulation = gain * fine.reshape(_ACQUISITIONS, _CYCLES, 1, 4).mean(axis=-1)
    none = np.zeros(0)
    evidence = LineEvidence(
        np.arange(float(_LINES)), none, none, density,
        modulation + rng.standard_normal(shape), np.ones(_LINES))
    return Evidence(
        replace(MODEL, noise_std=1.0, sample_rate=20e3), (AveragePulses(none),), none, none, none,
        none, rng.geometric(1.0 - lost, _COUNT) - 1, Clock(0.0, 0.0), evidence)


def limit_of(drawn: Stretch | Evidence, name: str) -> float:
    """Return the limit of an effect beside nothing else, infinite where there is none."""
    limit = _limit(drawn, name)
    return np.inf if limit.upper is None else limit.upper


def _limit(drawn: Stretch | Evidence, name: str) -> EffectLimit:
    timing = read_timing([drawn], names=frozenset()) if isinstance(drawn, Stretch) else None
    (found,) = limits(timing, drawn if isinstance(drawn, Evidence) else lines(0),
                      list(EFFECTS.keys() - {name}))
    return found


@cache
def bend_noise() -> float:
    """Return how much larger what the bends are wrong by is than what the errors are."""
    return float(np.std(recovery_noise(np.random.default_rng(0), 40_000)[1]))


@dataclass(frozen=True)
class Case:
    """
    How to `draw` an effect of some size, and the limit that the `fisher` information allows.

    Of a `slowest` clock the limit is one from below, and sizes are periods; the jitter has an
    `interval` around 1, and sizes are what it is more than 1.
    """

    name: str
    draw: Callable[[Sequence[int], float], Stretch | Evidence]
    fisher: float = np.nan
    slowest: bool = False
    interval: bool = False

    def size(self, limit: EffectLimit) -> float:
        """Return the size of a limit."""
        if self.slowest:
            return 1.0 / limit.lower if limit.lower else np.inf
        return (np.inf if limit.upper is None else limit.upper) - self.interval

    def covers(self, limit: EffectLimit, size: float) -> bool:
        """Return whether a limit admits a size."""
        lowest = limit.lower if self.interval and limit.lower is not None else 0.0
        return bool(self.size(limit) >= size * (1.0 - _ROUNDED) and size + self.interval >= lowest)


# Standard errors of a power of declared errors, and of normal ones, in parts of it, and of a mean.
_ERROR = UNIT * np.sqrt(1.0 + NOISE**2)
_UNIFORM, _NORMAL, _MEAN = np.sqrt([0.8 / _COUNT, 2.0 / _COUNT, 1.0 / _COUNT])
_RAD = 2.0 * np.pi * MODEL.fundamental_frequency
_TURN = 2.0 * np.pi * MODEL.trigger_speed
_BENDS = NOISE * UNIT * bend_noise()
_PAIRS = _LINES * (_LINES - 1)
_ALL = _ACQUISITIONS * _CYCLES


def _timing(name: str, make: Callable[[float], Mapping[str, Any]], fisher: float = np.nan,
            **options: bool) -> Case:
    return Case(name, lambda seed, size: machine(seed, **make(size)), fisher, **options)


def _of_lines(name: str, parameter: str, fisher: float) -> Case:
    return Case(name, lambda seed, size: lines(seed, **{parameter: size}), fisher)


CASES: Mapping[str, Case] = {
    'excess_jitter': _timing('excess_jitter', lambda size: {'excess': size / UNIT},
                             _ERROR * np.sqrt(1.645 * _UNIFORM)),
    'correlated_jitter': _timing(
        'correlated_jitter', lambda size: {'excess': size / UNIT, 'rho': _MEMORY}),
    'phase_wander': _timing('phase_wander', lambda size: {'wander': size / _RAD / UNIT}),
    'phase_wander, flat': _timing(
        'phase_wander', lambda size: {'wander': size / _RAD / UNIT, 'band': SLOW_BAND}),
    'clock_skew': _timing('clock_skew', lambda size: {'skew': size},
                          1.96 * _ERROR * np.sqrt(12.0 / _COUNT**3) / PERIOD),
    'path_delay': _timing('path_delay', lambda size: {'delay': size, 'swing': _SWING},
                          1.96 * _ERROR * np.sqrt(2.0) * _MEAN / _SWING),
    'target_geometry': _timing(
        'target_geometry', lambda size: {'marks': size / _TURN / UNIT * _MARKS},
        _ERROR * _MEAN * _TURN * np.sqrt(special.chndtrinc(special.chdtri(3, 0.5), 3, 0.05))),
    'jitter_scale': _timing('jitter_scale', lambda size: {'scale': 1.0 + size},
                            1.96 * 0.5 * _UNIFORM, interval=True),
    'speed_fluctuation': _timing(
        'speed_fluctuation', lambda size: {
            'walk': 0.0, 'shake': size / SpeedFluctuation.of_ripple(UNIT, MODEL).acceleration_std},
        SpeedFluctuation.of_ripple(_BENDS * np.sqrt(1.645 * _NORMAL), MODEL).acceleration_std),
    'keyphasor_quantisation': _timing(
        'keyphasor_quantisation', lambda size: {'clock': 1.0 / size if size else 0.0},
        slowest=True),
    'missing_pulses': _of_lines('missing_pulses', 'lost', 3.0 / _COUNT),
    'additive_noise': _of_lines('additive_noise', 'std', np.sqrt(
        1.645 * np.sqrt(2.0 / (_ACQUISITIONS * _LINES * _SQUARES)))),
    'amplitude_modulation': _of_lines('amplitude_modulation', 'gain', np.sqrt(
        1.645 * np.sqrt(2.0 / _ALL / _PAIRS)))}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--draws', type=int, default=1000, help='of each size')
    parser.add_argument('--first', type=int, default=0, help='seed of the first draw')
    parser.add_argument('--effects', nargs='+', choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    sizes = ' | '.join(f'{share:g} x' for share in _SIZES)
    print(f'| effect | median limit | over that of Fisher | covered at {sizes} |')
    print('|---|---|---|' + '---|' * len(_SIZES))
    seeds = range(options.first, options.first + options.draws)
    for label in options.effects:
        case, number = CASES[label], list(CASES).index(label)
        median = float(np.median([case.size(_limit(case.draw([1, number, k], 0.0), case.name))
                                  for k in seeds]))
        covered = []
        for place, share in enumerate(_SIZES):
            size = share * median
            found = [_limit(case.draw([2 + place, number, k], size), case.name) for k in seeds]
            hits = sum(case.covers(limit, size) for limit in found)
            covered.append(f'{100.0 * hits / options.draws:.1f} %')
        over = f'{median / case.fisher:.2f}' if np.isfinite(case.fisher) else '-'
        print(f'| {label} | {median:.3g} | {over} | {" | ".join(covered)} |', flush=True)


if __name__ == '__main__':
    main()
