"""Trigger cycles of a recording: reading them, their amplitudes, their pulse errors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.angle.laws import angle_law, AngleLaw, cycle_times
from sa_jitter_ros.angle.resampling import interpolate, margin
from sa_jitter_ros.averaging.cycle import grid_points, project
from sa_jitter_ros.averaging.recovery import PulseErrorRecovery, recover_pulse_errors
from sa_jitter_ros.statistics.prediction import DeclaredModel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Errors of this many declared standard deviations are tried again as if more had been declared: an
# effect may be larger than the declared jitter, and orders may have slipped a cycle.
_SUSPICIOUS, _WIDER = 1.3, 4.0
_WORTHWHILE = 0.7  # as in the recovery, of the errors that were found
_LEAST = 1e-9
_WHOLE = 1e-9
_SEPARATIONS = 6
# Lines of the average beside an order that tell the noise: beyond the window's main lobe.
_LOBE, _AROUND = 3, 150
_OUTLIER = 3.0  # times the noise
_LINEAR = angle_law('linear')
_COSINE = np.cos(np.pi * (np.arange(512) + 0.5) / 512)
#: Of a fitted ripple, in parts of that of noise of unit power over a cycle.
RIPPLE_VARIANCE = float(np.mean(1.0 / (1.0 / 30.0 - (1.0 + _COSINE) / (24.0 * (2.0 + _COSINE)))))


@dataclass(frozen=True)
class CycleReader:
    """Reads trigger cycles (cycle, point, channel) of samples (sample, channel)."""

    samples: FloatArray
    start_time: float
    rate: float
    method: str

    def inside(self, times: FloatArray) -> bool:
        """Tell whether cycles between these pulses can be read."""
        reach = margin(self.method) + 1
        position = (times[[0, -1]] - self.start_time) * self.rate
        return bool(position[0] >= reach and position[1] <= len(self.samples) - 1 - reach)

    def cycles(self, pulses: FloatArray, points: int, *, ends: bool = False,
               ripple: FloatArray | None = None, law: AngleLaw = _LINEAR) -> FloatArray:
        """
        Return the cycles between pulses, with both `ends` or without the last point.

        `pulses` are those of the cycles and all that the `law` reads beside them.
        """
        u = np.arange(points + ends) / points
        whole = range(law.before, len(pulses) - 1 - law.after)
        times = np.array([cycle_times(law, pulses, cycle, u) for cycle in whole])
        if ripple is not None:
            times = times - ripple[:, None] * u * (1.0 - u)
        position = np.clip((times.ravel() - self.start_time) * self.rate, 0.0,
                           len(self.samples) - 1.0)
        low = max(int(position.min()) - 40, 0)
        high = int(position.max()) + 42
        values = interpolate(self.samples[low:high], position - low, method=self.method)
        return values.reshape(*times.shape, -1)


def repaired(times: FloatArray, missing: NDArray[np.int64]
             ) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return pulses with the missing ones put evenly between, and where the measured ones are."""
    index = np.concatenate(([0], np.cumsum(1 + missing)))
    return np.interp(np.arange(index[-1] + 1), index, times), np.asarray(index, np.intp)


def recover(reader: CycleReader, pulses: FloatArray, model: DeclaredModel, rows: tuple[int, ...],
            *, with_ripple: bool, also: ArrayLike = ()) -> PulseErrorRecovery:
    """
    Recover pulse errors from the channels `rows`, of the declared size or larger.

    Of declared and integer orders, and those in `also`.
    """
    periods = np.diff(pulses)
    grid = reader.cycles(pulses, grid_points(float(periods.max()), reader.rate))[:, :, list(rows)]
    declared = max(float(np.sqrt(model.distribution.variance)), _LEAST)

    def attempt(expected: float) -> PulseErrorRecovery:
        return recover_pulse_errors(
            grid, periods=periods, ratio=model.cycle_length, also=(*model.orders, *np.ravel(also)),
            declared_standard_deviation=expected * declared, with_ripple=with_ripple)

    found = attempt(1.0)
    if found.accepted and found.errors.std() < _SUSPICIOUS * declared:
        return found
    wider = attempt(_WIDER)
    if not found.accepted:
        return wider if _stands_out(wider) else found
    if wider.accepted and _strength(wider) > _strength(found):
        return wider
    return found


def _stands_out(recovery: PulseErrorRecovery) -> bool:
    """Tell whether the errors themselves, not only those expected, exceed their standard error."""
    power = float(np.mean(recovery.standard_errors**2))
    return recovery.accepted and power < _WORTHWHILE**2 * (float(recovery.errors.var()) - power)


