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

from collections.abc import Iterator, Mapping, Sequence
from html import escape
import json
from pathlib import PurePath
from typing import Any

from sa_jitter_ros.html_parts import figure, kept, page, part, table
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.number_text import measured_text, order_text, percent_text
from sa_jitter_ros.report.figures import illustrate, Illustration
from sa_jitter_ros.report.report import ONLY_SHAFT, parameter_unit
from sa_jitter_ros.report.words import findings, next_steps, order_shares, verdict_sentence

Json = Any

_TITLE = 'Keyphasor jitter: measured against predicted'
_UNITS = {'keyphasor_rate': 'Hz', 'trigger_speed': 'Hz', 'sample_rate': 'Hz', 'jitter_std': 's',
          'jitter_table': 's'}
_SHARES = ('measured', 'as declared', 'as found')  # of the true amplitude, heads of columns
_BOUNDS = (('at least', 'lower_95'), ('at most', 'upper_95'))
_ERRORS = (
    ('rms', 'RMS of observed minus predicted attenuation'),
    ('rms_standard_error', 'standard error that the RMS contains (in quadrature)'),
    ('rms_parameter_error', 'part of this standard error that the fitted parameters cause'),
    ('chi2_per_dof', 'chi2 per degree of freedom of the amplitudes'),
    ('ks', 'Kolmogorov-Smirnov distance from the predicted distribution'),
    ('cramer_von_mises', 'Cramer-von Mises statistic'),
    ('coverage_95', 'share of amplitudes in the predicted 95 % band'))


def report_files(trace: Trace, content: Mapping[str, Json]) -> Mapping[str, bytes]:
    """Return all files of a report by name; `content` is that of `report.json`."""
    figures = illustrate(trace)
    pictures = {f'{item.name}.png': item.png() for item in figures}
    return {'report.json': _text(content),
            'report.html': html(content, figures, pictures).encode(), **pictures}


def _text(content: Mapping[str, Json]) -> bytes:
    return f'{json.dumps(content, indent=2, allow_nan=False)}\n'.encode()


def files_of_all(content: Mapping[str, Json], files: Mapping[str, Mapping[str, bytes]]
                 ) -> Mapping[str, bytes]:
    """
    Return the files of several shafts by path: those of each in a folder, and an index.

    `content` is that of the common `report.json`; `files` are those of each shaft.
    """
    shafts = content['shafts']
    parts = [*_head(next(iter(shafts.values())), list(shafts))]
    for shaft, item in shafts.items():
        parts += [f'<h2><a href="{escape(shaft)}/report.html">Shaft {escape(shaft)}</a></h2>',
                  _verdict(item)]
    return {'report.json': _text(content),
            'report.html': page(f'Report: {content["verdict"]}', parts).encode(),
            **{f'{shaft}/{name}': data for shaft, each in files.items()
               for name, data in each.items()}}


def html(content: Mapping[str, Json], figures: Sequence[Illustration],
         pictures: Mapping[str, bytes]) -> str:
    """Return the page; `pictures` are the PNGs of the figures by file name."""
    return page(f'Report: {content["verdict"]}', [
        *_head(content, [content['shaft']]), _verdict(content), *_found(content),
        *_amplitudes(content), *_steps(content),
        *(figure(item.title, pictures[f'{item.name}.png'], item.caption) for item in figures),
        '<h2>Evidence</h2>', *_evidence(content)])


# --- for five minutes ----------------------------------------------------------------------------

def _head(content: Mapping[str, Json], shafts: Sequence[str]) -> Iterator[str]:
    """Return which recording this is about, and when and by what it was analysed."""
    recordings = [PurePath(name).name for name in content['recordings']]
    yield f'<h1>{escape(", ".join(recordings) or _TITLE)}</h1>'
    if recordings:
        yield f'<p class="quiet">{_TITLE}</p>'
    count = sum(content['acquisitions'].values())
    orders = ('; orders ' + ', '.join(map(order_text, content['orders'], content['order_names']))
              if len(shafts) == 1 else '')
    names = ', '.join(name for name in shafts if name != ONLY_SHAFT)
    analysed = ' '.join(filter(None, (
        content['created'].replace('T', ' ').replace('+00:00', ' UTC'),
        f'with sa_jitter_ros {content["version"]}')))
    yield (f'<p>Analysed {escape(analysed)}: {count} averages of '
           f'{content["declared"]["trigger_cycles"]} trigger cycles at '
           f'{content["measured_speed"]:.4g} Hz{escape(orders)}'
           + (f'; shaft{"s" * (len(shafts) > 1)} {escape(names)}' if names else '') + '.</p>')


def _verdict(content: Mapping[str, Json]) -> str:
    kind = content['verdict'] if content['lines'] else 'unseen'
    return (f'<p class="verdict {escape(kind)}">'
            f'{kept(verdict_sentence(content))}</p>')


def _found(content: Mapping[str, Json]) -> Iterator[str]:
    found = list(findings(content))
    if found or content['remarks']:
        yield '<h2>What was found</h2>'
    for meaning, effect in found:
        yield f'<p><b>{escape(meaning)}</b><br>{kept(effect)}</p>'
    for remark in content['remarks']:
        yield f'<p>Note: {escape(remark)}.</p>'


