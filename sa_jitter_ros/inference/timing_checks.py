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
Checks of what a fit of the timing leaves, in ways that no effect has a part in.

Each has a p value from draws of the fitted model. None names a culprit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.effects.effect import RARE
from sa_jitter_ros.effects.timing import PULSES, SOURCE
from sa_jitter_ros.inference.line_search import APART
from sa_jitter_ros.inference.timing_choice import Choice, Chooser
from sa_jitter_ros.inference.timing_data import ALIASES, FEWEST, steering, Stretch, TimingData
from sa_jitter_ros.inference.timing_fit import JITTER, TimingFit
from sa_jitter_ros.inference.timing_shape import EDGE, through

_DECLARED, _SCALED, _TICKS = 'declared', 'scaled', 'ticks'
#: Draws of what is there by chance, and their seed.
DRAWS, SEED = 400, 11
_BINS = 5  # of frequency, whose excess power is taken together
_BESIDE = 8  # frequencies on either side of a sinusoid, that show what is there without it
_FEWEST = 40  # pulses whose distribution is looked at
_BEYOND = 100  # pulses that are drawn before and behind a stretch


@dataclass(frozen=True)
class Check:
    """
    A test of what the fit leaves: its p value and what it looked at, in words.

    `direction` is that in which the time moves; `size` (s) is the standard deviation of what is
    left there.
    """

    p_value: float
    direction: str
    size: float
    text: str


def check_timing(chooser: Chooser, choice: Choice) -> tuple[Check, ...]:
    """Return all checks of the best fit; few where the ticks of a clock hide what is left."""
    if choice.quantised:
        return ()
    tests = [(_power, PULSES), (_sinusoid, PULSES)]
    if not chooser.data.referenced:  # other pulses show nothing of the source
        # of a motion of the source nothing is known but its bandwidth, and that it has one
        moves = any(EFFECTS[name].pulse_times_correct for name in choice.best & EFFECTS.keys())
        tests += [(_narrow, SOURCE)] if moves else [(_power, SOURCE), (_sinusoid, SOURCE)]
    fit = choice.fit
    # where a smooth motion does not end, nothing is known: it may leave out any frequency
    found = [max((check(fit, fit.beside_motion(alias), direction)
                  for alias in range(ALIASES.size)), key=lambda item: item.p_value)
             for check, direction in tests]
    if chooser.on_ticks(fit):  # near the edges of ticks, jitter makes errors of a whole one
        return tuple(found)
    lasting = [name for name, item in fit.spectra.items()
               if name in EFFECTS and len(item.upper) > 1]
    return (*found, _shape(chooser, choice),
            *(_events(chooser, choice, name) for name in lasting),
            *(_drift(choice, name) for name in lasting), _steadiness(chooser, choice))


