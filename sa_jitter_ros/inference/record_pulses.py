# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The trigger pulses of a recording, numbered over gaps, and those of a reference keyphasor."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import BoolArray, FloatArray, IntArray
from sa_jitter_ros.effects.effect import RARE
from sa_jitter_ros.effects.lattice import SAME_RATE
from sa_jitter_ros.errors import ModelError, RecordingError
from sa_jitter_ros.parameters import SAME_RATIO
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.pulses.validation import PulseCounts, PulseValidator, TriggerPulses
from sa_jitter_ros.recordings.recording import Recording

#: Of the declared speed, relative.
SPEED_TOLERANCE = 0.1
_FEWEST = 3  # pulses
_USUAL = 15  # pulses before a gap that tell how many it hides
_COVERED = 0.5  # of the pulses, by those of a reference keyphasor


@dataclass(frozen=True)
class RecordPulses:
    """
    Trigger pulses of a recording.

    `times` (n,) in s are the measured ones; `missing` (n - 1,) is the number of trigger pulses
    that are missing in each interval, `displaced` (n - 1,) that of those among them that came, but
    so far from their place that they were dropped. `starts_run` (n,): no trigger cycle ends here.
    `doubtful` (n,): a double pulse next to this one was dropped, and this one may be the wrong
    one. `bridged` (m,), m = n + the missing ones, are the times with missing pulses interpolated,
    `reference` (m,) those of a reference keyphasor (None without one); both are NaN where there is
    no pulse. `remarks` say how pulses were repaired. The marks are counted from `ahead` trigger
    pulses before the first one.
    """

    times: FloatArray
    missing: IntArray
    starts_run: BoolArray
    doubtful: BoolArray
    bridged: FloatArray
    reference: FloatArray | None = None
    remarks: tuple[str, ...] = ()
    displaced: IntArray | int = 0
    ahead: int = 0

    @classmethod
    def unbroken(cls, times: FloatArray) -> 'RecordPulses':
        """Return consecutive trigger pulses, all of which are valid."""
        none = np.zeros(times.size, np.bool_)
        return cls(times, np.zeros(max(times.size - 1, 0), np.int64), none, none, times)

    @property
    def number(self) -> IntArray:
        """Return the number of trigger cycles from the first pulse to each pulse (n,)."""
        return numbered(self.missing)

    @property
    def measured(self) -> BoolArray:
        """Return which of the bridged pulses (m,) were measured."""
        return np.isin(np.arange(self.bridged.size), self.number)

    @property
    def index(self) -> IntArray:
        """Return the number of trigger cycles from the first mark to each pulse (n,)."""
        return self.ahead + self.number

    @property
    def lost(self) -> IntArray:
        """Return the number of pulses that did not come in each interval that ends no run."""
        return np.asarray(self.missing - self.displaced)[~self.starts_run[1:]]

    def broken_at(self, gaps: BoolArray, start_time: float, rate: float, reach: int
                  ) -> 'RecordPulses':
        """
        Return the pulses with a new run behind every trigger cycle that a gap touches.

        `gaps` (sample,) tells which samples are none, of those that begin at `start_time` (s);
        cycles read as many samples as `reach` beyond their pulses.
        """
        place = ((self.times - start_time) * rate).clip(-reach, gaps.size + reach)
        before = np.append(0, np.cumsum(gaps))
        first, last = (edge.astype(np.int64).clip(0, gaps.size) for edge in (
            place[:-1] - reach, place[1:] + reach + 1))
        broken = before[last] > before[first]
        if not broken.any():
            return self
        number, bridged = self.number, self.bridged.copy()
        for k in np.flatnonzero(broken & (self.missing > 0)).tolist():
            bridged[number[k] + 1:number[k + 1]] = np.nan
        remark = (f'{100.0 * np.mean(gaps):.3g}% of the samples are NaN, infinite or stuck at one '
                  f'value: no acquisition contains any of the {np.count_nonzero(broken)} trigger '
                  'cycles that they touch')
        return replace(self, starts_run=self.starts_run | np.append(False, broken),
                       bridged=bridged, remarks=(*self.remarks, remark))


def numbered(missing: IntArray) -> IntArray:
    """Return the numbers (n,) of pulses between which `missing` (n - 1,) others are missing."""
    return np.asarray(np.concatenate(([0], np.cumsum(1 + missing))), np.int64)


