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
The distribution of the amplitude for averages of few cycles, for which no limit theorem holds.

The draws are the same for every order and every call (fixed seed), so a prediction is a function
of its model. The mean square is not sampled: it is exact.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.angle_error import angle_spread, AngleErrorProcess, unit_nodes
from sa_jitter_ros.prediction.distributions import Empirical
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments
from sa_jitter_ros.prediction.parts import offset_of, Parts
from sa_jitter_ros.pulses.angle_law import LINEAR

#: ``known(count)``: pulse errors (count, pulse) in fundamental cycles of as many averages.
KnownErrors = Callable[[int], Array]

_SEED = 20190215
_BUDGET = 2_000_000  # phasors in one distribution: some hundredths of a second
# Draws: errors of 0.003 and 0.001 of a median's rank. The more cycles, the less heavy the tails.
_FEWEST, _MOST = 8192, 65536
#: Fewest draws of long averages.
COARSEST = 512
_IN_EACH = 256  # draws in a scenario that counts by itself: 6 % of its standard deviation
LONGEST, MOST_PHASORS = 20_000, 50_000  # cycles of an average drawn, and times orders
_MOST_POINTS = 1000  # of a process drawn at once: the cube of it is its time
# Places inside a cycle where errors are small, more for each cycle of the order that they spread.
_PLACES, _PLACES_PER_TURN, _MOST_PLACES = 6, 16.0, 96
# Cycles of the order beyond which single precision loses the angle, or the square of errors.
_NARROW, _WIDE = 1e-12, 30.0
# Values of a table, whose averages may have so few that rounding must not part them: of any number
# of cycles under the linear law, of this many under the others.
_VALUES, _LUMPY = 30, 9
# Generating vector of a lattice of 2^m points, m up to 20, by Cools, Kuo and Nuyens, "Constructing
# embedded lattice rules for multivariate integration", SIAM J. Sci. Comput. 28 (2006) 2162-2188.
_LATTICE = np.array([
    1, 182667, 469891, 498753, 110745, 446247, 250185, 118627, 245333, 283199, 408519, 391023,
    246327, 126539, 399185, 461527, 300343, 69681, 516695, 436179, 106383, 238523, 413283, 70841,
    47719, 300129, 113029, 123925, 410745, 211325, 17489, 511893, 40767, 186077, 519471, 255369,
    101819, 243573, 66189, 152143])
_LEAST = 1e-16  # probability of an error
_CHORDS = 2.0  # cycles of the order from which on an angle is straight between places
_NEAR_ZERO = 0.5  # square of an angle up to which a series gives its sine
# (-1)^n / (2 n + 3)!, highest first: all for double precision, the last for single.
_SINE = [(-1.0) ** n / math.factorial(2 * n + 3) for n in range(7)][::-1]
_SINGLE = 4
_MUCH = 1e-3  # of the mean square, of which differences have digits
_BELIEVED = 8.0  # standard errors of the mean of a control
_COLLINEAR = 1e-5  # variance of a sum of controls over that of one


