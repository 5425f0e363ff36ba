# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Whether pulses, vibration and declaration can belong together: a sentence for each doubt."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray, IntArray
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.keyphasor_check.jitter import measure_jitter
from sa_jitter_ros.keyphasor_check.lines import find_lines
from sa_jitter_ros.keyphasor_check.teeth import FEWEST
from sa_jitter_ros.parameters import listed
from sa_jitter_ros.pulses.trigger_counter import TriggerPulses
from sa_jitter_ros.pulses.unit_check import likely_mistake, other_span
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.recordings.recording import Recording
from scipy import special

_FIRST_SECONDS = 20.0
_MOST_VALUES = 4_000_000
_MOST_PULSES = 4000
_LONGEST_GAP = 10.0  # trigger cycles without a pulse
# Probability that so many orders stand by chance, above which nothing is said for them; other
# numbers of marks, in parts of the stated one, and by how much the logarithms of the peaks are
# larger with them on average; by how much where all of the orders stand with the stated one, too.
_BY_CHANCE = 0.05
_OTHER_MARKS = (Fraction(1, 2), 2, Fraction(1, 3), 3, Fraction(1, 4), 4, Fraction(1, 8), 8)
_LARGER, _FAR_LARGER = 0.7, 2.0
# A family of harmonics beside the stated one: orders that may be those of a mesh, and by how much
# the logarithm of each of their peaks is larger.
_LEAST_MESH, _BESIDE = 8, 1.6
_MOST_VALIDATED = 100_000
_UNUSED = 0.25  # of the time, and of the pulses, without a trigger cycle
_MOST_STRAYS = 0.05
_OTHER_SIZE, _SURE = 3.0, 4.0  # times as large; standard errors


def doubts(recording: Recording, pulses: FloatArray | None, *, orders: Sequence[float] = (),
           ratio: float = 1.0, jitter_std: float | None = None, **target: Any
           ) -> tuple[str, ...]:
    """
    Return what contradicts each other in a recording and its declaration, a sentence each.

    `pulses` (n,) are its pulse times in s, None if it has none; `orders` are those in which the
    user is interested, `jitter_std` in s is the declared one; `target` are options of
    `PulseValidator`.

    >>> from sa_jitter_ros.recordings.recording import ArraySource
    >>> time = np.arange(20_000) / 2e3
    >>> noise = np.random.default_rng(1).normal(size=time.size)
    >>> rig = Recording(ArraySource((np.cos(400.0 * time) + noise)[None]), 2e3)
    >>> for doubt in doubts(rig, np.arange(50) / 20.0, orders=(19.0,)):
    ...     print(doubt)  # doctest: +ELLIPSIS
    the pulses span 2.45 s, the vibration spans 10 s: ...
    none of the orders 19 stands above its noise at 20 Hz and ratio 1: ...
    """
    if pulses is None or pulses.size < FEWEST or recording.samples < 2:
        return ()
    start, end = recording.start_time, recording.start_time + recording.duration
    mistake = likely_mistake(pulses, start, end, recording.sample_rate)
    if mistake:
        return (mistake,)
    found = [*filter(None, [other_span(pulses, start, end)])]
    validated = _validated(pulses, target)
    unfit = _unfit(pulses, target.get('missing_teeth', 0), *validated) if validated else []
    found += unfit
    if orders and not unfit:  # which has one cause with it
        found += weak_orders(recording, pulses, orders, ratio=ratio, **target)
    if jitter_std:
        found += _other_jitter(pulses, jitter_std, target)
    return tuple(found)


def _validated(pulses: FloatArray, target: Mapping[str, Any]
               ) -> tuple[PulseValidator, TriggerPulses] | None:
    """Return the trigger pulses of pulses (n,) in s, and what found them; None if it cannot."""
    try:
        validator = PulseValidator(**{
            **target, 'pulses_per_trigger': target.get('pulses_per_trigger') or None})
    except SaJitterError:
        return None
    pulses = pulses[:_MOST_VALIDATED]
    return validator, TriggerPulses.joined([validator.update(pulses), validator.flush()])


def _unfit(pulses: FloatArray, missing_teeth: int, validator: PulseValidator,
           triggers: TriggerPulses) -> list[str]:
    """Return what pulses (n,) in s do not have in common with their target."""
    pulses = pulses[:_MOST_VALIDATED]
    messages, counts = validator.take_messages(), validator.finish()
    strays = counts.doubles + counts.early + counts.unlocked
    begins = np.flatnonzero(~triggers.starts_run[1:])
    ends = triggers.times[np.append(begins + 1, -1)[:begins.size]]
    used = np.concatenate(([pulses[0]], ends)), np.append(triggers.times[begins], pulses[-1])
    longest = int(np.argmax(used[1] - used[0]))
    start, end = float(used[0][longest]), float(used[1][longest])
    inside = int(np.count_nonzero((pulses >= start) & (pulses <= end)))
    if end - start > _UNUSED * np.ptp(pulses) and inside > _UNUSED * pulses.size:
        of = f'{validator.pulses_per_revolution} marks a revolution'
        if missing_teeth:
            of += f', {missing_teeth} of them missing'
        return [f'the {inside} pulses from {start:.6g} s to {end:.6g} s give no trigger cycle: '
                f'they are not those of a target with {of}; does the target, or the signal, '
                'change there? Check pulses_per_revolution and missing_teeth (check_keyphasor '
                'finds them)']
    if messages:
        return messages[:1]
    if strays > _MOST_STRAYS * pulses.size:
        return [f'{strays} of {pulses.size} pulses are strays: is there a second keyphasor of '
                'the same name, a second mark (pulses_per_revolution), or too little hysteresis?']
    return []


