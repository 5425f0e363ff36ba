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
The likelihood of the timing of a recording, with any set of effects, and its maximum.

The ordinates of pulse times, recovered errors and bends are normal (Whittle). Their mean is a sum
of patterns, their cross-spectrum that of the shaft's motion, of which nothing is known but that it
is smooth, of the declared jitter, of the noise of the recovery, and of random effects.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import count
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.timing import (
    FAINT, LARGE, MOTION, Pattern, PULSES, ROUNDING, SOURCE, Spectrum, white)
from sa_jitter_ros.inference.line_search import APART
from sa_jitter_ros.inference.timing_data import NOISE, parts, TimingData
from scipy.optimize import minimize

#: What is always there beside the noise: the motion of the shaft and the declared jitter.
SHAFT, JITTER = 'shaft', 'jitter_scale'
# Frequencies at which the spectrum of the motion is free.
_KNOTS = 5
_EDGE_SLOPE = 1.4  # of the motion beyond half the trigger rate
_MEMORIES = 3.0  # least number of memories in a stretch: longer ones look like a drift
_SMOOTH = 3.0  # change of the slope of a free spectrum between knots


class ShaftSpectrum:
    """A density of motion that is free at some frequencies of a trigger cycle."""

    def __init__(self, frequency: Array, lowest: float) -> None:
        """Take the frequencies (...), in cycles a trigger cycle; the first knot is `lowest`."""
        knots, place = np.linspace(math.log(lowest), math.log(0.5), _KNOTS), np.log(frequency)
        self._knots = np.stack([np.interp(place, knots, unit) for unit in np.eye(_KNOTS)])
        self._beyond = np.maximum(place - knots[-1], 0.0)
        self._motion = (2.0 * np.pi * frequency) ** -4

    def density(self, parameters: Array) -> tuple[Array, Array]:
        """
        Return the density, and its slope by each parameter (parameter, ...).

        Parameters are its logarithm at the knots, and that of the slope beyond them.
        """
        steeper = -np.exp(parameters[_KNOTS]) * self._beyond
        level = (parameters[:_KNOTS] @ self._knots.reshape(_KNOTS, -1)).reshape(steeper.shape)
        density = self._motion * np.exp(level + steeper)
        return density, density * np.concatenate([self._knots, steeper[None]])


