"""
The loop on line: from published averages, pulse errors and predictions to residual and trace.

Averages carry one amplitude per order and channel, not those of single trigger cycles, and pulse
errors without a ripple between them. Effects that only those show cannot be told here; the loop
off line can tell them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.closure.expectation import Lines
from sa_jitter_ros.closure.observation import Acquisition, Observation
from sa_jitter_ros.closure.residual import Residual, residual
from sa_jitter_ros.closure.trace import Bench, require_acquisitions, Trace, trace_bench
from sa_jitter_ros.closure.trigger_pulses import TriggerPulses
from sa_jitter_ros.effects.effect import Effect, Pulses
from sa_jitter_ros.effects.evidence import LineEvidence
from sa_jitter_ros.effects.lattice import Clock, find_clock, smooth_on_grid
from sa_jitter_ros.errors import ModelError, SignalError
from sa_jitter_ros.statistics.moments import noise_line_variance
from sa_jitter_ros.statistics.prediction import DeclaredModel
from scipy.special import ndtr

Array = NDArray[Any]

_STRONG = 0.2  # of its order's strongest channel
_NOISE = 0.1  # of its amplitude that a line may scatter by
_SPEED = 0.1
_FINE = 50.0
_REASON = 'the topics do not carry {}: run close_loop on a recording'
UNTOLD = {
    'speed_fluctuation': _REASON.format('the angle error inside the trigger cycles'),
    'interpolation_loss': _REASON.format('the samples'),
    'additive_noise': _REASON.format('the amplitudes of single trigger cycles'),
    'amplitude_modulation': _REASON.format('the amplitudes of single trigger cycles'),
    'interfering_tone': _REASON.format('the amplitudes of single trigger cycles')}


@dataclass(frozen=True)
class Average:
    """
    What the topics say of one average; times in s, speed of the tach shaft in Hz.

    `raw` and `corrected` (channel, order) are complex peak amplitudes, `noise` their standard
    deviation; `attenuation` is raw over corrected. `pulses` (N_t + 1, 3) are times, errors and
    standard errors, None where none came.
    """

    start_time: float
    end_time: float
    trigger_cycles: int
    fundamental_cycles: int
    trigger_speed: float
    orders: Array
    raw: Array
    corrected: Array
    attenuation: Array
    attenuation_standard_error: Array
    noise: Array
    pulses: Array | None = None

    @property
    def layout(self) -> tuple[int, int, tuple[float, ...]]:
        """Return what all averages of a batch have in common."""
        return self.trigger_cycles, len(self.raw), tuple(self.orders.tolist())


@dataclass(frozen=True)
class Published:
    """A published prediction: arrays (order,) and what they hold for."""

    order: Array
    mean: Array
    standard_deviation: Array
    trigger_speed: float
    keyphasor_rate: float
    trigger_cycles: int
    ratio: float
    pulse_error_std: float


class Batch:
    """Collects independent averages of one run: none that overlap, the newest `size` of them."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.averages: list[Average] = []
        self.overlapping = 0

    @property
    def full(self) -> bool:
        """Tell whether there are as many averages as asked for."""
        return len(self.averages) >= self.size

    def add(self, average: Average) -> None:
        """Take an average; another layout or an earlier time begins anew."""
        if self.averages:
            last = self.averages[-1]
            if average.layout != last.layout or average.start_time <= last.start_time:
                self.averages.clear()
            elif average.start_time < last.end_time - 1e-6:
                self.overlapping += 1
                return
        self.averages.append(average)
        del self.averages[:-self.size]


def require_comparable(averages: Sequence[Average], published: Published) -> None:
    """Raise ModelError where a prediction is of another average than the measured ones."""
    last = averages[-1]
    if published.trigger_cycles != last.trigger_cycles:
        raise ModelError(f'the prediction is for {published.trigger_cycles} trigger cycles and '
                         f'the averages have {last.trigger_cycles}: set trigger_cycles of '
                         'averager and predictor to the same')
    cycles = published.ratio * _share(last) * last.trigger_cycles
    if not cycles - 2.0 < last.fundamental_cycles < cycles + 1e-3 * cycles + 1e-6:
        raise ModelError(
            f'the prediction is for the ratio {published.ratio:g}, which makes {cycles:.5g} '
            f'fundamental cycles, and the averages have {last.fundamental_cycles}: set ratio of '
            'averager and predictor to the same')
    speed = float(np.mean([item.trigger_speed for item in averages]))
    if abs(speed / published.trigger_speed - 1.0) > _SPEED:
        raise ModelError(f'the prediction is for {published.trigger_speed:g} Hz and the tach '
                         f'shaft turns at {speed:.4g} Hz: set trigger_speed or '
                         'follow_shaft_speed of the predictor')
    if not _common(averages, published).size:
        raise ModelError(
            f'averages have the orders {_list(last.orders)} and the prediction '
            f'{_list(published.order)}: give averager and predictor orders in common')


