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
Synchronous averages by other software and by the core, as functions of one record.

Each takes a `Record` and returns the average over one cycle of the shaft of interest, (channel,
angle). The algorithms of MATLAB's `tsa` follow its documentation (Signal Processing Toolbox,
`tsa`, section Algorithms); other packages are called as their documentation says. A package that
cannot be imported is skipped, with the reason.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import warnings

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.pulses.resampling import interpolate, margin
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.samples import SampleBlock
from scipy.fft import irfft, rfft
from scipy.interpolate import make_interp_spline, PchipInterpolator

FloatArray = NDArray[np.float64]

RATE = 93750.0  # Hz
SPEED = 40.0  # Hz, of the tach shaft
SPEED_VARIATION = 0.005  # of the speed, peak
VARIATION_RATE = 0.1  # Hz: slow beside a trigger cycle, so that the angle law costs nothing
#: Frequencies over the sampling rate at which gains are compared, about.
BANDS = (0.09, 0.17, 0.30)


# --- the record that all methods average ---------------------------------------------------------

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
        """Return the number of channels."""
        return len(self.samples)

    @property
    def cycle_samples(self) -> int:
        """Return the samples in a mean cycle of the shaft of interest."""
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


# --- the methods ---------------------------------------------------------------------------------

Method = Callable[[Record], FloatArray]


# --- the core ------------------------------------------------------------------------------------

def blocks(record: Record, seconds: float = 0.05) -> Iterator[tuple[SampleBlock, FloatArray]]:
    """Cut a record into the messages that a driver would send, with the pulses in each."""
    length = round(seconds * record.rate)
    sent = 0
    for start in range(0, record.samples.shape[1], length):
        samples = record.samples[:, start:start + length]
        end = int(record.pulses.searchsorted((start + samples.shape[1]) / record.rate))
        yield (SampleBlock(samples, start / record.rate, record.rate, start),
               record.pulses[sent:end])
        sent = end


def stream(record: Record, *, trigger_cycles: int = 0, interpolation: str = 'band_limited',
           averaging: str = 'block') -> Iterator[Average]:
    """Average a record on line, all of it in one average unless `trigger_cycles` says less."""
    settings = AverageSettings(
        cycle_length=record.ratio, trigger_cycles=trigger_cycles or len(record.pulses) - 2,
        orders=record.orders, interpolation=interpolation, averaging=averaging)
    averager = StreamingAverager({'shaft': settings}, validator=PulseValidator(),
                                 timeline=VibrationTimeline())
    for block, pulses in blocks(record):
        averages = averager.add_samples(block)
        if pulses.size:
            averages += averager.add_pulses(pulses)
        yield from (average for _, average in averages)


def on_line(record: Record, interpolation: str = 'band_limited') -> FloatArray:
    """Everything the averager does: blocks, standard error, order amplitudes, their noise."""
    return next(stream(record, interpolation=interpolation)).waveform


def _grid(record: Record) -> tuple[FloatArray, int, int]:
    """Positions (samples) of equal steps of time in every cycle; cycles and points in each."""
    pulses, points = record.fundamental_pulses(), record.cycle_samples
    u = np.arange(points) / points
    times = pulses[:-1, None] + np.diff(pulses)[:, None] * u
    return times.ravel() * record.rate, len(pulses) - 1, points