class TimingFit:
    """
    The fit of some components; `value` is the logarithm of the greatest likelihood.

    `spectra` and `patterns` are the components in question by name; JITTER among the names lets
    the declared jitter have any size. `fixed` are directions and densities of declared random
    errors, `declared_motion` (bin, 3, 3) what those of source and shaft make; `known`
    (ordinate, 3) are the declared patterns. `held` maps (name, number) to the value of
    a parameter that stays. The ordinates without all patterns are `left`, and in bins `power`.
    """

    def __init__(self, data: TimingData, spectra: Mapping[str, Spectrum],
                 patterns: Mapping[str, tuple[Pattern, Array]], *, scaled: bool = False,
                 fixed: Sequence[tuple[str, Callable[[Array], Array]]] = (),
                 known: Array | float = 0.0, start: Mapping[str, Array] | None = None,
                 held: Mapping[tuple[str, int], float] | None = None) -> None:
        self.data, self.spectra, self.patterns = data, spectra, patterns
        self.free_jitter = scaled or any(item.replaces_jitter for item, _ in patterns.values())
        self._shaft = ShaftSpectrum(data.alias[MOTION], APART / data.longest)
        self.columns, total = {}, 0
        stack = []
        for name, (_, columns) in patterns.items():
            self.columns[name] = slice(total, total + columns.shape[-1])
            total += columns.shape[-1]
            stack.append(columns)
        self.matrix = np.concatenate(stack, axis=-1) if stack else np.zeros(
            (*data.ordinates.shape, 0))
        self.ordinates = data.ordinates - known
        self._fixed = np.zeros(data.table.shape[:2])
        for direction, density in fixed:
            self._fixed[data.rows[direction]] += density(data.alias[direction])
        source, motion = (self._fixed[data.rows[moves]] for moves in (SOURCE, MOTION))
        self.declared_motion = data.made(source, SOURCE) + data.made(motion, MOTION)
        if not self.free_jitter:
            self._fixed[data.rows[PULSES]] += 1.0
        self._lay_out(start or {}, held or {})
        self._maximise()

    def _lay_out(self, start: Mapping[str, Array], held: Mapping[tuple[str, int], float]) -> None:
        """Place all parameters in one vector, with bounds."""
        few = max(3, self.data.ordinates.shape[0] // 8)
        level = float(np.log(np.mean(np.abs(self.ordinates[:few, 0]) ** 2) + 1e-12))
        blocks: dict[str, tuple[Sequence[float], Sequence[float], Sequence[float]]] = {
            SHAFT: ((min(level, 3.0),) * (_KNOTS - 1) + (-3.0, _EDGE_SLOPE),
                    (-LARGE,) * _KNOTS + (0.7,), (LARGE,) * _KNOTS + (2.3,)),
            NOISE: ((0.0,), (-2.5,), (3.0,))}
        if self.free_jitter:
            replaced = any(item.replaces_jitter for item, _ in self.patterns.values())
            blocks[JITTER] = ((-3.0 if replaced else 0.0,), (FAINT,), (LARGE,))
        for name, item in self.spectra.items():
            lower = tuple(np.log(1.0 / self.data.longest) if low is None else low
                          for low in item.lower)
            upper = tuple(math.atanh(math.exp(-_MEMORIES / self.data.longest))
                          if high is None else high for high in item.upper)
            blocks[name] = item.starts[0], lower, upper
        self.place, begin = {}, 0
        for name, (first, _, _) in blocks.items():
            self.place[name] = slice(begin, begin + len(first))
            begin += len(first)
        self.lower, self.upper = (np.concatenate([np.asarray(block[i], float)
                                                  for block in blocks.values()]) for i in (1, 2))
        self.parameters = np.concatenate([
            np.asarray(start.get(name, block[0]), float) for name, block in blocks.items()])
        for (name, number), value in held.items():
            at = self.place[name].start + number
            self.parameters[at] = self.lower[at] = self.upper[at] = value
        self.parameters = np.clip(self.parameters, self.lower, self.upper)
        self._held = len(held)
        # the prior is normal: residuals are `stiff` times the parameters, less the usual ones;
        # the slope of the motion beyond the knots and the noise are known to a factor e
        self._stiff = np.zeros((_KNOTS, begin))
        self._stiff[:-2, self.place[SHAFT]][:, :_KNOTS] = np.diff(np.eye(_KNOTS), 2, 0) / _SMOOTH
        self._stiff[-2, self.place[SHAFT].stop - 1] = 1.0
        self._stiff[-1, self.place[NOISE]] = 1.0
        self._usual = np.zeros(_KNOTS)
        self._usual[-2] = _EDGE_SLOPE

    def _maximise(self) -> None:
        self.value = -np.inf
        for restart in count():  # a search that starts again where it ended goes on a little
            before = self.value
            self.sizes, self.size_covariance = self._patterns(
                self.data.made(self._densities(self.parameters)[0]))
            self.left = self.ordinates - self.matrix @ self.sizes
            self.power = self.data.binned(self.left)
            found = minimize(self._cost, self.parameters, method='L-BFGS-B', jac=True,
                             bounds=list(zip(self.lower, self.upper)))
            self.parameters, self.value = found.x, -float(found.fun)
            if restart and not (self.columns and self.value > before + ROUNDING * abs(before)):
                break

    @property
    def count(self) -> int:
        """Return the number of parameters of the components in question."""
        spectra = sum(len(item.upper) for item in self.spectra.values())
        return int(spectra + self.free_jitter + self.matrix.shape[-1] - self._held)

    @property
    def starts(self) -> Mapping[str, Array]:
        """Return the parameters by name, where another fit may start."""
        return {name: self.parameters[place] for name, place in self.place.items()}

    def density(self, name: str, parameters: Array) -> tuple[Array, Array]:
        """
        Return the power of a random component (alias, bin) in unit^2, where it has any.

        Its slopes by each of its parameters (parameter, alias, bin) follow.
        """
        values, alias = parameters[self.place[name]], self.data.alias[self.moves(name)]
        if name == SHAFT:
            return self._shaft.density(values)
        if name in (JITTER, NOISE):
            made = white(values, alias)
            return made, made[None]
        steps = ROUNDING * np.eye(values.size + 1, values.size, -1)
        made = self.spectra[name].density((values + steps).T[:, :, None, None], alias)
        return made[0], (made[1:] - made[0]) / ROUNDING

    def moves(self, name: str) -> str:
        """Return the direction of a random component."""
        return {SHAFT: MOTION, JITTER: PULSES, NOISE: NOISE}.get(
            name) or self.spectra[name].direction

    def contribution(self, name: str) -> Array:
        """Return the cross-spectrum (bin, 3, 3) that a component makes."""
        return self.data.made(self.density(name, self.parameters)[0], self.moves(name))

    def _densities(self, parameters: Array) -> tuple[Array, Array]:
        """Return the density (row, bin) of all components, and its slopes (parameter, ...)."""
        total, slopes = self._fixed.copy(), np.zeros((parameters.size, *self._fixed.shape))
        for name, place in self.place.items():
            rows = self.data.rows[self.moves(name)]
            made, slopes[place, rows] = self.density(name, parameters)
            total[rows] += made
        return total, slopes

    @cached_property
    def spectrum(self) -> Array:
        """Return what all components make of the three series together (bin, 3, 3)."""
        return self.data.made(self._densities(self.parameters)[0])

    def _cost(self, parameters: Array) -> tuple[float, Array]:
        """Return minus the logarithm of likelihood and prior, and its slope."""
        data = self.data
        density, slopes = self._densities(parameters)
        spectrum = data.made(density)
        inverse = np.linalg.inv(spectrum)
        off = self._stiff @ parameters - self._usual
        value = 0.5 * off @ off + data.size @ (np.linalg.slogdet(spectrum)[1] + np.sum(
            parts(inverse) * parts(self.power), axis=1))
        change = data.size[:, None, None] * (inverse - inverse @ self.power @ inverse)
        along = np.einsum('rfk,fk->rf', parts(data.table), parts(change))
        slope = off @ self._stiff + slopes.reshape(parameters.size, -1) @ along.ravel()
        return float(value), slope

    def _patterns(self, spectrum: Array) -> tuple[Array, Array]:
        """Return sizes of the patterns and their covariance."""
        if not self.columns:
            return np.zeros(0), np.zeros((0, 0))
        inverse = np.linalg.inv(spectrum)[self.data.bin] * self.data.weight[:, None, None]
        weighted = (inverse @ self.matrix).reshape(-1, self.matrix.shape[-1])
        normal = 2.0 * (self.matrix.reshape(weighted.shape).conj().T @ weighted).real
        right = 2.0 * (weighted.conj().T @ self.ordinates.ravel()).real
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        covariance = np.linalg.pinv(normal / np.outer(scale, scale), rcond=1e-10) / np.outer(
            scale, scale)
        return covariance @ right, covariance

    @cached_property
    def _changes(self) -> Array:
        """Return the whitened slopes (parameter, bin, 3, 3) of the cross-spectrum."""
        return np.stack([self.inverse @ self.data.made(slope)
                         for slope in self._densities(self.parameters)[1]])

    @cached_property
    def _information(self) -> Array:
        """Return what data and prior are expected to tell of the parameters (Fisher)."""
        return np.asarray(self._stiff.T @ self._stiff + np.einsum(
            'f,afij,bfji->ab', self.data.size, self._changes, self._changes).real)

    def standard_errors(self, name: str) -> Array:
        """Return the standard errors of the parameters of a random component."""
        # a parameter at its bound, or without influence, is known to its range at best
        width = np.where(self.lower < self.upper, self.upper - self.lower, 1e-6)
        covariance = np.linalg.inv(self._information + np.diag(12.0 / width**2))
        return np.asarray(np.sqrt(np.diag(covariance)[self.place[name]]))

    def more_than_held(self, name: str, kurtosis: float) -> tuple[float, float]:
        """
        Return how much more power than this one the data show, and how much it is more than 0.

        Both are in standard errors of the efficient score (Rao 1948): the slope of the likelihood
        by the logarithm of the power, less what the free parameters make of it. `kurtosis` is that
        of the declared errors beyond a normal one's 3: so much more their power scatters. Both
        are 0 where the data show nothing of it.
        """
        at, size = self.parameters, self.data.size
        own = self.place[name].start
        chosen = np.append(own, np.setdiff1d(
            np.flatnonzero((self.lower < at) & (at < self.upper)), own))
        change = self._changes[chosen]
        known = self._information[np.ix_(chosen, chosen)]
        known[1:, 1:] += np.diag(12.0 / (self.upper - self.lower)[chosen[1:]] ** 2)
        share = np.append(1.0, -np.linalg.solve(known[1:, 1:], known[1:, 0]))
        information = float(share @ known[0])
        if not information > 0.0:  # a source that moves, against a reference keyphasor
            return 0.0, 0.0
        weight = np.einsum('a,afij->fij', share, change)
        declared = np.einsum('f,fij,fji->', size, weight @ self.inverse,
                             self.data.table[self.data.rows[PULSES]][0]).real
        if JITTER in self.place:  # more may be of normal errors beside
            power = float(at[self.place[JITTER]][0])
            declared *= math.exp(power if name == JITTER else min(power, 0.0))
        error = math.sqrt(information + 0.5 * kurtosis * declared**2 / np.sum(size))
        # powers of few frequencies are skewed: a gamma variable by the root of its cube is normal
        skewness = 2.0 * np.einsum('f,fij,fjk,fki->', size, *3 * [weight]).real
        few = float(skewness) / information**1.5 / 6.0
        more = float(-share @ self._cost(at)[1][chosen]) / error
        return float(np.cbrt(1.0 + 3.0 * few * more) - 1.0) / few + few, information / error

    def pattern(self, name: str) -> tuple[Array, Array]:
        """Return the sizes of the columns of a pattern and their covariance."""
        place = self.columns[name]
        return self.sizes[place], self.size_covariance[place, place]

    @cached_property
    def inverse(self) -> Array:
        """Return the inverse of the cross-spectrum (bin, 3, 3)."""
        return np.asarray(np.linalg.inv(self.spectrum))

    def beside_motion(self, alias: int) -> Array:
        """Return the inverse (bin, 3, 3) in which motion at one of `ALIASES` counts nothing."""
        steer = self.data.steer[MOTION][alias]
        found = self.inverse @ steer @ self.inverse
        return np.asarray(self.inverse - found / np.einsum(
            'fij,fji->f', self.inverse, steer).real[:, None, None])

    def floor(self, direction: str, inverse: Array) -> Array:
        """Return the variance (bin,), in unit^2, of what the data tell of power in a direction."""
        steer = self.data.steer[direction][0]
        return np.asarray(1.0 / np.einsum('fij,fji->f', inverse, steer).real)

    def excess(self, direction: str, inverse: Array) -> Array:
        """Return the power (bin,) in a direction over that of the fit; 1 where all is right."""
        steer = self.data.steer[direction][0]
        weight = inverse @ steer @ inverse
        return np.asarray(np.einsum('fij,fji->f', weight, self.power).real
                          / np.einsum('fij,fji->f', inverse, steer).real)