def _amplitudes(content: Mapping[str, Json]) -> Iterator[str]:
    """Return what happens to the amplitude of each order."""
    shares = order_shares(content)
    if not shares:
        return
    against = ('those of the better keyphasor'
               if content['against'] == 'reference keyphasor' else 'the corrected amplitudes')
    shown = 3 if content['missing_effects'] else 2
    yield '<h2>What it does to the amplitudes</h2>'
    yield table(('order', *_SHARES[:shown]), [
        (order_text(item['order'], item['name']), *_shares(item)[:shown]) for item in shares])
    yield ('<p class="quiet">Share of the true amplitude that an average keeps, with one standard '
           f'error; the mean over the channels, of {content["acquisitions"]["held_out"]} averages '
           f'that served no fit. Measured against {against}.</p>')


def _steps(content: Mapping[str, Json]) -> Iterator[str]:
    yield '<h2>What to do next</h2>'
    yield '<ol>' + ''.join(f'<li>{kept(step)}</li>' for step in next_steps(content)) + '</ol>'
    if content['parameter_file']:
        yield f'<pre>{escape(content["parameter_file"])}</pre>'


# --- for those who want to know ------------------------------------------------------------------

def _evidence(content: Mapping[str, Json]) -> Iterator[str]:
    """Return everything that the report rests on, each part to be opened."""
    if content['lines']:
        if content['missing_effects']:
            yield part('Effects that are missing', *_effects(content))
        yield part('Error of the averages that served no fit', _error_table(content))
        yield part('All effects that were tried', _candidate_table(content['candidates']))
        yield part('What an effect that was not found could be at most', _limit_table(content))
        yield part('All lines', _line_table(content))
    yield part('Declared model and data', _declared_table(content))


def _effects(content: Mapping[str, Json]) -> Iterator[str]:
    for number, item in enumerate(content['missing_effects'], 1):
        yield f'<h3>{number}. {escape(item["name"])}</h3>'
        yield table(('parameter', 'value'), [
            (name, measured_text(value['value'], value['standard_error'], parameter_unit(
                item['name'], name, value['unit'], content['unit'])))
            for name, value in item['parameters'].items()])
        yield f'<p>Evidence: {kept(item["evidence"])}.</p>'


def _error_table(content: Mapping[str, Json]) -> str:
    before, after = content['error_before'], content['error_after']
    return table(('', 'before', 'after'), [
        *((text, measured_text(before[key]), measured_text(after[key])) for key, text in _ERRORS),
        ('unsteadiness: unexplained scatter of the amplitudes, which chi2 takes into account',
         *2 * (percent_text(content['unsteadiness']),))])


def _candidate_table(candidates: Sequence[Mapping[str, Json]]) -> str:
    return table(('effect', 'round', 'held-out score', 'outcome'), [
        (item['name'], item['round'], measured_text(item['held_out_score']),
         item['rejected_because'] or 'added')
        for item in candidates], kind='cards')


def _limit_table(content: Mapping[str, Json]) -> str:
    return table(('effect', 'parameter', 'at 95 %'), [
        (item['name'], item['parameter'], ' and '.join(
            f'{word} {measured_text(item[key], None, unit)}' for word, key in _BOUNDS
            if item[key] is not None) or '–')
        for item in content['limits'] for unit in [parameter_unit(
            item['name'], item['parameter'], item['unit'], content['unit'])]])


def _line_table(content: Mapping[str, Json]) -> str:
    return table(
        ('order', 'channel', 'amplitude', *_SHARES),
        [(order_text(item['order'], item['name']), item['channel'],
          measured_text(item['level'], None, content['unit']), *_shares(item))
         for item in content['lines']], kind='cards')


def _shares(item: Mapping[str, Json]) -> Sequence[str]:
    """Return the texts of `_SHARES` of a line."""
    return [percent_text(item[key], item['standard_error'], shown=key == 'observed')
            for key in ('observed', 'predicted_before', 'predicted_after')]


def _declared_table(content: Mapping[str, Json]) -> str:
    declared = content['declared']
    rows = [(key, f'{_given(value)} {_UNITS.get(key, "") if value != [] else ""}'.rstrip())
            for key, value in declared.items() if key != 'effects']
    rows += [(f'effects.{name}.{key}', _given(value))
             for name, values in declared['effects'].items() for key, value in values.items()]
    rows += [('measured trigger_speed', f'{content["measured_speed"]:.6g} Hz'),
             ('recordings', ', '.join(content['recordings'])),
             ('attenuation measured against', content['against']),
             ('acquisitions fitted', content['acquisitions']['fit']),
             ('acquisitions held out', content['acquisitions']['held_out'])]
    return table(('quantity', 'value'), rows, kind='pairs')


def _given(value: Json) -> str:
    """Return a declared value as it was given."""
    if isinstance(value, list):
        return ', '.join(map(_given, value)) or '–'
    return f'{value:.6g}' if isinstance(value, float) else str(value)
