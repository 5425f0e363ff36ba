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
What `close_loop` must say of a recording, and whether it did.

`Expected` is what is known of a recording whose truth is known. `judge` compares a report with it.
A key of the report that is absent counts as empty.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
import math
from typing import Any

import numpy as np
from scipy import stats

Report = Mapping[str, Any]
Names = frozenset[str]

SURE = 3.0  # standard errors
_WORSE = 2.0  # standard errors of a held-out error, as much as it may grow
_SAME = 1e-3  # relative, of a number without a standard error
_CYCLES = 2.0  # trigger cycles, to which the time of a step in a clock is known
TICKS = 'ticks'  # in `changes`: whatever is said of the clock that timed the pulses
_OF_TICKS = 'clock', 'tick', 'quantisation'
#: Of one report, only one of these.
_CONTRADICTION = 'predictions then hold', 'do not rely on predictions'
#: How an answer may end, in the order of the table.
OUTCOMES = 'right', 'near', 'other', 'missed', 'unexplained', 'failed'


@dataclass(frozen=True)
class Expected:
    """
    What must come out of a recording.

    `effects` are the sets of names that are right, `optional` names that may be there beside them.
    `sizes` are true parameters (`effect.parameter`), which a named effect must have within its
    standard errors; `covered` those that the limit must cover where the effect is not named.
    `changes` must be in `declared_changes` (`name.parameter`, NaN for any value, or `TICKS`).
    `never` are words that must not be said and `said` those that must. `steps` of the clock are
    (time, size) in s, found within two trigger cycles of `cycle` s. `unsteady` are (order,
    channel) of lines that vary. With `untested` nothing can be compared: the RMS is undefined and
    `not_testable` says why. With `error` the recording is refused in these words.
    """

    verdicts: tuple[str, ...] = ('none',)
    effects: tuple[Names, ...] = (frozenset(),)
    optional: Names = frozenset()
    sizes: Mapping[str, Any] = field(default_factory=dict)
    covered: Mapping[str, float] = field(default_factory=dict)
    changes: Mapping[str, float] = field(default_factory=dict)
    never: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    steps: tuple[tuple[float, float], ...] = ()
    cycle: float = 0.0
    unsteady: tuple[tuple[float, str], ...] = ()
    against: str = ''
    untested: bool = False
    error: str = ''


@dataclass(frozen=True)
class Answer:
    """
    What the loop gave: a report with all that it says in words, or an error or a crash.

    `seconds` are those of the processor.
    """

    report: Report = field(default_factory=dict)
    text: str = ''
    error: str = ''
    crash: str = ''
    seconds: float = math.nan


@dataclass(frozen=True)
class Judgement:
    """Whether an answer is right, how it ended (one of `OUTCOMES`), and what is wrong with it."""

    right: bool
    outcome: str
    why: tuple[str, ...]
    sizes: Mapping[str, tuple[Any, Any, Any, float]]


def names_of(report: Report) -> list[str]:
    """Return the effects that a report names, in its order."""
    return [item['name'] for item in report.get('missing_effects') or ()]


def stated(report: Report, expected: Expected) -> list[tuple[float, bool]]:
    """Return each probability that a report states, and whether the effect is there."""
    declared = (report.get('declared') or {}).get('effects') or {}
    some = frozenset(chain.from_iterable(expected.effects))
    every = some.intersection(*expected.effects)
    unsure = expected.optional | (some - every) | frozenset(declared)
    return [(value, name in every) for name, value in (report.get('probabilities') or {}).items()
            if name not in unsure]


def judge(answer: Answer, expected: Expected) -> Judgement:
    """Compare an answer with what must come out."""
    if answer.crash:
        return Judgement(False, 'failed', (answer.crash.strip().rpartition('\n')[2],), {})
    if expected.error or answer.error:
        right = bool(expected.error) and expected.error in answer.error
        wrong = answer.error or f'accepted as {answer.report.get("verdict")}'
        return Judgement(right, 'right' if right else 'failed', () if right else (wrong,), {})
    report = answer.report
    named = _told_apart(report, expected) - expected.optional
    sizes = dict(_sizes(report, expected))
    verdict = list(_verdict(report, named, expected))
    why = (*verdict, *_numbers(report, expected, sizes), *_parts(report, expected),
           *_words(answer, expected), *_harm(report))
    outcome = _outcome(report, named, expected, bool(verdict)) if why else 'right'
    return Judgement(not why, outcome, why, sizes)