def _strength(recovery: PulseErrorRecovery) -> float:
    """Return how much power of how high an order the recovered errors bring back."""
    return float(np.sum((recovery.orders * np.abs(recovery.amplitudes)) ** 2))


def amplitudes(grid: FloatArray, cycles: float, orders: tuple[float, ...]) -> ComplexArray:
    """Return complex peaks (cycle, channel, order) of cycles that hold both their ends."""
    count, points, channels = grid.shape
    flat = grid.transpose(1, 0, 2).reshape(points, count * channels)
    parts = project(flat, cycles, orders, 0.0).reshape(count, channels, len(orders))
    turn = np.exp(-2j * np.pi * cycles * np.multiply.outer(np.arange(count), orders))
    return np.asarray(parts * turn[:, None, :])


def noise_floor(grid: FloatArray, cycles: float, orders: FloatArray, top: float) -> FloatArray:
    """
    Return the noise (channel, order) of the mean of trigger cycles along the radius.

    `grid` (cycle, point, channel) are successive cycles of `cycles` fundamental cycles without
    their ends, of a band that ends at order `top`. It is what the spectrum holds in phase with the
    order (errors of the pulses only turn it) apart from lines: other orders and tones.
    """
    flat = grid.reshape(-1, grid.shape[2]).T
    window = np.hanning(flat.shape[1] + 1)[:-1]
    turns = cycles / grid.shape[1] * np.arange(flat.shape[1])
    lines = len(grid) * cycles
    floors = []
    for order in orders:
        turned = flat * np.exp(-2j * np.pi * order * turns)
        turned = turned * np.exp(-1j * np.angle(turned.mean(axis=1, keepdims=True)))
        reach = int(np.clip((top - order) * lines, 4 * _LOBE, max(_AROUND, 100.0 * lines)))
        spectrum = np.fft.rfft(2.0 * turned.real * window, axis=1)[:, _LOBE:reach]
        floors.append(_without_lines(np.abs(spectrum) ** 2))
    return np.sqrt(np.array(floors).T / (flat.shape[1] * np.sum(window**2)))


def _without_lines(power: FloatArray) -> FloatArray:
    """Return the mean of exponential values (row, value), of which outliers do not count."""
    floor = np.median(power, axis=1) / np.log(2.0)
    kept = 1.0 - _OUTLIER * np.exp(-_OUTLIER) / (1.0 - np.exp(-_OUTLIER))
    for _ in range(10):
        low = power < _OUTLIER * floor[:, None]
        floor = np.sum(power, axis=1, where=low) / np.maximum(low.sum(axis=1), 1) / kept
    return np.asarray(floor)


def ripple_error(recovery: PulseErrorRecovery, model: DeclaredModel) -> float:
    """
    Return the standard error of the ripple (s) that the noise of the recovered orders leaves.

    Ripples and pulse errors are fitted jointly, of all cycles: at the frequency w (per cycle)
    u (1 - u) keeps 1/30 - (1 + cos w) / (24 (2 + cos w)) in mean square beyond what straight
    lines between the pulses follow.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        signal = (2.0 * np.pi * recovery.orders * np.abs(recovery.amplitudes)) ** 2
        information = np.nansum(2.0 * signal / recovery.noise**2) / RIPPLE_VARIANCE
    cycles = 1.0 / np.sqrt(information) if information > 0.0 else float('inf')
    return float(cycles / model.fundamental_frequency)


def kept_apart(ratio: float, orders: FloatArray) -> bool:
    """Tell whether all orders are lines of a trigger cycle of `ratio` fundamental cycles."""
    return bool(np.all(np.abs(ratio * orders - np.rint(ratio * orders)) < _WHOLE))


def separated(cycles: ComplexArray, ratio: float, orders: FloatArray) -> ComplexArray:
    """
    Return complex peaks (cycle, channel, order) without what the other orders leak into each.

    A trigger cycle does not keep orders apart that are no lines of its own, nor such an order from
    its own mirror image.
    """
    if kept_apart(ratio, orders):
        return cycles
    middle = np.arange(len(cycles))[:, None, None] + 0.5
    apart = ratio * np.subtract.outer(orders, orders)
    leak = np.exp(-2j * np.pi * apart * middle) * np.sinc(apart)
    leak[:, np.eye(orders.size, dtype=np.bool_)] = 0.0
    both = ratio * np.add.outer(orders, orders)
    image = np.exp(-2j * np.pi * both * middle) * np.sinc(both)
    clean = cycles
    for _ in range(_SEPARATIONS):
        mean = clean.mean(axis=0)
        clean = cycles - np.einsum('kgs,cs->kcg', leak, mean) - np.einsum(
            'kgs,cs->kcg', image, mean.conj())
    return clean