def record_pulses(recording: Recording, model: DeclaredModel) -> RecordPulses:
    """
    Return the trigger pulses of a recording that the pulse validation of the averager accepts.

    Raises ModelError if the recording contradicts the declared model, RecordingError if it has no
    usable pulses.
    """
    if abs(recording.ratio / model.ratio - 1.0) > SAME_RATIO and recording.ratio != 1.0:
        raise ModelError(f'ratio is declared as {model.ratio:.9g} but the recording says '
                         f'{recording.ratio:.9g}: declare the ratio of this machine')
    if recording.pulses_per_revolution not in (1, model.pulses_per_revolution):
        raise ModelError(f'pulses_per_revolution is declared as {model.pulses_per_revolution} but '
                         f'the recording says {recording.pulses_per_revolution}: declare '
                         'that of this machine')
    step = model.pulses_in_trigger_cycle
    # As the keyphasor was sampled: the jitter of its sampling is part of the declared model.
    measured = recording.keyphasor_pulses(interpolate=False)
    if measured.size < _FEWEST:
        raise RecordingError(f'{measured.size} keyphasor pulses, at least {_FEWEST} are needed: '
                             'check that the tach waveform crosses its threshold')
    pulses, displaced, validator = _validated(
        measured, recording.duration, model.pulses_per_revolution, step, **recording.target)
    counts, causes = validator.finish(), validator.take_messages()
    spurious = counts.doubles + counts.early
    if spurious > RARE * measured.size:
        raise RecordingError(
            f'{spurious} of {measured.size} pulses are spurious, more than {RARE:.0%}: '
            + (causes or ['give the trigger more hysteresis'])[0])
    dropped = spurious + counts.unlocked
    if dropped > measured.size - dropped:  # most
        raise RecordingError(
            f'{dropped} of {measured.size} pulses follow each other at no interval that a shaft '
            'could have: ' + (causes or ['see what check_keyphasor finds in them'])[0])
    found = _every(step, pulses, displaced)
    if found.times.size < _FEWEST or not np.any(found.missing == 0):
        raise RecordingError(f'{found.times.size} trigger pulses of {measured.size} keyphasor '
                             f'pulses: the loop needs {_FEWEST} in a row; record longer')
    slow, middle, fast = model.revolutions_per_trigger / np.quantile(
        np.diff(found.times)[found.missing == 0], (1.0 - RARE, 0.5, RARE))
    if not slow * (1.0 - SPEED_TOLERANCE) <= model.trigger_speed <= fast * (1.0 + SPEED_TOLERANCE):
        raise ModelError(f'trigger_speed is declared as {model.trigger_speed:g} Hz but the tach '
                         f'shaft turns at {middle:.4g} Hz: declare the speed and '
                         'pulses_per_revolution of this recording')
    reference, other = None, recording.reference_pulse_times
    itself = other is not None and np.array_equal(measured, other)
    if other is not None and not itself:
        better, moved, _ = _validated(other, recording.duration)
        if better.times.size < _FEWEST:
            raise RecordingError(f'{better.times.size} valid reference_pulse_times, at least '
                                 f'{_FEWEST} are needed: give those of all pulses, or none')
        # one pulse of the reference in each trigger cycle, or as many as there are of the other
        longer = np.median(np.diff(better.times)) / np.median(np.diff(pulses.times))
        reference = _matched(found, _every(1, better, moved), step if longer**2 < step else 1)
    remarks = [*_remarks(counts, measured.size, int(displaced.sum())),
               *_tach_rate_remark(recording, model)]
    if itself and recording.pulse_times is not None:
        remarks.append('reference_pulse_times are the pulse times themselves: they tell nothing '
                       'of their errors and are not used')
    return RecordPulses(found.times, found.missing, found.starts_run, found.doubtful,
                        found.bridged, reference, tuple(remarks), found.displaced)


def _every(step: int, pulses: TriggerPulses, displaced: BoolArray) -> RecordPulses:
    """Return the pulses whose number over all gaps, their count, is a multiple of `step`."""
    chosen = pulses.count % step == 0
    there = np.flatnonzero(chosen & pulses.measured)
    number = pulses.count // step
    bridged = np.full(int(number[-1]) + 1 if number.size else 0, np.nan)
    bridged[number[chosen]] = pulses.times[chosen]
    run = np.cumsum(pulses.starts_run)[there]
    first, last = (int(number[there[k]]) if there.size else 0 for k in (0, -1))
    return RecordPulses(
        pulses.times[there], np.asarray(np.diff(number[there]) - 1, np.int64),
        np.diff(run, prepend=0) > 0, pulses.doubtful[there], bridged[first:last + 1],
        displaced=np.diff(np.cumsum(chosen & displaced)[there]))


