# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The report of a trace as files: `report.json`, self-contained `report.html`, PNG figures."""

import base64
from collections.abc import Iterable, Mapping, Sequence
from html import escape
import json
import re
from typing import Any

from sa_jitter_ros.inference.trace import Trace
from sa_jitter_ros.report.figures import illustrate, Illustration
from sa_jitter_ros.report.report import number_text, parameters_text, unit_text

Json = Any

_STYLE = """
body { font: 15px/1.45 sans-serif; color: #222; max-width: 62rem; margin: 2rem auto;
       padding: 0 1rem }
h1 { font-size: 1.5rem }
h2 { font-size: 1.15rem; margin-top: 2rem }
.verdict { font-size: 1.1rem; padding: .8rem 1rem; border-left: .4rem solid; background: #f3f3f3 }
.traced { border-color: #1f77b4 }
.none { border-color: #2ca02c }
.unexplained { border-color: #d62728 }
table { border-collapse: collapse; margin: .5rem 0 }
th, td { border: 1px solid #ccc; padding: .2rem .6rem; text-align: left; vertical-align: top }
td.number { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap }
figure { margin: 1rem 0 }
img { max-width: 100% }
figcaption { color: #555 }
"""
_ERRORS = (
    ('rms', 'RMS of observed minus predicted attenuation'),
    ('rms_standard_error', 'standard error that the RMS contains (in quadrature)'),
    ('rms_parameter_error', 'part of this standard error that the fitted parameters cause'),
    ('chi2_per_dof', 'chi2 per degree of freedom of the amplitudes'),
    ('ks', 'Kolmogorov-Smirnov distance from the predicted distribution'),
    ('cramer_von_mises', 'Cramer-von Mises statistic'),
    ('coverage_95', 'share of amplitudes in the predicted 95 % band'),
    ('p_value', 'p value of the residual'))


def report_files(trace: Trace, content: Mapping[str, Json]) -> Mapping[str, bytes]:
    """Return all files of a report by name; `content` is that of `report.json`."""
    figures = illustrate(trace)
    pictures = {f'{item.name}.png': item.png() for item in figures}
    page = html(content, figures, pictures)
    return {'report.json': _json(content),
            'report.html': page.encode(), **pictures}


def files_of_all(content: Mapping[str, Json], files: Mapping[str, Mapping[str, bytes]]
                 ) -> Mapping[str, bytes]:
    """
    Return the files of several shafts by path: those of each in a folder, and an index.

    `content` is that of the common `report.json`; `files` are those of each shaft.
    """
    rows = ''.join(
        f'<tr><td><a href="{escape(shaft)}/report.html">{escape(shaft)}</a></td>'
        f'<td>{escape(verdict_sentence(item))}</td></tr>\n'
        for shaft, item in content['shafts'].items())
    page = _page(content['verdict'], [
        '<h1>Measured against predicted attenuation</h1>',
        f'<table>\n<tr><th>shaft</th><th>result</th></tr>\n{rows}</table>'])
    return {'report.json': _json(content), 'report.html': page.encode(),
            **{f'{shaft}/{name}': data for shaft, each in files.items()
               for name, data in each.items()}}


def verdict_sentence(content: Mapping[str, Json]) -> str:
    """Return the verdict of a report in one sentence."""
    before, after = content['error_before'], content['error_after']
    rms_before, rms_after = number_text(before['rms']), number_text(after['rms'])
    error = (f'the held-out error goes from {rms_before} to {rms_after} '
             f'(RMS of observed minus predicted attenuation), chi2 per degree of freedom from '
             f'{number_text(before["chi2_per_dof"])} to {number_text(after["chi2_per_dof"])}')
    added = ' and '.join(f'{item["name"]} ({parameters_text(item)})'
                         for item in content['missing_effects'])
    if not content['lines']:
        return ('Nothing was found, and nothing could have been seen: no line of the vibration '
                'can be compared with its prediction.')
    if content['verdict'] == 'none':
        return (f'The declared model suffices: no significant residual (p = '
                f'{number_text(before["p_value"])}), held-out error {rms_before} (RMS of observed '
                'minus predicted attenuation).')
    if content['verdict'] == 'traced':
        return f'The declared model lacks {added}. With it {error}.'
    remains = ', '.join(filter(None, (f'p = {number_text(after["p_value"])}', content['remains'])))
    if added:
        return (f'The residual is not explained: even with {added} a significant residual remains '
                f'({remains}); {error}.')
    return (f'The residual is significant ({remains}, held-out error {rms_after}) and '
            'none of the known effects explains it.')


