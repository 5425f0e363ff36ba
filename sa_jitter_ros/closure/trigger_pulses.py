"""Trigger pulses of a recording: from the tach, matched with a better keyphasor, or made worse."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.angle.keyphasor import KeyphasorDetector
from sa_jitter_ros.errors import ModelError, RecordingError
from sa_jitter_ros.recordings.recording import Recording
from sa_jitter_ros.statistics.distributions import PulseErrorDistribution
from sa_jitter_ros.statistics.prediction import DeclaredModel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_SPEED_TOLERANCE = 0.1
_NEIGHBOURHOOD = 15
# Two intervals that last less than this part of what two usually do hold a pulse too many.
_TOO_SHORT = 0.75
_MOST_SPURIOUS = 0.05
_FEWEST = 3
_SAME_RATIO = 1e-5  # six digits, as people write them
_SAME_RATE = 0.01


@dataclass(frozen=True)
class TriggerPulses:
    """
    Measured trigger pulses of a recording.

    `times` (n,) in s; `missing` (n - 1,) is how many trigger pulses lack in each interval;
    `reference` (n,) are the times of the same pulses on a better keyphasor (NaN where it has
    none), None without one. `doubtful` (n,) pulses stand beside a spurious one that was dropped,
    and may be the spurious one themselves; `remarks` say what was done to the pulses.
    """

    times: FloatArray
    missing: IntArray
    reference: FloatArray | None
    doubtful: BoolArray
    remarks: tuple[str, ...] = ()


def trigger_pulses(recording: Recording, model: DeclaredModel) -> TriggerPulses:
    """
    Return the trigger pulses of a recording: spurious ones are dropped, missing ones stay missing.

    Raises ModelError where the recording contradicts the declared model and RecordingError where
    it has no usable pulses.
    """
    if abs(recording.ratio / model.ratio - 1.0) > _SAME_RATIO and recording.ratio != 1.0:
        raise ModelError(f'ratio is declared as {model.ratio:.9g} but the recording says '
                         f'{recording.ratio:.9g}: declare the ratio of this machine')
    if recording.pulses_per_revolution not in (1, model.pulses_per_revolution):
        raise ModelError(f'pulses_per_revolution is declared as {model.pulses_per_revolution} but '
                         f'the recording says {recording.pulses_per_revolution}')
    step = model.pulses_per_trigger or model.pulses_per_revolution
    measured = _pulse_times(recording)
    if measured.size < _FEWEST:
        raise RecordingError(f'{measured.size} keyphasor pulses, at least {_FEWEST} are needed: '
                             'look at the tach, its level may never cross the threshold')
    times, doubtful = without_spurious(measured)
    missing = missing_pulses(times)
    better = recording.reference_pulse_times
    if better is not None:
        better, _ = without_spurious(better)
    reference = None if better is None or better.size < 0.6 * times.size else _matched(
        times, missing, better)
    spurious = measured.size - times.size
    chosen, missing = _every(missing, step)
    times, doubtful = times[chosen], doubtful[chosen]
    if reference is not None:
        reference = reference[chosen]
    elif better is not None:  # one pulse a trigger cycle
        reference = _matched(times, missing, better)
    if times.size < _FEWEST or not np.any(missing == 0):
        raise RecordingError(f'{times.size} trigger pulses of {measured.size} keyphasor pulses: '
                             f'the loop needs {_FEWEST} in a row; record longer')
    speed = model.trigger_revolutions / float(np.median(np.diff(times)[missing == 0]))
    if abs(speed / model.trigger_speed - 1.0) > _SPEED_TOLERANCE:
        raise ModelError(f'trigger_speed is declared as {model.trigger_speed:g} Hz but the tach '
                         f'shaft turns at {speed:.4g} Hz: declare the speed and '
                         'pulses_per_revolution of this recording')
    remarks = []
    if spurious:
        remarks.append(f'{spurious} of {measured.size} pulses are spurious (double): they were '
                       f'dropped, and the trigger cycles of the {np.count_nonzero(doubtful)} '
                       'trigger pulses beside them left out')
    tach_rate = recording.tach_rate
    if tach_rate and abs(model.keyphasor_rate / tach_rate - 1.0) > _SAME_RATE:
        remarks.append(f'keyphasor_rate is declared as {model.keyphasor_rate:.6g} Hz but the '
                       f"recording's tach was sampled at {tach_rate:.6g} Hz: declare "
                       f'{tach_rate:.6g}')
    return TriggerPulses(times, missing, reference, doubtful, tuple(remarks))


def without_spurious(times: FloatArray) -> tuple[FloatArray, BoolArray]:
    """
    Return the pulses (n,) without spurious ones, and which of them stood beside one.

    A pulse is spurious (bounce, glitch) where the intervals on both sides of it together are one
    interval rather than two; of neighbours of which that holds it is the one for which they are
    so best. Raises RecordingError where more than 5 % are spurious.
    """
    kept = np.ones(times.size, np.bool_)
    doubtful = np.zeros(times.size, np.bool_)
    while kept.sum() > _NEIGHBOURHOOD:
        index = np.flatnonzero(kept)
        around = times[index[2:]] - times[index[:-2]]  # of pulse 1, 2, ...
        share = around / _usual(around)
        short = np.flatnonzero(share < _TOO_SHORT)
        if short.size == 0:
            break
        for cluster in np.split(short, np.flatnonzero(np.diff(short) > 1) + 1):
            best = cluster[np.argmin(np.abs(share[cluster] - 0.5))]
            kept[index[best + 1]] = False
            doubtful[index[best:best + 3]] = True
        if kept.sum() < (1.0 - _MOST_SPURIOUS) * times.size:
            raise RecordingError(
                f'{times.size - kept.sum()} of {times.size} pulses are spurious, more than '
                f'{_MOST_SPURIOUS:.0%}: give the trigger more hysteresis or drop double pulses')
    return times[kept], doubtful[kept]


def missing_pulses(times: FloatArray) -> IntArray:
    """Return how many pulses lack in each interval (n - 1,), by the intervals around it."""
    intervals = np.diff(times)
    if intervals.size == 0:
        return np.zeros(0, np.int64)
    if np.any(intervals <= 0.0):
        raise RecordingError('pulse times do not increase: sort them and drop repeated ones')
    return np.asarray(np.maximum(np.rint(intervals / _usual(intervals)) - 1.0, 0.0), np.int64)


def _usual(durations: FloatArray) -> FloatArray:
    """Return the median of each and those around it (n,)."""
    half = _NEIGHBOURHOOD // 2
    around = np.pad(durations, half, mode='symmetric' if durations.size >= half else 'edge')
    return np.asarray(np.median(
        np.lib.stride_tricks.sliding_window_view(around, 2 * half + 1), axis=1))


def with_added_jitter(recording: Recording, law: PulseErrorDistribution, *, seed: int
                      ) -> Recording:
    """
    Return the recording with random errors added to its pulses, which become the reference.

    The procedure of Section 5.2 of Camerini et al. 2019.
    """
    times = _pulse_times(recording)
    errors = law.draw(np.random.default_rng(seed), times.size)
    return replace(recording, pulse_times=np.sort(times + errors), tach=None,
                   reference_pulse_times=times)


def with_slower_clock(recording: Recording, clock_rate: float) -> Recording:
    """
    Return the recording with its pulses timed by a clock of `clock_rate` Hz, rounded up.

    The unrounded pulses become the reference. Section 5.1.2 of Camerini et al. 2019.
    """
    if not clock_rate > 0.0:
        raise ModelError(f'clock_rate is {clock_rate} Hz: give a positive rate')
    better = recording.reference_pulse_times
    times = _pulse_times(recording) if better is None else better
    return replace(recording, pulse_times=np.ceil(times * clock_rate) / clock_rate, tach=None,
                   tach_rate=clock_rate, reference_pulse_times=times)


def _pulse_times(recording: Recording) -> FloatArray:
    """Return the tested keyphasor's pulses: those of the file, else of its waveform."""
    if recording.pulse_times is not None:
        return recording.pulse_times
    if recording.tach is None or recording.tach_rate is None:
        if recording.reference_pulse_times is not None:
            return recording.reference_pulse_times
        raise RecordingError('no pulse_times and no tach: the loop needs a keyphasor')
    detector = KeyphasorDetector(interpolate=False)
    found, index = [], 0
    for block in recording.tach_blocks():
        found.append(detector.update(
            block[0], recording.start_time + index / recording.tach_rate, recording.tach_rate))
        index += block.shape[1]
    return np.concatenate(found)


def _every(missing: IntArray, step: int) -> tuple[IntArray, IntArray]:
    """Return which pulses are every `step`-th, lacking ones counted, and how many of it lack."""
    count = np.concatenate(([0], np.cumsum(1 + missing)))
    chosen = np.flatnonzero(count % step == 0)
    return chosen, np.diff(count[chosen]) // step - 1


def _matched(times: FloatArray, missing: IntArray, better: FloatArray) -> FloatArray:
    """Return the pulse of the better keyphasor for each of `times`, NaN where it has none."""
    count = np.concatenate(([0], np.cumsum(1 + missing)))
    other = np.concatenate(([0], np.cumsum(1 + missing_pulses(better))))
    nearest = np.argmin(np.abs(better[:, None] - times[None, :_NEIGHBOURHOOD]), axis=0)
    wanted = int(np.median(other[nearest] - count[:nearest.size])) + count
    index = np.clip(np.searchsorted(other, wanted), 0, better.size - 1)
    inside = other[index] == wanted
    matched = np.where(inside, better[index], np.nan)
    if inside.sum() < 0.5 * times.size:
        raise RecordingError(f'reference_pulse_times cover {inside.mean():.0%} of the pulses: '
                             'give the same stretch of time')
    return np.asarray(matched)