def _told_apart(report: Report, expected: Expected) -> Names:
    """Return the names of a report, a true one for each that is said to look the same."""
    found = set(names_of(report))
    every = frozenset(chain.from_iterable(expected.effects))
    for item in report.get('missing_effects') or ():
        rivals = sorted(set(item['indistinguishable_from']) & (every - found))
        if item['name'] not in every and rivals:
            found = (found - {item['name']}) | {rivals[0]}
    return frozenset(found)


def _verdict(report: Report, named: Names, expected: Expected) -> Iterator[str]:
    """Yield what is wrong with verdict and names; what is present changes nothing."""
    verdict, found = report['verdict'], names_of(report)
    present = {item['name'] for item in report.get('present') or ()}
    if not any(named <= want <= named | present for want in expected.effects):
        wanted = ' or '.join('+'.join(sorted(want)) or 'nothing' for want in expected.effects)
        yield f'named {"+".join(sorted(found)) or "nothing"}, not {wanted}'
    told = {'none', 'traced'} & set(expected.verdicts)
    if verdict not in expected.verdicts and not (
            told and verdict == ('traced' if found else 'none')):
        yield f'verdict {verdict}, not {" or ".join(expected.verdicts)}'
    if verdict == 'none' and found:
        yield f'verdict none, and {"+".join(found)} named'


def _outcome(report: Report, named: Names, expected: Expected, verdict: bool) -> str:
    every = frozenset(chain.from_iterable(expected.effects))
    if not verdict or named & every:
        return 'near'
    if named:
        return 'other'
    return 'unexplained' if report['verdict'] == 'unexplained' else 'missed'


# --- numbers -------------------------------------------------------------------------------------

def _sizes(report: Report, expected: Expected
           ) -> Iterator[tuple[str, tuple[Any, Any, Any, float]]]:
    """Yield value, standard error, truth and their distance in standard errors by parameter."""
    every = [*(report.get('missing_effects') or ()), *(report.get('present') or ())]
    for item in every:
        for name, stated in item['parameters'].items():
            key = f'{item["name"]}.{name}'
            truth = expected.sizes.get(key, expected.covered.get(key))
            if truth is not None:
                value, error = stated['value'], stated['standard_error']
                plain = np.asarray(truth).tolist()
                yield key, (value, error, plain, distance(value, error, plain))


def distance(value: Any, error: Any, truth: Any) -> float:
    """
    Return how many standard errors a value is off, infinity for another text or number of items.

    A list counts with its mean taken out, from whichever of its items it begins: that of normal
    errors which are together as unlikely as one that is so many standard errors off.
    """
    if isinstance(truth, str):
        return 0.0 if value == truth else math.inf
    values, truths = np.atleast_1d(np.array(value, float)), np.atleast_1d(np.array(truth, float))
    if values.shape != truths.shape:
        return math.inf
    if error is None:
        return 0.0 if np.allclose(values, truths, rtol=_SAME, atol=0.0) else math.inf
    errors = np.broadcast_to(np.array(error, float), values.shape)
    if np.ndim(truth) == 0:
        return float(_over(values - truths, errors)[0])
    return min(_list_distance(values - np.roll(truths, shift), errors)
               for shift in range(truths.size))


def _list_distance(off: Any, errors: Any) -> float:
    # what is off from the mean has errors that depend on each other: they add up to 0
    known = np.isfinite(errors) & np.isfinite(off)
    z = _over(off[known] - off[known].mean(), errors[known])
    tail = stats.chi2.sf(np.sum(z**2) * (1.0 - 1.0 / max(z.size, 1)),
                         max(z.size - 1, 1))
    return float(stats.norm.isf(max(tail, 1e-300) / 2.0))


def _over(off: Any, errors: Any) -> Any:
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.where(off == 0.0, 0.0, np.abs(off) / errors)


