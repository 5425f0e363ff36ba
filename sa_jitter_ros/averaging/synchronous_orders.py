"""
Which orders of a channel are synchronous: coherent from cycle to cycle, and above the noise.

Pulse errors that are known already are taken out of the phases first, so that an order which
jitter has averaged away is still seen. `LineSearch` finds where to look, cheaply;
`significant_orders` tests.

One average cannot tell everything: random vibration that rings on for many cycles, from a
resonance right at an order, is nearly as coherent as the order would be, and passes more often
than the level of the test says (with a quality factor of 500 at order 19, in 7 % of averages of
100 cycles).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.pulse_error_fit import (CompressedCycles, deviations,
                                                     least_squares, real_parts)
from scipy import stats
from scipy.fft import rfft
from scipy.ndimage import median_filter

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Chance that noise alone, in all orders and channels together, passes for a synchronous order.
_FALSE_ALARM = 1e-3
# Share of an order's power that must be coherent from cycle to cycle.
_COHERENCE = 0.15
# More cycles than these show no order that could tell anything of a single pulse.
_SEARCHED_CYCLES = 32
_NEIGHBOURHOOD = 41
_MAIN_LOBE = 3
_CLEAR = 100.0  # times the power of the orders around


@dataclass(frozen=True)
class LineSearch:
    """
    Hann-windowed spectra (line, cycle, channel) of some consecutive cycles.

    They begin with cycle `first`; `orders` are those below 0.4 of the sampling rate: the integer
    ones and others that are known to be there.
    """

    spectra: ComplexArray
    orders: FloatArray
    cycle_length: float
    first: int

    @classmethod
    def of(cls, samples: FloatArray, cycle_length: float, also: Sequence[float] = ()
           ) -> 'LineSearch':
        """
        Prepare the search in `samples` (sample, cycle, channel) of trigger cycles.

        `also` are orders to look at beside the integer ones.
        """
        points, count, _ = samples.shape
        first = max(count - _SEARCHED_CYCLES, 0) // 2
        part = samples[:, first:first + _SEARCHED_CYCLES]
        part = part - part.mean(axis=(0, 1))
        window = np.sin(pi * np.arange(points) / points) ** 2
        # A taper over the cycles keeps strong orders from showing at their neighbours.
        spectra = rfft(part * np.multiply.outer(window, _taper(part.shape[1]))[:, :, None], axis=0)
        top = 0.4 * points / cycle_length
        others = [g for g in also if 0.0 < g <= top]
        orders = np.union1d(np.arange(1.0, int(top) + 1.0), others)
        return cls(spectra, orders, cycle_length, first)

    def strongest(self, errors: FloatArray, most: int, *, below: float
                  ) -> tuple[FloatArray, FloatArray]:
        """
        Return the orders up to `below` that stand out most, best first, and those that do clearly.

        They are at most `most`; `errors` (pulse,) of the average, in fundamental cycles, are taken
        out of the phases.
        """
        g = self.orders[self.orders <= below]
        if not len(g):
            return g, g
        power = self.power(errors, g)
        # Mirrored, not repeated: of copies of itself order 1 could not stand out.
        background = median_filter(power, size=(_NEIGHBOURHOOD, 1), mode='reflect')
        contrast = np.max(power / np.maximum(background, np.finfo(float).tiny), axis=1)
        best = np.argsort(-contrast)[:most]
        return g[best], g[best[contrast[best] > _CLEAR]]

    def gain(self, errors: FloatArray, orders: FloatArray) -> float:
        """
        Return how the power of some `orders` changes when `errors` (pulse,) are taken out.

        Orders are weighted by their square, as what they tell of the errors. Errors that the
        pulses have can but raise it; 1 where there is no order.
        """
        before, after = (self.power(item, orders, tapered=False)
                         for item in (0.0 * errors, errors))
        weight = orders[:, None] ** 2 / np.maximum(np.sum(before, axis=0), np.finfo(float).tiny)
        known = float(np.sum(weight * before))
        return float(np.sum(weight * after)) / known if known else 1.0

    def power(self, errors: FloatArray, g: FloatArray, *, tapered: bool = True) -> FloatArray:
        """Return an array (order, channel), the power of orders `g` without `errors` (pulse,)."""
        count = self.spectra.shape[1]
        errors = errors[self.first:self.first + count + 1]
        angle = self.cycle_length * (self.first + np.arange(count)) + errors[:-1]
        position = np.outer(g, self.cycle_length + np.diff(errors))
        nearest = np.rint(g * self.cycle_length).astype(np.intp)
        phase = np.exp(-2j * pi * np.outer(g, angle)) / (1.0 if tapered else _taper(count))
        line = np.zeros((len(g), self.spectra.shape[2]), np.complex128)
        for offset in range(-_MAIN_LOBE, _MAIN_LOBE + 1):
            bins = nearest + offset
            x = position - bins[:, None]
            lobe = 0.5 * np.sinc(x) + 0.25 * (np.sinc(x - 1.0) + np.sinc(x + 1.0))
            weight = phase * lobe * np.exp(-1j * pi * x)
            weight[(bins < 0) | (bins >= len(self.spectra))] = 0.0
            line += np.einsum('gk,gkc->gc', weight, self.spectra.take(bins, axis=0, mode='clip'))
        return np.asarray(np.abs(line) ** 2)


def _taper(count: int) -> FloatArray:
    return np.asarray(np.sin(pi * (np.arange(count) + 0.5) / count) ** 2)


def significant_orders(model: CompressedCycles, errors: FloatArray, *, tests: int,
                       least: FloatArray) -> NDArray[np.bool_]:
    """
    Tell which orders (row) stand above the noise in which channels (column).

    The mean amplitude over the cycles, with pulse `errors` taken out, against its scatter: an F
    test whose level is shared by `tests` orders and all channels. Amplitudes below `least`
    (channel,) are not significant. A lightly damped resonance rings on from cycle to cycle: its
    scatter counts with its autocorrelation. That is seen in phase with the mean, where errors of
    the pulses, which may be correlated as well, do not show to first order.
    """
    count, _, channels = model.coefficients.shape
    everything = np.arange(len(model.orders))
    signal = model.response(errors, np.zeros(count), everything).signal
    amplitudes = least_squares(signal, model.coefficients)
    residual = model.coefficients - signal @ real_parts(amplitudes)
    power = np.abs(amplitudes) ** 2
    deviation = deviations(signal, residual)
    scatter = np.sum(np.abs(deviation) ** 2, axis=0) / (count - 1)
    in_phase = (deviation * np.exp(-1j * np.angle(amplitudes))).real
    ringing = np.maximum(scatter, 2.0 * _long_run_variance(in_phase))
    limit = stats.f.isf(_FALSE_ALARM / (tests * channels), 2, 2 * (count - 1))
    return np.asarray((count * power > limit * ringing) & (np.sqrt(power) > least)
                      & (power > _COHERENCE * (power + scatter)))


def _long_run_variance(series: FloatArray) -> FloatArray:
    """Count times the variance of a mean over the first axis (Newey and West 1987)."""
    count = len(series)
    lags = count // 4
    total = np.sum(series**2, axis=0)
    for lag in range(1, lags + 1):
        total += 2.0 * (1.0 - lag / (lags + 1.0)) * np.sum(series[lag:] * series[:-lag], axis=0)
    return np.asarray(total / (count - 1))