def weak_orders(recording: Recording, pulses: FloatArray, orders: Sequence[float], *,
                ratio: float, **target: Any) -> tuple[str, ...]:
    """
    Return a sentence if the vibration shows other orders than these, nothing else.

    So it does if no more of them stand above their noise than by chance, if they do with another
    number of marks, or if they are the harmonics of a mesh beside those of a far larger one.

    An order stands where the spectrum over the angle has a peak; what leaks from its neighbours
    is none. So many peaks as there are anywhere in the spectrum are there by chance. `pulses`
    (n,) in s are those of a `target` with `pulses_per_revolution`, `pulses_per_trigger` and
    `missing_teeth`.
    """
    found = _validated(pulses, target)
    if found is None:
        return ()
    validator, triggers = found
    times, numbers = _longest(triggers)
    share = validator.pulses_per_trigger / validator.pulses_per_revolution
    count = round(min(_FIRST_SECONDS * recording.sample_rate, recording.samples,
                      _MOST_VALUES / recording.channels))
    samples = next(recording.blocks(max(count, 1)))
    lines = find_lines(
        np.nan_to_num(samples.T, posinf=0.0, neginf=0.0), recording.start_time,
        recording.sample_rate, times, np.asarray(numbers * share, np.float64), weak=True)
    if lines is None:
        return ()
    places = ratio * np.asarray(orders)
    sizes = lines.logarithms(places)
    stand = sizes > 0.0
    chance = lines.share(0.8 * float(places.min()), 1.2 * float(places.max()))
    count, names = int(np.count_nonzero(stand)), listed(orders, 6)
    speed = share * (times.size - 1) / float(np.sum(np.diff(times) / np.diff(numbers)))
    by_chance = float(special.betainc(count, stand.size - count + 1, chance)) if count else 1.0
    if count < stand.size and by_chance > _BY_CHANCE:
        beyond = ' more often than by chance' if count else ''
        return (f'none of the orders {names} stands above its noise{beyond} at {speed:.4g} Hz '
                f'and ratio {ratio:.6g}: check ratio, pulses_per_revolution and sample_rate '
                '(check_keyphasor finds them), and that one clock times pulses and vibration',)
    marks, larger = validator.pulses_per_revolution, _LARGER if count < stand.size else _FAR_LARGER
    for other in _OTHER_MARKS:
        fitting = round(other * marks)
        if fitting != other * marks:
            continue
        others = lines.logarithms(places / float(other))
        if others.min() > 0.0 and others.sum() > sizes.sum() + larger * sizes.size:
            better = 'all of them do' if count < stand.size else 'they are far larger'
            return (f'{count} of the orders {names} stand above their noise at {speed:.4g} Hz '
                    f'and ratio {ratio:.6g}: with pulses_per_revolution {fitting} instead of '
                    f'{marks} {better} (check_keyphasor finds out)',)
    base = round(min(orders))
    multiple = np.asarray(orders) / base
    if len(orders) < 2 or base < _LEAST_MESH or not np.allclose(multiple, np.rint(multiple)):
        return ()
    for miscounted in (base - 1, base + 1, base - 2, base + 2):
        others = lines.logarithms(places * (miscounted / base))
        if np.all(others - sizes > _BESIDE):
            larger_ones = listed([order * miscounted / base for order in orders], 6)
            return (f'the orders {names} hold no line beside {larger_ones}, each at least '
                    f'{np.exp(_BESIDE):.0f} times as large: are those meant? Count the teeth',)
    return ()


def _other_jitter(pulses: FloatArray, declared: float, target: Mapping[str, Any]) -> list[str]:
    """Return whether the pulses scatter by much more, or much less, than is declared."""
    geometry = 'given' if target.get('target_geometry') == 'given' else 'learn'
    validated = _validated(pulses[:_MOST_PULSES], {
        **target, 'pulses_per_trigger': 1, 'target_geometry': geometry})
    if validated is None or validated[0].hides_missing:
        return []
    times, numbers = _longest(validated[1])
    found = measure_jitter(times, numbers)
    if found is None or math.isnan(found.correlation):
        return []
    factor = found.std / declared
    if 1.0 / _OTHER_SIZE < factor < _OTHER_SIZE or (
            abs(found.std - declared) < _SURE * found.std_error):
        return []
    return [f'the pulses scatter by {1e6 * found.std:.3g} us, but {1e6 * declared:.3g} us are '
            'declared: check keyphasor_rate and jitter_std']


def _longest(triggers: TriggerPulses) -> tuple[FloatArray, IntArray]:
    """Return times in s and numbers (n,) of the longest part without a gap in the angle."""
    if not triggers.times.size:
        return triggers.times, triggers.count
    gaps = np.diff(triggers.times, prepend=triggers.times[:1])
    # Between these parts the angle is not known, or the shaft stands still.
    parts = np.cumsum((np.diff(triggers.count, prepend=-1) <= 0) | (
        gaps > _LONGEST_GAP * np.median(gaps)))
    chosen = (parts == np.argmax(np.bincount(parts))) & triggers.measured
    return triggers.times[chosen], triggers.count[chosen]
