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
Condition indicators of a synchronous average: numbers that grow with the damage of a gear.

A healthy gear shows mesh harmonics, a few shaft orders and a few sidebands; a damaged tooth adds
all other orders. With ``M`` the mesh orders, their harmonics, the first shaft orders and the mean,
and ``S`` the sidebands (the orders next to a mesh harmonic), `separate` gives::

    regular    = M and S                     (as MATLAB's tsaregular with NumSidebands)
    difference = everything but M and S      (tsadifference)
    residual   = everything but M            (tsaresidual; the sidebands are kept)

so that regular + difference is the average. An average over one revolution consists of harmonics
of the shaft only, so "shaft harmonics" means the first few; two are customary. Stewart (1977)
introduced these signals; Lebold et al., "Review of vibration analysis methods for gearbox
diagnostics and prognostics", 54th MFPT (2000), says which indicator uses which signal.

``x`` is the average, ``d`` the difference and ``r`` the residual signal, ``s(.)`` a standard
deviation over one revolution (divisor n), ``mk(.)`` a central moment over one revolution and
``A`` are peak amplitudes of orders. In the order of `INDICATORS`::

    rms, peak, crest_factor   sqrt(mean x^2); max |x|; peak / rms. An offset of x counts.
    kurtosis                  m4(x) / s(x)^4; 3 for Gaussian noise. Dyer and Stewart (1978)
    fm0                       (max x - min x) / sum of A over all mesh harmonics. Stewart (1977)
    fm4                       m4(d) / s(d)^4; 3 for Gaussian noise. Stewart (1977)
    m6a, m8a                  m6(d) / s(d)^6, m8(d) / s(d)^8; 15 and 105 for Gaussian noise.
                              Martin (1989)
    na4                       m4(r) / (mean of s(r)^2 over all averages so far)^2: grows on with
                              the damage. Zakrajsek, Townsend, Decker (1993)
    energy_ratio              s(d) / s(regular signal). Swansson (1980)
    sideband_ratio            sum of A over the sidebands of the mesh orders / sum of A over the
                              mesh orders. Hanna, Hatch, Kalb, Weiss, Luo (2011), with as many
                              pairs as `GearSettings.sidebands` says (they take 6)
    sideband_level_factor     sum of A over the first sidebands of the mesh orders / s(x).
                              Vecer, Kreidl, Smid (2005)

Overviews: Lebold et al. (2000); Vecer, Kreidl, Smid, "Condition indicators for gearbox condition
monitoring systems", Acta Polytechnica 45 (2005). A value is NaN where its denominator is zero
within rounding (a constant signal for example). Without mesh orders all from fm0 on are NaN.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.errors import ParameterError, SignalError

Array = NDArray[Any]

INDICATORS: tuple[str, ...] = (
    'rms', 'peak', 'crest_factor', 'kurtosis', 'fm0', 'fm4', 'm6a', 'm8a', 'na4',
    'energy_ratio', 'sideband_ratio', 'sideband_level_factor')

# Fraction of the peak of the average, below which a value is a rounding error.
_ROUNDING = 1e-13
# Far above the range of any sensor; its square is far from overflow.
_LARGEST_SAMPLE = 1e100


@dataclass(frozen=True)
class GearSettings:
    """
    Which orders of an average belong to the regular signal.

    `mesh_orders` are the numbers of teeth on the shaft of interest (one for each gear on it; empty
    if unknown), `sidebands` the number of pairs of sidebands of each mesh harmonic, one order
    apart, `shaft_harmonics` the number of shaft orders. Raises ParameterError for a mesh order
    that is not a positive integer and for negative numbers.
    """

    mesh_orders: Sequence[float] = ()
    sidebands: int = 1
    shaft_harmonics: int = 2

    def __post_init__(self) -> None:
        """Check the numbers and make them integers, the mesh orders a sorted tuple."""
        mesh_orders = np.unique(np.asarray(self.mesh_orders, float))
        for order in mesh_orders:
            if not (order >= 1.0 and order.is_integer()):
                raise ParameterError(
                    f'mesh order {order:g} is not a positive integer: an average over one '
                    'revolution has whole orders only; give the number of teeth of the gear')
        object.__setattr__(self, 'mesh_orders', tuple(int(order) for order in mesh_orders))
        for name in ('sidebands', 'shaft_harmonics'):
            count = float(getattr(self, name))
            if not (count >= 0.0 and count.is_integer()):
                raise ParameterError(f'{name} = {count:g}: give a whole number, 0 or more')
            object.__setattr__(self, name, int(count))


@dataclass(frozen=True)
class GearLines:
    """
    The kinds of orders 0..n//2 of an average, as boolean masks.

    `mesh` are the mesh harmonics, `shaft` the mean and the shaft harmonics that are not mesh
    harmonics, `sidebands` the neighbours of mesh harmonics that are neither. `fundamentals` are
    the mesh orders, `fundamental_sidebands` those up to `GearSettings.sidebands` orders from them,
    and `first_sidebands` those one order from them, for any settings.
    """

    mesh: Array
    shaft: Array
    sidebands: Array
    fundamentals: Array
    fundamental_sidebands: Array
    first_sidebands: Array


@dataclass(frozen=True)
class GearSignals:
    """
    The gear signals of an average, of its shape (..., n), and the peak amplitudes of its orders.

    `amplitudes` (..., n//2 + 1) is indexed by order and by the masks of `lines`.
    """

    regular: Array
    residual: Array
    difference: Array
    amplitudes: Array
    lines: GearLines


def gear_lines(settings: GearSettings, points: int) -> GearLines:
    """
    Return the kinds of orders of an average with so many points.

    Raises ParameterError for a mesh order at or above the Nyquist order, half the points.
    """
    for mesh_order in settings.mesh_orders:
        if 2 * mesh_order >= points:
            raise ParameterError(
                f'mesh order {mesh_order} is not below the Nyquist order {points / 2:g} of an '
                f'average of {points} points: use more samples per revolution')
    orders = np.arange(points // 2 + 1)
    tooth_counts = np.asarray(settings.mesh_orders, int)
    fundamentals = np.isin(orders, tooth_counts)
    mesh = (orders[:, None] % tooth_counts == 0).any(axis=1) & (orders > 0)
    shaft = (orders <= settings.shaft_harmonics) & ~mesh

    def neighbours(centres: Array, reach: int) -> Array:
        reach = min(reach, orders.size)
        kernel = np.ones(2 * reach + 1)
        near = np.convolve(centres, kernel)[reach:reach + orders.size] > 0.5
        return np.asarray(near & ~mesh & ~shaft)

    return GearLines(
        mesh=mesh, shaft=shaft, sidebands=neighbours(mesh, settings.sidebands),
        fundamentals=fundamentals,
        fundamental_sidebands=neighbours(fundamentals, settings.sidebands),
        first_sidebands=neighbours(fundamentals, 1))


def separate(average: ArrayLike, settings: GearSettings) -> GearSignals:
    """
    Return the gear signals of a synchronous average over one revolution, (..., n).

    Raises SignalError for samples that are not finite and for an average that is empty or has one
    point, ParameterError for a mesh order at or above the Nyquist order n/2.

    >>> angle = np.arange(256) / 256
    >>> average = np.cos(2.0 * np.pi * 19.0 * angle) + 0.1 * np.cos(2.0 * np.pi * 7.0 * angle)
    >>> signals = separate(average, GearSettings(mesh_orders=[19]))
    >>> float(signals.regular.std().round(3)), float(signals.difference.std().round(3))
    (0.707, 0.071)
    >>> float(signals.amplitudes[7].round(3))
    0.1
    """
    samples = np.asarray(average, float)
    if samples.size == 0 or samples.ndim == 0 or samples.shape[-1] < 2:
        raise SignalError(f'average of shape {samples.shape}: its last dimension is the angle and '
                          'must have 2 points or more, the others 1 or more')
    if not np.all(np.abs(samples) < _LARGEST_SAMPLE):
        raise SignalError(f'average with samples that are not finite or not below '
                          f'{_LARGEST_SAMPLE:g}: leave this average out')
    points = samples.shape[-1]
    lines = gear_lines(settings, points)
    spectrum = np.fft.rfft(samples)
    # Of the mean, and of the Nyquist order of even n, there is no negative frequency.
    weight = np.full(spectrum.shape[-1], 2.0 / points)
    weight[0] = 1.0 / points
    if points % 2 == 0:
        weight[-1] = 1.0 / points
    difference = np.fft.irfft(
        np.where(lines.mesh | lines.shaft | lines.sidebands, 0.0, spectrum), points)
    return GearSignals(
        regular=samples - difference,
        residual=difference + np.fft.irfft(np.where(lines.sidebands, spectrum, 0.0), points),
        difference=difference, amplitudes=weight * np.abs(spectrum), lines=lines)


@dataclass(frozen=True)
class ConditionIndicators:
    """
    Condition indicators in the order of `names`: `values` (..., indicator), NaN where undefined.

    The leading dimensions are the average's: (channel, indicator) or (average, channel,
    indicator). `averages` is the number of averages on which na4 is based.
    """

    values: Array
    averages: int
    names: tuple[str, ...] = INDICATORS

    def __getitem__(self, name: str) -> Array:
        """Return one indicator of all channels by its name."""
        return np.asarray(self.values[..., self.names.index(name)])


class RunningIndicators:
    """
    Condition indicators of one average after another, with the history that na4 needs.

    The result after each update equals that of `condition_indicators` for all averages so far.

    >>> running = RunningIndicators(GearSettings(mesh_orders=[19]))
    >>> noise = np.random.default_rng(1)
    >>> for growth in (1.0, 1.0, 2.0):
    ...     running.update(growth * noise.normal(0.0, 0.1, (1, 512)))
    ...     print(running.get()['na4'].round(1))
    [3.2]
    [3.9]
    [12.7]
    """

    def __init__(self, settings: GearSettings | None = None) -> None:
        """Start without history."""
        self._settings = settings or GearSettings()
        self._variance_sum: Array = np.zeros(0)
        self._latest = ConditionIndicators(np.zeros((0, len(INDICATORS))), 0)

    def update(self, average: ArrayLike) -> None:
        """
        Take the next average, (channels, n).

        Raises SignalError and ParameterError as `condition_indicators` does, and SignalError if
        the number of channels changes. After an error the history is unchanged.
        """
        samples = np.asarray(average, float)
        count = self._latest.averages
        if samples.ndim != 2 or (count > 0 and samples.shape[0] != self._variance_sum.size):
            expected = self._variance_sum.size if count else 'any number of'
            raise SignalError(f'average of shape {samples.shape}: expected {expected} channels x '
                              'points; make new RunningIndicators when the channels change')
        values, self._variance_sum = _indicators(
            samples[None], self._settings, count, self._variance_sum if count else np.zeros(()))
        self._latest = ConditionIndicators(values[0], count + 1)

    def get(self) -> ConditionIndicators:
        """Return the indicators of the latest average; before the first one, of no channel."""
        return self._latest


def condition_indicators(
    average: ArrayLike, settings: GearSettings | None = None,
) -> ConditionIndicators:
    """
    Return the condition indicators of one average or of a history of averages.

    `average` is (channels, n), or (averages, channels, n) from the oldest to the latest. na4 uses
    an average and those before it; of a single average it is the kurtosis of the residual signal.
    Raises SignalError for another shape or samples that are not finite, ParameterError for a mesh
    order at or above the Nyquist order n/2.

    A sine has the kurtosis 1.5. A pulse in one place of the revolution, as of a damaged tooth,
    raises the indicators of the difference signal:

    >>> angle = np.arange(512) / 512
    >>> healthy = np.cos(2.0 * np.pi * 19.0 * angle)
    >>> damaged = healthy + 0.2 * np.exp(-(((angle - 0.5) / 0.01) ** 2))
    >>> indicators = condition_indicators([healthy, damaged], GearSettings(mesh_orders=[19]))
    >>> indicators['kurtosis'].round(2), indicators['fm4'].round(1)
    (array([1.5, 1.5]), array([ nan, 37.4]))
    """
    samples = np.asarray(average, float)
    if samples.ndim not in (2, 3):
        raise SignalError(f'average of shape {samples.shape}: give channels x points, or '
                          'averages x channels x points')
    history = samples if samples.ndim == 3 else samples[None]
    values, _ = _indicators(history, settings or GearSettings(), 0, np.zeros(()))
    return ConditionIndicators(values if samples.ndim == 3 else values[0], len(history))


def _indicators(
    history: Array, settings: GearSettings, count: int, variance_sum: Array,
) -> tuple[Array, Array]:
    """
    Return the values of (averages, channels, n), and the new sum of residual variances.

    `variance_sum` is that of the `count` averages before these.
    """
    signals = separate(history, settings)
    lines = signals.lines
    peak = np.abs(history).max(axis=-1)

    def defined(denominator: Array) -> Array:
        return np.where(denominator > _ROUNDING * peak, denominator, np.nan)

    def squares(signal: Array, deviation: Array) -> Array:
        centred = signal - signal.mean(axis=-1, keepdims=True)
        return np.asarray(np.square(centred / defined(deviation)[..., None]))

    def mean_product(a: Array, b: Array) -> Array:
        return np.asarray(np.einsum('...i,...i->...', a, b) / a.shape[-1])

    def amplitude_sum(mask: Array) -> Array:
        return np.asarray(signals.amplitudes[..., mask].sum(axis=-1) if mask.any()
                          else np.full(peak.shape, np.nan))

    rms = np.sqrt(mean_product(history, history))
    deviation = history.std(axis=-1)
    square = squares(history, deviation)
    difference_deviation = signals.difference.std(axis=-1)
    difference_square = squares(signals.difference, difference_deviation)
    difference_fourth = np.square(difference_square)
    variance_sums = variance_sum + np.cumsum(signals.residual.var(axis=-1), axis=0)
    counts = np.arange(count + 1, count + 1 + len(history))[:, None]
    residual_square = squares(signals.residual, np.sqrt(variance_sums / counts))
    values = np.stack([
        rms,
        peak,
        peak / defined(rms),
        mean_product(square, square),
        np.ptp(history, axis=-1) / defined(amplitude_sum(lines.mesh)),
        difference_fourth.mean(axis=-1),
        mean_product(difference_fourth, difference_square),
        mean_product(difference_fourth, difference_fourth),
        mean_product(residual_square, residual_square),
        difference_deviation / defined(signals.regular.std(axis=-1)),
        amplitude_sum(lines.fundamental_sidebands) / defined(amplitude_sum(lines.fundamentals)),
        amplitude_sum(lines.first_sidebands) / defined(deviation),
    ], axis=-1)
    if not settings.mesh_orders:
        values[..., INDICATORS.index('fm0'):] = np.nan
    return values, variance_sums[-1]
