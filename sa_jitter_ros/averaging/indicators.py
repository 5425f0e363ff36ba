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

``x`` is the average without its mean, ``d`` the difference and ``r`` the residual signal, ``e``
the envelope of the lowest mesh order with the orders around it up to half its number of teeth
away, ``s(.)`` a standard deviation over one revolution (divisor n), ``mk(.)`` a central moment
over one revolution and ``A`` are peak amplitudes of orders. ``all`` is the mean over all averages
so far, ``nominal`` that over the averages of the undamaged gear. In the order of `INDICATORS`::

    rms, peak, crest_factor   sqrt(mean x^2); max |x|; peak / rms
    kurtosis                  m4(x) / s(x)^4; 3 for Gaussian noise. Dyer and Stewart (1978)
    fm0                       (max x - min x) / sum of A over all mesh harmonics. Stewart (1977)
    fm4                       m4(d) / s(d)^4; 3 for Gaussian noise. Stewart (1977)
    m6a, m8a                  m6(d) / s(d)^6, m8(d) / s(d)^8; 15 and 105 for Gaussian noise.
                              Martin (1989)
    na4                       m4(r) / (all s(r)^2)^2: grows on with the damage. Zakrajsek,
                              Townsend, Decker (1993), NASA TM-105950
    energy_ratio              s(d) / s(regular signal). Swansson (1980)
    sideband_ratio            sum of A over the sidebands of the mesh orders / sum of A over the
                              mesh orders. Hanna, Hatch, Kalb, Weiss, Luo (2011), with as many
                              pairs as `GearSettings.sidebands` says (they take 6)
    sideband_level_factor     sum of A over the first sidebands of the mesh orders / s(x).
                              Vecer, Kreidl, Smid (2005)
    na4_star                  m4(r) / (nominal s(r)^2)^2: na4 falls again when the damage has
                              spread, because all s(r)^2 grow. Decker, Handschuh, Zakrajsek (1994),
                              NASA TM-106553
    nb4                       m4(e) / (all s(e)^2)^2. Zakrajsek, Handschuh, Decker (1994), NASA
                              TM-106467
    m6a_star, m8a_star        m6(d) / (nominal s(d)^2)^3, m8(d) / (nominal s(d)^2)^4: normalised as
                              na4_star is. Decker (2002), NASA TM-2002-211492

An average counts as nominal unless its variance is more than 3 standard deviations above the mean
of the nominal ones before it; the first 8 do. Decker et al. choose the limit by a probability.

Overviews: Lebold et al. (2000); Vecer, Kreidl, Smid, "Condition indicators for gearbox condition
monitoring systems", Acta Polytechnica 45 (2005). A value is NaN where its denominator is zero
within rounding (a constant signal for example). Without mesh orders all from fm0 on are NaN.

