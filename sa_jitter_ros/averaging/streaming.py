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

A trigger cycle is averaged as soon as its two pulses, the other pulses that the angle law uses and
the samples around it are there. The result depends on the data only: not on the sizes of the
blocks, and not on whether pulses arrive before or after their samples. A cycle without its samples
is discarded and counted, and it ends the unfinished averages.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, AverageSettings
from sa_jitter_ros.averaging.correction import CorrectingAverager
from sa_jitter_ros.averaging.cycle import CycleSamples
from sa_jitter_ros.averaging.timeline import Segment, VibrationTimeline
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.angle_law import angle_law
from sa_jitter_ros.pulses.validation import PulseCounts, PulseValidator, TriggerPulses
from sa_jitter_ros.samples import SampleBlock

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Trigger:
    """
    A trigger pulse at `time` (s).

    `starts_run`: no trigger cycle ends here. `epoch` is how often time ran back before; `elapsed`
    the time (s) since the first pulse, without the steps back.
    """

    time: float
    starts_run: bool
    epoch: int
    elapsed: float


@dataclass
class StreamCounts:
    """Counts of trigger cycles and averages, and of pulses that waited too long, so far."""

    cycles: int = 0
    cycles_dropped: int = 0
    pulses_dropped: int = 0
    averages_dropped: int = 0