def compare(averages: Sequence[Average], published: Published) -> tuple[Array, Residual]:
    """
    Compare the mean attenuation of every order with the published prediction.

    Returns the table (order, 6) of order, observed, predicted, residual, standard error and z, and
    the residual's summary. Channels count by their signal-to-noise ratio; acquisitions are what
    is independent. Raises SignalError where no order stands above the noise.
    """
    common = _common(averages, published)
    good = _good_lines(averages)[:, common]
    with np.errstate(divide='ignore', invalid='ignore'):
        weight = np.array([np.abs(item.corrected[:, common] / item.noise[:, common])
                           for item in averages]).mean(axis=0) ** 2
    weight = np.where(good, np.minimum(weight, 1e12), 0.0)
    weight = weight / np.where(good.any(axis=0), weight.sum(axis=0), 1.0)
    seen = np.flatnonzero(good.any(axis=0))
    common, weight = common[seen], weight[:, seen]
    ratio = np.array([item.attenuation[:, common] for item in averages])
    error = np.array([item.attenuation_standard_error[:, common] for item in averages])
    attenuation = np.sum(weight * np.where(weight > 0.0, ratio, 0.0), axis=1)
    variance = np.sum((weight * np.where(weight > 0.0, error, 0.0)) ** 2, axis=1)
    index = _places(averages[-1].orders[common], published.order)
    expected = np.broadcast_to(published.mean[index], attenuation.shape)
    total = variance + published.standard_deviation[index] ** 2
    z = (attenuation - expected) / np.sqrt(np.maximum(total, 1e-12))
    found = residual(attenuation, expected, total, attenuation, expected, total, ndtr(z))
    table = np.stack((
        averages[-1].orders[common], attenuation.mean(axis=0), expected[0], found.mean,
        found.standard_error, found.mean / found.standard_error), axis=1)
    return table, found


def declared_by(averages: Sequence[Average], published: Published) -> DeclaredModel:
    """Return the model that a prediction's header tells, where its predictor cannot be asked."""
    share = Fraction(_share(averages[-1])).limit_denominator(1000)
    clock = 1.0 / (math.sqrt(12.0) * published.keyphasor_rate)
    uniform = math.isclose(published.pulse_error_std, clock, rel_tol=1e-6)
    return DeclaredModel(
        keyphasor_rate=published.keyphasor_rate, trigger_speed=published.trigger_speed,
        trigger_cycles=published.trigger_cycles, ratio=published.ratio,
        orders=tuple(published.order.tolist()), pulses_per_revolution=share.denominator,
        pulses_per_trigger=share.numerator,
        jitter_distribution='uniform' if uniform else 'normal',
        jitter_std=0.0 if uniform else published.pulse_error_std)


def trace_averages(averages: Sequence[Average], model: DeclaredModel, *,
                   declared: Sequence[Effect] = (),
                   progress: Callable[[str], None] | None = None) -> Trace:
    """
    Trace the residual of averages, those of the longest stretch without a gap.

    Raises ModelError for fewer than 4 of them and SignalError where nothing can be compared.
    """
    stretch = _longest_stretch(averages)
    observation = _observation(stretch, model)
    require_acquisitions(observation)
    good = _good_lines(stretch)[:, _places(observation.orders, stretch[0].orders)]
    if not good.any():
        raise SignalError(f'none of the declared orders {_list(observation.orders)} stands above '
                          'its noise: declare orders that the vibration holds')
    lines = Lines(*np.nonzero(good))
    count = len(stretch)
    fit, held_out = tuple(range(0, count, 2)), tuple(range(1, count, 2))
    times = observation.pulses.times
    clock, period_std, smooth = find_clock(times), float('nan'), None
    if 0.0 < clock.rate < _FINE * model.keyphasor_rate:
        smooth = smooth_on_grid(times, clock.rate)
        period_std = float(np.diff(times - smooth).std(ddof=1))
    else:
        clock = Clock(0.0, 0.0)
    pulses = [[Pulses(item.times, item.first, None if smooth is None else
                      smooth[item.first:item.first + item.times.size], item.missing)]
              for item in observation.acquisitions]
    level = lines.of(np.abs(observation.stacked('corrected'))[list(fit)].mean(axis=0))
    found = trace_bench(Bench(
        observation, lines, level, pulses, clock, period_std, np.zeros(len(stretch[0].raw), int),
        _scatter(observation, lines, level), fit, held_out,
        (*declared, _measured_noise(observation, lines)), UNTOLD), progress=progress)
    return replace(found, declared=tuple(declared))


