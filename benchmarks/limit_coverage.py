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
How often the 95 % limit of an effect on the timing covers its true size.

`python benchmarks/limit_coverage.py` draws pulses of a shaft and what a recovery makes of their
errors (`machine`), finds the median limit where the effect is not there, and puts the effect in
with half, once and twice that size. A limit that holds covers 95 % of them.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from sa_jitter_ros.effects.timing import Setting, SOURCE
from sa_jitter_ros.inference.limits import largest
from sa_jitter_ros.inference.timing import read_timing
from sa_jitter_ros.inference.timing_data import steering, Stretch
from sa_jitter_ros.prediction.model import DeclaredModel
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
_COUNT, _MEMORY = 400, 0.7
_SIZES = 0.5, 1.0, 2.0
_RAD = 2.0 * np.pi * MODEL.fundamental_frequency
# How to draw an effect of a size in the unit of its parameter, and the limit that the Fisher
# information allows: 1.96 standard errors of a slope of either sign, 1.64 of a power.
_ERROR = UNIT * np.sqrt(1.0 + NOISE**2)
EFFECTS: Mapping[str, tuple[Callable[[float], Mapping[str, float]], float]] = {
    'excess_jitter': (lambda size: {'excess': size / UNIT},
                      _ERROR * np.sqrt(1.645 * np.sqrt(2.0 / _COUNT))),
    'correlated_jitter': (lambda size: {'excess': size / UNIT, 'rho': _MEMORY}, np.nan),
    'phase_wander': (lambda size: {'wander': size / _RAD / UNIT}, np.nan),
    'clock_skew': (lambda size: {'skew': size},
                   1.96 * _ERROR * np.sqrt(12.0 / _COUNT**3) / PERIOD)}


def machine(seed: int | Sequence[int], *, count: int = _COUNT, scale: float = 1.0,
            excess: float = 0.0, rho: float = 0.0, wander: float = 0.0, skew: float = 0.0,
            marks: Sequence[float] | None = None, delay: float = 0.0, shocks: float = 0.0,
            hum: float = 0.0, noise: float = NOISE) -> Stretch:
    """
    Return the stretch of a shaft whose speed walks at random; sizes in units of the jitter.

    Pulses have the declared jitter times `scale`, `excess` normal errors of correlation `rho`,
    uneven `marks`, `shocks` that fade, and `hum`; the source moves by `wander`; the clock has a
    `skew`, the path a `delay` in s.
    """
    rng = np.random.default_rng([29, *np.atleast_1d(seed)])
    index = np.arange(count)
    speed = 5e-5 * lfilter([1.0], [1.0, -0.99], rng.standard_normal(count))
    slow = 2e-3 * np.sin(2.0 * np.pi * index / count) if delay else 0.0
    motion = PERIOD * np.cumsum(1.0 + speed + slow)
    errors = scale * rng.uniform(-0.5, 0.5, count) / MODEL.keyphasor_rate
    drawn = rng.standard_normal(count) * np.sqrt(1.0 - rho**2)
    errors += excess * UNIT * lfilter([1.0], [1.0, -rho], drawn)
    if marks is not None:
        errors += UNIT * np.asarray(marks)[index % len(marks)]
    errors += shocks * UNIT * lfilter([1.0], [1.0, -0.7], rng.uniform(size=count) < 0.03)
    errors += hum * UNIT * np.cos(2.0 * np.pi * 0.1371 * index)
    times = motion + errors
    shape = np.hanning(17) / np.sqrt(np.sum(np.hanning(17) ** 2))
    source = wander * UNIT * recovered_source(np.convolve(
        rng.standard_normal(count + 16), shape, 'valid'))
    late = errors + source[0] + skew * (motion - motion[0])
    late = late + delay * (PERIOD / np.gradient(motion) - 1.0)
    wrong, bends = recovery_noise(rng, count)
    late = late + noise * UNIT * wrong
    late -= late.mean()
    bends = noise * UNIT * bends
    setting = Setting(MODEL, UNIT, index, times, times - late)
    return Stretch(setting, np.ones(count, np.bool_), late, noise * UNIT, np.inf,
                   (bends + source[1] + np.gradient(np.gradient(motion)) / 2.0)[:-1],
                   float(np.std(bends)), np.inf)


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


def limit_of(part: Stretch, name: str) -> float:
    """Return the limit of an effect beside nothing else, infinite where there is none."""
    timing = read_timing([part], names=frozenset())
    assert timing is not None
    effect = largest(timing, name)
    return np.inf if effect is None else float(next(iter(effect.values.values())))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--draws', type=int, default=1000, help='of each size')
    parser.add_argument('--effects', nargs='+', choices=list(EFFECTS), default=list(EFFECTS))
    options = parser.parse_args()
    sizes = ' | '.join(f'{share:g} x' for share in _SIZES)
    print(f'| effect | median limit | over that of Fisher | covered at {sizes} |')
    print('|---|---|---|' + '---|' * len(_SIZES))
    for number, name in enumerate(options.effects):
        make, fisher = EFFECTS[name]
        median = float(np.median([limit_of(machine([1, number, k]), name)
                                  for k in range(options.draws)]))
        covered = []
        for place, share in enumerate(_SIZES):
            size = share * median
            hits = sum(limit_of(machine([2 + place, number, k], **make(size)), name) >= size
                       for k in range(options.draws))
            covered.append(f'{100.0 * hits / options.draws:.1f} %')
        over = f'{median / fisher:.2f}' if np.isfinite(fisher) else '-'
        print(f'| {name} | {median:.3g} | {over} | {" | ".join(covered)} |', flush=True)


if __name__ == '__main__':
    main()