def _power(fit: TimingFit, inverse: Array, direction: str) -> Check:
    """
    Test whether the power in a direction is the expected one, in neighbouring bins together.

    `inverse` (bin, 3, 3) is that of the cross-spectrum.
    """
    data = fit.data
    size = data.size
    window = np.ones(min(_BINS, size.size))

    def statistic(ratio: Array) -> Array:
        gain = size * (ratio - 1.0 - np.log(np.maximum(ratio, 1e-300)))
        return np.array([np.convolve(row, window, 'same') for row in np.atleast_2d(gain)])

    draws = np.random.default_rng(SEED).gamma(size, 1.0 / size, (DRAWS, size.size))
    ratio = fit.excess(direction, inverse)
    gain = statistic(ratio)[0]
    top = int(np.argmax(gain))
    near = slice(max(top - _BINS // 2, 0), top + _BINS // 2 + 1)
    more = np.sum((size * np.abs(ratio - 1.0) * fit.floor(direction, inverse))[near]) / size.sum()
    return Check(chance(float(gain[top]), statistic(draws).max(axis=1)), direction,
                 data.unit * math.sqrt(more),
                 f'the power of the {direction} from {data.frequency[near][0]:.3g} to '
                 f'{data.frequency[near][-1]:.3g} cycles a trigger cycle is '
                 f'{float(np.average(ratio[near], weights=size[near])):.3g} times the expected')


def _sinusoid(fit: TimingFit, inverse: Array, direction: str) -> Check:
    """Test whether a sinusoid in a direction stands out; `inverse` is as in `_power`."""
    size, unit = _waves(fit, inverse, direction)
    return _highest(fit, direction, size, unit, np.exp(-size))


def _narrow(fit: TimingFit, inverse: Array, direction: str) -> Check:
    """Test whether a sinusoid stands out of a random motion whose spectrum nobody knows."""
    size, unit = _waves(fit, inverse, direction)
    count = len(fit.data.lengths)  # ordinates of each frequency
    near, far = 3 * count, (3 + _BESIDE) * count
    place, sums = np.arange(size.size), np.append(0.0, np.cumsum(size))
    ends = np.clip([place - far + 1, place - near + 1, place + near, place + far], 0, size.size)
    beside = sums[ends[1]] - sums[ends[0]] + sums[ends[3]] - sums[ends[2]]
    known = ends[1] - ends[0] + ends[3] - ends[2]
    ratio = size / np.maximum(np.maximum(known, beside), 1.0)
    return _highest(fit, direction, size, unit, (1.0 + ratio) ** -known)


def _waves(fit: TimingFit, inverse: Array, direction: str) -> tuple[Array, Array]:
    """Return the power of sinusoids (ordinate,) over the expected one, and that of a unit one."""
    data = fit.data
    inverse = inverse[data.bin]
    wave = np.einsum('fij,fj->fi', data.passed, steering(direction, data.frequency, data.frequency)
                     )[data.bin]
    known = np.einsum('fi,fij,fj->f', wave.conj(), inverse, wave).real
    return np.abs(np.einsum('fi,fij,fj->f', wave.conj(), inverse, fit.left)) ** 2 / known, known


def _highest(fit: TimingFit, direction: str, size: Array, unit: Array, by_chance: Array
             ) -> Check:
    """Return the test of the sinusoid that is there least `by_chance` (ordinate,)."""
    data, frequency = fit.data, fit.data.each
    tried = frequency > APART / data.longest  # slower ones are a drift
    top = int(np.argmin(np.where(tried, by_chance, 2.0)))
    count = int(np.count_nonzero(tried))
    return Check(-math.expm1(count * math.log1p(-min(float(by_chance[top]), 1.0 - 1e-9))),
                 direction, data.unit * math.sqrt(2.0 * size[top] / unit[top] / data.longest),
                 f'a sinusoid of the {direction} of {frequency[top]:.4g} cycles a trigger cycle')


def _shape(chooser: Chooser, choice: Choice) -> Check:
    """
    Test whether the pulse errors are drawn as the model draws them, by skewness and kurtosis.

    Those of the recovered errors, whitened, are compared with those of drawn errors: of the
    declared distribution, and normal ones for all that is beside it. Jitter larger than declared
    may have the declared distribution, too.
    """
    fit, data = choice.fit, chooser.data
    white = 1.0 / np.sqrt(fit.spectrum[:, 1, 1].real)
    p_value = _likeness(chooser, choice, white)
    names = [*fit.spectra, *([JITTER] if JITTER in fit.place else [])]
    power = sum(float(np.average(fit.contribution(name)[:, 1, 1].real, weights=data.size))
                for name in names)
    return Check(p_value, PULSES, data.unit * math.sqrt(power),
                 'the pulse errors are distributed as no effect makes them (skewness, kurtosis)')


def _events(chooser: Chooser, choice: Choice, name: str) -> Check:
    """
    Test whether single events make what is taken for normal errors with a memory.

    An event that the memory lets fade is what the matched filter of a component shows best.
    """
    fit, data = choice.fit, chooser.data
    total = fit.spectrum[:, 1, 1].real
    made = fit.contribution(name)[:, 1, 1].real
    even = np.linspace(0.0, 0.5, data.longest)
    response = np.interp(data.frequency, even, _minimum_phase(
        np.interp(even, data.frequency, np.log(made + np.finfo(np.float64).eps))))
    return Check(_likeness(chooser, choice, response.conj() / total), fit.moves(name),
                 data.unit * math.sqrt(float(np.average(made, weights=data.size))),
                 f'the pulse errors have the memory of {name}, but come from single events, each '
                 'of which fades (skewness, kurtosis)')


def _drift(choice: Choice, name: str) -> Check:
    """
    Test whether an effect is so slow that the recording holds few independent values of it.

    Those are the cycles times the bandwidth of a flat spectrum whose power scatters as much. Of a
    few swings nobody can tell a random motion from any other drift.
    """
    fit, data = choice.fit, choice.fit.data
    made = fit.density(name, fit.parameters)[0][0]
    power = float(np.average(made, weights=data.size))
    values = data.cycles * power**2 / float(np.average(made**2, weights=data.size))
    return Check(0.0 if values < FEWEST else 1.0, fit.moves(name),
                 data.unit * math.sqrt(power),
                 f'a drift of the {fit.moves(name)}, of which the recording holds about '
                 f'{values:.2g} independent values: too few to tell {name} from any other one')


def _minimum_phase(log_power: Array) -> Array:
    """Return the response, causal as its inverse, of a log power from frequency 0 to a half."""
    cepstrum = np.fft.irfft(log_power)
    folded = cepstrum.copy()
    half = cepstrum.size // 2
    folded[1:half] *= 2.0
    folded[half + 1:] = 0.0
    return np.asarray(np.exp(0.5 * np.fft.rfft(folded)))


def _likeness(chooser: Chooser, choice: Choice, gain: Array) -> float:
    """Return the p value of skewness and kurtosis of errors through a filter."""
    data = chooser.data
    p_values = []
    items = [item for item in data.stretches if item.errors.size >= _FEWEST]
    found = [_moments(_filtered(chooser.left(choice.fit, item), gain, data)) for item in items]
    for kind in _kinds(choice) if items else ():
        seen, null = np.zeros(2), np.zeros((2, DRAWS))
        for item, moments in zip(items, found):
            draws = _moments(_filtered(_drawn(choice, item, kind), gain, data))
            middle = np.median(draws, axis=1)
            seen += item.errors.size * (moments - middle)
            null += item.errors.size * (draws - middle[:, None])
        p_values.append(min(1.0, len(seen) * min(
            chance(abs(value), np.abs(draws)) for value, draws in zip(seen, null))))
    return max(p_values, default=1.0)


def _steadiness(chooser: Chooser, choice: Choice) -> Check:
    """Test whether the pulse errors are as large in all parts of the recording."""
    fit, data = choice.fit, choice.fit.data
    items = [item for item in data.stretches if item.errors.size >= _FEWEST]
    seen = [power for item in items for power in _powers(fit, chooser.left(fit, item))]
    if len(seen) < 2:
        return Check(1.0, PULSES, 0.0, 'the size of the pulse errors')
    logs, p_value = np.log(np.array(seen)), 0.0
    place = np.arange(logs.size) - 0.5 * (logs.size - 1)  # most change along the recording
    for kind in _kinds(choice):
        null = np.log(np.array([power for item in items for power in _powers(
            fit, _drawn(choice, item, kind))]))
        each = (chance(float(np.var(logs)), np.var(null, axis=0)),
                chance(float(abs(place @ logs)), np.abs(place @ null)))
        p_value = max(p_value, min(1.0, len(each) * min(each)))
    power = float(np.average(fit.spectrum[:, 1, 1].real, weights=data.size))
    size = float(np.ptp(np.exp(logs - np.median(null))))
    return Check(p_value, PULSES, data.unit * math.sqrt(size * power),
                 f'the power of the pulse errors is {float(np.exp(logs.max() - logs.min())):.2g} '
                 'times larger in some parts of the recording than in others')


def _kinds(choice: Choice) -> Sequence[str]:
    """
    Return the shapes that errors may have: declared ones, scaled ones, those of a clock's ticks.

    What is beside them may be normal errors.
    """
    starts = choice.fit.starts
    scaled = (_SCALED,) if JITTER in starts and starts[JITTER][0] > 0.0 else ()
    return _DECLARED, *scaled, *([_TICKS] if choice.setting.clock_rate else [])


def _powers(fit: TimingFit, errors: Array) -> list[Array]:
    """Return the power (part, ...) of errors (..., pulse), whitened, in parts of a stretch."""
    values = _filtered(errors, 1.0 / np.sqrt(fit.spectrum[:, 1, 1].real), fit.data)
    parts = np.array_split(values, max(1, values.shape[-1] // _FEWEST), axis=-1)
    return [np.asarray(np.mean(part**2, axis=-1)) for part in parts]


def _drawn(choice: Choice, item: Stretch, kind: str) -> Array:
    """Return drawn errors (draw, pulse) in units, as the recovery shows them."""
    fit, data = choice.fit, choice.fit.data
    rng = np.random.default_rng([SEED, int(item.setting.index[0])])  # others in each stretch
    # neither end follows from the other, as it would in what a filter of waves makes
    beyond = min(item.errors.size // 2, _BEYOND)
    shape = DRAWS, item.errors.size + 2 * beyond
    power = math.exp(fit.starts[JITTER][0]) if JITTER in fit.starts else 1.0
    if kind == _TICKS:
        tick = 1.0 / (choice.setting.clock_rate * data.unit)
        power = min(power, tick**2 / 12.0)
        declared = math.sqrt(12.0 * power) * rng.uniform(-0.5, 0.5, shape)
    else:
        power = power if kind == _SCALED else min(power, 1.0)  # normal errors make the rest
        declared = math.sqrt(power) / data.unit * np.asarray(
            choice.setting.model.distribution.draw(rng, shape))
    gain = np.abs(data.passed[:, 1, 1])
    total = fit.spectrum[:, 1, 1].real
    rest = np.sqrt(np.maximum(total - data.measured * power * gain**2, 0.0))
    drawn = through(declared, gain, data) + through(rng.standard_normal(shape), rest, data)
    return drawn[:, beyond:-beyond]


def _filtered(values: Array, gain: Array, data: TimingData) -> Array:
    return through(values, gain, data)[..., EDGE:-EDGE]


def _moments(values: Array) -> Array:
    """Return skewness and logarithm of kurtosis of each row."""
    z = values - values.mean(axis=-1, keepdims=True)
    square = z * z
    power = square.mean(axis=-1)
    return np.array([(square * z).mean(axis=-1) / power**1.5,
                     np.log((square * square).mean(axis=-1) / power**2)])


def chance(value: float, draws: Array) -> float:
    """Return the chance of draws as large as a value; their tail is taken as exponential."""
    high = float(np.quantile(draws, 1.0 - RARE))
    if value <= high:
        return float(np.mean(draws >= value))
    return RARE * math.exp((high - value) / float(np.mean(draws[draws > high] - high)))
