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
The on-line average: samples and pulses in, in blocks of any size, averages out.

A trigger cycle is taken as soon as its two pulses, the other pulses that the angle law uses and
the samples around it are there; all that are there are taken together. The result depends on the
data only: not on the sizes of the blocks, and not on whether pulses arrive before or after their
samples. A cycle without its samples is discarded and counted, and it ends the unfinished averages.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.correction import CorrectingAverager, LatestGrid
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.error_ramp import ErrorRamp
from sa_jitter_ros.averaging.recovered_marks import RecoveredMarks
from sa_jitter_ros.averaging.rows import Rows
from sa_jitter_ros.averaging.shaft import TOGETHER
from sa_jitter_ros.averaging.timeline import Segment, VibrationTimeline
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.angle_law import angle_law
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.pulses.validation import PulseCounts, PulseValidator, TriggerPulses
from sa_jitter_ros.samples import SampleBlock

#: A trigger pulse at `time` (s). `starts_run`: no trigger cycle ends here; `skipped` are the
#: discarded ones since the pulse before, 0 if their number is not known. `epoch` is how often time
#: ran back before; `elapsed` the time (s) since the first pulse, without the steps back. `mark` is
#: numbering * teeth + tooth (`TriggerPulses.mark`), -1 where the geometry of the target is not
#: known, or `RecoveredMarks` has taken the last of it from the time.
TRIGGER = np.dtype([('time', np.float64), ('elapsed', np.float64), ('epoch', np.int64),
                    ('skipped', np.int64), ('starts_run', np.bool_), ('mark', np.int64)])

_FEW, _SILENCE = 3, 1.0  # trigger cycles and s: longer gaps of the pulses are said


@dataclass
class StreamCounts:
    """Counts of trigger cycles and averages, and of pulses that waited too long, so far."""

    cycles: int = 0
    cycles_dropped: int = 0
    pulses_dropped: int = 0
    averages_dropped: int = 0
    pulses_refitted: int = 0


