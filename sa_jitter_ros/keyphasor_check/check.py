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
What a keyphasor is and what is wrong with it, found in a recording: `check_keyphasor`.

Each finding has a value with its standard error, or other values with their probabilities, and
says what decided it or would. Each warning says what it costs at each order, and what to do.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
import math

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.effects.lattice import Clock
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.keyphasor_check.clock import find_clock, is_decimal, ROUNDING
from sa_jitter_ros.keyphasor_check.costs import by_marks, costs, NO_ORDERS
from sa_jitter_ros.keyphasor_check.declared_parts import contradictions, meshes_seen, orders_seen
from sa_jitter_ros.keyphasor_check.jitter import Jitter, measure_jitter
from sa_jitter_ros.keyphasor_check.lines import (
    find_lines, is_usual, marks_evidence, on_orders, ratio_evidence, speed_ripples, ToothLines,
    usual_marks)
from sa_jitter_ros.keyphasor_check.marks import fit_pulses, FittedPulses, number_and_patterns
from sa_jitter_ros.keyphasor_check.result import Checked, KeyphasorCheck, Warn
from sa_jitter_ros.keyphasor_check.teeth import FEWEST, NumberedPulses
from sa_jitter_ros.keyphasor_check.vibration import (
    averages_of, is_steady, path_delay, recovered_jitter, UNCHANGED)
from sa_jitter_ros.keyphasor_check.wheel import Marking
from sa_jitter_ros.machine import Machine, UNKNOWN
from sa_jitter_ros.pulses.detection import KeyphasorDetector, spikes_text
from sa_jitter_ros.pulses.pulse_judge import HIDDEN
from sa_jitter_ros.pulses.unit_check import find_mistakes, other_span, rate_factor
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.recordings.channel_check import bad_channels
from sa_jitter_ros.recordings.recording import Recording
from scipy import special

_MOST_MARKS, _MOST_ENCODER = 72, 4096  # of any number, and of usual ones
_SYMMETRY = 1.5  # log probability that a pattern repeats in a revolution
_DECLARED = math.log(300.0)  # what the statement of a recording says for a number of marks
_LISTED = 0.01  # probability of an alternative that is listed
_SURE = 0.9
_MOST_ORDERS = 12
_COSTS = 4  # stated orders of which a cost is given
_MOST_SAMPLES = 12_000_000
# Lines at whole orders of the tach shaft, beside those there by chance, with which it is the shaft
# of interest; and the probability that another one is, all the same.
_FEWEST_OWN, _ANOTHER = 3, 0.25
_APART = 4.0  # standard errors
_FEWEST_SAMPLES = 16
# Share of strays and lost pulses, and mean distance of the others from their marks (teeth): pulses
# at random have 0.58 to 0.8 and 0.07 to 0.13; a quarter lost and as many strays 0.6 and 0.056.
_AT_RANDOM, _OFF_PLACE = 0.4, 0.065


def check_keyphasor(recording: Recording, *, teeth: Sequence[int] = (),
                    machine: Machine = UNKNOWN,
                    progress: Callable[[str], None] | None = None) -> KeyphasorCheck:
    """
    Examine the keyphasor of a recording of which hardly anything is declared.

    `teeth` are numbers of teeth of gears in the machine, which help to find `ratio`; those of a
    `machine` do, too, and a warning says which of them the vibration contradicts. `progress` is
    called with a line of text for every step. Raises SignalError for a keyphasor without pulses
    that could be examined, RecordingError for a recording without a keyphasor.

    A wheel of eight teeth, of which one is missing, on a shaft at 20 Hz; one pulse is lost:

    >>> from sa_jitter_ros.recordings.recording import ArraySource
    >>> place = np.arange(800)
    >>> rng = np.random.default_rng(1)
    >>> times = 0.1 + place / 160.0 + rng.normal(0.0, 2e-6, 800)
    >>> check = check_keyphasor(Recording(
    ...     ArraySource(np.zeros((1, 51_000))), 10e3,
    ...     pulse_times=times[(place % 8 != 5) & (place != 300)]))
    >>> check.findings['pulses_per_revolution'].value, check.findings['missing_teeth'].value
    (8, 1)
    >>> check.findings['missing'].value['count'], check.findings['jitter_std'].unit
    (1, 's')
    """
    teeth = teeth or sorted({count for pair in machine.gears.values()
                             for count in (pair.teeth, pair.mate_teeth)})
    return _Check(recording, teeth, machine, progress or (lambda text: None)).run()


