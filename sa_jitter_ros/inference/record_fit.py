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
The record fit: pulse errors and all lines of a whole recording in one least-squares problem.

The vibration is read at even steps of the angle that the pulses tell. Every trigger cycle then
differs from a sum of lines by the derivative of that sum times what the angle is wrong by:

* the errors of its two pulses, times hat functions;
* bends of the speed inside the cycle, times u (1 - u) and u (1 - u) (2 u - 1);

and by a gain that all lines share. These states of the cycles have a banded normal matrix; the
amplitudes of the lines border it (Schur complement). Gauss-Newton steps read the vibration again
at the corrected angle, so that nothing is linearised at the end. The sizes of the states are
estimated with them (expectation-maximisation).

Undeclared orders of other shafts and sidebands leak into trigger cycles that are too short to keep
them apart, and would be taken for pulse errors. So the fit looks for them in the spectrum of what
it leaves, over angle (orders) and over time (tones): the sharper peak decides which it is.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.noise import row_medians
from sa_jitter_ros.effects.clock_skew import USUAL_SKEW
from sa_jitter_ros.effects.timing import ROUNDING
from sa_jitter_ros.inference.slips import mend_slips
from sa_jitter_ros.prediction.influence import trigger_periods
from sa_jitter_ros.pulses.resampling import interpolate
from scipy.fft import irfft, next_fast_len, rfft
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.special import gammaincc, gammainccinv

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]

# The band that is read ends so far above the highest declared order: by orders, and by lines of a
# trigger cycle. What lies further away does not leak into a cycle.
_BEYOND, _BEYOND_LINES = 6.0, 3.0
_EDGE = 1.15  # of the band, where the low pass ends
#: Of the sample rate: beyond it, filters may end.
FULL_BAND = 0.4
_MOST_TAKEN = 0.5  # of the noise near the lines, that states may take up
_SAMPLES = 3.7  # in a period of the band's end
# Bends in parts of the declared jitter, and gains: a first guess when they become free, and the
# least that they keep always: a bend of nothing would be certain.
_FREE, _LEAST_BEND, _LEAST_GAIN = 0.1, 0.003, 1e-3
_LEAST_JITTER = 0.1  # of the declared one
# Turns of the highest declared order, beyond which its phase tells errors ambiguously.
_MOST_TURNS = 0.25
_MOST_LINES = 60  # undeclared ones, half of them before bends and gains are free
# Steps that a search may take; what its last one may change, in standard errors.
_MOST_STEPS, _SETTLED = 20, 0.1
# A peak is a line where noise exceeds it once in so many spectra, by some margin for its floor;
# it must not be far below the strongest, which may leave images of itself.
_FALSE, _MARGIN, _SHARE = 1e-3, 1.25, 0.3
_SHARPER = 1.3  # in power, over angle than over time or the reverse
_FEWEST_SIDES = 3  # lines as far from declared ones that show a shaft
#: Bins between lines, or cycles in a stretch between waves, that are told apart.
APART = 1.5
_ACCURACY = 1e-5  # of the RMS: amplitudes that resampling may make
_FINE = 0.3  # bins between frequencies that are tried
_PRUNED_EARLY, _PRUNED = 25.0, 4.0  # mean power of a line in its variances that keeps it
_SKIRT = 24  # bins beside a line, of which the median is the floor; half an order is one, too
_SLOPE_GAIN = 0.7
_SLOPE_LINES = 0.7  # share of the declared lines that must stand out of the noise with a slope
# The last fit expects pulse errors that are so many times as large as they, or their standard
# errors, are, so that they are hardly shrunk.
_WEAK = 3.0


@dataclass(frozen=True)
class RecordFit:
    """
    Pulse errors and lines of a stretch of a recording.

    `errors` and `standard_errors` (pulse,) in s, measured minus true, less the turn of all lines
    that leaves their mean 0;
    `roughness` (s) is the RMS of what their second differences are wrong by. `bends` (cycle, 2)
    are the factors of u (1 - u) and of u (1 - u) (2 u - 1) in the error inside a cycle (s),
    `bend_standard_errors` (2,) their standard errors, infinite where the vibration tells nothing
    of them. `orders` (order,), the first of them `declared`, and `tones` (tone,) in Hz are the
    lines; `amplitudes` (channel, order) and `tone_amplitudes` (channel, tone) complex peak
    amplitudes; `amplitude_errors` (channel, order + tone) the standard errors of their real and
    imaginary parts. `turning` (line,) tells which orders, and tones after them, turn with the
    shafts: orders that shafts must have, those that a varying speed shows to turn, and sidebands
    of several lines. `jitter_std` (s) is the estimated size of the pulse errors; `expected_std`
    (3,) in s are the sizes of errors and bends that the fit expected, towards 0, the errors
    towards a line that grows by `trend` s in a second. Declared lines that stand out of the noise
    have `held` the angle to the pulses: others go along with any drift.
    """

    errors: Array
    standard_errors: Array
    roughness: float
    bends: Array
    bend_standard_errors: Array
    declared: int
    orders: Array
    tones: Array
    amplitudes: ComplexArray
    tone_amplitudes: ComplexArray
    amplitude_errors: Array
    turning: BoolArray
    jitter_std: float
    expected_std: Array
    trend: float
    held: bool


def fit_record(samples: Array, sample_rate: float, start_time: float, times: Array, *,
               measured: BoolArray, cycle_length: float, orders: Sequence[float],
               jitter_std: float, wider: float = 1.0,
               known: tuple[Array, Array] | None = None) -> RecordFit:
    """
    Fit consecutive trigger cycles of a recording.

    `samples` (sample, channel) begin at `start_time` (s); `times` (pulse,) are the trigger pulses,
    of which some are `measured` (pulse,) and the others were put in evenly. `cycle_length` is r;
    `jitter_std` (s) the declared size of the pulse errors. Lines are looked for up to little
    beyond the highest order, or in a band that is `wider` by this factor. `known` are undeclared
    orders, and tones (Hz), of an earlier fit; then none is looked for.
    """
    return OpenRecord(samples, sample_rate, start_time, times, measured=measured,
                      cycle_length=cycle_length, orders=orders, jitter_std=jitter_std,
                      top=band_end(times, sample_rate, cycle_length, orders, wider)).fit(known)


