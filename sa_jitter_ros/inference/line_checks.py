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
Checks of the lines: whether all move together, as pulse errors and load move them.

With the pulse errors taken out, the phases of all lines follow the angle of the shaft. Paths that
change, and resonances that the speed crosses, turn lines each by itself, and make amplitudes
follow the speed. No effect of the package does that.
"""

import math

import numpy as np
from sa_jitter_ros.arrays import Array, IntArray
from sa_jitter_ros.effects.evidence import LineEvidence
from sa_jitter_ros.effects.path_delay import STEADY
from sa_jitter_ros.inference.expectation import Lines
from sa_jitter_ros.inference.gathering import cycle_amplitudes, hidden_lines
from sa_jitter_ros.inference.observation import Observation
from sa_jitter_ros.inference.residual import NOTICEABLE
from sa_jitter_ros.inference.timing_checks import chance, Check, DRAWS, SEED
from sa_jitter_ros.inference.timing_data import TAPER, taper
from sa_jitter_ros.inference.unsteady import SCATTER
from scipy import special

LINES = 'lines'
_NEAR = 1.5  # ratio of frequencies whose power is alike
_EVENTS = 4.5  # kurtosis; a gain that swings by a third loses cycles, which makes 4


def check_gain(lines: LineEvidence) -> Check:
    """
    Test whether single events make what is taken for a modulation, by the kurtosis of the gain.

    Whitened, a step or a loss of signal for a while stands out, and noise in a band does not.
    """
    weight = lines.radial_noise**-2.0
    # less sources, an acquisition has other amplitudes at its ends
    radial = lines.radial if lines.with_sources is None else lines.with_sources
    gain = (radial @ (weight / weight.sum())).ravel()
    number = np.arange(gain.size) if lines.number is None else lines.number.ravel()
    every = np.interp(np.arange(number[-1] + 1), number, gain)
    # a gap makes kinks beside it
    inside = number[1:-1][number[2:] - number[:-2] == 2]
    waves = np.fft.rfft((every - every.mean()) * taper(every.size))
    drawn = np.random.default_rng(SEED).standard_normal((DRAWS, every.size))
    like = np.fft.irfft(np.fft.rfft(drawn) * np.sqrt(_smooth(waves)), every.size)
    found, null = (_tails(item, every.size, inside) for item in (
        waves, np.fft.rfft(like * taper(every.size))))
    p_value = chance(float(found), null) if found > _EVENTS else 1.0
    return Check(p_value, LINES, float(np.std(gain)),
                 'the amplitudes grow and shrink together by single events, as steps or losses of '
                 f'signal make them: {float(np.std(gain)):.2g} RMS')


def check_channels(lines: LineEvidence) -> Check:
    """Test whether the averages of one channel grow and shrink by themselves, as a drift does."""
    weight = lines.radial_noise**-2.0 * lines.radial.shape[1]
    means, checks = lines.radial.mean(axis=1), []
    names = np.unique(lines.channel)
    changes = [float(np.std(means[:, lines.channel == name])) for name in names]
    for name in names[np.argsort(changes)[::-1]].tolist() if names.size > 1 else ():
        parts = [lines.channel == name, lines.channel != name]
        own, others = (means[:, part] @ weight[part] / weight[part].sum() for part in parts)
        apart, freedom = own - others, len(own) - 1
        noise = sum(1.0 / weight[part].sum() for part in parts) + SCATTER**2
        size = float(np.std(apart, ddof=1))
        checks.append(Check(
            min(1.0, float(special.chdtrc(freedom, freedom * size**2 / noise)) * names.size),
            LINES, size, f'the amplitudes of channel {name} change by {size:.2g} RMS from average '
            'to average, relative to the other channels'))
    return min(checks, key=lambda check: check.p_value,
               default=Check(1.0, LINES, 0.0, 'the amplitudes of one channel'))


def _smooth(waves: Array) -> Array:
    """Return the mean power (..., frequency) of frequencies that are near one."""
    place = np.arange(waves.shape[-1])
    low = np.floor(place / _NEAR).astype(int)
    high = np.minimum(np.ceil(place * _NEAR).astype(int) + 1, place.size)
    power = np.cumsum(np.abs(waves) ** 2, axis=-1)
    power = np.concatenate([np.zeros_like(power[..., :1]), power], axis=-1)
    return np.asarray((power[..., high] - power[..., low]) / (high - low))


def _tails(waves: Array, count: int, inside: IntArray) -> Array:
    """Return the kurtosis of series (..., time) `inside`, with power alike at all frequencies."""
    ends = math.ceil(TAPER * count)
    inside = inside[(inside >= ends) & (inside < count - ends)]
    white = np.fft.irfft(waves / np.sqrt(_smooth(waves)), count)[..., inside]
    return np.asarray(np.mean(white**4, axis=-1) / np.mean(white**2, axis=-1) ** 2)


def check_lines(observation: Observation, lines: Lines, variance: Array) -> tuple[Check, ...]:
    """
    Return the checks of the amplitudes of all acquisitions of a recording that has lines.

    Of the scatter of each order its `variance` (order,) is explained, half of it in phase.
    """
    if not lines.count or not observation.recoveries:
        return ()
    amplitude = lines.of(observation.stacked('corrected'))
    noise = np.sqrt(np.maximum(np.mean(lines.of(observation.stacked('noise')) ** 2, axis=0),
                               0.5 * variance[lines.order]))
    order = observation.orders[lines.order]
    run, number, late = _runs(observation)
    turned = amplitude * np.exp(
        -2j * np.pi * observation.model.cycle_length * np.outer(number, order))
    # late pulses are ahead by an angle that follows the speed of their acquisition
    turned *= np.exp(-2j * np.pi * np.outer(
        late / observation.periods * observation.model.cycle_length, order))
    weight = order**2 * np.mean(np.abs(amplitude), axis=0) ** 2 / noise**2
    # all lines of an acquisition may be late by one time
    late = np.angle(turned / _means(run, turned)) / order @ (weight / weight.sum())
    turned = turned * np.exp(-1j * np.outer(late, order))
    mean = _means(run, turned)
    size = np.abs(mean).mean(axis=0)
    ratio, noise = turned * np.abs(mean) / mean / size, noise / size
    # the angle of a speed that rises bends, which makes orders leak into those beside them
    rises = _accelerations(observation)
    ratio = ratio - np.outer(rises, rises @ (ratio - 1.0)) / max(
        float(rises @ rises), np.finfo(np.float64).tiny)
    return (_turns(observation, ratio, noise, order, run.size - int(run.max()) - 1),
            _turns_in_cycles(observation, lines),
            *_follows(observation, np.abs(ratio), noise))


def _runs(observation: Observation) -> tuple[Array, Array, Array]:
    """
    Return the run of each acquisition, the number of its first trigger pulse, and its delay.

    A run is an unbroken stretch of a recording: how many cycles lie between two is not known. By
    the delay (s) the pulses of the acquisition are late in the mean.
    """
    runs, late = [], []
    for item, recording, number in zip(observation.acquisitions, observation.recording.tolist(),
                                       observation.first_numbers.tolist()):
        recovery = observation.recoveries[recording]
        runs.append((recording, next((part.start for part in recovery.stretches
                                      if part.start <= number < part.stop), -1)))
        errors = recovery.errors[item.first:item.first + item.times.size]
        late.append(float(np.nan_to_num(errors.mean())))
    return (np.unique(runs, axis=0, return_inverse=True)[1].ravel(), observation.first_numbers,
            np.array(late))


def _means(run: Array, values: Array) -> Array:
    """Return the mean of values (acquisition, line) over the run of each acquisition."""
    total = np.zeros((int(run.max()) + 1, values.shape[1]), values.dtype)
    np.add.at(total, run, values)
    return np.asarray((total / np.bincount(run)[:, None])[run])


def _accelerations(observation: Observation) -> Array:
    """Return how each acquisition's trigger period grows (acquisition,), less their mean."""
    grows = np.array([np.polyfit(np.arange(item.bridged.size), item.bridged, 2)[0]
                      for item in observation.acquisitions])
    return np.asarray(grows - grows.mean())