@dataclass(frozen=True)
class SampledDistribution:
    """
    The distribution of |X| by draws |X| = center + offset (orders, n) and an exact mean square.

    The draws have `weights` (orders, n), or are equally likely. Offsets keep the digits of draws
    that hardly differ. Of 8192 evenly drawn averages with weights a median has its rank to 0.003,
    one standard error, and the standard deviation is good to 0.5 %; of random draws, 1 %.
    """

    center: Array
    offset: Array = field(repr=False)
    mean_square: Array
    weights: Array | None = field(default=None, repr=False)

    @property
    def draws(self) -> Array:
        """Return the draws of |X| (orders, n)."""
        return np.asarray(self.center[:, None] + self.offset)

    @cached_property
    def _sorted(self) -> tuple[Array, Array | None]:
        """Return sorted offsets, and the probability up to each unless all are equally likely."""
        if self.weights is None:
            return np.sort(self.offset, axis=1), None
        order = np.argsort(self.offset, axis=1)
        below = np.cumsum(np.take_along_axis(self.weights, order, axis=1), axis=1)
        np.maximum.accumulate(below, axis=1, out=below)  # a weight may be negative
        return (np.take_along_axis(self.offset, order, axis=1),
                np.asarray(np.clip(below / below[:, -1:], 0.0, 1.0)))

    @cached_property
    def variance(self) -> Array:
        """Return Var|X|: that of the draws, or what E|X| leaves of the mean square if much."""
        if self.weights is None:
            return np.asarray(np.var(self.offset, axis=1))
        mean = np.sum(self.weights * self.offset, axis=1)
        drawn = np.sum(self.weights * (self.offset - mean[:, None]) ** 2, axis=1)
        left = self.mean_square - (self.center + mean) ** 2
        return np.asarray(np.maximum(np.where(left > _MUCH * self.mean_square, left, drawn), 0.0))

    @property
    def mean(self) -> Array:
        """Return E|X|, so that mean^2 + variance = E|X|^2."""
        return np.asarray(np.sqrt(np.maximum(self.mean_square - self.variance, 0.0)))

    def cdf(self, amplitude: ArrayLike) -> Array:
        """Return P(|X| <= amplitude), (orders, k) for amplitudes of shape (k,) or (orders, k)."""
        y = np.atleast_2d(np.asarray(amplitude, float))
        y = np.broadcast_to(y, (self.offset.shape[0], y.shape[-1])) - self.center[:, None]
        if y.shape[1] == 1:  # not worth sorting
            inside = self.offset <= y
            found = (inside.mean(axis=1) if self.weights is None
                     else np.clip(np.sum(self.weights * inside, axis=1), 0.0, 1.0))[:, None]
        else:
            values, below = self._sorted
            counts = np.array([np.searchsorted(row, at, side='right')
                               for row, at in zip(values, y)])
            found = (counts / values.shape[1] if below is None else np.take_along_axis(
                np.pad(below, ((0, 0), (1, 0))), counts, axis=1))
        return np.where(np.isnan(y), np.nan, found)

    def ppf(self, probability: ArrayLike) -> Array:
        """
        Return quantiles of |X|, shape (orders, k) for k probabilities in (0, 1).

        Each is a draw, so that it is one of the values where these are few. Raises ParameterError
        for a probability outside (0, 1).
        """
        p = require_probabilities(probability)
        values, below = self._sorted
        count = values.shape[1]
        if below is None:
            index = np.broadcast_to(np.ceil(p * count).astype(int) - 1, (len(values), p.size))
        else:
            index = np.array([np.searchsorted(row, p) for row in below])
        return np.asarray(self.center[:, None] + np.take_along_axis(
            values, np.clip(index, 0, count - 1), axis=1))