class StreamingAverager:
    """
    Synchronous averages of several shafts from one keyphasor.

    `add_samples` and `add_pulses` return the averages that are due, as (shaft, average) pairs;
    `take_messages` returns a line of text for each problem since its last call. Samples wait for
    their pulses, and pulses for their samples, for `timeline.buffer_seconds`. Where the trigger
    cycles are interrupted, an unfinished block average is dropped and counted, or returned with
    `keep_unfinished`; or it goes on behind the discarded cycles, as `maximum_discarded` of its
    settings allows.

    Two shafts from one keyphasor, with 100 cycles at 10 Hz:

    >>> shafts = {name: AverageSettings(cycle_length=ratio, trigger_cycles=50, orders=(3.0,))
    ...           for name, ratio in (('input', 1.0), ('output', 2.5))}
    >>> stream = StreamingAverager(shafts, validator=PulseValidator(),
    ...                            timeline=VibrationTimeline(buffer_seconds=60.0))
    >>> stream.add_pulses(np.arange(101) / 10.0)
    []
    >>> vibration = np.cos(2.0 * np.pi * 3.0 * 25.0 * np.arange(11_000) / 1e3)[None]
    >>> for name, average in stream.add_samples(SampleBlock(vibration, 0.0, 1e3, 0)):
    ...     print(name, average.sequence, abs(average.amplitudes).round(3))
    input 0 [[0.]]
    output 0 [[1.]]
    input 1 [[0.]]
    output 1 [[1.]]
    """

    def __init__(self, shafts: dict[str, AverageSettings], *, validator: PulseValidator,
                 timeline: VibrationTimeline, keep_unfinished: bool = False) -> None:
        if not shafts:
            raise ParameterError('no shaft to average: name at least one')
        self.timeline, self.validator = timeline, validator
        self.counts = StreamCounts()
        self._pulse_counts = PulseCounts()  # of earlier validators
        self._grids = LatestGrid()
        self.shafts = {name: CorrectingAverager(settings, self._grids)
                       for name, settings in shafts.items()}
        self._law = angle_law(next(iter(shafts.values())).angle_law)
        self._triggers = Rows(np.empty(0, TRIGGER))  # of which the next cycle begins at _next
        self._next = 0
        self._run = 0  # where the run of the next cycle begins
        self._pulse_epoch = 0
        self._last_count = 0  # of the trigger cycles at the last pulse
        self._last_time = np.nan  # s, of the last pulse as it came
        self._lead = np.inf  # s of samples before a cycle that its interpolation reads
        self._speed = 0, 0.0  # cycles and seconds since the last take_speed
        self._messages: list[str] = []
        self._keep_unfinished = keep_unfinished
        self._recovered = RecoveredMarks(validator.pulses_per_revolution)
        self._ramps = {name: ErrorRamp() for name in shafts}
        self._due: list[tuple[str, Average]] = []
        self._ended = False

    @property
    def pulse_counts(self) -> PulseCounts:
        """Return the counts of the pulses so far, of all validators."""
        validator = self.validator
        return self._pulse_counts + (validator.finish() if self._ended else validator.counts)

    @property
    def doubts(self) -> dict[str, str]:
        """Return how the pulses run away from the vibration, by shaft; '' where they do not."""
        return {name: ramp.doubt for name, ramp in self._ramps.items()}

    @property
    def geometry(self) -> MarkOffsets | None:
        """Return what is taken from the pulses of each mark of the target, None for nothing."""
        found = self.validator.geometry
        return None if found is None else self._recovered.added_to(found, self.validator.teeth)

    @property
    def totals(self) -> dict[str, int]:
        """Return the counts of dropped and lost data so far, by the keys of the diagnostics."""
        samples, pulses = self.timeline.counts, self.pulse_counts
        return {
            'samples_dropped': samples.samples_dropped, 'samples_lost': samples.samples_lost,
            'pulses_dropped': (self.counts.pulses_dropped + pulses.doubles + pulses.early
                               + pulses.out_of_order + pulses.non_finite + pulses.unlocked),
            'pulses_refitted': self.counts.pulses_refitted,
            'cycles_dropped': self.counts.cycles_dropped + pulses.cycles_discarded,
            'averages_dropped': self.counts.averages_dropped, 'gaps': samples.gaps,
            'restarts': max(samples.restarts, pulses.restarts), 'repeats': samples.repeats,
            'clock_deviation': samples.clock_deviation}

    def take_messages(self) -> list[str]:
        """Return the messages since the last call."""
        lines = self._messages + self.timeline.messages
        self._messages, self.timeline.messages = [], []
        return lines

    def add_samples(self, block: SampleBlock) -> list[tuple[str, Average]]:
        """Take a block; raises `SignalError` for one that cannot be used, which is counted."""
        self.timeline.add(block)
        averages = self._process()
        self.timeline.bound()
        return averages

    def add_pulses(self, times: FloatArray) -> list[tuple[str, Average]]:
        """Take pulse times (s), in order of arrival."""
        triggers = self.validator.update(times)
        self._messages += self.validator.take_messages()
        self._queue(triggers)
        averages = self._process()
        self._bound_pulses()
        return averages

    def finish(self) -> list[tuple[str, Average]]:
        """Return the averages that become due because neither samples nor pulses follow."""
        self._ended = True
        self._queue(self.validator.flush())
        self.timeline.close()
        averages = self._process()
        waiting = self._triggers.items[self._next:]
        count = int(np.count_nonzero(~waiting['starts_run'][1:]))
        if count:
            self._discard(count, f'no vibration from {waiting["time"][0]:.6f} s on')
        self._triggers = Rows(np.empty(0, TRIGGER))
        self._next = 0
        self._begin_run()
        due, self._due = self._due, []
        return averages + due

    def change(self, shafts: dict[str, AverageSettings]) -> None:
        """Continue with other settings of the same shafts; unfinished averages count as lost."""
        lost = [self.shafts[name].change(settings) for name, settings in shafts.items()]
        self._ramps = {name: ErrorRamp() for name in shafts}
        self.counts.averages_dropped += sum(lost)
        self._law = angle_law(next(iter(shafts.values())).angle_law)

    def change_pulses(self, validator: PulseValidator) -> None:
        """Continue with another validator: waiting pulses are dropped, the angle begins at 0."""
        self._pulse_counts += self.validator.finish()
        self.validator = validator
        self._recovered = RecoveredMarks(validator.pulses_per_revolution)
        self._ramps = {name: ErrorRamp() for name in self.shafts}
        self.counts.cycles_dropped += max(len(self._triggers) - self._next - 1, 0)
        self._triggers, self._last_time = Rows(np.empty(0, TRIGGER)), np.nan
        self._next = 0
        self._begin_run()

    def take_speed(self) -> float:
        """Return the trigger cycles per second since the last call; NaN if there was none."""
        cycles, seconds = self._speed
        self._speed = 0, 0.0
        return cycles / seconds if cycles else float('nan')

    # --- pulses ---

    def _queue(self, triggers: TriggerPulses) -> None:
        times = triggers.times
        if not times.size:
            return
        items = np.zeros(times.size, TRIGGER)
        items['time'], items['mark'] = times, triggers.mark
        if np.count_nonzero(triggers.starts_run) or self.timeline.epoch > self._pulse_epoch:
            self._mark_runs(items, triggers)
        else:
            items['epoch'] = self._pulse_epoch
        self._last_count = int(triggers.count[-1])
        elapsed = items['elapsed']
        if len(self._triggers):
            last = float(self._triggers.items['elapsed'][-1])
            elapsed[0] = last + max(float(times[0]) - self._last_time, 0.0)
        else:
            items['starts_run'][0], items['skipped'][0] = True, 0
        elapsed[1:] = elapsed[0] + np.maximum(times[1:] - times[:-1], 0.0).cumsum()
        self._last_time = float(times[-1])
        self._triggers.append(items)

    def _mark_runs(self, items: NDArray[Any], triggers: TriggerPulses) -> None:
        """Set the epochs of pulses, where runs begin, and what was discarded before."""
        epochs = self._epochs(triggers)
        # Behind a gap of unknown length the count begins at 0 again.
        changed = epochs != np.concatenate(((self._pulse_epoch,), epochs[:-1]))
        skipped = triggers.count - np.concatenate(((self._last_count,), triggers.count[:-1]))
        items['epoch'] = epochs
        items['starts_run'] = triggers.starts_run | changed
        anew = changed | triggers.restarted
        items['skipped'] = np.where(anew, 0, np.maximum(skipped, 0))
        self._pulse_epoch = int(epochs[-1])
        before = np.concatenate(((self._last_time,), triggers.times[:-1]))
        long = (items['skipped'] > _FEW) | (triggers.times - before > _SILENCE)
        for number in np.flatnonzero(triggers.starts_run & long & ~anew):
            since = '' if np.isnan(before[number]) else f'from {before[number]:.6f} s '
            self._messages.append(
                f'no valid pulses {since}to {triggers.times[number]:.6f} s: '
                f'{items["skipped"][number] or "an unknown number of"} trigger cycles discarded')

    def _epochs(self, triggers: TriggerPulses) -> NDArray[np.int64]:
        """Return the epoch of each pulse."""
        # If the pulse times ran back, those of the vibration did so, too, or will.
        earliest = self._pulse_epoch + triggers.restarted.cumsum()
        if all(item.epoch == self.timeline.epoch for item in self.timeline.segments):
            return np.asarray(earliest + max(self.timeline.epoch - int(earliest[0]), 0))
        epochs, epoch, times = [], self._pulse_epoch, triggers.times.tolist()
        for number, restarted in enumerate(triggers.restarted.tolist()):
            # The first pulses may lie before the vibration: the third one decides the epoch.
            reach = times[number] if self._triggers or number else times[:3][-1]
            epoch = self.timeline.epoch_near(reach, epoch + restarted)
            epochs.append(epoch)
        return np.array(epochs)

    def _bound_pulses(self) -> None:
        """Drop and count pulses that wait for their vibration longer than `buffer_seconds`."""
        limit = self.timeline.buffer_seconds
        waiting = self._triggers.items[self._next:]
        if not len(waiting) or waiting['elapsed'][-1] - waiting['elapsed'][0] <= limit:
            return
        if waiting['epoch'][0] > self.timeline.epoch:
            # The times of the vibration do not run back: the pulses belong to its present epoch.
            self._pulse_epoch = self.timeline.epoch
            waiting['epoch'] = self._pulse_epoch
        keep = int(np.argmax(waiting['elapsed'][-1] - waiting['elapsed'] <= limit))
        if keep:
            self.counts.pulses_dropped += keep * self.validator.pulses_per_trigger
            ends = self.timeline.end_time
            where = f', which ends at {ends:.6f} s' if np.isfinite(ends) else ''
            self._discard(keep, f'{keep} trigger pulses waited longer than buffer_seconds = '
                          f'{limit:g} s for vibration{where}: is it published, on the clock of '
                          'the pulses? (raise it for a slower shaft only)')
        self._forget_used()

    # --- cycles ---

    def _process(self) -> list[tuple[str, Average]]:
        before = self._next
        while len(self._triggers) - self._next >= 2:
            items = self._triggers.items
            times = items['time']
            stop = self._run_end()
            if stop == self._next + 1:
                self._break_run()
                continue
            ready = self._ready(stop)
            if ready < 1:
                break
            if self.validator.corrects_marks:
                self._take_marks(stop)
            start, end = float(times[self._next]), float(times[self._next + 1])
            segment = self._locate(int(items['epoch'][self._next]), start, end)
            if segment is None:
                break
            if isinstance(segment, str):
                count = self._uncovered(stop)
                end = float(times[self._next + count])
                self._discard(count, f'no vibration without a gap from {start:.6f} s to '
                              f'{end:.6f} s{segment}')
                continue
            count, margin = self._together(segment, times[self._next:self._next + ready + 1])
            self._hand_over(segment, count, margin, stop)
            self._next += count
        if self._next != before:
            self._forget_used()
        due, self._due = self._due, []
        return due

    def _take_marks(self, stop: int) -> None:
        """Take from the pulses up to the next average what is known of their marks."""
        shafts = self.shafts.values()
        last = min(stop, self._next + 1 + min(item.room for item in shafts)
                   + self._law.after_first)
        settings = [item.settings for item in shafts]
        self._recovered.take_from(
            self._triggers.items, self._next, last,
            revolutions=settings[0].revolutions_per_trigger,
            remember=any(item.correct_jitter for item in settings))

    def _run_end(self) -> int:
        """Return the number of the pulse behind the last one of the next cycle's run."""
        items = self._triggers.items
        begins = items['starts_run'][self._next + 1:]
        number = int(begins.argmax()) if len(begins) else 0
        return self._next + 1 + number if len(begins) and begins[number] else len(items)

    def _ready(self, stop: int) -> int:
        """Return how many cycles, from the next one on, have the pulses that the law may use."""
        count = stop - self._next - 1
        if stop < len(self._triggers) or self._ended:
            return count
        if self._next == self._run and count - 1 < self._law.after_first:
            return 0
        return count - self._law.after

    def _together(self, segment: Segment, times: FloatArray) -> tuple[int, int]:
        """
        Return how many of the cycles between `times`, at least one, can be taken together.

        The second number are the samples that they need on either side.
        """
        clock, samples = segment.clock, segment.samples
        offset = clock.index - segment.index
        times = times[:min(item.room for item in self.shafts.values()) + 1] - clock.time

        def cycles_to(position: float) -> int:
            return int(times.searchsorted((position - offset) / clock.rate, 'right')) - 1

        last = len(samples) - (1.0 - 1e-6 if segment.closed else 1.0)
        reach = min(last, float(times[0]) * clock.rate + offset + 4 * TOGETHER / samples.shape[1])
        count = max(cycles_to(reach), 1)
        periods = (times[1:count + 1] - times[:count]).tolist()
        margin = self._margin(max(periods), clock.rate)
        if count > 1:
            if not segment.closed:
                count = cycles_to(min(reach, last - margin))
            shortest = max(item.shortest(clock.rate) for item in self.shafts.values())
            if min(periods) <= shortest:  # a cycle that a shaft refuses is taken alone
                count = min(count, next(k for k, item in enumerate(periods) if item <= shortest))
        return max(count, 1), margin

    def _margin(self, period: float, rate: float) -> int:
        """Return the samples that a cycle of `period` s needs on either side, for any shaft."""
        return max(item.margin(period, rate) for item in self.shafts.values())

    def _uncovered(self, stop: int) -> int:
        """Return the number of cycles, from the next one on, whose vibration will not come."""
        items = self._triggers.items
        epoch, times = int(items['epoch'][self._next]), items['time'][self._next:stop].tolist()
        count = 1
        while count < len(times) - 1 and isinstance(
                self._locate(epoch, times[count], times[count + 1]), str):
            count += 1
        return count

    def _locate(self, epoch: int, start: float, end: float) -> Segment | str | None:
        """Return the segment of a cycle, None if it may come, else a remedy (text)."""
        timeline = self.timeline
        if epoch > timeline.epoch:
            return None
        ahead = True
        for segment in timeline.around(epoch, start):
            if segment.epoch != epoch or not segment.size:
                continue
            low, high = segment.position(start), segment.position(end)
            last = segment.size - 1
            ahead = low > last
            if low < -1e-6 or ahead:
                continue
            margin = self._margin(end - start, segment.clock.rate)
            if last >= high + margin or (segment.closed and last >= high - 1e-6):
                return segment
            if not segment.closed:
                return None
            break
        if ahead and epoch == timeline.epoch:
            return None
        if timeline.layout is not None:
            rate = timeline.layout[1]
            margin = self._margin(end - start, rate)
            if end - start + 2 * margin / rate > timeline.buffer_seconds:
                return (' (the cycle is longer than buffer_seconds = '
                        f'{timeline.buffer_seconds:g} s: raise it)')
        if timeline.segments and (first := timeline.segments[0].start_time) > end:
            return f' (vibration begins at {first:.6f} s: time both by one clock)'
        return ''

    def _hand_over(self, segment: Segment, count: int, margin: int, stop: int) -> None:
        """Average the next `count` cycles, of a run that ends before pulse `stop`."""
        begin = max(self._run, self._next - self._law.before, 0)
        stop = min(stop, self._next + count + 1 + self._law.after_first)
        pulses = self._triggers.items['time'][begin:stop].copy()
        first = self._next - begin
        low, high = (segment.position(float(pulses[i])) for i in (first, first + count))
        self.timeline.counts.samples_dropped += segment.use(low, high)
        failed, clock = '', segment.clock
        self._lead = 1.5 * margin / clock.rate
        cycles = CycleSamples.cut(
            segment.samples, start_time=clock.time, rate=clock.rate, pulses=pulses, first=first,
            margin=margin, offset=segment.index - clock.index, count=count)
        if segment.lacks_channels:
            cycles = cycles.without_gaps()
        for name, shaft in self.shafts.items():
            try:
                average = shaft.update(cycles)
            except SignalError as error:  # the other shafts continue
                self.counts.averages_dropped += shaft.reset()
                failed = f'{name}: {error}'
                continue
            if average is not None:
                self._due.append((name, average))
                self._recovered.learn(average)
                self._look_at_errors(name, average)
        self._grids.forget()
        if failed:
            self.counts.cycles_dropped += 1
            self._messages.append(f'{failed}: trigger cycle discarded')
        self.counts.cycles += count
        self._speed = (self._speed[0] + count,
                       self._speed[1] + float(pulses[first + count] - pulses[first]))

    def _look_at_errors(self, name: str, average: Average) -> None:
        """Count the pulses that the correction of an average left out, and look for a ramp."""
        ramp, settings = self._ramps[name], self.shafts[name].settings
        before = ramp.doubt
        ramp.update(average, ratio=settings.cycle_length / settings.revolutions_per_trigger)
        if ramp.doubt and not before:
            self._messages.append(f'{name}: the pulses come {ramp.doubt}')
        correction = average.correction
        if correction is not None and correction.refitted:
            self.counts.pulses_refitted += correction.refitted
            self._messages.append(
                f'pulses from {average.start_time:.6f} s to {average.end_time:.6f} s with errors '
                f'that no jitter explains: {correction.refitted}; the correction takes them for '
                'missing ones, the raw average does not; check the tach, and set '
                'interval_tolerance to 0')

    def _discard(self, count: int, why: str) -> None:
        """Discard the next `count` cycles."""
        self.counts.cycles_dropped += count
        self._messages.append(f'{why}: {count} trigger cycle{"s" if count > 1 else ""} discarded')
        self._next += count
        self._triggers.items['starts_run'][self._next:self._next + 1] = True
        self._begin_run(count)

    def _break_run(self) -> None:
        """Begin a run at the next pulse, where no trigger cycle ends."""
        self._next += 1
        self._begin_run(int(self._triggers.items['skipped'][self._next]))

    def _begin_run(self, skipped: int = 0) -> None:
        """Begin a run at the next pulse, behind so many discarded cycles if it is known."""
        self._run, self._lead = self._next, np.inf
        for name, shaft in self.shafts.items():
            if skipped and shaft.skip(skipped):
                continue
            if skipped and shaft.begin_later(skipped):
                self.counts.averages_dropped += 1
                continue
            average = shaft.finish() if self._keep_unfinished else None
            if average is not None:
                self._due.append((name, average))
            self.counts.averages_dropped += shaft.reset()
        self._grids.forget()

    def _forget_used(self) -> None:
        """Drop the samples before the next cycle, and the pulses that the law needs no more."""
        if not self._triggers:
            return
        head = self._triggers.items[min(self._next, len(self._triggers) - 1)]
        self.timeline.release(int(head['epoch']), float(head['time']) - self._lead)
        keep = max(self._run, self._next - self._law.before, 0)
        self._triggers.drop(keep)
        self._next -= keep
        self._run -= keep