def independent_power(third: Array) -> float:
    """
    Return the power of independent errors (s^2) that makes third differences of pulses (s).

    A shaft that runs up makes second differences, too.
    """
    return float(np.mean(third**2)) / 20.0


def band_end(times: Array, sample_rate: float, cycle_length: float, orders: Sequence[float],
             wider: float) -> float:
    """Return the order at which the band of `fit_record` ends."""
    return min(wider * (max(orders) + max(_BEYOND, _BEYOND_LINES / cycle_length)), max(
        max(orders), FULL_BAND * sample_rate * float(np.diff(times).mean()) / cycle_length))


class OpenRecord:
    """What all fits of a stretch of a recording have in common: its band, and where they begin."""

    def __init__(self, samples: Array, sample_rate: float, start_time: float, times: Array, *,
                 measured: BoolArray, cycle_length: float, orders: Sequence[float],
                 jitter_std: float, top: float, trend: float = 0.0) -> None:
        """
        Read the band that ends at order `top`; the others are those of `fit_record`.

        The errors are expected to grow by `trend` s in a second, as elsewhere in the recording.
        """
        band, rate = _low_passed(
            samples, sample_rate, top * cycle_length / float(np.diff(times).mean()))
        self._begin = States(band, rate, start_time, times, measured, cycle_length,
                             np.array(orders), top, jitter_std)
        self._begin.follow_trend(trend)

    def fit(self, known: tuple[Array, Array] | None = None) -> RecordFit:
        """Fit the stretch, as `fit_record`."""
        states = copy(self._begin)
        states.size = states.size.copy()
        states.fit_amplitudes()
        _search(states, known)
        states.settled = True
        for _ in range(_MOST_STEPS):
            if states.step() < _SETTLED * states.unsure:
                break
        return states.result()


def _search(states: 'States', known: tuple[Array, Array] | None) -> None:
    """
    Fit states and lines by turns until no line is found any more.

    Lines that are `known` come after the first steps, too: high ones follow a trend that the
    declared ones have shown.
    """
    look, lines, mended = known is None, known or ((), ()), 0
    states.step()
    while True:
        for _ in range(2):
            states.step()
        (orders, tones), lines = states.new_lines() if look else lines, ((), ())
        if len(orders) or len(tones):
            states.add(orders, tones)
            states.fit_amplitudes()
            if look:
                states.refine()
                states.fit_amplitudes()
        elif states.all_free:
            if mended == _MOST_STEPS or not mend_slips(states):
                break
            mended += 1
        else:
            states.free_all()
            for _ in range(4):
                states.step()
            if look:
                states.prune(_PRUNED_EARLY)
                states.fit_amplitudes()
    if look:
        states.let_stand()
        for _ in range(_MOST_STEPS):  # each 0.6 of the one before where an order is near
            moved = states.refine()
            states.fit_amplitudes()
            states.step()
            if moved < _SETTLED:
                break
        states.prune(_PRUNED)
        states.fit_amplitudes()