def _turns(observation: Observation, ratio: Array, noise: Array, order: Array, freedom: int
           ) -> Check:
    """Test whether a line turns by itself, by `freedom` acquisitions beyond the means of runs."""
    freedom = max(freedom - 1, 1)  # of the acceleration
    power = np.sum(ratio.imag**2, axis=0) / freedom
    own = np.sqrt(np.maximum(power - noise**2, 0.0))
    chance = special.chdtrc(freedom, freedom * power / (noise**2 + SCATTER**2))
    worst = int(np.argmin(chance))
    return Check(min(1.0, float(chance[worst]) * order.size), LINES, float(own[worst]),
                 f'the phase of {observation.words(order[worst])} changes by {own[worst]:.2g} '
                 'rad RMS from average to average, relative to the other orders')


def _turns_in_cycles(observation: Observation, lines: Lines) -> Check:
    """
    Test whether a line turns by itself from cycle to cycle, beside what turns all of them.

    One that turns much is not worth comparing and is looked at, too. Noise turns a line as much as
    it makes it longer and shorter.
    """
    hidden = hidden_lines(observation, lines)
    every = Lines(*(np.append(*both) for both in zip(
        (lines.channel, lines.order), (hidden.channel, hidden.order))))
    order = observation.orders[every.order]
    cycles = every.of(cycle_amplitudes(observation))
    ratio = cycles / cycles.mean(axis=1, keepdims=True) - 1.0
    noise = np.maximum(np.mean(ratio.real**2, axis=(0, 1)), np.finfo(np.float64).tiny)
    weight = order / noise
    turn = ratio.imag - np.multiply.outer(ratio.imag @ weight / (weight @ order), order)
    power = np.mean(turn**2, axis=(0, 1))
    freedom = len(cycles) * (cycles.shape[1] - 1)
    own = np.sqrt(np.maximum(power - noise, 0.0))
    # a line that turns by x rad in each cycle loses x^2 / 2 of its average
    chance = special.fdtrc(freedom, freedom, power / (noise + 2.0 * NOTICEABLE))
    worst = int(np.argmin(chance))
    return Check(min(1.0, float(chance[worst]) * order.size), LINES, float(own[worst]),
                 f'the phase of {observation.words(order[worst])} changes by {own[worst]:.2g} '
                 'rad RMS from cycle to cycle, relative to the other orders')


def _follows(observation: Observation, size: Array, noise: Array) -> tuple[Check, ...]:
    """Test whether the amplitudes follow the speed."""
    speed = 1.0 / observation.periods
    speed = speed / speed.mean() - 1.0
    spread = float(np.std(speed))
    freedom = speed.size - 4  # of the parabola and the acceleration
    if freedom < 1 or spread < STEADY:
        return ()
    shape = np.stack([np.ones(speed.size), speed / spread, (speed / spread) ** 2], axis=1)
    fitted = shape @ np.linalg.lstsq(shape, size, rcond=None)[0]
    total, left = np.var(size, axis=0), np.mean((size - fitted) ** 2, axis=0)
    explained = total - left
    worst = int(np.argmax(explained / noise**2))
    if not explained[worst] > SCATTER**2:
        return ()
    ratio = (total[worst] - left[worst]) / 2.0 / (left[worst] / freedom)
    return (Check(float(special.fdtrc(2, freedom, ratio)) * size.shape[1], LINES,
                  math.sqrt(float(explained[worst])),
                  f'the amplitudes follow the speed: {math.sqrt(float(explained[worst])):.2g} of '
                  'an amplitude RMS, as a resonance makes them'),)