def _numbers(report: Report, expected: Expected,
             sizes: Mapping[str, tuple[Any, Any, Any, float]]) -> Iterator[str]:
    """Yield each size, limit and declared number that is not the true one."""
    for key, (value, error, truth, off) in sizes.items():
        if not off <= SURE:
            yield f'{key} = {value} +- {error}, true {truth}'
    limits = {f'{item["name"]}.{item["parameter"]}': item for item in report.get('limits') or ()}
    for key, truth in expected.covered.items():
        if key in sizes:
            continue
        limit = limits.get(key)
        if limit is None or limit['upper_95'] is None:
            yield f'{key} has no limit, true {truth}'
        elif limit['upper_95'] < abs(truth) or (limit['lower_95'] or -math.inf) > truth:
            yield f'{key} is at most {limit["upper_95"]}, true {truth}'
    changes = {f'{item["name"]}.{item["parameter"]}': item
               for item in report.get('declared_changes') or ()}
    for key, truth in expected.changes.items():
        if key == TICKS:
            if not any(word in name for name in changes for word in _OF_TICKS):
                yield 'no ticks in declared_changes'
        elif key not in changes:
            yield f'{key} is not in declared_changes'
        elif not math.isnan(truth):
            item = changes[key]
            if not distance(item['value'], item['standard_error'], truth) <= SURE:
                yield f'{key} = {item["value"]} +- {item["standard_error"]}, true {truth}'


# --- what else a report holds --------------------------------------------------------------------

def _parts(report: Report, expected: Expected) -> Iterator[str]:
    """Yield what is missing of the steps of a clock, lines that vary, and what was not tested."""
    steps = report.get('clock_steps') or ()
    for time, size in expected.steps:
        if not any(abs(item['time'] - time) <= _CYCLES * expected.cycle
                   and _sized(item, size) for item in steps):
            yield f'no step of the clock by {size:.3g} s at {time:.2f} s, but {list(steps)}'
    if not expected.steps and steps:
        yield f'steps of the clock that are not there: {list(steps)}'
    lines = [(item['order'], item['channel']) for item in report.get('unsteady_lines') or ()]
    for order, channel in expected.unsteady:
        if not any(math.isclose(order, other) and channel in ('', where)
                   for other, where in lines):
            yield f'order {order:g} {channel} varies and is not named as unsteady'
    if expected.untested:
        if report['error_after']['rms'] is not None:
            yield 'the RMS is defined where nothing can be compared'
        if not report.get('not_testable'):
            yield 'not_testable does not say what could not be compared'
    if expected.against and report['against'] != expected.against:
        yield f'compared against the {report["against"]}, not the {expected.against}'


def _sized(step: Mapping[str, Any], size: float) -> bool:
    """Whether a step of the clock is of a `size` (s, signed), or whole periods from it."""
    size -= step['step']
    if step['period'] is not None:
        size = math.remainder(size, step['period'])
    return distance(0.0, step['standard_error'], size) <= SURE


def _words(answer: Answer, expected: Expected) -> Iterator[str]:
    """Yield words that are said and must not be, and the other way round."""
    report = answer.report
    text = '\n'.join([answer.text, report.get('remains') or '', *report.get('remarks', ()), *(
        item['evidence'] for item in report.get('missing_effects') or ())]).lower()
    for words in expected.never:
        if words.lower() in text:
            yield f'says "{words}"'
    for words in expected.said:
        if words.lower() not in text:
            yield f'does not say "{words}"'
    if all(words in text for words in _CONTRADICTION):
        yield f'says "{_CONTRADICTION[0]}" and "{_CONTRADICTION[1]}"'


def _harm(report: Report) -> Iterator[str]:
    """Yield where held-out averages are predicted worse with what was named."""
    before, after = report['error_before'], report['error_after']
    errors = [item for item in (before['rms_standard_error'], after['rms_standard_error'])
              if item is not None]
    if names_of(report) and None not in (before['rms'], after['rms']) and errors and (
            after['rms'] > before['rms'] + _WORSE * max(errors)):
        yield f'RMS {before["rms"]:.3g} before, {after["rms"]:.3g} after'


# --- two versions on the same recordings ---------------------------------------------------------

def mcnemar(better: int, worse: int) -> float:
    """
    Return the exact p value of McNemar's test: one of two as likely to be right as the other.

    `better` and `worse` count the pairs in which only the second, or only the first, is right.
    """
    if not better + worse:
        return 1.0
    return float(stats.binomtest(better, better + worse).pvalue)


def decision(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what was decided: right or not, verdict, names, and which sizes are the true ones."""
    return {'right': row['right'], 'verdict': row['verdict'], 'effects': sorted(row['effects']),
            'sizes': {key: bool(off <= SURE) for key, (*_, off) in sorted(row['sizes'].items())}}


def count(rows: Sequence[Mapping[str, Any]], outcome: str) -> int:
    """Return how many rows ended so."""
    return sum(row['outcome'] == outcome for row in rows)
