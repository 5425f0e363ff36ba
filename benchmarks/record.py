"""The record that all methods average: a machine of slightly varying speed, without noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

RATE = 93750.0  # Hz
SPEED = 40.0  # Hz, of the tach shaft
SPEED_VARIATION = 0.005  # of the speed, peak
VARIATION_RATE = 0.1  # Hz: slow beside a trigger cycle, so that the angle law costs nothing
#: Frequencies over the sampling rate at which gains are compared, about.
BANDS = (0.09, 0.17, 0.30)


@dataclass(frozen=True)
class Record:
    """
    Vibration with one pulse per revolution of the tach shaft.

    `samples` (channel, sample) hold a cosine of amplitude 1 at each of `orders` of the shaft of
    interest, which turns `ratio` times as fast as the tach shaft; `frames` are the same (sample,
    channel), for methods that like it so. `pulses` (s) are exact; `tach` is a sine that crosses
    zero upwards at them.
    """

    samples: FloatArray
    frames: FloatArray
    pulses: FloatArray
    tach: FloatArray
    rate: float
    ratio: float
    orders: tuple[float, ...]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.samples)

    @property
    def cycle_samples(self) -> int:
        """Samples in a mean cycle of the shaft of interest."""
        period = (self.pulses[-1] - self.pulses[0]) / (len(self.pulses) - 1)
        return round(period * self.rate / self.ratio)

    def fundamental_pulses(self) -> FloatArray:
        """Return the times (s) at which the shaft of interest stands at 0, by the linear law."""
        angles = self.ratio * np.arange(len(self.pulses))
        return np.interp(np.arange(np.floor(angles[-1] + 1e-9) + 1.0), angles, self.pulses)


def _angle(times: FloatArray, speed: float, variation: float) -> FloatArray:
    turn = 2.0 * np.pi * VARIATION_RATE
    return np.asarray(speed * (times + variation / turn * (1.0 - np.cos(turn * times))))


def make_record(*, channels: int = 8, seconds: float = 10.0, ratio: float = 1.0,
                speed: float = SPEED, variation: float = SPEED_VARIATION) -> Record:
    """Return a record; orders are those nearest to `BANDS`."""
    times = np.arange(round(seconds * RATE)) / RATE
    angle = _angle(times, speed, variation)
    count = np.arange(np.floor(angle[-1]) + 1.0)
    pulses = count / speed
    for _ in range(20):  # the speed hardly varies: a fixed-point iteration
        pulses -= (_angle(pulses, speed, variation) - count) / speed
    orders = tuple(float(round(band * RATE / (speed * ratio))) for band in BANDS)
    frames = np.zeros((len(times), channels))
    for number, order in enumerate(orders):
        phase = 2.0 * np.pi * order * ratio * angle
        for channel in range(channels):
            frames[:, channel] += np.cos(phase + channel + number)
    return Record(np.ascontiguousarray(frames.T), frames, pulses, np.sin(2.0 * np.pi * angle),
                  RATE, ratio, orders)


def gains(record: Record, waveform: FloatArray) -> FloatArray:
    """Return gain in dB at every order, the mean of all channels, of an average over one cycle."""
    angle = np.arange(waveform.shape[1]) / waveform.shape[1]
    basis = np.exp(-2j * np.pi * np.outer(record.orders, angle))
    amplitude = 2.0 * np.abs(waveform @ basis.T) / waveform.shape[1]
    return np.asarray(20.0 * np.log10(amplitude.mean(axis=0)))