@dataclass(frozen=True)
class MeasuredNoise(Effect):
    """The noise that the averages themselves report, `variance` (order,) of a peak amplitude."""

    name: ClassVar[str] = 'measured_noise'
    summary: ClassVar[str] = 'noise that the averages report'
    variance: tuple[float, ...]

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return the variance of each order."""
        return np.array(self.variance)


# --- parts ---------------------------------------------------------------------------------------

def _share(average: Average) -> float:
    """Return the revolutions of the tach shaft in a trigger cycle."""
    return (average.trigger_speed * (average.end_time - average.start_time)
            / average.trigger_cycles)


def _common(averages: Sequence[Average], published: Published) -> Array:
    """Return which of the measured orders are predicted."""
    orders = averages[-1].orders
    return np.flatnonzero(np.isclose(orders[:, None], published.order, rtol=1e-6).any(axis=1))


def _places(orders: Array, among: Array) -> Array:
    return np.asarray(np.argmin(np.abs(orders[:, None] - among), axis=1))


def _list(orders: Array) -> str:
    return ', '.join(f'{order:g}' for order in orders)


def _good_lines(averages: Sequence[Average]) -> Array:
    """Return which lines (channel, order) stand above the noise; raises SignalError for none."""
    level = np.abs([item.corrected for item in averages]).mean(axis=0)
    noise = np.sqrt(np.mean([item.noise**2 for item in averages], axis=0))
    attenuation = np.array([item.attenuation for item in averages])
    good = np.isfinite(attenuation).all(axis=0) & (noise <= _NOISE * level)
    good &= level >= _STRONG * np.where(good, level, 0.0).max(axis=0)
    if not good.any():
        raise SignalError(f'none of the orders {_list(averages[-1].orders)} stands ten times '
                          'above its noise on any channel: average more trigger cycles, or other '
                          'orders')
    return np.asarray(good)


def _longest_stretch(averages: Sequence[Average]) -> Sequence[Average]:
    """Return the longest run of averages with pulse errors, each beginning where one ended."""
    best: list[Average] = []
    run: list[Average] = []
    for item in averages:
        if item.pulses is None:
            run = []
            continue
        if run and abs(item.start_time - run[-1].end_time) > 1e-6:
            run = []
        run.append(item)
        best = list(run) if len(run) > len(best) else best
    if not best:
        raise SignalError('no pulse errors came with the averages: set correct_jitter: true of '
                          'the averager')
    return best


def _observation(averages: Sequence[Average], model: DeclaredModel) -> Observation:
    """Return the averages as the observation of a record that begins with their first pulse."""
    measured = averages[0].orders
    places = [int(np.argmin(np.abs(measured - order))) for order in model.orders
              if np.isclose(measured, order, rtol=1e-6).any()]
    if not places:
        raise ModelError(f'averages have the orders {_list(measured)}, none of which is declared')
    count = averages[0].trigger_cycles
    found, times = [], []
    for number, item in enumerate(averages):
        assert item.pulses is not None
        when, errors, error = item.pulses.T
        times.append(when if number == 0 else when[1:])
        found.append(Acquisition(
            first=number * count, times=when, missing=np.zeros(count, np.int64),
            errors=errors - errors.mean(), standard_errors=error, reference=None,
            raw=item.raw[:, places], corrected=item.corrected[:, places],
            cycles=item.corrected[None][:, :, places], noise=item.noise[:, places],
            ripple=np.full(count, np.nan), ripple_standard_error=math.inf, recovered=True,
            reason=''))
    speed = float(np.mean([item.trigger_speed for item in averages]))
    orders = measured[places]
    record = np.concatenate(times)
    return Observation(
        replace(model, trigger_speed=speed, orders=tuple(orders.tolist())), tuple(found), orders,
        orders, tuple(f'channel {k}' for k in range(len(averages[0].raw))),
        TriggerPulses(record, np.zeros(record.size - 1, np.int64), None), model.sample_rate, False)


def _measured_noise(observation: Observation, lines: Lines) -> MeasuredNoise:
    """Return the noise of each order beyond the declared one, the mean over its channels."""
    model = observation.model
    power = 2.0 * np.mean(np.asarray(observation.stacked('noise')) ** 2, axis=0)
    known = (noise_line_variance(model.noise_std, model.sample_rate, model.duration)
             if model.noise_std else 0.0)
    count = np.bincount(lines.order, minlength=observation.orders.size)
    total = np.bincount(lines.order, lines.of(power), observation.orders.size)
    return MeasuredNoise(tuple(
        np.maximum(total / np.maximum(count, 1) - known, 0.0).tolist()))


def _scatter(observation: Observation, lines: Lines, level: Array) -> LineEvidence:
    """Return how the amplitudes of whole averages scatter."""
    amplitude = lines.of(np.abs(observation.stacked('corrected')))
    noise = np.sqrt(np.mean(lines.of(np.asarray(observation.stacked('noise'))) ** 2, axis=0))
    return LineEvidence(
        order=observation.orders[lines.order], channel=lines.channel, level=level,
        noise_density=np.full(lines.count, np.nan), radial=(amplitude / level - 1.0)[:, None],
        radial_noise=noise / level)