class StreamingAverager:
    """
    Synchronous averages of several shafts from one keyphasor.

    `add_samples` and `add_pulses` return the averages that are due, as (shaft, average) pairs;
    `take_messages` returns a line of text for each problem since its last call. Samples wait for
    their pulses, and pulses for their samples, for `timeline.buffer_seconds`. Where the trigger
    cycles are interrupted, an unfinished block average is dropped and counted, or returned with
    `keep_unfinished`.

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
        self.shafts = {name: CorrectingAverager(settings) for name, settings in shafts.items()}
        self._law = angle_law(next(iter(shafts.values())).angle_law)
        self._triggers: list[Trigger] = []  # of which the next cycle begins at _next
        self._next = 0
        self._run = 0  # where the run of the next cycle begins
        self._pulse_epoch = 0
        self._lead = np.inf  # s of samples before a cycle that its interpolation reads
        self._speed = 0, 0.0  # cycles and seconds since the last take_speed
        self._messages: list[str] = []
        self._keep_unfinished = keep_unfinished
        self._due: list[tuple[str, Average]] = []
        self._ended = False

    @property
    def pulse_counts(self) -> PulseCounts:
        """Return the counts of the pulses so far, of all validators."""
        validator = self.validator
        return self._pulse_counts + (validator.finish() if self._ended else validator.counts)

    @property
    def totals(self) -> dict[str, int]:
        """Return the counts of dropped and lost data so far, by the keys of the diagnostics."""
        samples, pulses = self.timeline.counts, self.pulse_counts
        return {
            'samples_dropped': samples.samples_dropped, 'samples_lost': samples.samples_lost,
            'pulses_dropped': (self.counts.pulses_dropped + pulses.doubles + pulses.early
                               + pulses.out_of_order + pulses.non_finite + pulses.unlocked),
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
        self._queue(triggers)
        averages = self._process()
        self._bound_pulses()
        return averages

    def finish(self) -> list[tuple[str, Average]]:
        """Return the averages that become due because neither samples nor pulses follow."""
        self._ended = True
        self.timeline.close()
        averages = self._process()
        waiting = self._triggers[self._next:]
        count = sum(not item.starts_run for item in waiting[1:])
        if count:
            self._discard(count, f'no vibration from {waiting[0].time:.6f} s on')
        self._triggers.clear()
        self._next = 0
        self._begin_run()
        due, self._due = self._due, []
        return averages + due

    def change(self, shafts: dict[str, AverageSettings]) -> None:
        """Continue with other settings of the same shafts; unfinished averages count as lost."""
        lost = [self.shafts[name].change(settings) for name, settings in shafts.items()]
        self.counts.averages_dropped += sum(lost)
        self._law = angle_law(next(iter(shafts.values())).angle_law)

    def change_pulses(self, validator: PulseValidator) -> None:
        """Continue with another validator: waiting pulses are dropped, the angle begins at 0."""
        self._pulse_counts += self.validator.finish()
        self.validator = validator
        self.counts.cycles_dropped += max(len(self._triggers) - self._next - 1, 0)
        self._triggers.clear()
        self._next = 0
        self._begin_run()

    def take_speed(self) -> float:
        """Return the trigger cycles per second since the last call; NaN if there was none."""
        cycles, seconds = self._speed
        self._speed = 0, 0.0
        return cycles / seconds if cycles else float('nan')

    # --- pulses ---

    def _queue(self, triggers: TriggerPulses) -> None:
        for number, (time, starts, restarted) in enumerate(zip(
                triggers.times.tolist(), triggers.starts_run.tolist(),
                triggers.restarted.tolist())):
            # The first pulses may lie before the vibration: the third one decides the epoch.
            reach = time if self._triggers else triggers.times[number:number + 3][-1]
            # If the pulse times ran back, those of the vibration did so, too, or will.
            epoch = self.timeline.epoch_near(reach, self._pulse_epoch + restarted)
            starts = starts or epoch != self._pulse_epoch
            self._pulse_epoch = epoch
            last = self._triggers[-1] if self._triggers else Trigger(time, True, 0, 0.0)
            self._triggers.append(Trigger(time, starts or not self._triggers, self._pulse_epoch,
                                          last.elapsed + max(time - last.time, 0.0)))

    def _bound_pulses(self) -> None:
        """Drop and count pulses that wait for their vibration longer than `buffer_seconds`."""
        limit = self.timeline.buffer_seconds
        waiting = self._triggers[self._next:]
        if not waiting or waiting[-1].elapsed - waiting[0].elapsed <= limit:
            return
        if waiting[0].epoch > self.timeline.epoch:
            # The times of the vibration do not run back: the pulses belong to its present epoch.
            self._pulse_epoch = self.timeline.epoch
            self._triggers[self._next:] = [
                replace(item, epoch=self._pulse_epoch) for item in waiting]
        keep = next(i for i, item in enumerate(waiting)
                    if waiting[-1].elapsed - item.elapsed <= limit)
        if keep:
            self.counts.pulses_dropped += keep * self.validator.pulses_per_trigger
            self._discard(keep, f'{keep} trigger pulses waited longer than buffer_seconds = '
                          f'{limit:g} s for vibration: is it published, on the clock of the '
                          'pulses? (raise it for a slower shaft only)')
        self._forget_used()

    # --- cycles ---

    def _process(self) -> list[tuple[str, Average]]:
        while len(self._triggers) - self._next >= 2:
            start, end = self._triggers[self._next:self._next + 2]
            if end.starts_run or end.epoch != start.epoch:
                self._break_run()
                continue
            after, closed = self._pulses_after()
            first = self._next == self._run
            if not closed and after < (self._law.after_first if first else self._law.after):
                break
            segment = self._locate(start, end)
            if segment is None:
                break
            if isinstance(segment, str):
                count = self._uncovered()
                end = self._triggers[self._next + count]
                self._discard(count, f'no vibration without a gap from {start.time:.6f} s to '
                              f'{end.time:.6f} s{segment}')
                continue
            self._hand_over(segment)
            self._next += 1
        self._forget_used()
        due, self._due = self._due, []
        return due

    def _uncovered(self) -> int:
        """Return the number of cycles, from the next one on, whose vibration will not come."""
        count = 1
        for start, end in pairwise(self._triggers[self._next + 1:]):
            if (end.starts_run or end.epoch != start.epoch
                    or not isinstance(self._locate(start, end), str)):
                break
            count += 1
        return count

    def _pulses_after(self) -> tuple[int, bool]:
        """Return the pulses behind the next cycle that the law may use, and if the run ended."""
        count = 0
        for item in self._triggers[self._next + 2:self._next + 2 + self._law.after_first]:
            if item.starts_run:
                return count, True
            count += 1
        return count, self._ended

    def _locate(self, start: Trigger, end: Trigger) -> Segment | str | None:
        """Return the segment of a cycle, None if it may come, else a remedy (text)."""
        timeline = self.timeline
        if start.epoch > timeline.epoch:
            return None
        ahead = True
        for segment in timeline.segments:
            if segment.epoch != start.epoch or not len(segment.samples):
                continue
            low, high = segment.position(start.time), segment.position(end.time)
            last = len(segment.samples) - 1
            ahead = low > last
            if low < -1e-6 or ahead:
                continue
            margin = max(item.margin(end.time - start.time, segment.clock.rate)
                         for item in self.shafts.values())
            if last >= high + margin or (segment.closed and last >= high - 1e-6):
                return segment
            if not segment.closed:
                return None
            break
        if ahead and start.epoch == timeline.epoch:
            return None
        if timeline.layout is not None:
            rate = timeline.layout[1]
            margin = max(item.margin(end.time - start.time, rate) for item in self.shafts.values())
            if end.time - start.time + 2 * margin / rate > timeline.buffer_seconds:
                return (' (the cycle is longer than buffer_seconds = '
                        f'{timeline.buffer_seconds:g} s: raise it)')
        return ''

    def _hand_over(self, segment: Segment) -> None:
        """Average the next cycle for every shaft."""
        begin = max(self._run, self._next - self._law.before, 0)
        stop = self._next + 2
        for item in self._triggers[stop:stop + self._law.after_first]:
            if item.starts_run:
                break
            stop += 1
        pulses = np.array([item.time for item in self._triggers[begin:stop]])
        first = self._next - begin
        low, high = (segment.position(float(pulse)) for pulse in pulses[first:first + 2])
        self.timeline.counts.samples_dropped += segment.use(low, high)
        failed, clock = '', segment.clock
        self._lead = 0.0
        for name, shaft in self.shafts.items():
            margin = shaft.margin(float(pulses[first + 1] - pulses[first]), clock.rate)
            self._lead = max(self._lead, 1.5 * margin / clock.rate)
            cycle = CycleSamples.cut(
                segment.samples, start_time=clock.time, rate=clock.rate, pulses=pulses,
                first=first, margin=margin, offset=segment.index - clock.index)
            try:
                average = shaft.update(cycle)
            except SignalError as error:  # the other shafts continue
                self.counts.averages_dropped += shaft.reset()
                failed = f'{name}: {error}'
                continue
            if average is not None:
                self._due.append((name, average))
        if failed:
            self.counts.cycles_dropped += 1
            self._messages.append(f'{failed}: trigger cycle discarded')
        self.counts.cycles += 1
        self._speed = (self._speed[0] + 1,
                       self._speed[1] + float(pulses[first + 1] - pulses[first]))

    def _discard(self, count: int, why: str) -> None:
        """Discard the next `count` cycles; the angle begins at 0 behind them."""
        self.counts.cycles_dropped += count
        self._messages.append(f'{why}: {count} trigger cycle{"s" if count > 1 else ""} discarded')
        self._next += count
        if self._next < len(self._triggers):
            self._triggers[self._next] = replace(self._triggers[self._next], starts_run=True)
        self._begin_run()

    def _break_run(self) -> None:
        """Begin a run at the next pulse, where no trigger cycle ends."""
        self._next += 1
        self._begin_run()

    def _begin_run(self) -> None:
        self._run, self._lead = self._next, np.inf
        for name, shaft in self.shafts.items():
            average = shaft.finish() if self._keep_unfinished else None
            if average is not None:
                self._due.append((name, average))
            self.counts.averages_dropped += shaft.reset()

    def _forget_used(self) -> None:
        """Drop the samples before the next cycle, and the pulses that the law needs no more."""
        if not self._triggers:
            return
        head = self._triggers[min(self._next, len(self._triggers) - 1)]
        self.timeline.release(head.epoch, head.time - self._lead)
        keep = max(self._run, self._next - self._law.before, 0)
        del self._triggers[:keep]
        self._next -= keep
        self._run -= keep