def html(content: Mapping[str, Json], figures: Sequence[Illustration],
         pictures: Mapping[str, bytes]) -> str:
    """Return the page; `pictures` are the PNGs of the figures by file name."""
    verdict = content['verdict']
    compared = [
        *_effects(content['missing_effects']),
        '<h2>Error of held-out acquisitions</h2>', _error_table(content),
        '<h2>Dependence of the residual on other quantities</h2>',
        _dependence_table(content['dependence']),
        *(_figure(item, pictures[f'{item.name}.png']) for item in figures),
        '<h2>Candidates</h2>', _candidate_table(content['candidates']),
        '<h2>Lines</h2>', _line_table(content['lines'])]
    return _page(verdict, [
        '<h1>Measured against predicted attenuation</h1>',
        f'<p class="verdict {escape(verdict)}">{escape(verdict_sentence(content))}</p>',
        *(f'<p>Note: {escape(remark)}.</p>' for remark in content['remarks']),
        *(compared if content['lines'] else ()),
        '<h2>Declared model and data</h2>', _declared_table(content)])


def _json(content: Mapping[str, Json]) -> bytes:
    return (json.dumps(content, indent=2, allow_nan=False) + '\n').encode()


def _page(verdict: str, parts: Sequence[str]) -> str:
    return ('<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<title>Report: {escape(verdict)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n'
            + '\n'.join(parts) + '\n</body>\n</html>\n')


def _effects(effects: Sequence[Mapping[str, Json]]) -> Iterable[str]:
    for number, item in enumerate(effects, 1):
        yield f'<h2>{number}. Missing effect: {escape(item["name"])}</h2>'
        yield _table(('parameter', 'value', 'standard error', 'unit'), [
            (name, number_text(value['value']), number_text(value['standard_error']),
             unit_text(value)) for name, value in item['parameters'].items()])
        text = f'Evidence: {item["evidence"]}.'
        if item['indistinguishable_from']:
            text += (' These data do not distinguish it from '
                     f'{", ".join(item["indistinguishable_from"])}.')
        yield f'<p>{escape(text)}</p>'


def _error_table(content: Mapping[str, Json]) -> str:
    before, after = content['error_before'], content['error_after']
    return _table(('', 'before', 'after'), [
        *((text, number_text(before[key]), number_text(after[key])) for key, text in _ERRORS),
        ('unsteadiness: unexplained scatter of the amplitudes, which chi2 and p value take into '
         'account',
         *2 * (number_text(content['unsteadiness']),))])


def _dependence_table(rows: Sequence[Mapping[str, Json]]) -> str:
    return _table(
        ('quantity', 'lowest', 'highest', 'change of the residual, before', 'p value',
         'change of the residual, after', 'p value'),
        [(item['on'].replace('_', ' '), number_text(item['low']),
          f'{number_text(item["high"])} {item["unit"]}'.strip(),
          *(text for when in ('before', 'after') for text in (
              f'{number_text(item[when]["change"])} ± {number_text(item[when]["standard_error"])}',
              number_text(item[when]['p_value'])))) for item in rows])


def _candidate_table(candidates: Sequence[Mapping[str, Json]]) -> str:
    return _table(('round', 'effect', 'held-out score', 'p value', 'outcome'), [
        (item['round'], item['name'], number_text(item['held_out_score']),
         number_text(item['p_value']), item['rejected_because'] or 'added')
        for item in candidates])


def _line_table(lines: Sequence[Mapping[str, Json]]) -> str:
    keys = ('level', 'observed', 'predicted_before', 'predicted_after', 'standard_error')
    return _table(
        ('order', 'channel', 'amplitude', 'observed attenuation', 'predicted before',
         'predicted after', 'standard error'),
        [(number_text(item['order']), item['channel'], *(number_text(item[key]) for key in keys))
         for item in lines])


def _declared_table(content: Mapping[str, Json]) -> str:
    rows = [(key, number_text(value)) for key, value in content['declared'].items()]
    rows += [('measured trigger_speed', number_text(content['measured_speed'])),
             ('recordings', ', '.join(content['recordings'])),
             ('attenuation measured against', content['against']),
             ('acquisitions fitted', content['acquisitions']['fit']),
             ('acquisitions held out', content['acquisitions']['held_out'])]
    return _table(('quantity', 'value'), rows)


def _figure(item: Illustration, picture: bytes) -> str:
    data = base64.b64encode(picture).decode()
    return (f'<h2>{escape(item.title)}</h2>\n<figure>'
            f'<img alt="{escape(item.title)}" src="data:image/png;base64,{data}">'
            f'<figcaption>{escape(item.caption)}</figcaption></figure>')


def _table(head: Sequence[str], rows: Iterable[Sequence[Json]]) -> str:
    lines = ['<tr>' + ''.join(f'<th>{escape(cell)}</th>' for cell in head) + '</tr>']
    lines += ['<tr>' + ''.join(_cell(cell) for cell in row) + '</tr>' for row in rows]
    return '<table>\n' + '\n'.join(lines) + '\n</table>'


def _cell(value: Json) -> str:
    text = str(value)
    kind = ' class="number"' if re.fullmatch(r'–|[-\d.e+]+', text) else ''
    return f'<td{kind}>{escape(text)}</td>'