class _Check:
    """The steps of a check, which share what was found."""

    def __init__(self, recording: Recording, teeth: Sequence[int], machine: Machine,
                 progress: Callable[[str], None]) -> None:
        self._machine = machine
        self._recording, self._teeth, self._progress = recording, teeth, progress
        self._rate, self._start = recording.sample_rate, recording.start_time
        self._warnings: list[Warn] = []
        self._from_waveform = recording.pulse_times is None and recording.tach is not None
        self._other_rate = 0.0  # with which the vibration is as long as the pulses

    def run(self) -> KeyphasorCheck:
        """Return what was found."""
        times = self._pulses()
        self._progress(f'{times.size} pulses from {times[0]:.6g} s to {times[-1]:.6g} s')
        self._progress('looking for the pattern of the target')
        numbered, found = number_and_patterns(times)
        clock = find_clock(numbered.times, largest=self._largest)
        tick = 1.0 / clock.rate if clock.rate else 0.0
        fit = cache(partial(fit_pulses, numbered, tick=tick))
        samples = self._samples()
        lines = None
        if samples is not None:
            self._progress('looking for lines of the vibration over the angle')
            base = fit(found[0].teeth if found else 1)
            once = base.once_a_revolution()
            turned = base.true[once], base.numbers[once].astype(np.float64)
            lines = find_lines(samples.T, self._start, self._rate, *turned)
        marks, decided = self._marks(numbered, found, lines)
        if samples is not None and self._other_rate:
            marks = self._at_both_rates(marks, numbered, found, lines, find_lines(
                samples.T, self._start, self._other_rate, *turned))
        count = int(marks.value)
        fitted = fit(count)
        even = samples is not None and speed_ripples(samples, self._start, self._rate, fitted)
        if even and samples is not None:
            fitted = fitted.with_even_marks()
            lines = find_lines(samples.T, self._start, self._rate, fitted.true,
                               fitted.numbers.astype(np.float64))
        fitted, hidden = _without_hidden(fitted, times, count)
        _require_wheel(fitted, numbered)
        per_revolution = None if lines is None else lines.scaled(float(count))
        ratio, orders = self._ratio(per_revolution)
        self._progress('measuring the jitter')
        averages = {} if samples is None or not orders.value else self._averaged(
            samples, times, fitted, ratio, orders.value, clock)
        findings = {
            'pulses_per_revolution': marks,
            'missing_teeth': Checked(
                count - fitted.pattern.present,
                decided_by='teeth without a pulse in every revolution' if decided else ''),
            'marks': self._target(fitted, decided, even),
            'clock_rate': self._clock(clock, times),
            **self._jitter(fitted, averages.get(True, ()), hidden),
            'missing': _counted(fitted.lost, hidden or 'marks without a pulse'),
            'spurious': _counted(fitted.spurious, hidden or 'pulses that stand beside every mark'),
            'speed': self._speed(fitted),
            'ratio': ratio, 'orders': orders,
            'path_delay': UNCHANGED if averages and False not in averages else path_delay(
                averages.get(False, ()), float(ratio.value or 1.0))}
        concerned = orders.value or NO_ORDERS
        from_marks = by_marks(fitted, float(ratio.value or 1.0), concerned)
        warnings = (*self._warnings, *contradictions(per_revolution, self._machine),
                    *costs(findings, fitted, times, concerned, from_marks))
        return KeyphasorCheck(findings, warnings, fitted, per_revolution, self._rate,
                              self._from_waveform, from_marks is not None)

    def _warn(self, code: str, text: str, *, spoils: bool = False) -> None:
        """Add a warning, which `spoils` all stated orders."""
        self._warnings.append(Warn(code, text, tuple(
            (g, 100.0) for g in self._recording.orders[:_COSTS] if spoils)))

    # --- what is there ---

    def _pulses(self) -> FloatArray:
        """Return the pulse times in s on the clock of the vibration."""
        self._check_tach_rate()
        recording = self._recording
        detector = KeyphasorDetector()
        times = recording.keyphasor_pulses(detector=detector)
        if spikes := spikes_text(detector.state.spikes):
            self._warn('spikes', spikes)
        # s, pulse time as recorded: the larger, the coarser its digits
        self._largest = float(np.max(np.abs(times), initial=0.0))
        whose = f'{times.size} pulses in {recording.duration:.4g} s'
        if times.size < FEWEST:
            raise SignalError(f'{whose}: at least {FEWEST} are needed to examine a keyphasor; '
                              'record longer, or check that the tach crosses its threshold')
        if not np.ptp(times) > 0.0:
            raise SignalError(f'all {times.size} pulses are at {times[0]:.9g} s: give their times')
        if recording.samples > 1:
            for _ in range(2):
                end = self._start + recording.samples / self._rate
                mistakes = find_mistakes(times, self._start, end, self._rate)
                if not mistakes:
                    break
                likely = mistakes[0]
                others = ''.join(f'; or {item.code[5:]} ({item.probability:.0%})'
                                 for item in mistakes[1:] if item.probability > _LISTED)
                self._warn(likely.code, likely.text + others, spoils=True)
                times = (times - likely.shift) * likely.scale
                self._rate *= likely.rate_scale
                self._largest *= likely.scale
                if likely.code in ('span', 'backwards'):
                    break
            self._span(times)
        return times

    def _check_tach_rate(self) -> None:
        """Take a tach rate for kHz if the waveform then is as long as the vibration."""
        text = self._recording.tach_in_khz
        if self._from_waveform and text and self._recording.tach_rate:
            self._warn('unit_khz', text)
            self._recording = replace(
                self._recording, tach_rate=1e3 * self._recording.tach_rate)

    def _span(self, times: FloatArray) -> None:
        end = self._start + self._recording.samples / self._rate
        text = other_span(times, self._start, end)
        if text and not {'span', 'no_overlap'} & {item.code for item in self._warnings}:
            self._warn('span', text)
            factor = rate_factor(times, self._start, end)
            self._other_rate = factor * self._rate if factor != 1.0 else 0.0

    def _samples(self) -> FloatArray | None:
        """Return the good channels of the vibration (channel, sample); None without any."""
        recording = self._recording
        if recording.samples < _FEWEST_SAMPLES:
            return None
        samples = next(recording.blocks(_MOST_SAMPLES // recording.channels))
        bad = bad_channels(samples)
        for channel, reason in bad.items():
            self._warn(
                'bad_channel', f'channel {recording.channel_names[channel]} {reason}: it is left '
                'out; check its sensor, cable and range')
        good = [channel for channel in range(len(samples)) if channel not in bad]
        return np.nan_to_num(samples[good], nan=0.0, posinf=0.0, neginf=0.0) if good else None

    # --- marks ---

    def _marks(self, numbered: NumberedPulses, found: Sequence[Marking], lines: ToothLines | None
               ) -> tuple[Checked, bool]:
        """Return the marks of a revolution, and whether the pulses themselves show them."""
        declared = self._recording.pulses_per_revolution
        probability, vibration = self._probabilities(numbered, found, lines)
        best = max(probability, key=lambda count: probability[count])
        shown = any(best % item.teeth == 0 for item in found)
        if shown:
            by = 'the pattern of the pulses repeats with the revolution'
        elif declared == best and declared > 1:
            by = 'stated by the recording, which pulses and vibration do not contradict'
        elif vibration[best] > 2.0:
            by = ('lines of the vibration are multiples of the shaft speed, known meshes, or '
                  'stated orders')
        else:
            by = ('even marks look all alike: count the marks on the shaft, or measure its speed '
                  'once with a strobe')
        others = tuple((count, round(value, 4)) for count, value in sorted(
            probability.items(), key=lambda item: -item[1]) if count != best and value > _LISTED)
        if probability[best] < _SURE:
            listed = ', '.join(f'{count} ({value:.0%})' for count, value in (
                (best, probability[best]), *others[:4]))
            self._warn(
                'marks_ambiguous', f'several numbers of marks a revolution fit: {listed}; count '
                'the marks on the shaft, or measure its speed with a strobe, and give '
                'pulses_per_revolution')
        if declared > 1 and declared != best:
            self._warn(
                'marks_contradict', f'the recording states {declared} marks a revolution, but the '
                f'pulses show {best}: check pulses_per_revolution', spoils=True)
        return Checked(best, None, '1', others, by), shown

    def _probabilities(self, numbered: NumberedPulses, found: Sequence[Marking],
                       lines: ToothLines | None) -> tuple[dict[int, float], dict[int, float]]:
        """Return the probability of each number of marks, and what the vibration says for it."""
        declared = self._recording.pulses_per_revolution
        span = int(numbered.numbers[-1] - numbered.numbers[0])
        counts = sorted({declared, *(item.teeth for item in found),
                         *filter(is_usual, range(1, _MOST_ENCODER + 1)),
                         *range(1, _MOST_MARKS + 1)})
        counts = [count for count in counts if count <= max(span // 2, 1) or count == declared]
        vibration = marks_evidence(lines, counts)
        seen = {count: 0 if lines is None else meshes_seen(
            lines.scaled(float(count)), self._machine) for count in counts}
        for count in counts:
            vibration[count] += _DECLARED * seen[count] / max(1, *seen.values())
        if lines is not None and self._recording.orders:
            vibration[declared] += _DECLARED * orders_seen(
                lines.scaled(float(declared)), self._recording.ratio, self._recording.orders)
        log = {}
        # Half orders are those of an engine: the gaps of its wheel do not repeat in a revolution.
        for count in counts:
            pattern = max((item.evidence - (0.0 if count == item.teeth else _SYMMETRY + math.log(
                count / item.teeth)) for item in found if count % item.teeth == 0 and (
                    not item.missing.any() or count in (item.teeth, declared))), default=0.0)
            log[count] = usual_marks(count) + vibration[count] + pattern
        if declared > 1:
            log[declared] += _DECLARED
        return dict(zip(log, special.softmax([*log.values()]).tolist())), vibration

    def _at_both_rates(self, marks: Checked, numbered: NumberedPulses, found: Sequence[Marking],
                       lines: ToothLines | None, others: ToothLines | None) -> Checked:
        """Return the marks, and say what they are at the other sampling rate."""
        probability, _ = self._probabilities(numbered, found, others)
        other = max(probability, key=lambda count: probability[count])
        answers = ' or '.join(
            f'{count} mark{"s" * (count > 1)} a revolution at sample_rate {rate:.10g} Hz '
            f'({0 if seen is None else seen.places.size} lines of the vibration)'
            for count, rate, seen in ((int(marks.value), self._rate, lines),
                                      (other, self._other_rate, others)))
        decides = ('time the length of the recording with a watch, or measure the speed of the '
                   'shaft once with a strobe')
        self._warn(
            'rate_ambiguous', f'the vibration is as long as the pulses with sample_rate='
            f'{self._other_rate:.10g}, so that the answer may be {answers}: {decides}',
            spoils=True)
        return replace(marks, decided_by=f'{marks.decided_by}; the sampling rate may be '
                       f'{self._other_rate:.10g} Hz: {decides}')

    def _target(self, fitted: FittedPulses, shown: bool, even: bool) -> Checked:
        pattern = fitted.pattern
        scale = 2.0 * math.pi / pattern.teeth
        errors = np.nan_to_num(pattern.errors * scale, nan=0.0)
        by = ('mean place of each mark over the revolutions, late positive; a ripple of the speed '
              'with the revolution looks the same' if shown else '')
        if even:
            by = ('the lines of the vibration are sharper between even marks: the speed changes '
                  'with the revolution')
        return Checked((pattern.marks * scale).tolist(),
                       errors.tolist() if pattern.teeth > 1 else None, 'rad', (), by)

    # --- clock and jitter ---

    def _clock(self, clock: Clock, times: FloatArray) -> Checked:
        recording = self._recording
        if self._from_waveform:
            return Checked(recording.tach_rate, None, 'Hz', (), 'sampling rate of the tach '
                           'waveform, between whose samples pulses are interpolated')
        if not clock.rate:
            stated = recording.tach_rate
            return Checked(stated, None, 'Hz', (), 'stated by the recording' if stated else
                           'no grid in the pulse times: they are not rounded to a clock')
        by = ', which may be their last written decimal' if is_decimal(clock.rate) else ''
        return Checked(clock.rate, clock.standard_error, 'Hz', (),
                       f'all pulse times are multiples of its period{by}')

    def _averaged(self, samples: FloatArray, times: FloatArray, fitted: FittedPulses,
                  ratio: Checked, orders: Sequence[float], clock: Clock
                  ) -> dict[bool, tuple[Average, ...]]:
        """
        Return averages with corrected jitter (True), and short ones at their speed (False).

        The latter tell a delay, which a steady speed does not.
        """
        measured = self._jitter_of(fitted)
        size = measured.std if measured else fitted.scatter
        expected = max(math.sqrt(12.0) * size, 1.0 / clock.rate if clock.rate else 0.0)
        turns = fitted.turns
        kept = times[~np.isin(times, fitted.strays)]
        cycles = {True: int(np.clip(turns // 8, 4, 40)), False: int(np.clip(turns // 24, 1, 20))}
        teeth = fitted.pattern.teeth
        found: dict[bool, tuple[Average, ...]] = {}
        for correct, count in cycles.items():
            if correct or not (found[True] and is_steady(fitted.speed)):
                found[correct] = averages_of(
                    samples, self._rate, kept, start_time=self._start,
                    ratio=float(ratio.value or 1.0), orders=orders, pulses_per_revolution=teeth,
                    missing_teeth=teeth - fitted.pattern.present, trigger_cycles=count,
                    keyphasor_rate=1.0 / expected, correct_jitter=correct)
        return found

    def _jitter_of(self, fitted: FittedPulses) -> Jitter | None:
        """Return the jitter that the pulses show beyond the rounding of their times."""
        found = measure_jitter(fitted.true, fitted.numbers)
        rounding = ROUNDING * np.spacing(self._largest)
        return None if found is None or found.std <= rounding else found

    def _jitter(self, fitted: FittedPulses, averages: Sequence[Average], hidden: str
                ) -> dict[str, Checked]:
        alone = None if hidden else self._jitter_of(fitted)
        recovered = recovered_jitter(averages)
        if alone is None and recovered is None:
            by = (f'the motion makes all of the scatter, {1e6 * fitted.scatter:.2g} us: a '
                  'vibration with strong orders decides')
            return {'jitter_std': Checked(None, None, 's', (), by),
                    'jitter_correlation': Checked(None, None, '1', (), by)}
        best, by = alone, 'scatter of the pulses beside their neighbours'
        if recovered is not None:
            apart = 0.0 if alone is None else (recovered.std - alone.std) / math.hypot(
                recovered.std_error, alone.std_error)
            if alone is None or abs(apart) > _APART or recovered.std_error < alone.std_error:
                best, by = recovered, 'pulse errors recovered from the vibration'
            if alone is not None and apart > _APART:
                by += (f'; the pulses alone show {1e6 * alone.std:.3g} us, so that the rest is '
                       'slow, or the vibration wanders against the tach shaft')
        assert best is not None
        return {'jitter_std': Checked(best.std, best.std_error, 's', (), by),
                'jitter_correlation': Checked(
                    None, None, '1', (), 'motion hides it: vibration with strong orders decides')
                if math.isnan(best.correlation) else Checked(
                    best.correlation, best.correlation_error, '1', (), by)}

    # --- speed and orders ---

    def _speed(self, fitted: FittedPulses) -> Checked:
        speed = fitted.speed
        return Checked({'minimum': float(speed.min()), 'mean': fitted.mean_speed,
                        'maximum': float(speed.max())}, None, 'Hz', (), 'times of revolutions')

    def _ratio(self, lines: ToothLines | None) -> tuple[Checked, Checked]:
        stated = self._recording.ratio
        if lines is None or not lines.places.size:
            silent = self._recording.samples < _FEWEST_SAMPLES
            reason = ('no vibration' if silent else
                      'no line of the vibration stands above the noise')
            if not silent:
                self._warn(
                    'no_orders', 'no order of the tach shaft stands above the noise of the '
                    'vibration: check that tach and vibration are of the same machine and time, '
                    'and sample_rate')
            return (Checked(stated if stated != 1.0 else None, None, '1', (), 'stated' if stated
                            != 1.0 else reason), Checked(None, None, '1', (), reason))
        if stated != 1.0:
            best, probability, others = stated, 1.0, []
            by = 'stated by the recording'
        else:
            (best, probability), *others = self._ranked(lines)
            by = ('lines of the vibration are whole orders of the tach shaft; numbers of teeth '
                  '(--teeth) decide for another shaft' if best == 1.0 else
                  'lines of the vibration, and their sidebands, are multiples of this speed; the '
                  'numbers of teeth (--teeth) decide')
        orders, near = on_orders(lines, best)
        strength = lines.sizes * lines.levels
        chosen = np.flatnonzero(near)
        chosen = chosen[np.argsort(-strength[chosen])][:_MOST_ORDERS]
        listed = sorted({float(orders[k]) for k in chosen})
        if not listed:
            self._warn(
                'no_orders', f'no order of a shaft at ratio {best:.6g} stands above the noise: '
                'check ratio, pulses_per_revolution and sample_rate')
            if stated == 1.0:
                reason = ('no line of the vibration is a whole order of the tach shaft; give the '
                          'numbers of teeth (--teeth) or the ratio of another shaft')
                return Checked(None, None, '1', (), reason), Checked(None, None, '1', (), reason)
        if probability < _SURE and best != 1.0:
            text = ', '.join(f'{value:.6g} ({chance:.0%})'
                             for value, chance in ((best, probability), *others[:4]))
            self._warn(
                'ratio_ambiguous', f'several ratios fit the lines of the vibration: {text}; give '
                'the numbers of teeth (--teeth) or the ratio')
        missing = [g for g in self._recording.orders if not np.any(
            near & (np.abs(orders - g) < 0.5))]
        if missing:
            self._warn(
                'orders_weak', 'stated orders that do not stand above the noise: '
                + ', '.join(f'{g:g}' for g in missing[:8]))
        return (Checked(best, lines.step * 0.1 if best != 1.0 and stated == 1.0 else None, '1',
                        tuple((ratio, round(value, 4)) for ratio, value in others
                              if value > _LISTED), by),
                Checked(listed or None, None, '1', (), 'lines of the vibration over the angle'))

    def _ranked(self, lines: ToothLines) -> list[tuple[float, float]]:
        """Return the ratios that fit, best first, each with its probability."""
        ranked = ratio_evidence(lines, self._teeth)
        _, own = on_orders(lines, 1.0)
        by_chance = 1.2 * lines.step * lines.places.size
        if self._teeth or ranked[0][0] == 1.0 or np.count_nonzero(own) < _FEWEST_OWN + by_chance:
            return ranked
        # Nobody named another shaft, and the tach shaft has orders of its own.
        others = [(ratio, value) for ratio, value in ranked if ratio != 1.0]
        total = sum(value for _, value in others)
        return [(1.0, 1.0 - _ANOTHER), *((ratio, _ANOTHER * value / total)
                                         for ratio, value in others)]


def _require_wheel(fitted: FittedPulses, numbered: NumberedPulses) -> None:
    """Raise SignalError for pulses that come at random."""
    true, strays, lost = fitted.true.size, fitted.strays.size, fitted.lost.size
    off = float(np.mean(np.abs(numbered.places)))
    if (strays + lost) > _AT_RANDOM * (true + strays + lost) and off > _OFF_PLACE:
        raise SignalError(
            f'the {true + strays} pulses belong to no steady wheel: where marks might be, {lost} '
            f'have no pulse, {strays} pulses stand beside them, and the others {off:.0%} of the '
            'distance of marks away, as pulses at random do; look at the waveform of the tach, '
            'its threshold, its cable and the distance of the sensor')


def _without_hidden(fitted: FittedPulses, times: FloatArray, count: int
                    ) -> tuple[FittedPulses, str]:
    """Take no speed for strays and lost pulses; the text says if it hides them, else ''."""
    validator = PulseValidator(pulses_per_revolution=count, pulses_per_trigger=1)
    validator.update(times)
    if not validator.hides_missing:
        return fitted, ''
    return replace(fitted, strays=times[:0], lost=times[:0]), HIDDEN


def _counted(times: FloatArray, by: str) -> Checked:
    return Checked({'count': int(times.size), 'times': times.tolist()}, None, '1', (), by)