def _low_passed(samples: Array, rate: float, top: float) -> tuple[Array, float]:
    """Return the samples up to 1.15 `top` (Hz) at a rate that the interpolator reads exactly."""
    count = len(samples)
    padded = next_fast_len(count + 200, real=True)
    spectrum = rfft(samples - samples.mean(axis=0), padded, axis=0)
    spectrum[int(_EDGE * top / rate * padded):] = 0.0
    size = next_fast_len(min(round(padded * _SAMPLES * top / rate), padded), real=True)
    size = min(size, padded)
    found = irfft(spectrum[:size // 2 + 1], size, axis=0)[:int(count * size / padded)]
    return np.ascontiguousarray(found * (size / padded)), rate * size / padded


class States:
    """
    The states of all cycles and the lines, and one step of their fit.

    A cycle has `width` states: the error of its first pulse (s), its bends (s), its gain. Angles
    are in fundamental cycles; lines are those in angle, then those in time.
    """

    def __init__(self, samples: Array, rate: float, start_time: float, times: Array,
                 measured: BoolArray, cycle_length: float, orders: Array, top: float,
                 jitter_std: float) -> None:
        self.samples, self.sample_rate, self.start_time = samples, rate, start_time
        self.times, self.measured, self.cycle_length = times, measured, cycle_length
        self.whole = measured[:-1] & measured[1:]
        self.frequency = cycle_length / float(np.diff(times).mean())
        self.orders, self.declared = orders, orders.size
        self.tones = np.zeros(0)
        self.highest = top
        self.jitter_std = jitter_std
        points = next_fast_len(math.ceil(2.0 * _EDGE * top * cycle_length), real=True)
        self.u = u = (np.arange(points) + 0.5) / points
        # of the states of a cycle, and of the error of its last pulse
        self.shapes = np.stack([1.0 - u, u * (1.0 - u), u * (1.0 - u) * (2.0 * u - 1.0),
                                np.ones(points), u])
        self.width = len(self.shapes) - 1
        self.states = np.zeros((times.size, self.width))
        self.least = np.array([*[_LEAST_BEND * jitter_std] * (self.width - 2), _LEAST_GAIN])
        self.size = np.append(jitter_std, self.least)
        self.all_free = self.settled = False
        self.told = np.zeros(self.width)
        self.around: Array | float = 1.0
        # pulses do not err by more than they scatter; a source that moves may do more
        even = self.whole[2:] & self.whole[1:-1] & self.whole[:-2]
        self.most_power = independent_power(np.diff(times, 3)[even]) if even.any() else math.inf
        # the straight line of the errors, which is no jitter, is `trend` times this
        self.ramp: Array = np.asarray(
            (np.arange(times.size) - 0.5 * (times.size - 1)) * float(np.diff(times).mean()))
        self.trend = 0.0
        self.amplitudes = np.zeros((samples.shape[1], orders.size), np.complex128)
        self.turning = self.single = np.ones(orders.size, np.bool_)
        self._made: tuple[bytes, bytes, Array] = b'', b'', np.zeros(0)
        self.read()

    @property
    def lines_found(self) -> int:
        """Return the number of undeclared lines."""
        return self.amplitudes.shape[1] - self.declared

    @property
    def unsure(self) -> float:
        """Return the standard error of the pulse errors (s), those of most pulses."""
        return float(self.size[0] * np.sqrt(1.0 - self.told[0]))

    @property
    def moving(self) -> BoolArray:
        """Return which lines (line,) are orders of shafts, which the states move."""
        return self.single & (np.arange(self.single.size) < self.orders.size)

    @property
    def transformed(self) -> int:
        """Return how many of the first cycles have a fast Fourier transform: nearly all."""
        return next(count for count in range(self.times.size - 1, 0, -1)
                    if next_fast_len(count, real=True) == count)

    @property
    def span(self) -> float:
        """Return the fundamental cycles in the stretch."""
        return self.cycle_length * (self.times.size - 1)

    # --- the vibration at the present angle, and the lines in it ---

    def read(self) -> None:
        """Read the vibration at the present angle."""
        corrected = self.times - self.states[:, 0]
        period = np.diff(corrected)
        self.slope = self.cycle_length / period
        self.place = (corrected[:-1, None] + period[:, None] * self.u
                      - self.states[:-1, 1:-1] @ self.shapes[1:-2])
        self.vibration = np.moveaxis(self.vibration_at(self.place), 2, 0) * self.whole[:, None]

    def vibration_at(self, place: Array) -> Array:
        """Return the vibration (..., channel) at times (...) in s."""
        position = np.clip((place - self.start_time) * self.sample_rate, 0.0,
                           len(self.samples) - 1.0)
        return interpolate(self.samples, position.ravel()).reshape(*place.shape, -1)

    def _make_tables(self) -> None:
        """
        Make the lines: of orders, a phase for each cycle times a wave that all cycles share.

        What is there of the same lines at the same places is left as it is.
        """
        made = self.orders.tobytes(), self.tones.tobytes(), self.place
        if self._made[:2] == made[:2] and self._made[2] is self.place:
            return
        self._made = made
        cycle = np.arange(self.times.size - 1)[:, None]
        self.turn = np.exp(2j * np.pi * (self.cycle_length * cycle * self.orders % 1.0))
        self.turn *= self.whole[:, None]
        self.wave = np.exp(2j * np.pi * self.cycle_length * self.orders[:, None] * self.u)
        self.reading = np.ascontiguousarray(self.wave.conj().T).view(np.float64).T
        # cosines and sines of the tones side by side (cycle, point, 2 tone)
        turned = (self.place - self.start_time)[..., None] * (2.0 * np.pi * self.tones)
        self.in_time = np.stack([np.cos(turned), np.sin(turned)], axis=-1).reshape(
            *self.place.shape, -1)
        self.in_time *= self.whole[:, None, None]
        straight = (self.turn.conj().T @ self.turn) * (self.wave.conj() @ self.wave.T)
        mirrored = (self.turn.T @ self.turn) * (self.wave @ self.wave.T)
        if self.tones.size:
            n, tones = self.orders.size, self.in_time.reshape(-1, 2 * self.tones.size)
            both = np.concatenate([self.wave.real, self.wave.imag]) @ self.in_time
            cos, sin = both[:, :n].view(np.complex128), both[:, n:].view(np.complex128)
            plus, minus = (np.hstack([  # (tone, line)
                np.einsum('knt,kn->tn', cos + sign * sin, turn), own])
                for sign, turn, own in zip(
                    (1j, -1j), (self.turn, self.turn.conj()), _products(tones.T @ tones)))
            straight = np.block([[straight, minus[:, :n].T], [minus.conj()]])
            mirrored = np.block([[mirrored, plus[:, :n].T], [plus]])
        cross = 0.5 * (mirrored.imag + straight.imag)
        self.normal = np.block([[0.5 * (straight + mirrored).real, -cross],
                                [-cross.T, 0.5 * (straight - mirrored).real]])

    def signals(self, amplitudes: ComplexArray) -> Array:
        """Return the sums (channel, cycle, point) of lines with amplitudes (channel, line)."""
        n = self.orders.size
        # each order turned, its real and imaginary part side by side
        parts = np.multiply(amplitudes[:, None, :n], self.turn, order='C').view(np.float64)
        found = (parts.reshape(-1, 2 * n) @ self.reading).reshape(
            len(parts), -1, self.u.size)
        if self.tones.size:
            rest = np.ascontiguousarray(amplitudes[:, n:].conj()).view(np.float64)
            found += np.moveaxis(self.in_time @ rest.T, 2, 0)
        return np.asarray(found)

    def _sums(self, values: Array, shapes: Array | None = None) -> ComplexArray:
        """
        Return the sums (cycle, line) over the points of `values` (cycle, point) by lines.

        With `shapes` (shape, point), which multiply the values, they are (cycle, shape, line).
        """
        some = np.ones((1, self.u.size)) if shapes is None else shapes
        wave = np.ascontiguousarray((some[:, None] * self.wave).reshape(-1, self.u.size).T)
        found = (values @ wave.view(np.float64)).view(np.complex128).reshape(
            len(values), len(some), -1)
        found *= self.turn[:, None]
        if self.tones.size:
            found = np.concatenate([found, ((values[:, None] * some) @ self.in_time).view(
                np.complex128)], axis=2)
        return np.asarray(found if shapes is not None else found[:, 0])

    def rate(self) -> Array:
        """Return the derivative (channel, cycle, point) of the lines by the pulse errors."""
        turns = 2j * np.pi * np.append(self.orders, np.zeros(self.tones.size))
        found = self.signals(turns * self.moving * self.amplitudes)
        found *= self.slope[:, None]
        return found

    def residual(self) -> Array:
        """Return the vibration less the lines (channel, cycle, point)."""
        return np.asarray(self.vibration - (1.0 + self.states[:-1, -1:]) * self.signals(
            self.amplitudes))

    def fit_amplitudes(self) -> None:
        """Fit the amplitudes of all lines with the states as they are."""
        self._make_tables()
        gain = 1.0 + self.states[:-1, -1:]
        right = np.stack([self._sums(row / gain).conj().sum(axis=0)
                          for row in self.vibration], axis=1)
        ridge = ROUNDING * self.normal[0, 0] * np.eye(len(self.normal))
        found = np.linalg.solve(self.normal + ridge, np.vstack((right.real, right.imag)))
        n = len(right)
        self.amplitudes = (found[:n] + 1j * found[n:]).T
        self.turning, self.single = self._turning()

    # --- one step ---

    def step(self, *, weak: float = 1.0, move: bool = True) -> float:
        """Do a Gauss-Newton step; return the RMS change of the pulse errors (s)."""
        self._make_tables()
        # a line of no shaft tells nothing of the angle: its own frequency may vary
        moving = self.signals(self.moving * self.amplitudes)
        residual = self.residual() if not self.moving.all() else (
            self.vibration - (1.0 + self.states[:-1, -1:]) * moving)
        points = self.whole.sum() * self.u.size
        self.weight = points / np.einsum('ckp,ckp->c', residual, residual)
        if self.settled:
            self._weigh(residual)
        change, amplitudes, trend = self._solve(residual, (self.rate(), moving), weak)
        self.change = change[:, 0]
        size = float(np.sqrt(np.mean(self.change**2)))
        if move:
            most = _MOST_TURNS / (self.orders[:self.declared].max() * self.frequency)
            part = min(1.0, most / max(size, 1e-300))
            self.states = self.states + part * change
            self.trend += part * trend
            self._take_out_mean_bend()
            self.amplitudes = self.amplitudes + part * amplitudes
            if weak == 1.0:
                self._estimate_sizes()
            self.read()
        return size

    def _weigh(self, residual: Array) -> None:
        """
        Weigh the channels by the noise that leaks into their orders, not by all noise.

        Each order counts as much as it tells of the pulse errors. States that take up a part of
        the noise leave less of it there. `around` (channel, line) is the noise near each line.
        """
        cycles = self.transformed
        flat = residual[:, :cycles].reshape(len(residual), -1)
        lines = rfft(flat * _hann(flat.shape[1]))
        power = lines.real**2 + lines.imag**2
        power /= power.mean(axis=1, keepdims=True)
        reach, span = 0.5 * _BEYOND_LINES / self.cycle_length, self.cycle_length * cycles
        places = np.append(self.orders, self.tones / self.frequency)
        first, last = (np.clip(np.rint((places + side) * span).astype(int), side > 0.0,
                               power.shape[1] - (side < 0.0)) for side in (-reach, reach))
        summed = np.pad(np.cumsum(power, axis=1), ((0, 0), (1, 0)))
        around = (summed[:, last] - summed[:, first]) / (last - first)
        for c, told in enumerate((np.abs(self.amplitudes[:, :self.orders.size])
                                  * self.orders) ** 2 + np.finfo(np.float64).tiny):
            share = np.zeros(power.shape[1])
            for i in np.argsort(told).tolist():  # of several orders nearby the strongest counts
                share[first[i]:last[i]] = told[i]
            share /= share.sum()
            taken = cycles * float(self.told.sum()) * float(share @ share) / (2 * len(power))
            colour = float(share @ power[c]) / (1.0 - min(taken, _MOST_TAKEN))
            self.weight[c] /= colour
            around[c] /= colour
        self.around = around

    def _take_out_mean_bend(self) -> None:
        """
        Leave no bend that all cycles share.

        It would make sidebands that do not change: no vibration tells it from lines beside lines.
        """
        bends = self.states[:-1, 1:-1]
        bends -= bends[self.whole].mean(axis=0)

    def _solve(self, residual: Array, derivative: tuple[Array, Array], weak: float
               ) -> tuple[Array, ComplexArray, float]:
        """Return the changes of states (pulse, state), amplitudes (channel, line) and trend."""
        pulses, width = self.states.shape
        by = [*[0] * (width - 1), 1, 0]  # which derivative a state goes with
        cells, down = np.zeros((pulses, width + 1, width + 1)), np.zeros((pulses, width + 1))
        weighted = [self.weight[:, None, None] * item for item in derivative]
        for m, own in enumerate(weighted):
            states = [i for i, which in enumerate(by) if which == m]
            right = np.einsum('ckp,ckp->kp', own, residual)
            down[:-1, states] = right @ self.shapes[states].T
            for n in range(m + 1):
                others = [i for i, which in enumerate(by) if which == n]
                products = self.shapes[states][:, None] * self.shapes[others]
                found = (np.einsum('ckp,ckp->kp', own, derivative[n])
                         @ products.reshape(-1, self.u.size).T).reshape(-1, *products.shape[:2])
                cells[:-1, np.array(states)[:, None], others] = found
                cells[:-1, np.array(others)[:, None], states] = np.moveaxis(found, 1, 2)
        size = self.size * np.append(weak, np.ones(width - 1))
        precision = np.tile(size**-2.0, (pulses, 1))
        expected = self.states.copy()
        expected[:, 0] -= self.trend * self.ramp
        total = precision + np.einsum('kii->ki', cells)[:, :-1]
        total[1:, 0] += cells[:-1, -1, -1]
        down[1:, 0] += down[:-1, -1]
        down = down[:, :-1] - precision * expected
        border, corner, below = self._border(residual, derivative, by)
        # the trend that the errors are expected along stands after the amplitudes
        along = precision[:, 0] * self.ramp
        border[:, 0, -1] = -along
        corner[-1, -1] = along @ self.ramp + USUAL_SKEW**-2.0
        below[-1] = along @ expected[:, 0] - self.trend * USUAL_SKEW**-2.0
        scale = 1.0 / np.sqrt(total)  # seconds and gains together
        scales = np.hstack([scale, np.roll(scale[:, :1], -1)])
        cells *= scales[:, :, None] * scales[:, None, :]
        border *= scale[:, :, None]
        down *= scale
        self.solved = solved = _Solved.of(cells, border, corner, scale)
        amplitudes = cho_solve(solved.schur, below - border.reshape(
            down.size, -1).T @ solved.of_states(down).ravel())
        change = solved.of_states(down - border @ amplitudes) * scale
        cos, sin = np.split(amplitudes[:-1].reshape(len(residual), -1), 2, axis=1)
        return change, cos + 1j * sin, float(amplitudes[-1])

    def _border(self, residual: Array, derivative: tuple[Array, Array], by: Sequence[int]
                ) -> tuple[Array, Array, Array]:
        """Return border, corner and right side of amplitudes (cos, sin by channel) and a trend."""
        pulses, width = self.states.shape
        channels, lines = self.amplitudes.shape
        whole = np.zeros((pulses, width, 2 * channels * lines + 1))
        border = whole[:, :, :-1].reshape(pulses, width, channels, 2, lines)
        corner = np.zeros((channels, 2 * lines, channels, 2 * lines))
        below = np.zeros((channels, 2 * lines))
        for c, weight in enumerate(self.weight):
            for which, item in enumerate(derivative):
                states = [i for i, own in enumerate(by) if own == which]
                found = self._sums_of(item[c], which, c, self.shapes[states])
                found *= weight
                for i, row in zip(states, np.moveaxis(found, 1, 0)):
                    place = border[1:, 0, c] if i == width else border[:-1, i, c]
                    place[:, 0] += row.real
                    place[:, 1] -= row.imag
            total = weight * self._sums(residual[c]).sum(axis=0)
            below[c] = np.append(total.real, -total.imag)
            corner[c, :, c] = weight * self.normal
        flat = np.pad(corner.reshape(below.size, -1), (0, 1))
        flat[np.diag_indices(len(flat))] *= 1.0 + ROUNDING
        return whole, flat, np.append(below, 0.0)

    def _sums_of(self, values: Array, which: int, channel: int, shapes: Array) -> ComplexArray:
        """Return `_sums` of a derivative (cycle, point) of a channel, from its lines if faster."""
        n = self.orders.size
        if self.tones.size or 2 * n >= self.u.size:
            return self._sums(values, shapes)
        part = (self.moving * self.amplitudes[channel]) * (self.turn if which else (
            2j * np.pi * self.slope[:, None] * self.orders * self.turn))
        wave = (shapes[:, None] * self.wave).reshape(-1, self.u.size)
        each = np.ascontiguousarray(self.reading @ wave.T).view(np.float64)
        found = (part.view(np.float64) @ each).view(np.complex128).reshape(
            len(part), len(shapes), n)
        found *= self.turn[:, None]
        return np.asarray(found)

    def _variance(self, state: int) -> float:
        """Return the variance of a state of most cycles; that of errors is about their trend."""
        return float(np.median(self._variances(state, about_trend=not state)[2:-2]))

    def _variances(self, state: int, *, about_trend: bool = False) -> Array:
        """
        Return posterior variances (pulse,) of a state.

        Those of pulse errors are about their mean, which nothing tells.
        """
        solved = self.solved
        local, inner = solved.of_state(state)
        if about_trend:
            inner = inner.copy()
            inner[:, -1] += self.ramp / solved.scale[:, 0]
        through = cho_solve(solved.schur, inner.T)
        variance = (local + np.sum(inner * through.T, axis=1)) * solved.scale[:, state] ** 2
        if state:
            return np.asarray(variance)
        mean = solved.scale[:, 0] * self.measured / self.measured.sum()
        shared = solved.of_errors(mean)
        return np.asarray(variance - 2.0 * shared * solved.scale[:, 0] + mean @ shared)

    def _estimate_sizes(self) -> None:
        """Estimate how large the states are from their values and variances."""
        inner = np.arange(self.times.size)[2:-2]
        inner = inner[self.measured[2:-2]]
        errors = (self.states[:, 0] - self.trend * self.ramp)[inner]
        power, more = self._estimated(0, errors - errors.mean(),
                                      1.0 - 1.0 / np.count_nonzero(self.measured))
        power = max(power, min(more, self.most_power), (_LEAST_JITTER * self.jitter_std) ** 2)
        self.size[0] = np.sqrt(power)
        if self.all_free:
            for i, least in enumerate(self.least, start=1):
                self.size[i] = np.sqrt(max(self._estimated(i, self.states[2:-2, i])[1], least**2))

    def _estimated(self, state: int, values: Array, share: float = 1.0) -> tuple[float, float]:
        """
        Return the power of a state by some of its values: of an EM step, and of a longer one.

        EM grows from small sizes too slowly, by a factor of what the vibration tells, or its
        square once all lines are there (scoring); it shrinks as slowly, so that errors have room
        for lines that were not found. Variances are a `share` of those of the state: those about
        a mean that nothing tells.
        """
        before = self.size[state] ** 2
        expected, variance = share * before, self._variance(state)
        power = float(np.mean(values**2)) + variance
        self.told[state] = told = max(1.0 - variance / expected, ROUNDING)
        gained = power - expected
        if gained > 0.0:
            gained /= told**2 if self.settled and not state else told
        return power, before + gained

    def free_all(self) -> None:
        """Let bends and gains free."""
        self.all_free = True
        self.size[1:] = _FREE * np.array([*[self.jitter_std] * (self.width - 2), 1.0])

    # --- lines ---

    def follow_trend(self, expected: float) -> None:
        """
        Start from the slope of the errors that keeps the declared lines together.

        A clock that is fast or slow, or a wrong ratio, makes it. It is the `expected` one where
        no other is clearly better.
        """
        span = self.cycle_length * self.transformed
        flat = self.vibration[:, :self.transformed].reshape(len(self.vibration), -1)
        spectrum = np.abs(np.fft.rfft(flat * np.hanning(flat.shape[1]))).T ** 2
        power = np.sum(spectrum / spectrum.mean(axis=0), axis=1)
        step = _FINE / self.orders.max() / span
        most = int(USUAL_SKEW / step)
        slope = step * np.arange(-most, most + 1)
        self.slopes = slope.size
        score = np.sum([np.log(1e-3 * power.max() + np.interp(
            g * (1.0 + slope) * span, np.arange(power.size), power)) for g in self.orders],
            axis=0)
        best = slope[np.argmax(score)]
        before = score[np.argmin(np.abs(slope - expected))]
        ratio = sum(item * np.log(2.0) / _medians(item, max(int(span / 2), _SKIRT))
                    for item in spectrum.T)
        places = np.rint(self.orders * (1.0 + best) * span).astype(int)
        chance = gammaincc(spectrum.shape[1], ratio[places])
        clear = (score.max() - before > _SLOPE_GAIN * self.declared
                 and abs(best - expected) > 1.5 * step
                 and np.mean(chance < _FALSE / slope.size) > _SLOPE_LINES)
        self.trend = float(best) if clear else expected
        self.states[:, 0] = self.trend * self.ramp
        self.read()

    def new_lines(self) -> tuple[list[float], list[float]]:
        """Return orders, and tones in Hz, that stand out of the residual; some if too many do."""
        self._make_tables()
        span = self.cycle_length * self.transformed
        residual = self.residual()[:, :self.transformed]
        flat = np.ascontiguousarray(residual.reshape(len(residual), -1).T)
        time = self.place[:self.transformed].ravel()
        duration = float(time[-1] - time[0])
        at = np.interp(np.linspace(time[0], time[-1], time.size), time, np.arange(time.size))
        even = interpolate(flat, np.clip(at, 0.0, time.size - 1.0))
        least = _ACCURACY * np.sqrt(np.mean(self.vibration**2, axis=(1, 2)))
        over_angle, over_time = (_spectrum(item, span, least) for item in (flat, even))
        limit = gammainccinv(flat.shape[1], _FALSE / len(over_angle[0])) * _MARGIN
        found: list[tuple[float, float, bool]] = []
        for tone, (ratio, power), (_, other) in ((False, over_angle, over_time),
                                                 (True, over_time, over_angle)):
            middle = ratio[1:-1]
            peaks = 1 + np.flatnonzero((middle > ratio[:-2]) & (middle >= ratio[2:])
                                       & (middle > limit))
            order = peaks / span
            for peak in peaks[(order > 3.0 / span) & (order < self.highest)]:
                near = other[max(peak - 8, 0):peak + 9].max()
                if power[peak] > near * (_SHARPER if tone else 1.0 / _SHARPER):
                    place = _between(np.log(ratio[peak - 1:peak + 2])) + peak
                    found.append((power[peak], place / (duration if tone else span), tone))
        found.sort(reverse=True)
        orders: list[float] = []
        tones: list[float] = []
        room = _MOST_LINES // (1 if self.all_free else 2) - self.lines_found
        least_power = 0.0
        for size, place, tone in found:
            if size < least_power or len(orders) + len(tones) >= room:
                break
            others = np.array([*self.orders, *orders])
            beside = np.array([*self.tones, *tones])
            if tone:
                near_one = np.any(np.abs(beside - place) * duration < APART) or np.any(
                    np.abs(others - place / self.frequency) * self.span < APART)
            else:
                near_one = np.any(np.abs(others - place) * self.span < APART)
            if not near_one:
                (tones if tone else orders).append(float(place))
                least_power = least_power or _SHARE * size
        return orders, tones

    def add(self, orders: Sequence[float] | Array, tones: Sequence[float] | Array) -> None:
        """Add undeclared lines, their amplitudes 0."""
        old = np.split(self.amplitudes, [self.orders.size], axis=1)
        none = [np.zeros((len(self.amplitudes), len(new))) for new in (orders, tones)]
        self.amplitudes = np.hstack([old[0], none[0], old[1], none[1]])
        self.orders = np.append(self.orders, orders)
        self.tones = np.append(self.tones, tones)

    def refine(self) -> float:
        """
        Move each undeclared line to where the residual has nothing left of it.

        The declared lines alone tell how fast the angle runs; those that may move do not. What a
        tone moves by at most is returned in standard errors.
        """
        self._make_tables()
        residual = self.residual()
        cycle = np.arange(self.times.size - 1) - 0.5 * (self.times.size - 1)
        angle = self.cycle_length * (cycle[:, None] + self.u)
        time = self.place - self.place.mean()
        count = self.orders.size
        top, bottom = np.zeros(self.amplitudes.shape[1]), np.zeros(self.amplitudes.shape[1])
        for c, (weight, row) in enumerate(zip(self.weight, self.amplitudes)):
            moved = np.append(self._sums(angle * residual[c])[:, :count].sum(axis=0),
                              self._sums(time * residual[c])[:, count:].sum(axis=0))
            top += weight * np.real(2j * np.pi * row * moved)
            bottom += weight * 2.0 * np.pi**2 * np.abs(row) ** 2
        curves = [float(np.sum(x**2 * self.whole[:, None])) for x in (angle, time)]
        most_of = [0.5 / float(np.ptp(x)) for x in (angle, time)]
        declared = self.orders[:self.declared]
        stretch = float(top[:self.declared] @ declared) / max(
            float(bottom[:self.declared] @ declared**2) * curves[0], np.finfo(np.float64).tiny)
        most_stretched = most_of[0] / declared.max()
        stretch = min(max(stretch, -most_stretched), most_stretched)
        for chosen, curve, most in zip((slice(self.declared, count), slice(count, None)), curves,
                                       most_of):
            with np.errstate(divide='ignore', invalid='ignore'):
                step = np.nan_to_num(top[chosen] / (bottom[chosen] * curve), posinf=0.0,
                                     neginf=0.0).clip(-most, most)
            lines = self.orders[self.declared:] if chosen.stop else self.tones
            lines += step
        self.orders[self.declared:] *= 1.0 - stretch
        self.states[:, 0] += stretch * self.ramp
        self.trend += stretch
        self.read()
        return float(np.max(np.abs(step) * np.sqrt(bottom[count:] * curves[1]), initial=0.0))

    def prune(self, least: float) -> None:
        """Take out undeclared lines whose amplitudes are noise."""
        lines = self.amplitudes.shape[1]
        power = np.abs(self.amplitudes) ** 2 / self._amplitude_variances()
        kept = (np.arange(lines) < self.declared) | (power.mean(axis=0) > 2.0 * least)
        orders, tones = np.split(kept, [self.orders.size])
        self.orders, self.tones = self.orders[orders], self.tones[tones]
        self.amplitudes = self.amplitudes[:, kept]
        self.turning, self.single = self.turning[kept], self.single[kept]

    def _amplitude_variances(self) -> Array:
        """Return the variances (channel, line) of real and imaginary part of the amplitudes."""
        schur = self.solved.schur
        variance = np.diag(cho_solve(schur, np.eye(len(schur[0]))))[:-1]
        return np.asarray(variance.reshape(len(self.amplitudes), 2, -1).mean(axis=1)
                          * self.around)

    # --- what comes out ---

    def result(self) -> RecordFit:
        """Return the fit, pulse errors and bends as good as unshrunk."""
        variance = self._variance(0)
        weak = _WEAK * max(1.0, float(np.sqrt(variance / self.told[0]) / self.size[0]))
        self.step(weak=_WEAK)
        self.step(weak=weak, move=False)
        errors = self.states[:, 0] + self.change
        # an angle that all lines turn by takes longer where the shaft is slow
        period = trigger_periods(self.times - errors)
        errors -= period * (errors[self.measured].mean() / period[self.measured].mean())
        bends, bend_errors = self.states[:-1, 1:3].copy(), np.full(2, np.inf)
        for i in range(2):
            variance = self._variance(1 + i)
            kept = 1.0 - variance / self.size[1 + i] ** 2  # not shrunk
            if kept > ROUNDING:
                bends[:, i] /= kept
                bend_errors[i] = np.sqrt(variance / kept)
        variances = self._amplitude_variances()
        shown = (np.abs(self.amplitudes) ** 2 / variances)[:, :self.declared]
        return RecordFit(
            errors, np.sqrt(self._variances(0)), self._roughness(), bends, bend_errors,
            self.declared, self.orders, self.tones, self.amplitudes[:, :self.orders.size],
            self.amplitudes[:, self.orders.size:],
            np.sqrt(variances), self.turning,
            float(self.size[0]), self.size[:3] * np.array([weak, 1.0, 1.0]), self.trend,
            bool(gammaincc(shown.size, 0.5 * shown.sum()) < _FALSE / self.slopes))

    def _roughness(self) -> float:
        """Return the RMS of what second differences of the pulse errors are wrong by, of some."""
        chosen = np.arange(0, self.times.size - 2, math.isqrt(self.times.size))
        unit = np.zeros((self.times.size, chosen.size))
        whole = np.ones(chosen.size, np.bool_)
        for place, factor in zip((chosen, chosen + 1, chosen + 2), (1.0, -2.0, 1.0)):
            unit[place, np.arange(chosen.size)] = factor * self.solved.scale[place, 0]
            whole &= self.measured[place]
        variance = np.sum(unit * self.solved.of_errors(unit), axis=0)
        return float(np.sqrt(variance @ whole / max(whole.sum(), 1)))

    def _turning(self) -> tuple[BoolArray, BoolArray]:
        """
        Tell which orders, and tones after them (line,), turn with the shafts, and which may.

        Shafts must have whole orders and the lines of the trigger cycle. Others have more power
        over angle than any tone near them over time. Sidebands turn with those as far from
        declared lines or 0; on a steady machine, several show a shaft. Lines that stand alone may
        turn, but not several side by side, as a machine makes them whose own speed varies.
        """
        lines = np.append(self.orders, self.tones / self.frequency)
        declared, others = np.split(lines, [self.declared])
        least, r = APART / self.span, self.cycle_length
        exact = np.minimum(np.abs(others - np.rint(others)),
                           np.abs(others * r - np.rint(others * r)) / r) < least
        apart = others[:, None] - declared
        near = np.argmin(np.abs(apart), axis=1)
        offset = apart[np.arange(near.size), near]
        distance = np.stack([np.abs(offset), others], axis=1)
        alike = np.abs(distance[:, None, :, None] - distance[:, None, :]).min(axis=(2, 3)) < least
        known = exact & (np.arange(others.size) < self.orders.size - self.declared)
        for size in np.unique(np.abs(offset)).tolist():
            beside = np.abs(np.abs(offset) - size) < least
            sides = {*zip(near[beside].tolist(), (offset[beside] < 0.0).tolist())}
            if len(sides) >= _FEWEST_SIDES:
                known |= np.any(np.abs(np.abs(apart) - size) < least, axis=1)
                known |= np.abs(others - size) < least
        over_angle, over_time, _ = self._both_ways()
        sharper = np.append(over_angle > _SHARPER * over_time,
                            np.zeros(self.tones.size, np.bool_))
        close = np.abs(others[:, None] - others) * self.span < _SKIRT
        alone = (np.count_nonzero(close, axis=1) < 2) | (np.abs(offset) * self.span < _SKIRT)
        own = np.ones(self.declared, np.bool_)
        turning, single = (np.append(own, np.any(alike & found, axis=1) | found)
                           for found in (known | sharper, known | alone))
        return turning, single

    def let_stand(self) -> None:
        """Make tones of the undeclared orders that show better over time than over angle."""
        over_angle, over_time, tones = self._both_ways()
        standing = (over_time > over_angle) & ~self.turning[self.declared:self.orders.size]
        if not standing.any():
            return
        self.orders = self.orders[np.append(np.ones(self.declared, np.bool_), ~standing)]
        apart = APART / float(np.ptp(self.place))
        for i in np.flatnonzero(standing)[np.argsort(-over_time[standing])].tolist():
            if np.all(np.abs(self.tones - tones[i]) > apart):  # else a part of the same
                self.tones = np.append(self.tones, tones[i])
        self.amplitudes = np.zeros((len(self.amplitudes), self.orders.size + self.tones.size),
                                   np.complex128)
        self.fit_amplitudes()
        self.step()

    def _both_ways(self) -> tuple[Array, Array, Array]:
        """Return the power of undeclared orders, that of the best tones near them, and these."""
        self._make_tables()
        residual = self.residual()
        middle = self.place.mean(axis=1)
        angle = self.cycle_length * (np.arange(self.times.size - 1) + 0.5)
        reach = math.ceil(1.0 / _FINE)
        near = _FINE * np.arange(-reach, reach + 1) / float(np.ptp(middle))
        count = self.orders.size - self.declared
        over_angle, over_time, tones = np.zeros((3, count))
        sums = [self._sums(item) for item in residual]
        for k, i in enumerate(range(self.declared, self.orders.size)):
            timed = np.zeros(near.size)
            wave, turn = self.wave[i], self.turn[:, i]
            tone = self.orders[i] * self.frequency + near
            beside = np.exp(2j * np.pi * (self.orders[i] * angle - tone[:, None] * middle))
            for c, row in enumerate(self.amplitudes):
                part = row[i] * turn
                alone = 0.5 * turn * (part * np.sum(wave**2) + part.conj() * wave.size)
                each = (sums[c][:, i] + alone).conj()
                over_angle[k] += self.weight[c] * float(np.abs(each.sum()) ** 2)
                timed += self.weight[c] * np.abs(beside @ each) ** 2
            best = int(np.argmax(timed))
            over_time[k], tones[k] = timed[best], tone[best]
        return over_angle, over_time, tones


@dataclass(frozen=True)
class _Solved:
    """
    The normal equations of a step, solved; states and right-hand sides times `scale`.

    Bends and gain of a cycle meet those of others only through the errors of its two pulses. So
    they are eliminated cycle by cycle, and what is left of the states is a tridiagonal matrix of
    the errors, of which `factor` is the Cholesky factor. `root` (pulse, rest, rest) is the inverse
    Cholesky factor of bends and gain, `through` (pulse, rest, 2) how they follow the errors of
    the two pulses, `border` (pulse, state, amplitude) that of the amplitudes, `inner` (pulse,
    amplitude) how the errors follow the amplitudes, `schur` the factor of what is left of these.
    """

    scale: Array
    root: Array
    through: Array
    factor: tuple[Array, bool]
    border: Array
    inner: Array
    schur: tuple[Array, bool]

    @classmethod
    def of(cls, cells: Array, border: Array, corner: Array, scale: Array) -> '_Solved':
        """Solve for `cells` (pulse, state + 1, state + 1) of the states and the next error."""
        own = cells[:, 1:-1, 1:-1].copy()
        own[:, np.arange(own.shape[1]), np.arange(own.shape[1])] = 1.0  # with the precision
        root = np.linalg.inv(np.linalg.cholesky(own))
        coupling = root @ cells[:, 1:-1, [0, -1]]
        less = np.moveaxis(coupling, 1, 2) @ coupling
        band = np.zeros((2, len(cells)))
        band[0, 1:] = (cells[:, 0, -1] - less[:, 0, 1])[:-1]
        band[1] = 1.0 - less[:, 0, 0]
        band[1, 1:] -= less[:-1, 1, 1]
        through = np.moveaxis(root, 1, 2) @ coupling
        factor = (cholesky_banded(band), False)
        errors = _of_errors(through, border)
        inner = cho_solve_banded(factor, errors)
        rest = (root @ border[:, 1:]).reshape(-1, border.shape[2])
        schur = cho_factor(corner - rest.T @ rest - errors.T @ inner)
        return cls(scale, root, through, factor, border, inner, schur)

    def of_states(self, right: Array) -> Array:
        """Return the states (pulse, state) for a right-hand side with the amplitudes as 0."""
        errors = cho_solve_banded(self.factor, _of_errors(self.through, right[..., None])[:, 0])
        after = np.append(errors[1:], 0.0)
        rest = np.einsum('kji,kjl,kl->ki', self.root, self.root, right[:, 1:])
        rest -= self.through[:, :, 0] * errors[:, None] + self.through[:, :, 1] * after[:, None]
        return np.column_stack([errors, rest])

    def of_errors(self, right: Array) -> Array:
        """Return the errors (pulse, ...) for a right-hand side of the errors, amplitudes free."""
        return np.asarray(cho_solve_banded(self.factor, right)
                          + self.inner @ cho_solve(self.schur, self.inner.T @ right))

    def of_state(self, state: int) -> tuple[Array, Array]:
        """Return variances (pulse,) with the amplitudes as 0, and how it follows these."""
        variance, beside = self._variances
        if not state:
            return variance, self.inner
        i = state - 1
        one, other = self.through[:, i].T
        own = np.einsum('kj,kjl->kl', self.root[:, :, i], self.root)
        inner = np.einsum('kl,kla->ka', own, self.border[:, 1:])
        local = own[:, i] + one**2 * variance
        local[:-1] += other[:-1] ** 2 * variance[1:] + 2.0 * (one * other)[:-1] * beside
        inner -= one[:, None] * self.inner
        inner[:-1] -= other[:-1, None] * self.inner[1:]
        return local, inner

    @cached_property
    def _variances(self) -> tuple[Array, Array]:
        """Return diagonal and next diagonal of the inverse of the tridiagonal matrix."""
        beside, diagonal = self.factor[0]
        ratio = np.append(beside[1:] / diagonal[:-1], 0.0)
        found, last = np.empty(diagonal.size), 0.0
        for k, (own, step) in enumerate(zip((diagonal**-2.0)[::-1].tolist(),
                                            (ratio**2)[::-1].tolist())):
            found[k] = last = own + step * last
        found = found[::-1]
        return found, -ratio[:-1] * found[1:]


def _products(parts: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return products of waves, and those with the conjugate, of cosines and sines in turn."""
    cos, sin = parts[::2].view(np.complex128), parts[1::2].view(np.complex128)
    return cos + 1j * sin, (cos - 1j * sin).conj()


def _of_errors(through: Array, right: Array) -> Array:
    """Return right-hand sides (pulse, ...) of errors for those of states (pulse, state, ...)."""
    each = np.moveaxis(through, 1, 2) @ right[:, 1:]
    found = right[:, 0] - each[:, 0]
    found[1:] -= each[:-1, 1]
    return np.asarray(found)


def _spectrum(values: Array, span: float, least: Array) -> tuple[Array, Array]:
    """
    Return power over its floor, summed over channels (last axis), and power (bin,).

    The floor of a channel is at least the power of a line of the amplitude `least` (channel,).
    """
    window = _hann(len(values))
    lines = rfft(values.T * window)
    power = lines.real**2 + lines.imag**2
    ratio = np.zeros(power.shape[1])
    for channel, limit in zip(power, (0.5 * least * window.sum()) ** 2):
        floor = np.full(channel.size, limit)
        for reach in (max(int(span / 2), _SKIRT), _SKIRT):
            np.maximum(floor, _medians(channel, reach), out=floor)
        ratio += channel * np.log(2.0) / floor
    return ratio, power.sum(axis=0)


@lru_cache(maxsize=4)
def _hann(count: int) -> Array:
    return np.hanning(count + 1)[:-1]


def _medians(power: Array, reach: int) -> Array:
    """Return the median of the values up to `reach` bins away, between some bins linearly."""
    size, step = min(2 * reach, len(power)), max(1, reach // 2)
    medians = row_medians(np.lib.stride_tricks.sliding_window_view(power, size)[::step])
    inner = np.linspace(medians[:-1], medians[1:], step, endpoint=False, axis=1).ravel()
    return np.pad(inner, (size // 2, len(power) - size // 2 - inner.size), mode='constant',
                  constant_values=(medians[0], medians[-1]))


def _between(values: Array) -> float:
    """Return where a parabola through three values has its top, from the middle one."""
    left, middle, right = values
    return float(0.5 * (left - right) / (left - 2.0 * middle + right))
