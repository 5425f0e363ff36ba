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
Pulse validation: which pulses of a keyphasor are valid, and which of them begin a trigger cycle.

This module checks the order in time. `pulse_judge` then decides by the intervals which pulses
are valid, and `trigger_counter` counts these. A pulse that is earlier than the last one by at most
`time_tolerance` is out of order and is dropped. A pulse that is earlier by more waits for the next
pulses. If one of these continues the old sequence, the one or two waiting pulses are out of order.
If three pulses follow each other in time, or one fits the waiting ones and not the old sequence,
they begin a new run. If no regular pulse confirmed the last pulse before time ran back, that last
pulse is the one out of order.
"""

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.mark_corrector import MarkCorrector, PulseSink
from sa_jitter_ros.pulses.pulse_follower import JudgeOptions
from sa_jitter_ros.pulses.pulse_judge import PulseJudge
from sa_jitter_ros.pulses.target import EvenTarget, Target, ToothedWheel
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.pulses.trigger_counter import TriggerCounter, TriggerPulses
from sa_jitter_ros.pulses.verdicts import PulseCounts, Verdicts

__all__ = ['GeometryMode', 'MissingPulses', 'PulseCounts', 'PulseValidator', 'TriggerPulses']

MissingPulses = Literal['break', 'bridge']
GeometryMode = Literal['none', 'learn', 'given']
GEOMETRY_MODES = ('none', 'learn', 'given')
_PIECE = 4096  # pulses judged at once
_RESTART = 3  # pulses after time ran back that begin a new run
_WHEEL_TOLERANCE = 0.25  # of the intervals in which the gaps of a wheel are found
_KNOWN_TOLERANCE = 0.15  # of those of a wheel with known uneven marks


class PulseValidator:
    """
    Validate a stream of pulse times, in blocks of any size, and return its trigger pulses.

    A trigger pulse is returned as soon as it ends a trigger cycle, the first one of a run together
    with the second; a doubtful one waits for the next pulses. At the start, the pulses of a second
    wait, at least 4 and at most 12, or 56 where intervals scatter, and those of four revolutions
    of a target with several marks, at most 3 s, or twice as many where a gap or a stray hides the
    angles of a few marks; no pulse is lost by this. `flush` returns those that wait at the end.

    :param pulses_per_revolution: of the tach shaft; with missing teeth, those counted.
    :param pulses_per_trigger: pulses in a trigger cycle, None for all of a revolution.
    :param missing_teeth: number of teeth that the wheel lacks, in one gap or several.
    :param missing_pulses: 'bridge' interpolates missing pulses between their neighbours, 'break'
        discards the trigger cycle.
    :param interval_tolerance: of an interval, as a fraction of the expected one; 0 learns it from
        the scatter of the intervals, 1 accepts every pulse.
    :param maximum_missing: more missing pulses than this in a row are a standstill.
    :param minimum_interval: pulses that follow an accepted one sooner (s) are doubles.
    :param time_tolerance: time (s) by which a pulse may be early before a new run begins.
    :param path_delay: delay (s) of the pulses behind the vibration, which is taken from them.
    :param target_geometry: 'learn' measures how late each mark of the target is, 'given' takes it
        from `target_angles`; either is taken from the pulses. These wait for 100 revolutions at
        first, and behind an interruption until their pattern shows which mark is which, but 3 s at
        most (`mark_corrector`).
    :param target_angles: how late (rad) each mark is, but those of missing teeth, which have none.
    :raises ParameterError: an option is out of range, or cycles do not fit the wheel.

    One pulse of eight is missing, and one is doubled:

    >>> validator = PulseValidator(missing_pulses='bridge')
    >>> validator.update([0.0, 1.0, 2.0, 2.01, 3.0, 5.0, 6.0, 7.0]).times.tolist()
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    >>> validator.flush().times.tolist()
    []
    >>> validator.counts.doubles, validator.counts.missing_bridged
    (1, 1)
    """

    def __init__(
        self, *, pulses_per_revolution: int = 1, pulses_per_trigger: int | None = None,
        missing_teeth: int = 0, missing_pulses: MissingPulses = 'break',
        interval_tolerance: float = 0.0, maximum_missing: int = 3,
        minimum_interval: float = 0.0, time_tolerance: float = 0.01, path_delay: float = 0.0,
        target_geometry: GeometryMode = 'none', target_angles: Sequence[float] = (),
    ) -> None:
        teeth = pulses_per_revolution
        per_trigger = teeth if pulses_per_trigger is None else pulses_per_trigger
        for name, number, least in (
                ('pulses_per_revolution', teeth, 1), ('pulses_per_trigger', per_trigger, 1),
                ('missing_teeth', missing_teeth, 0), ('maximum_missing', maximum_missing, 0)):
            if number != int(number) or number < least:
                raise ParameterError(f'{name} {number} must be a whole number, {least} or more')
        if missing_pulses not in ('break', 'bridge'):
            raise ParameterError(f"missing_pulses '{missing_pulses}': use 'break' or 'bridge'")
        every = interval_tolerance == 1.0
        if not (every or 0.0 <= interval_tolerance < 0.5):
            raise ParameterError(
                f'interval_tolerance {interval_tolerance} must be 0 (learnt), below 0.5 (from '
                'there on a missing pulse looks like a late one), or 1 (accept every pulse)')
        if every and missing_teeth:
            raise ParameterError('interval_tolerance 1 accepts every pulse and hides the gap of '
                                 f'missing_teeth {missing_teeth}: set 0 (learnt)')
        for name, value in (('minimum_interval', minimum_interval),
                            ('time_tolerance', time_tolerance)):
            if not 0.0 <= value < np.inf:
                raise ParameterError(f'{name} {value} s must be finite and not negative')
        if not np.isfinite(path_delay):
            raise ParameterError(f'path_delay {path_delay} s must be finite')
        if missing_teeth and teeth % per_trigger and per_trigger % teeth:
            raise ParameterError(f'pulses_per_trigger {per_trigger} does not divide the {teeth} '
                                 'teeth of the wheel: choose a divisor or a multiple')
        given = _given_angles(target_geometry, target_angles, teeth - missing_teeth, teeth)
        widths = 1.0 + teeth / (2.0 * math.pi) * (np.roll(given, -1) - given)
        tolerance = interval_tolerance or _WHEEL_TOLERANCE
        target: Target = EvenTarget(marks=teeth)
        if missing_teeth:
            target = ToothedWheel(teeth=teeth, missing=missing_teeth, tolerance=tolerance)
        elif np.any(np.abs(widths - 1.0) > tolerance):
            target = ToothedWheel(teeth=teeth, widths=widths,
                                  tolerance=interval_tolerance or _KNOWN_TOLERANCE)
        verdicts = Verdicts(target.marks)
        self._counter = TriggerCounter(teeth=teeth, teeth_per_trigger=per_trigger)
        self._sink: PulseSink = self._counter
        self._corrector: MarkCorrector | None = None
        if target_geometry != 'none' and target.marks > 1:
            self._sink = self._corrector = MarkCorrector(
                self._counter, count=teeth, given=given if given.size else None,
                index=isinstance(target, ToothedWheel), say=verdicts.say)
        self._judge = PulseJudge(target, self._sink, JudgeOptions(
            bridge=missing_pulses == 'bridge', tolerance=interval_tolerance,
            maximum_missing=maximum_missing, minimum_interval=minimum_interval,
            pulses_per_trigger=per_trigger), verdicts)
        self.pulses_per_revolution, self.pulses_per_trigger = teeth, per_trigger
        self._time_tolerance, self._path_delay = time_tolerance, path_delay
        self._held: list[float] = []  # pulses after time ran back

    @property
    def counts(self) -> PulseCounts:
        """Return the counts so far."""
        refused = 0 if self._corrector is None else self._corrector.refused
        return PulseCounts(**{**self._judge.verdicts.counts, 'geometry_refused': refused,
                              'cycles_discarded': self._counter.discarded})

    @property
    def rejected(self) -> list[tuple[float, str]]:
        """
        Return the latest pulses that were not taken as they came, and the missing ones.

        Each has its time in s, with the path delay, and the reason: the name of a count, or
        'missing'. There are 2000 at most.
        """
        return [(time + self._path_delay, why) for time, why in self._judge.verdicts.rejected]

    @property
    def hides_missing(self) -> bool:
        """Whether the speed scatters so much that strays and missing pulses do not show."""
        return self._judge.hides_missing

    @property
    def corrects_marks(self) -> bool:
        """Whether the geometry of the target is taken from the pulses, as far as it is known."""
        return self._corrector is not None

    @property
    def geometry(self) -> MarkOffsets | None:
        """Return what is taken from the pulses of each mark, None for nothing."""
        return None if self._corrector is None else self._corrector.geometry

    @property
    def teeth(self) -> npt.NDArray[np.int64]:
        """Return the numbers of the teeth that are there (mark,), as far as they are known."""
        return np.empty(0, np.int64) if self._corrector is None else self._corrector.teeth

    def finish(self) -> PulseCounts:
        """Return the counts at the end of the stream: pulses that still wait are unlocked."""
        waiting = len(self._held) + self._judge.waiting
        return replace(self.counts, unlocked=self.counts.unlocked + waiting)

    def update(self, times: npt.ArrayLike) -> TriggerPulses:
        """
        Take the next pulse times (n,) in s, in order of arrival, and return new trigger pulses.

        Pulses that are not finite are dropped and counted.

        :raises SignalError: not a one-dimensional array of real numbers.
        """
        given = np.asarray(times)
        if given.ndim != 1 or given.dtype.kind not in 'fiu':
            raise SignalError(f'pulse times have type {given.dtype} and shape {given.shape}: '
                              'give real numbers, (n,)')
        pulses = given.astype(np.float64)
        finite = np.isfinite(pulses)
        self._judge.verdicts.counts['non_finite'] += int(np.count_nonzero(~finite))
        pulses = pulses[finite] - self._path_delay
        while pulses.size:
            piece, ahead = pulses[:1 if self._held else _PIECE].tolist(), 0
            if not self._held:
                every = [self._judge.last, *piece]  # up to the first that runs back
                ahead = next((k for k, time in enumerate(piece) if time < every[k]), len(piece))
                self._judge.take(piece[:ahead])
            if ahead < len(piece):
                self._take(piece[ahead])
                ahead += 1
            pulses = pulses[ahead:]
        return self._sink.take()

    def take_messages(self) -> list[str]:
        """Return what pulses cannot do and did, a sentence each, and forget it."""
        verdicts = self._judge.verdicts
        found, verdicts.messages = verdicts.messages, []
        return found

    def flush(self) -> TriggerPulses:
        """Return the trigger pulses that were not certain, because no pulse follows."""
        self._judge.flush()
        return self._sink.flush()

    def _take(self, pulse: float) -> None:
        judge, counts = self._judge, self._judge.verdicts.counts
        back = pulse < judge.last - self._time_tolerance
        if back and pulse > judge.confirmed:
            counts['out_of_order'] += judge.drop_later(pulse, _RESTART - 1)
            back = pulse < judge.last - self._time_tolerance
        if back or (self._held and self._continues_held(pulse)):
            self._hold(pulse)
            return
        counts['out_of_order'] += len(self._held) + (pulse < judge.last)
        self._held = []
        if pulse >= judge.last:
            judge.take([pulse])

    def _continues_held(self, pulse: float) -> bool:
        """Whether a pulse continues the waiting pulses rather than the sequence before."""
        return pulse <= self._judge.last or (
            not self._judge.fits(pulse - self._judge.last)
            and self._judge.fits(pulse - self._held[-1]))

    def _hold(self, pulse: float) -> None:
        """Let a pulse wait after time ran back, or begin a new run with the waiting pulses."""
        if self._held and pulse <= self._held[-1]:
            self._judge.verdicts.counts['out_of_order'] += len(self._held)
            self._held = []
        self._held.append(pulse)
        if len(self._held) == _RESTART or pulse > self._judge.last:
            self._judge.verdicts.counts['restarts'] += 1
            self._judge.flush()
            self._judge.forget()
            self._sink.restart()
            held, self._held = self._held, []
            self._judge.take(held)


def _given_angles(mode: str, angles: Sequence[float], marks: int, teeth: int
                  ) -> npt.NDArray[np.float64]:
    """Return the angles (mark,) in rad that are given, if any; raise ParameterError."""
    if mode not in GEOMETRY_MODES:
        raise ParameterError(f'target_geometry {mode!r}: use one of {", ".join(GEOMETRY_MODES)}')
    if mode != 'given':
        return np.empty(0)
    if len(angles) != marks:
        raise ParameterError(f'target_angles has {len(angles)} angles for a target of {marks} '
                             f'marks: give one for each, in rad')
    pitch = 2.0 * math.pi / teeth
    for mark, angle in enumerate(angles):
        step = pitch + angle - angles[mark - 1]
        if not 0.0 < step < 2.0 * math.pi:  # also for NaN
            raise ParameterError(f'target_angles: mark {mark}, {angle} rad late, is not behind '
                                 f'the mark before, {angles[mark - 1]} rad late and '
                                 f'{pitch:.4g} rad away: give the angles in order, in rad')
    return np.array(angles, np.float64)