Standard errors are by the jackknife over parts of the cycles of an average (`jackknife.py`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.amplitude_errors import widened
from sa_jitter_ros.averaging.jackknife import jackknife_variance, PARTS, WaveformParts
from sa_jitter_ros.errors import ParameterError, SignalError
from scipy.fft import ifft, next_fast_len

INDICATORS: tuple[str, ...] = (
    'rms', 'peak', 'crest_factor', 'kurtosis', 'fm0', 'fm4', 'm6a', 'm8a', 'na4',
    'energy_ratio', 'sideband_ratio', 'sideband_level_factor', 'na4_star', 'nb4', 'm6a_star',
    'm8a_star')
#: Those in the unit of the vibration; the others have none.
IN_UNIT = ('rms', 'peak')

# Fraction of the peak of the average, below which a value is a rounding error.
_ROUNDING = 1e-13
# Far above the range of any sensor; its square is far from overflow.
_LARGEST_SAMPLE = 1e100
# Averages that are nominal in any case, and standard deviations above their mean up to which
# further ones are.
_FIRST_NOMINAL, _NOMINAL = 8, 3.0
# Averages over which the variance by the jackknife is smoothed: one alone has two degrees of
# freedom.
_SMOOTHED = 8
# Standard deviation of an indicator over that by the jackknife, measured
# (benchmarks/interval_coverage.py): three parts exaggerate that of a moment of noise by a tenth,
# that of a moment that a burst makes not at all; the factor is between.
_JACKKNIFE = np.array([{
    'peak': 1.02, 'crest_factor': 1.02, 'kurtosis': 0.96, 'fm0': 1.02, 'fm4': 0.92, 'm6a': 0.92,
    'm8a': 0.97, 'na4': 1.04, 'na4_star': 1.04,
    'nb4': 1.13, 'm8a_star': 1.03}.get(name, 1.0) for name in INDICATORS])
_CHANGED = 3.0  # errors from which on an indicator has changed
# Points of the envelope in a period of its highest order: it has cusps where it touches zero, of
# which 8 miss up to 2 % of nb4, 32 less than 0.1 %.
_ENVELOPE_POINTS = 32
_CACHED = 1 << 14  # numbers


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

    `amplitudes` and the complex `spectrum` (numpy.fft.rfft), both (..., n//2 + 1), are indexed by
    order and by the masks of `lines`.
    """

    regular: Array
    residual: Array
    difference: Array
    amplitudes: Array
    spectrum: Array
    lines: GearLines


@lru_cache(maxsize=16)
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


def _checked(average: ArrayLike) -> Array:
    """Return the samples of an average; raises SignalError as `separate` does."""
    samples = np.asarray(average, float)
    if samples.size == 0 or samples.ndim == 0 or samples.shape[-1] < 2:
        raise SignalError(f'average of shape {samples.shape}: its last dimension is the angle and '
                          'must have 2 points or more, the others 1 or more')
    if not max(samples.max(), -samples.min()) < _LARGEST_SAMPLE:
        raise SignalError(f'average with samples that are not finite or not below '
                          f'{_LARGEST_SAMPLE:g}: leave this average out')
    return samples


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
    return _separated(_checked(average), settings)


def _separated(samples: Array, settings: GearSettings) -> GearSignals:
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
    residual = difference
    if lines.sidebands.any():
        residual = difference + np.fft.irfft(np.where(lines.sidebands, spectrum, 0.0), points)
    return GearSignals(
        regular=samples - difference, residual=residual, difference=difference,
        amplitudes=weight * np.abs(spectrum), spectrum=spectrum, lines=lines)


@dataclass(frozen=True)
class ConditionIndicators:
    """
    Condition indicators in the order of `names`: `values` (..., indicator), NaN where undefined.

    The leading dimensions are the average's: (channel, indicator) or (average, channel,
    indicator). `averages` is the number of averages on which na4 is based. `standard_errors` are
    those of the values, NaN without parts of the average.
    """

    values: Array
    averages: int
    standard_errors: Array
    names: tuple[str, ...] = INDICATORS

    def __getitem__(self, name: str) -> Array:
        """Return one indicator of all channels by its name."""
        return np.asarray(self.values[..., self.names.index(name)])


class RunningIndicators:
    """
    Condition indicators of one average after another, with the history that some of them need.

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
        self._history = _History()
        self._variance: Array = np.zeros(0)  # of the logarithms
        self._level: Array = np.zeros(0)  # mean logarithms
        self._jackknifed = 0
        empty = np.zeros((0, len(INDICATORS)))
        self._latest = ConditionIndicators(empty, 0, empty)

    def update(self, average: ArrayLike, parts: WaveformParts | None = None) -> None:
        """
        Take the next average, (channels, n), and the `parts` of its cycles for standard errors.

        Channels that are not finite have no indicators; their history waits for the next average.

        Raises SignalError and ParameterError as `condition_indicators` does, and SignalError if
        the number of channels changes. After an error the history is unchanged.
        """
        samples = np.ascontiguousarray(average, float)
        count, channels = self._latest.averages, len(self._latest.values)
        if samples.ndim != 2 or (count > 0 and samples.shape[0] != channels):
            expected = channels if count else 'any number of'
            raise SignalError(f'average of shape {samples.shape}: expected {expected} channels x '
                              'points; make new RunningIndicators when the channels change')
        replicates = () if parts is None else parts.without_one(samples)
        together = np.stack((samples, *replicates))
        lost = ~np.isfinite(samples).all(axis=1)
        if not lost.all():
            together[:, lost] = 0.0
        moments = _moments(together, self._settings)
        for item in moments if lost.any() else ():
            item[:, lost] = np.nan
        if parts is not None:
            moments = moments.levelled(parts.counts).with_extents(parts, self._settings)
        values = self._history.take(moments)
        error = np.full(values[0].shape, np.nan)
        if parts is not None and len(replicates):
            with np.errstate(divide='ignore', invalid='ignore'):
                logarithms = np.log(values)
                error = self._error(logarithms[0], self._history.variance + jackknife_variance(
                    logarithms[0], logarithms[1:], parts.counts))
        self._latest = ConditionIndicators(values[0], count + 1, error)

    def _error(self, logarithm: Array, variance: Array) -> Array:
        """
        Return the standard error of the latest values from their `logarithm` and its `variance`.

        Both are smoothed over the averages. A value that is low by chance must not have a small
        error: the relative one counts from halfway to the smoothed value, unless it has changed.
        """
        if not self._jackknifed:
            self._variance, self._level = variance, logarithm
        self._jackknifed += 1
        share = max(1.0 / self._jackknifed, 1.0 / _SMOOTHED)

        def smoothed(before: Array, latest: Array) -> Array:
            return np.where(np.isfinite(latest - before), before + share * (latest - before),
                            latest)

        self._variance = smoothed(self._variance, variance)
        relative = _JACKKNIFE * widened(np.sqrt(self._variance), (PARTS - 1.0) / share)
        changed = ~(np.abs(logarithm - self._level) < _CHANGED * relative)
        self._level = np.where(changed, logarithm, smoothed(self._level, logarithm))
        return np.asarray(relative * np.exp(0.5 * (logarithm + self._level)))

    def get(self) -> ConditionIndicators:
        """Return the indicators of the latest average; before the first one, of no channel."""
        return self._latest


def condition_indicators(
    average: ArrayLike, settings: GearSettings | None = None,
) -> ConditionIndicators:
    """
    Return the condition indicators of one average or of a history of averages.

    `average` is (channels, n), or (averages, channels, n) from the oldest to the latest. na4 and
    those that end in _star or b4 use an average and those before it; of a single average na4 is
    the kurtosis of the residual signal. Raises SignalError for another shape or samples that are
    not finite, ParameterError for a mesh order at or above the Nyquist order n/2.

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
    running, values = RunningIndicators(settings), []
    for item in _checked(samples).reshape(-1, *samples.shape[-2:]):
        running.update(item)
        values.append(running.get().values)
    found = np.array(values) if samples.ndim == 3 else values[0]
    return ConditionIndicators(found, len(values), np.full(found.shape, np.nan))


class _Moments(NamedTuple):
    """
    What the indicators of an average need, each an array (average, channel).

    `own` (average, channel, indicator) are those that need no other average. `extents` (average,
    channel, 3) are the largest distance from the mean, the range, and the sum of the amplitudes of
    the mesh. `peak` is no less than that of the samples; all signals are divided by it before
    powers are taken. `residual`, `difference` and `envelope` are the variances of these signals,
    divided by peak^2, with the central moments of the named orders, divided by its powers.
    """

    own: Array
    extents: Array
    peak: Array
    residual: Array
    residual_4: Array
    difference: Array
    difference_6: Array
    difference_8: Array
    envelope: Array
    envelope_4: Array

    def levelled(self, counts: Array) -> '_Moments':
        """
        Return the moments of an average and of it without one part each, with the same noise.

        `counts` (part,) is the number of cycles in each part. The mean of fewer cycles has more
        noise, which m8a_star would show with its eighth power.
        """
        more = counts / (counts.sum() - counts)

        def level(variance: Array) -> Array:
            own = variance * self.peak**2
            noise = np.clip((own[1:].mean(axis=0) - own[0]) / more.mean(), 0.0, own[0])
            expected = own[0] + more[:, None] * noise
            share = own[0] / np.maximum(expected, np.finfo(float).tiny)
            return np.concatenate((np.ones((1, *share.shape[1:])), share))

        residual, difference = level(self.residual), level(self.difference)
        values = self.own.copy()
        values[..., INDICATORS.index('energy_ratio')] *= np.sqrt(difference)
        return self._replace(
            own=values, residual=self.residual * residual,
            residual_4=self.residual_4 * residual**2, difference=self.difference * difference,
            difference_6=self.difference_6 * difference**3,
            difference_8=self.difference_8 * difference**4)

    def with_extents(self, parts: WaveformParts, settings: GearSettings) -> '_Moments':
        """
        Return the moments of an average and of it without one part each, with other extents.

        Where several points compete for the maximum, the jackknife exaggerates what it scatters.
        That of a third of the cycles, whose noise is sqrt(3) as large, scatters sqrt(3) as much,
        if one point is the maximum or noise makes all of them, and less in between. The mean of
        the deviations of both is taken.
        """
        weight = (parts.counts / parts.counts.sum())[:, None, None]
        points = parts.waveforms.shape[-1]
        mesh: Array = np.zeros(parts.waveforms.shape[:-1])
        if settings.mesh_orders:
            amplitudes = 2.0 / points * np.abs(np.fft.rfft(parts.waveforms))
            mesh = amplitudes[..., gear_lines(settings, points).mesh].sum(axis=-1)
        of_parts = _extents(parts.waveforms, parts.waveforms.mean(axis=-1), mesh)
        among = (weight * of_parts).sum(axis=0) - of_parts
        left_out = self.extents[1:] - self.extents[1:].mean(axis=0)
        extents = self.extents[0] + 0.5 * (weight / (1.0 - weight) * among + left_out)
        own = self.own.copy()
        with np.errstate(divide='ignore', invalid='ignore'):
            farthest, width, total = np.moveaxis(extents / self.extents[1:], -1, 0)
            for name, change in (('peak', farthest), ('crest_factor', farthest),
                                 ('fm0', width / total)):
                own[1:, :, INDICATORS.index(name)] *= change
        return self._replace(own=own)


def _extents(samples: Array, mean: Array, mesh: Array) -> Array:
    """Return the `extents` of `_Moments`; `mesh` is the sum of the amplitudes of the mesh."""
    largest, smallest = samples.max(axis=-1), samples.min(axis=-1)
    return np.stack((np.maximum(largest - mean, mean - smallest), largest - smallest,
                     mesh), axis=-1)


def _mean_product(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum('...i,...i->...', a, b) / a.shape[-1])


def _moments(samples: Array, settings: GearSettings) -> _Moments:
    """Return the moments of averages (average, channel, n)."""
    together = max(_CACHED // max(samples[:, :1].size, 1), 1)
    parts = [_moments_together(samples[:, first:first + together], settings)
             for first in range(0, max(samples.shape[1], 1), together)]
    return _Moments(*(np.concatenate(items, axis=1) for items in zip(*parts)))


def _moments_together(samples: Array, settings: GearSettings) -> _Moments:
    """Return the moments of averages of some channels, few enough for the cache."""
    mean, unknown = _checked(samples).mean(axis=-1), np.full(samples.shape[:-1], np.nan)
    signals = _separated(samples, settings) if settings.mesh_orders else None
    extents = _extents(samples, mean, np.zeros(mean.shape) if signals is None else
                       signals.amplitudes[..., signals.lines.mesh].sum(axis=-1))
    peak = np.maximum(np.abs(mean) + extents[..., 0], np.sqrt(np.finfo(float).tiny))
    square = _squares(samples - mean[..., None], peak)
    rms = np.sqrt(square.mean(axis=-1))
    own = np.stack([rms * peak, extents[..., 0], extents[..., 0] / peak / _defined(rms),
                    _mean_product(square, square) / _defined(rms) ** 4,
                    *(unknown,) * (len(INDICATORS) - 4)], axis=-1)
    moments = _Moments(own, extents, peak, *(unknown,) * 7)
    return moments if signals is None else _of_gear(signals, settings, moments, rms)


def _of_gear(signals: GearSignals, settings: GearSettings, moments: _Moments, rms: Array
             ) -> _Moments:
    """Return `moments` with what needs mesh orders; `rms` is that of the average over the peak."""
    lines, peak, own = signals.lines, moments.peak, moments.own

    def amplitude_sum(mask: Array) -> Array:
        return np.asarray(signals.amplitudes[..., mask].sum(axis=-1) / peak if mask.any()
                          else np.full(peak.shape, np.nan))

    square = _squares(signals.residual, peak)
    residual, residual_4 = square.mean(axis=-1), _mean_product(square, square)
    square = _squares(signals.difference, peak)
    difference = square.mean(axis=-1)
    power = np.square(square)
    deviation = _defined(np.sqrt(difference))
    difference_6, difference_8 = _mean_product(power, square), _mean_product(power, power)
    envelope = _mesh_envelope(signals.spectrum, signals.regular.shape[-1], settings)
    square = _squares(envelope - envelope.mean(axis=-1, keepdims=True), peak)
    regular = np.sqrt(np.maximum(rms**2 - difference, 0.0))
    for name, value in (
            ('fm0', moments.extents[..., 1] / peak / _defined(amplitude_sum(lines.mesh))),
            ('fm4', power.mean(axis=-1) / deviation**4),
            ('m6a', difference_6 / deviation**6),
            ('m8a', difference_8 / deviation**8),
            ('energy_ratio', np.sqrt(difference) / _defined(regular)),
            ('sideband_ratio', amplitude_sum(lines.fundamental_sidebands)
             / _defined(amplitude_sum(lines.fundamentals))),
            ('sideband_level_factor', amplitude_sum(lines.first_sidebands) / _defined(rms))):
        own[..., INDICATORS.index(name)] = value
    return moments._replace(
        residual=residual, residual_4=residual_4, difference=difference,
        difference_6=difference_6, difference_8=difference_8, envelope=square.mean(axis=-1),
        envelope_4=_mean_product(square, square))


def _defined(denominator: Array) -> Array:
    return np.where(denominator > _ROUNDING, denominator, np.nan)


def _squares(signal: Array, peak: Array) -> Array:
    return np.asarray(np.square(signal * (1.0 / peak)[..., None]))


def _mesh_envelope(spectrum: Array, points: int, settings: GearSettings) -> Array:
    """Return the envelope (..., angle) of the lowest mesh order and those around it."""
    mesh = min(int(order) for order in settings.mesh_orders)
    reach = min(mesh // 2, (points - 1) // 2 - mesh)
    count = next_fast_len(_ENVELOPE_POINTS * (2 * reach + 1))
    band = np.zeros((*spectrum.shape[:-1], count), complex)
    band[..., :2 * reach + 1] = spectrum[..., mesh - reach:mesh + reach + 1]
    return np.asarray(np.abs(ifft(band)) * (2.0 * count / points))


class _Reference:
    """The mean of a variance over averages, all or the nominal ones, of each channel."""

    def __init__(self, nominal: bool) -> None:
        self._nominal = nominal
        self._count: Array = np.zeros(())
        self._mean: Array = np.zeros(())
        self._squares: Array = np.zeros(())

    @property
    def uncertainty(self) -> Array:
        """Return the variance (channel,) that earlier averages give to the reference, relative."""
        scatter = self._squares / np.maximum(self._count - 1.0, 1.0)
        earlier = np.maximum(self._count - 1.0, 0.0) / np.maximum(self._count, 1.0) ** 2
        relative = np.sqrt(scatter) / np.maximum(self._mean, np.finfo(float).tiny)
        return np.asarray(earlier * relative**2)

    def take(self, variance: Array) -> Array:
        """
        Take the variance of the next average; return the reference with it.

        `variance` (replicate, channel) is that of the average and of replicates of it, for each of
        which the reference is returned; the first counts.
        """
        counts = np.isfinite(variance[0])
        if self._nominal:
            scatter = np.sqrt(self._squares / np.maximum(self._count - 1.0, 1.0))
            counts &= (self._count < _FIRST_NOMINAL) | (
                variance[0] <= self._mean + _NOMINAL * scatter)
        count = self._count + counts
        step = np.where(counts, variance - self._mean, 0.0)
        mean = self._mean + step / np.maximum(count, 1.0)
        self._squares = self._squares + np.where(counts, step[0] * (variance[0] - mean[0]), 0.0)
        self._count, self._mean = count, mean[0]
        return np.asarray(mean)


class _History:
    """
    What indicators need of earlier averages.

    `variance` (channel, indicator) is what these give to the logarithms of the latest indicators.
    """

    def __init__(self) -> None:
        self._residual, self._envelope = _Reference(False), _Reference(False)
        self._nominal_residual, self._nominal_difference = _Reference(True), _Reference(True)
        self.variance: Array = np.zeros(())

    def take(self, moments: _Moments) -> Array:
        """
        Return the indicators (replicate, channel, indicator) of the next average.

        The first replicate is the average itself.
        """
        scale = moments.peak**2

        def over(moment: Array, reference: Array, power: int) -> Array:
            share = reference / scale
            with np.errstate(over='ignore'):  # nothing beside earlier averages that large
                return np.asarray(moment / np.where(share > _ROUNDING**2, share, np.nan) ** power)

        values = moments.own.copy()
        residual, difference = moments.residual * scale, moments.difference * scale
        nominal = self._nominal_difference.take(difference)
        envelope = self._envelope.take(moments.envelope * scale)
        self.variance = np.zeros(values.shape[1:])
        for name, moment, reference, kind, power in (
                ('na4', moments.residual_4, self._residual.take(residual), self._residual, 2),
                ('na4_star', moments.residual_4, self._nominal_residual.take(residual),
                 self._nominal_residual, 2),
                ('nb4', moments.envelope_4, envelope, self._envelope, 2),
                ('m6a_star', moments.difference_6, nominal, self._nominal_difference, 3),
                ('m8a_star', moments.difference_8, nominal, self._nominal_difference, 4)):
            place = INDICATORS.index(name)
            values[..., place] = over(moment, reference, power)
            self.variance[..., place] = power**2 * kind.uncertainty
        return values
