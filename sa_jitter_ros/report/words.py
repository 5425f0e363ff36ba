# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What a report says in plain words: what was found, what it does to amplitudes, what to do."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from sa_jitter_ros.effects import EFFECTS
from sa_jitter_ros.inference.residual import NOTICEABLE
from sa_jitter_ros.number_text import order_words, percent_text
from sa_jitter_ros.report.report import change_text, other_numbers, parameters_text, refinements

Json = Any

_LOSS = 0.05  # of an amplitude, from which on correction is worth its work
_MEANS = ('observed', 'standard_error', 'predicted_before', 'predicted_after')


def order_shares(content: Mapping[str, Json]) -> Sequence[Mapping[str, Json]]:
    """
    Return the shares of the true amplitudes that averages keep: the mean of the lines of an order.

    All channels share the pulse errors, so that their mean is no more certain than one of them.
    """
    shares = []
    for order in sorted({item['order'] for item in content['lines']}):
        lines = [item for item in content['lines'] if item['order'] == order]
        shares.append({**lines[0], **{
            key: float(np.mean([item[key] for item in lines])) for key in _MEANS}})
    return shares


def verdict_sentence(content: Mapping[str, Json]) -> str:
    """Return the verdict of a report in one sentence."""
    others = dict.fromkeys(item['name'] for item in other_numbers(content))
    remains = f' What remains: {content["remains"]}.' if content['remains'] else ''
    names = _listed([*(item['name'] for item in content['missing_effects']),
                     *(f'the right numbers of {name}' for name in others)], 'and').replace(
                         '_', ' ')
    if not content['lines'] and content['candidates']:  # the vibration holds lines
        found = f'Lines and pulse times show {names or "nothing"}'
        return (f'{found}; no attenuation can be compared with its prediction, since the errors '
                f'of single pulses do not show.{remains}')
    if not content['lines']:
        found = f'The pulse times alone show {names}; nothing else' if names else (
            'Nothing was found, and nothing')
        return (f'{found} could have been seen: no line of the vibration can be compared with its '
                f'prediction.{remains}')
    if content['verdict'] == 'none':
        return ('The declared model suffices: the averages lose what it predicts, within '
                f'{_rms(content, "before")} of an amplitude.')
    if content['verdict'] == 'traced':
        if not _improves(content):
            return (f'The declared model lacks {names}, but does not predict the amplitudes '
                    f'better with it: it misses them by {_rms(content, "after")} instead of '
                    f'{_rms(content, "before")}.')
        return (f'The declared model lacks {names}. With it the prediction misses the measured '
                f'amplitudes by {_rms(content, "after")} instead of {_rms(content, "before")}.')
    missed = _rms(content, 'after')
    if names:
        return (f'The averages are not explained: even with {names} the prediction misses the '
                f'measured amplitudes by {missed}.{remains}')
    return (f'The averages are not explained: the prediction misses the measured amplitudes by '
            f'{missed}, and none of the known effects explains it.{remains}')


def _improves(content: Mapping[str, Json]) -> bool:
    """Return whether the prediction is nearer to the amplitudes with what was found."""
    before, after = content['error_before']['rms'], content['error_after']['rms']
    return None in (before, after) or after <= before


def _rms(content: Mapping[str, Json], when: str) -> str:
    error = content[f'error_{when}']
    return percent_text(error['rms'], error['rms_standard_error'])


def findings(content: Mapping[str, Json]) -> Iterator[tuple[str, str]]:
    """Iterate over what was found: what it means, and the effect with its numbers."""
    for item in content['missing_effects']:
        kind = EFFECTS.get(item['name'])
        text = f'{item["name"]}: {parameters_text(item, content["unit"])}.'
        if item['indistinguishable_from']:
            others = _listed(item['indistinguishable_from'], 'or')
            text += f' It may also be {others}: these data do not tell them apart.'
        yield _sentence((kind.meaning or kind.summary) if kind else item['name']), text
    for item in other_numbers(content):
        yield (f'{item["name"]} is not as it was declared.',
               f'{change_text(item, content["unit"])}.')
    for item in refinements(content):
        yield ('The recording says more of the machine than was declared; predictions take it '
               'into account.', f'{item["name"]}: {change_text(item, content["unit"])}.')


def next_steps(content: Mapping[str, Json]) -> Sequence[str]:
    """Return what to do next, the most useful first."""
    steps = []
    shares = order_shares(content)
    explained = content['verdict'] != 'unexplained'
    if content['parameter_file'] and content['verdict'] == 'none' and not other_numbers(content):
        steps.append('Nothing has to change: predictions hold for this machine. The section below '
                     'declares, too, what the recording shows of it.')
    elif content['parameter_file'] and explained:
        steps.append('Paste the section below into your machine file'
                     + (': predictions then hold for this machine.' if _improves(content) else
                        ' only if a longer recording confirms it: here predictions are no better '
                        'with it.'))
    if not explained:
        steps.append('Do not rely on predictions for this machine'
                     + (', not even with the section below, which declares what is certain'
                        if content['parameter_file'] else '')
                     + '. Take corrected amplitudes, which need none, and look in the evidence '
                     'below at when and where the rest appears.')
    if content['clock_steps']:
        steps.append('Look for lost samples at the times of clock_steps: a buffer that overflows, '
                     'or a file that was cut. Each average that holds such a time is left out.')
    worst: Mapping[str, Json] = min(
        shares, key=lambda item: float(item['observed']), default={'observed': 1.0})
    if worst['observed'] < 1.0 - _LOSS:
        steps.append(
            f'The averages lose {percent_text(1.0 - worst["observed"], worst["standard_error"])} '
            f'of {order_words(worst["order"], worst["name"])}. Take corrected amplitudes '
            '(correct_jitter: true in synchronous_averager), and compare no raw amplitudes across '
            'keyphasors.')
    for item in content['missing_effects']:
        if item['name'] in EFFECTS and EFFECTS[item['name']].remedy:
            steps.append(f'Against {item["name"]}: {EFFECTS[item["name"]].remedy}.')
        if item['indistinguishable_from']:
            steps.append(f'To tell {item["name"]} from '
                         f'{_listed(item["indistinguishable_from"], "or")}, take '
                         f'{item["deciding_measurement"]}.')
    if content['undecided'] and content['lines'] and content['verdict'] != 'unexplained':
        steps.append('This recording cannot exclude '
                     f'{_listed(content["undecided"], "or")}, which may change '
                     f'an amplitude by {percent_text(NOTICEABLE)} or more. A longer recording '
                     'can.')
    if not content['lines']:
        steps += [_sentence(remark.rpartition('; ')[2]) for remark in content['remarks'][-1:]]
    return steps or ['Nothing: predictions of the declared model hold for this machine.']


def _sentence(text: str) -> str:
    return f'{text[:1].upper()}{text[1:]}.' if text else ''


def _listed(names: Sequence[str], word: str) -> str:
    """Return names as a list in a sentence, the last behind a word."""
    return f' {word} '.join(filter(None, (', '.join(names[:-1]), *names[-1:])))