def most_cycles(processes: Sequence[AngleErrorProcess], orders: int) -> int:
    """Return how many cycles averages have at most that can be drawn in about a second."""
    pulsed = all(hasattr(process, 'draw_pulses') for process in processes)
    drawn = _MOST_POINTS if any(hasattr(item, 'draw_angle') or hasattr(item, 'draw_gain')
                                for item in processes) else LONGEST
    possible = all(any(hasattr(process, f'draw_{what}') for what in ('pulses', 'angle', 'gain'))
                   for process in processes)
    most = min(drawn, LONGEST, MOST_PHASORS // max(orders, 1)) * possible
    return most // (1 if pulsed else _PLACES)


def drawn_averages(model: DeclaredModel, processes: Sequence[Any], *,
                   known: KnownErrors | None = None, each: Array | None = None
                   ) -> tuple[Array, Array]:
    """
    Return X - 1 (order, draw) of averages of a `model`, and noise, E|n|^2 1.

    `processes` can be drawn (`most_cycles`).
    ``known(count)`` returns pulse errors (count, n) in fundamental cycles that come on top of the
    random ones, of all N_t - 1 + weights.pulses pulses or of the average's own N_t + 1. The errors
    `each` (scenario, n) come on top of the same random ones each, so that draws are (order,
    scenario, draw).

    Both parts of X - 1 are right to some digits of single precision, relative to themselves. They
    have double precision of tables of few values, where averages have few, too, and of errors too
    large or too small for single precision.
    """
    g, trigger_cycles, weights = np.asarray(model.orders), model.trigger_cycles, model.weights
    spread = max(model.orders) * angle_spread(processes)
    pulsed = [process for process in processes if hasattr(process, 'draw_pulses')]
    inside = [process for process in processes if process not in pulsed]
    bare = weights is LINEAR and not inside
    rough = known is not None or each is not None
    chords = spread > _CHORDS and not any(hasattr(item, 'draw_gain') for item in inside)
    u, w = unit_nodes(1 if bare else number_of_places(spread, rough))
    if chords and not bare:
        u = np.linspace(0.0, 1.0, u.size)
    count = _IN_EACH if each is not None else affordable_draws(
        g.size, trigger_cycles, u.size)
    rng = np.random.default_rng(_SEED)
    shape = (trigger_cycles + weights.pulses - 1, count)
    errors = _pulse_errors(pulsed, rng, shape)
    noise = rng.normal(0.0, np.sqrt(0.5), (2, count))
    if known is not None:
        errors = errors + weights.padded(known(count), trigger_cycles).T
    extra = [process.draw_angle(rng, trigger_cycles, u, count) for process in inside
             if hasattr(process, 'draw_angle')]
    gains = [process.draw_gain(rng, trigger_cycles, u, count) for process in inside
             if hasattr(process, 'draw_gain')]
    few = (bare or trigger_cycles <= _LUMPY) and any(map(_of_few_values, pulsed))
    kind = np.float32 if _NARROW < spread < _WIDE and not few else np.float64
    swell = (np.prod(gains, axis=0) - 1.0).astype(kind, order='C') if gains else None

    def averages(errors: Array) -> Array:
        angle = errors if bare else (weights.path(errors.T, u, trigger_cycles).transpose(1, 2, 0)
                                     + sum(extra))
        angle = (2.0 * np.pi * angle).astype(kind, order='C')
        if chords and not bare:
            angle = angle.transpose(1, 0, 2).reshape(u.size, -1)
        draws = np.empty((g.size, count), complex)
        for row, order in zip(draws, g):
            turned = kind(order) * angle
            if bare or chords:
                real, imag = _linear_cycles(turned)
            else:
                real, imag = _bent_cycles(turned, w, swell)
            row.real, row.imag = (part.reshape(-1, count).mean(axis=0) for part in (real, imag))
        return draws

    found = averages(errors) if each is None else np.stack(
        [averages(errors + row[:, None]) for row in weights.padded(each, trigger_cycles)], axis=1)
    return found, noise[0] + 1j * noise[1]


def number_of_places(spread: float, rough: bool = False) -> int:
    """Return at how many places in a cycle to draw errors of so many cycles of the order."""
    fewest = 2 * _PLACES if rough else _PLACES
    return min(math.ceil(fewest + _PLACES_PER_TURN * spread), _MOST_PLACES)


def _pulse_errors(processes: Sequence[Any], rng: np.random.Generator, shape: tuple[int, int]
                  ) -> Array:
    """
    Return the sum of pulse errors (pulse, draw) in fundamental cycles.

    Those of one process of independent errors lie evenly, in each pulse and in each pair of them:
    on a lattice as far as it has dimensions, those in the middle first. A standard deviation then
    scatters half as much as that of random draws.
    """
    total: Array = np.zeros(shape)
    pulses, count = shape
    even = [item for item in processes if hasattr(item, 'pulses_at')][:1]
    for process in processes:
        if process not in even:
            total = total + process.draw_pulses(rng, shape)
            continue
        place = rng.random(shape)
        middle = np.argsort(np.abs(np.arange(pulses) - 0.5 * (pulses - 1)), kind='stable')
        middle = middle[:_LATTICE.size]
        # The remainder of a power of two, and that of a number below 2, take a tenth of the time.
        steps = np.arange(count) * _LATTICE[:middle.size, None] & (count - 1)
        shifted = steps / count + place[middle, :1]
        place[middle] = shifted - (shifted >= 1.0)
        total = total + process.pulses_at(np.clip(place, _LEAST, 1.0 - _LEAST))
    return total


def _of_few_values(process: Any) -> bool:
    """Return whether pulse errors are of a table of few values, so that averages have few, too."""
    distribution = getattr(process, 'distribution', None)
    return isinstance(distribution, Empirical) and distribution.values <= _VALUES


def affordable_draws(orders: int, trigger_cycles: int, places: int) -> int:
    """Return how many averages of so many phasors are worth their time and memory."""
    phasors = orders * (trigger_cycles + 3) * places
    largest = max(_MOST // max(trigger_cycles // 4, 1), _FEWEST)
    count = int(np.clip(_BUDGET // phasors, _FEWEST, largest))
    most = min(MOST_PHASORS, LONGEST * orders)
    count = max(COARSEST, min(count, COARSEST * most // phasors))
    return int(2 ** math.floor(math.log2(count)))  # as a lattice needs


def moments_of(draws: Array) -> AverageMoments:
    """Return the moments of X of draws (order, draw) of X - 1."""
    mean = draws.mean(axis=1)
    off = draws - mean[:, None]
    return AverageMoments(1.0 + mean, np.mean(np.abs(off) ** 2, axis=1), np.mean(off**2, axis=1))


def distribution_of(off: Array, parts: Parts) -> SampledDistribution:
    """
    Return the distribution of |X| by draws `off` (order, draw) of R + j I with these `parts`.

    The draws get the weights that give power and second moments their exact means. |X| is nearly a
    sum of these, and so is what falls below a quantile: means and quantiles scatter less.
    """
    size = parts.size
    real, imag = off.real, off.imag
    offset = offset_of(size[:, None], size[:, None], np.zeros((size.size, 1)), real, imag)
    ii, ri, rr = (parts.ii + parts.i**2, parts.ri + parts.r * parts.i, parts.rr + parts.r**2)
    power = 2.0 * size * parts.r + rr + ii
    controls = np.stack([
        offset * (2.0 * size[:, None] + offset) - power[:, None], imag - parts.i[:, None],
        imag**2 - ii[:, None], real * imag - ri[:, None], real**2 - rr[:, None]], axis=1)
    return SampledDistribution(size, offset, np.asarray(size**2 + power), _calibrated(controls))


def _calibrated(controls: Array) -> Array:
    """
    Return weights (order, draw) of sum 1 that give controls (order, i, draw) the mean 0.

    They are those of the estimator by regression; the controls are overwritten. A control whose
    mean the draws contradict is rounding and does not count; nor does what is left of a control
    beside the others, if that is.
    """
    count = controls.shape[-1]
    mean = controls.mean(axis=-1, keepdims=True)
    controls -= mean
    products = controls @ controls.transpose(0, 2, 1) / count
    scale = np.sqrt(np.diagonal(products, axis1=1, axis2=2))[..., None]
    known = np.abs(mean) < _BELIEVED / math.sqrt(count) * scale
    factor = np.where(known, 1.0 / np.where(known, scale, 1.0), 0.0)
    normal = factor * products * factor.transpose(0, 2, 1)
    inverse = np.linalg.pinv(normal, rcond=_COLLINEAR, hermitian=True)
    slope = ((mean * factor).transpose(0, 2, 1) @ inverse) * factor.transpose(0, 2, 1)
    return np.asarray((1.0 - (slope @ controls)[:, 0]) / count)


def _linear_cycles(angle: Array) -> tuple[Array, Array]:
    """
    Return both parts of int_0^1 exp(j e_k(u)) du - 1, cycles on axis 0, under the linear law.

    `angle` are pulse errors in radians of the order, pulses on axis 0; the precision is theirs.
    """
    half = 0.5 * (angle[1:] - angle[:-1])
    less = _less_than_sine(half)
    middle = half
    middle += angle[:-1]
    behind = np.sin(0.5 * middle)
    behind *= 2.0 * behind
    imag = np.sin(middle, out=middle)
    imag -= less * imag
    real = less * behind
    real -= less
    real -= behind
    return real, imag


def _less_than_sine(half: Array) -> Array:
    """Return 1 - sin(half) / half, which is small where half is."""
    square = half * half
    series = _SINE[-len(_SINE) if half.dtype == np.float64 else -_SINGLE:]
    less = np.full_like(square, series[0])
    near = np.minimum(square, _NEAR_ZERO)
    for term in series[1:]:
        less *= near
        less += term
    less *= near
    if square.max(initial=0.0) > _NEAR_ZERO:
        far = square > _NEAR_ZERO
        less[far] = 1.0 - np.sin(half[far]) / half[far]
    return less


def _bent_cycles(angle: Array, weights: Array, swell: Array | None) -> tuple[Array, Array]:
    """Return the same of angles (cycle, place, draw) at places of such weights, and a gain - 1."""
    w = weights.astype(angle.dtype)
    real, imag = np.empty((2, len(angle), angle.shape[2]), angle.dtype)
    for k, turned in enumerate(angle):  # one cycle after the other stays in the cache
        less, across = np.sin(0.5 * turned), np.sin(turned)
        less *= -2.0 * less
        if swell is not None:
            less += swell[k] * (1.0 + less)
            across += swell[k] * across
        real[k], imag[k] = w @ less, w @ across
    return real, imag


def require_probabilities(probability: ArrayLike) -> Array:
    """Return probabilities of shape (k,); raise ParameterError for one outside (0, 1)."""
    try:
        p = np.atleast_1d(np.asarray(probability, float))
    except (TypeError, ValueError) as error:
        raise ParameterError(
            f'probabilities {probability!r} must be numbers between 0 and 1') from error
    if not np.all((p > 0.0) & (p < 1.0)):
        raise ParameterError(f'probabilities {p} must lie between 0 and 1, both excluded')
    return p