def resampled(record: Record, interpolation: str = 'band_limited', together: int = 9600
              ) -> FloatArray:
    """Resample a record that is there, some cycles `together`, and take the mean, as peers do."""
    positions, cycles, points = _grid(record)
    total = np.zeros((points, record.channels))
    length = max(together // points, 1) * points
    reach = margin(interpolation) + 1
    for first in range(0, len(positions), length):
        part = positions[first:first + length]
        start = max(int(part[0]) - reach, 0)
        values = interpolate(record.frames[start:int(part[-1]) + reach + 1], part - start,
                             method=interpolation)
        total += values.reshape(-1, points, record.channels).sum(axis=0)
    return total.T / cycles


# --- MATLAB's tsa, and scipy's other interpolators in its place ----------------------------------

def tsa_linear(record: Record) -> FloatArray:
    """`tsa` with its default method 'linear'."""
    positions, cycles, points = _grid(record)
    index = np.arange(record.samples.shape[1])
    return np.stack([np.interp(positions, index, channel).reshape(cycles, points).mean(axis=0)
                     for channel in record.samples])


def _interpolated(record: Record, interpolator: Callable[[FloatArray], FloatArray]) -> FloatArray:
    positions, cycles, points = _grid(record)
    values = interpolator(positions).reshape(cycles, points, record.channels)
    return np.asarray(values.mean(axis=0).T)


def tsa_pchip(record: Record) -> FloatArray:
    """`tsa` with method 'pchip'."""
    return _interpolated(record, PchipInterpolator(np.arange(len(record.frames)), record.frames))


def tsa_spline(record: Record, degree: int = 3) -> FloatArray:
    """`tsa` with method 'spline' (cubic)."""
    return _interpolated(record, make_interp_spline(
        np.arange(len(record.frames), dtype=float), record.frames, k=degree))


def quintic_spline(record: Record) -> FloatArray:
    """Use scipy's spline of degree 5 instead."""
    return tsa_spline(record, degree=5)


def tsa_fft(record: Record) -> FloatArray:
    """`tsa` with method 'fft': spectra of the cycles, cut to one length, averaged."""
    edges = np.rint(record.fundamental_pulses() * record.rate).astype(int)
    shortest = int(np.diff(edges).min())
    total = np.zeros((record.channels, shortest // 2 + 1), np.complex128)
    for start, length in zip(edges, np.diff(edges)):
        spectrum = rfft(record.samples[:, start:start + length], axis=1)
        total += spectrum[:, :shortest // 2 + 1] / length
    return np.asarray(irfft(total, shortest, axis=1) * shortest / (len(edges) - 1))


# --- other packages ------------------------------------------------------------------------------

def rota_order() -> Method:
    """rota-order (GPL): anti-aliased angular resampling; speed from its own pulse detection."""
    import rota

    def average(record: Record) -> FloatArray:
        rpm = rota.speed.tacho_to_rpm(record.tach, record.rate, level=0.0)
        points = 2 * round(1.25 * record.cycle_samples / 2.0)
        angular = rota.angle.angular_resample(
            record.frames, record.rate, record.ratio * rpm, samples_per_rev=points,
            max_order=0.36 * points)
        cycles = len(angular.x) // points
        inner = angular.x[2 * points:(cycles - 2) * points]  # its filters end there
        return np.asarray(inner.reshape(cycles - 4, points, record.channels).mean(axis=0).T)
    return average


def acoular_tracker() -> Method:
    """acoular: the angle of every sample by its `AngleTracker`, then `numpy.interp` over it."""
    import acoular
    acoular.config.global_caching = 'none'

    def average(record: Record) -> FloatArray:
        spikes = np.zeros(len(record.frames))
        spikes[np.rint(record.pulses * record.rate).astype(int)] = 1.0
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # it is deprecated, and says so
            trigger = acoular.tprocess.Trigger(source=acoular.TimeSamples(
                data=spikes[:, None], sample_freq=record.rate), threshold=0.5)
            tracker = acoular.tprocess.AngleTracker(
                source=acoular.TimeSamples(data=record.frames, sample_freq=record.rate),
                trigger=trigger, rot_direction=1)
            angle = np.unwrap(tracker.angle) / (2.0 * np.pi) * record.ratio
        points = record.cycle_samples
        first, last = np.ceil(angle[0]), np.floor(angle[-1])
        grid = np.arange(first * points, last * points) / points
        rising = np.maximum.accumulate(angle)
        return np.stack([
            np.interp(grid, rising, channel).reshape(-1, points).mean(axis=0)
            for channel in record.samples])
    return average


def phonometry_average() -> Method:
    """phonometry: the comb filter of McFadden (1987), for a constant period; no tachometer."""
    from phonometry.signals.synchronous_average import time_synchronous_average

    def average(record: Record) -> FloatArray:
        return np.stack([time_synchronous_average(
            channel, record.rate, period_s=float(np.mean(np.diff(record.fundamental_pulses()))),
        ).period_waveform
            for channel in record.samples])
    return average


#: Name: method, in the order of the tables.
METHODS: dict[str, Method] = {
    'sa_jitter_ros, on line': on_line,
    'sa_jitter_ros, resampling and mean': resampled,
    'sa_jitter_ros, resampling and mean, linear': lambda record: resampled(record, 'linear'),
    'tsa linear': tsa_linear,
    'tsa pchip': tsa_pchip,
    'tsa spline': tsa_spline,
    'quintic spline': quintic_spline,
    'tsa fft': tsa_fft,
}


@dataclass(frozen=True)
class Package:
    """A package that may be missing: what makes its method, and the record that it can bear."""

    make: Callable[[], Method]
    note: str = ''
    seconds: float = 10.0
    constant: bool = False
    whole_period: bool = False

    def record(self, channels: int, seconds: float, ratio: float) -> Record:
        """Return the record for this package."""
        speed = RATE / round(RATE / SPEED) if self.whole_period else SPEED
        return make_record(channels=channels, seconds=min(seconds, self.seconds), ratio=ratio,
                           speed=speed, variation=0.0 if self.constant else SPEED_VARIATION)


PACKAGES = {
    'rota-order': Package(rota_order),
    'acoular': Package(
        acoular_tracker, 'angle only; constant speed of a whole number of samples a revolution, '
        'elsewhere it fails; 2 s, scaled', 2.0, constant=True, whole_period=True),
    'phonometry': Package(
        phonometry_average, 'no tachometer: constant speed; 2 s, scaled, though its time grows '
        'with the square', 2.0, constant=True),
}
