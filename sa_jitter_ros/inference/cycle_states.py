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
The states of trigger cycles: what each differs by from a sum of lines, and a step of their fit.

The vibration is read at even steps of the angle that the pulses tell. Every trigger cycle then
differs from a sum of lines by the derivative of that sum times what the angle is wrong by:

* the errors of its two pulses, times hat functions;
* bends of the speed inside the cycle, times u (1 - u) and u (1 - u) (2 u - 1);

and by a gain that all lines share. These states of the cycles have a banded normal matrix; the
amplitudes of the lines border it (Schur complement). Gauss-Newton steps read the vibration again
at the corrected angle, so that nothing is linearised at the end. The sizes of the states are
estimated with them (expectation-maximisation).
"""

from collections.abc import Sequence
import math

import numpy as np
from sa_jitter_ros.arrays import Array, BoolArray, ComplexArray
from sa_jitter_ros.averaging.spectral_lines import hann
from sa_jitter_ros.effects.clock_skew import USUAL_SKEW
from sa_jitter_ros.effects.timing import ROUNDING
from sa_jitter_ros.inference.bordered import Solved
from sa_jitter_ros.inference.order_band import BEYOND_LINES, EDGE, OrderBand
from sa_jitter_ros.prediction.influence import common_turn
from scipy.fft import next_fast_len, rfft
from scipy.linalg import cho_solve

_MOST_TAKEN = 0.5  # of the noise near the lines, that states may take up
# Errors and bends in parts of the declared jitter, and gains: a first guess of bends and gains,
# and the least that all keep always: a bend of nothing would be certain.
_FREE, _LEAST = 0.1, 1e-3
# Turns of the highest declared order, beyond which its phase tells errors ambiguously.
_MOST_TURNS = 0.25


def independent_power(third: Array) -> float:
    """
    Return the power of independent errors (s^2) that makes third differences of pulses (s).

    A shaft that runs up makes second differences, too.
    """
    return float(np.mean(third**2)) / 20.0


class States:
    """
    The states of all cycles and the lines, and one step of their fit.

    A cycle has `width` states: the error of its first pulse (s), its bends (s), its gain. Angles
    are in fundamental cycles; lines are those in angle, then those in time.
    """

    def __init__(self, band: OrderBand, times: Array, measured: BoolArray, cycle_length: float,
                 orders: Array, top: float, jitter_std: float) -> None:
        self.band = band
        self.times, self.measured, self.cycle_length = times, measured, cycle_length
        self.whole = measured[:-1] & measured[1:]
        self.frequency = cycle_length / float(np.diff(times).mean())
        self.orders, self.declared = orders, orders.size
        self.tones = np.zeros(0)
        self.highest = top
        self.jitter_std = jitter_std
        points = next_fast_len(math.ceil(2.0 * EDGE * top * cycle_length), real=True)
        self.u = u = (np.arange(points) + 0.5) / points
        # of the states of a cycle, and of the error of its last pulse
        self.shapes = np.stack([1.0 - u, u * (1.0 - u), u * (1.0 - u) * (2.0 * u - 1.0),
                                np.ones(points), u])
        self.width = len(self.shapes) - 1
        self.states = np.zeros((times.size, self.width))
        units = np.array([*[jitter_std] * (self.width - 2), 1.0])
        self.least, self.size = _LEAST * units, np.append(jitter_std, _FREE * units)
        self.converged = False
        self.resolved = np.zeros(self.width)
        self.weight, self.around = np.ones(band.samples.shape[1]), np.ones(1)
        # pulses do not err by more than they scatter; a source that moves may do more
        even = self.whole[2:] & self.whole[1:-1] & self.whole[:-2]
        self.most_power = independent_power(np.diff(times, 3)[even]) if even.any() else math.inf
        # the straight line of the errors, which is no jitter, is `trend` times this; beside it
        # are those that a delay or a clock makes as the speed changes
        self.by_speed: Array = np.zeros(times.size)
        self.ramp: Array = np.asarray(
            (np.arange(times.size) - 0.5 * (times.size - 1)) * float(np.diff(times).mean()))
        self.trend = 0.0
        self.amplitudes = np.zeros((band.samples.shape[1], orders.size), np.complex128)
        self.synchronous = self.movable = np.ones(orders.size, np.bool_)
        self._made: tuple[bytes, bytes, Array] = b'', b'', np.zeros(0)
        self.read()

    @property
    def moved(self) -> BoolArray:
        """Return which lines (line,) are orders of shafts, which the states move."""
        return self.movable & (np.arange(self.movable.size) < self.orders.size)

    @property
    def no_jitter(self) -> Array:
        """Return the errors (pulse,) that are expected before any jitter."""
        return self.trend * self.ramp + self.by_speed

    @property
    def common_turn(self) -> Array:
        """Return how long a turn of all lines takes at each pulse, 1 in the mean."""
        return common_turn(self.times - self.states[:, 0], self.measured)

    @property
    def transformed(self) -> int:
        """Return how many of the first cycles have a fast Fourier transform: nearly all."""
        return next(count for count in range(self.times.size - 1, 0, -1)
                    if next_fast_len(count, real=True) == count)

    @property
    def span(self) -> float:
        """Return the fundamental cycles in the stretch."""
        return self.cycle_length * (self.times.size - 1)

    def read(self) -> None:
        """Read the vibration at the present angle."""
        corrected = self.times - self.states[:, 0]
        period = np.diff(corrected)
        self.slope = self.cycle_length / period
        self.place = (corrected[:-1, None] + period[:, None] * self.u
                      - self.states[:-1, 1:-1] @ self.shapes[1:-2])
        self.vibration = np.moveaxis(self.band.at(self.place), 2, 0) * self.whole[:, None]

    def make_tables(self) -> None:
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
        turned = (self.place - self.band.start)[..., None] * self.tones
        turned -= np.rint(turned)  # waves of small angles take less time
        turned *= 2.0 * np.pi
        waves = np.empty((*turned.shape, 2))
        np.cos(turned, out=waves[..., 0])
        np.sin(turned, out=waves[..., 1])
        self.in_time = waves.reshape(*self.place.shape, -1)
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

    def sums(self, values: Array, shapes: Array | None = None) -> ComplexArray:
        """
        Sum `values` (cycle, point) times each line over the points: (cycle, line).

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
        found = self.signals(turns * self.moved * self.amplitudes)
        found *= self.slope[:, None]
        return found

    def residual(self) -> Array:
        """Return the vibration less the lines (channel, cycle, point)."""
        return np.asarray(self.vibration - (1.0 + self.states[:-1, -1:]) * self.signals(
            self.amplitudes))

    def fit_amplitudes(self) -> None:
        """Fit the amplitudes of all lines with the states as they are."""
        self.make_tables()
        gain = 1.0 + self.states[:-1, -1:]
        right = np.stack([self.sums(row / gain).conj().sum(axis=0)
                          for row in self.vibration], axis=1)
        ridge = ROUNDING * self.normal[0, 0] * np.eye(len(self.normal))
        found = np.linalg.solve(self.normal + ridge, np.vstack((right.real, right.imag)))
        n = len(right)
        self.amplitudes = (found[:n] + 1j * found[n:]).T

    def step(self, *, weak: float = 1.0, move: bool = True) -> float:
        """Do a Gauss-Newton step; return the RMS change of the pulse errors (s)."""
        self.make_tables()
        # a line of no shaft tells nothing of the angle: its own frequency may vary
        moving = self.signals(self.moved * self.amplitudes)
        residual = self.residual() if not self.moved.all() else (
            self.vibration - (1.0 + self.states[:-1, -1:]) * moving)
        points = self.whole.sum() * self.u.size
        self.weight = points / np.einsum('ckp,ckp->c', residual, residual)
        if self.converged:
            self._weigh(residual)
        change, amplitudes, trend = self._solve(residual, (self.rate(), moving), weak)
        self.change = change[:, 0]
        size = float(np.sqrt(np.mean(self.change**2)))
        if move:
            most = _MOST_TURNS / (self.orders[:self.declared].max() * self.frequency)
            # pulses come no nearer to each other than half as far as they were measured
            room = np.diff(0.5 * self.times - self.states[:, 0])
            nearer = np.diff(self.change) / np.maximum(room, 1e-300)
            part = min(1.0, most / max(size, 1e-300), 1.0 / max(float(nearer.max()), 1e-300))
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
        lines = rfft(flat * hann(flat.shape[1]))
        power = lines.real**2 + lines.imag**2
        power /= power.mean(axis=1, keepdims=True)
        reach, span = 0.5 * BEYOND_LINES / self.cycle_length, self.cycle_length * cycles
        places = np.append(self.orders, self.tones / self.frequency)
        first, last = (np.clip(np.rint((places + side) * span).astype(int), side > 0.0,
                               power.shape[1] - (side < 0.0)) for side in (-reach, reach))
        summed = np.pad(np.cumsum(power, axis=1), ((0, 0), (1, 0)))
        around = (summed[:, last] - summed[:, first]) / (last - first)
        for c, height in enumerate((np.abs(self.amplitudes[:, :self.orders.size])
                                    * self.orders) ** 2 + np.finfo(np.float64).tiny):
            share = np.zeros(power.shape[1])
            for i in np.argsort(height).tolist():  # of several orders nearby the strongest counts
                share[first[i]:last[i]] = height[i]
            share /= share.sum()
            taken = cycles * float(self.resolved.sum()) * float(share @ share) / (2 * len(power))
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
        expected[:, 0] -= self.no_jitter
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
        self.solved = solved = Solved.of(cells, border, corner, scale)
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
                found = self.sums(item[c], self.shapes[states])
                found *= weight
                for i, row in zip(states, np.moveaxis(found, 1, 0)):
                    place = border[1:, 0, c] if i == width else border[:-1, i, c]
                    place[:, 0] += row.real
                    place[:, 1] -= row.imag
            total = weight * self.sums(residual[c]).sum(axis=0)
            below[c] = np.append(total.real, -total.imag)
            corner[c, :, c] = weight * self.normal
        flat = np.pad(corner.reshape(below.size, -1), (0, 1))
        flat[np.diag_indices(len(flat))] *= 1.0 + ROUNDING
        return whole, flat, np.append(below, 0.0)

    def variance(self, state: int) -> float:
        """Return the variance of a state of most cycles; that of errors is about their trend."""
        return float(np.median(self.variances(state, about_trend=not state)[2:-2]))

    def variances(self, state: int, *, about_trend: bool = False) -> Array:
        """
        Return the posterior variance of a state at each pulse.

        Those of pulse errors are about the turn that they have in common, which nothing tells.
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
        turn = self.common_turn
        return np.asarray(variance - 2.0 * turn * shared * solved.scale[:, 0]
                          + turn**2 * (mean @ shared))

    def _estimate_sizes(self) -> None:
        """Estimate how large the states are from their values and variances."""
        inner = np.arange(self.times.size)[2:-2]
        inner = inner[self.measured[2:-2]]
        errors = (self.states[:, 0] - self.no_jitter)[inner]
        power, more = self._estimated(0, errors - errors.mean(),
                                      1.0 - 1.0 / np.count_nonzero(self.measured))
        power = max(power, min(more, self.most_power), (_LEAST * self.jitter_std) ** 2)
        self.size[0] = np.sqrt(power)
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
        expected, variance = share * before, self.variance(state)
        power = float(np.mean(values**2)) + variance
        self.resolved[state] = resolved = max(1.0 - variance / expected, ROUNDING)
        gained = power - expected
        if gained > 0.0:
            gained /= resolved**2 if self.converged and not state else resolved
        return power, before + gained

    def amplitude_variances(self) -> Array:
        """Return the variances (channel, line) of real and imaginary part of the amplitudes."""
        schur = self.solved.schur
        variance = np.diag(cho_solve(schur, np.eye(len(schur[0]))))[:-1]
        return np.asarray(variance.reshape(len(self.amplitudes), 2, -1).mean(axis=1)
                          * self.around)


def _products(parts: Array) -> tuple[ComplexArray, ComplexArray]:
    """Return products of waves, and those with the conjugate, of cosines and sines in turn."""
    cos, sin = parts[::2].view(np.complex128), parts[1::2].view(np.complex128)
    return cos + 1j * sin, (cos - 1j * sin).conj()