def _validated(times: FloatArray, longest: float, marks: int = 1, step: int = 1, **target: Any
               ) -> tuple[TriggerPulses, BoolArray, PulseValidator]:
    """
    Return the accepted pulses of a target of so many marks, numbered by `count` over all gaps.

    Which of the missing ones came far from their place, and what validated all, is returned, too.
    A gap that is `longest` (s) has no vibration behind it, so that pulses need no number there.
    Uneven angles of the `target` are taken from the times as in an average, unless every trigger
    cycle, of `step` pulses, begins at the same mark.
    """
    # Every pulse is a trigger here, so that pulses are counted also where a run is interrupted.
    validator = PulseValidator(pulses_per_revolution=marks, pulses_per_trigger=1,
                               missing_pulses='bridge', **target)
    found = TriggerPulses.joined([validator.update(times), validator.flush()])
    number = found.count.copy()
    for begin in np.flatnonzero(np.diff(number) <= 0) + 1:  # after a gap of unknown length
        usual = float(np.median(np.diff(found.times[max(begin - _USUAL, 0):begin])))
        gap = float(found.times[begin] - found.times[begin - 1])
        number[begin:] += number[begin - 1] + max(round(min(gap, longest) / usual), 1
                                                  ) - number[begin]
    # Of a double and the pulse before it, either may be the true one. One of the last two pulses
    # before an interruption may be its cause.
    doubtful = found.doubtful | np.append((found.doubtful | found.starts_run)[1:], False)
    doubtful[:-2] |= found.starts_run[2:]
    came = _as_they_came(times, found, number, validator,
                         np.array(target.get('target_angles', ())))
    # A pulse that was dropped where one is missing is that one, far from its place by its jitter.
    dropped = np.setdiff1d(times, came[found.measured])
    displaced = np.isin(np.arange(number.size),
                        np.searchsorted(0.5 * (came[1:] + came[:-1]), dropped))
    return (replace(found, times=found.times if step % marks else came, count=number,
                    doubtful=doubtful), displaced & ~found.measured, validator)


def _as_they_came(times: FloatArray, found: TriggerPulses, number: IntArray,
                  validator: PulseValidator, angles: FloatArray) -> FloatArray:
    """
    Return when the pulses `found` (n,) among `times` came.

    They are given without the `angles` (mark,) in rad by which their marks are late.
    """
    if number.size < 2 or not validator.teeth.size:
        return found.times
    late = np.zeros(validator.pulses_per_revolution)
    late[validator.teeth] = late.size / (2.0 * np.pi) * (angles - angles.mean())  # in teeth
    came = found.times + np.gradient(found.times, number) * np.where(
        found.mark < 0, 0.0, late[found.mark % late.size])
    nearest = np.searchsorted(0.5 * (times[1:] + times[:-1]), came[found.measured])
    came[found.measured] = times[nearest]
    return came


def _matched(pulses: RecordPulses, better: RecordPulses, step: int) -> FloatArray:
    """Return the reference time of every trigger pulse (m,), NaN where there is none."""
    middle = 0.5 * (better.times[1:] + better.times[:-1])
    nearest = np.searchsorted(middle, pulses.times)
    ahead = better.number[nearest] - step * pulses.number
    beside = (pulses.times >= better.times[0]) & (pulses.times <= better.times[-1])
    shift = int(np.median(ahead[beside])) if beside.any() else 0
    wanted = shift + step * np.arange(pulses.bridged.size)
    known = better.bridged.copy()
    known[better.number[better.doubtful]] = np.nan
    inside = (wanted >= 0) & (wanted < known.size)
    matched = np.full(wanted.size, np.nan)
    matched[inside] = known[wanted[inside]]
    share = float(np.mean(np.isfinite(matched[pulses.number])))
    if share < _COVERED:
        raise RecordingError(f'reference_pulse_times cover {share:.0%} of the pulses, at least '
                             f'{_COVERED:.0%} are needed: give pulses of the same period of time')
    return matched


def _remarks(counts: PulseCounts, total: int, displaced: int) -> list[str]:
    """Return what the validation dropped, interpolated or could not use, one sentence each."""
    spurious = counts.doubles + counts.early
    lost = counts.missing_bridged - displaced
    found = (
        (spurious, f'{spurious} of {total} pulses are spurious ({counts.doubles} double, '
         f'{counts.early} early): they were dropped, and no acquisition contains a trigger cycle '
         'next to them'),
        (displaced, f'{displaced} of them came where a pulse is missing: they are that pulse, '
         'displaced by its jitter, and not lost'),
        (lost, f'{lost} pulses are missing between the {total} that were measured'),
        (counts.late, f'{counts.late} of {total} pulses are late: the gap before them is not a '
         'whole number of intervals, or longer than three missing pulses; no acquisition contains '
         'such a gap'),
        (counts.unlocked, f'{counts.unlocked} of {total} pulses arrived before a steady interval '
         'was known: they were dropped'))
    return [text for count, text in found if count > 0]


def _tach_rate_remark(recording: Recording, model: DeclaredModel) -> list[str]:
    """Return a remark if the tach was sampled at another rate than the declared one."""
    rate = recording.tach_rate
    if not rate or abs(model.keyphasor_rate / rate - 1.0) <= SAME_RATE:
        return []
    return [f'keyphasor_rate is declared as {model.keyphasor_rate:.6g} Hz but the '
            f"recording's tach was sampled at {rate:.6g} Hz: declare {rate:.6g}"]
