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
A machine on a page that prints: changes, limits, orders, indicators, keyphasor and figures.

It is made of the files of a recording; numbers are those of its last average.
"""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
import math
from pathlib import Path
from typing import Any

import numpy as np
from sa_jitter_ros.averaging.indicators import IN_UNIT
from sa_jitter_ros.html_parts import figure, kept, page, table
from sa_jitter_ros.machine import LEVELS
from sa_jitter_ros.monitoring.quantities import best_amplitudes
from sa_jitter_ros.number_text import HALF_95, measured_text, order_text, order_words, percent_text
from sa_jitter_ros.offline.changes import Changes, FIGURE
from sa_jitter_ros.offline.files import read_averages, Signals
from sa_jitter_ros.offline.plotting import squared
from sa_jitter_ros.offline.series import ShaftSeries
from sa_jitter_ros.whole_files import whole_file

PAGE = 'page.html'
_CHANNELS, _ORDERS = 3, 10  # the strongest ones
_CLEAR = 0.05  # standard error of an attenuation that is one
_FIGURES = {'waveform': 'Average', 'spectrum': 'Order spectrum', 'tracked_orders': 'Trend',
            'envelope': 'Squared envelope'}


def write_page(folder: Path, changes: Changes | None = None, *, place: Path | None = None) -> None:
    """
    Write `page.html` of the files in a folder into it, or at another `place`; raises OSError.

    `changes` are those of the machine up to this recording, with their figure beside the page.
    """
    signals, shafts, about = read_averages(folder)
    place = place or folder / PAGE
    parts = [*_head(signals, shafts, about['row']), *_findings(changes, about), *_limits(signals),
             *_keyphasor(signals, shafts, about['row']),
             *_picture(place.with_name(FIGURE), 'Changes', kind='half')]
    for series in shafts:
        parts += _shaft(signals, series)
        prefix = f'{series.shaft}_' if len(shafts) > 1 else ''
        for name, title in _FIGURES.items():
            parts += _picture(folder / f'{prefix}{name}.png', title)
    parts += _picture(folder / 'repairs.png', 'Repaired pulses')
    with whole_file(place) as file:
        file.write(page(signals.recording, parts))


def _picture(path: Path, title: str, *, kind: str = 'wide') -> Iterator[str]:
    if path.exists():
        yield figure(title, path.read_bytes(), kind=kind)


def _head(signals: Signals, shafts: Sequence[ShaftSeries], row: dict[str, Any]) -> Iterator[str]:
    speed = shafts[0]['trigger_speed']
    yield f'<h1>{escape(signals.recording)}</h1>'
    yield (f'<p class="quiet">Recording {escape(row["recording"])}: {row["averages"]} averages of '
           f'{", ".join(map(escape, (item.shaft for item in shafts)))}, tach shaft at '
           f'{speed.min():.4g} to {speed.max():.4g} Hz, {len(signals.channels)} '
           f'channel{"s" * (len(signals.channels) > 1)}.</p>')


def _findings(changes: Changes | None, about: Mapping[str, Any]) -> Iterator[str]:
    """Return what has changed, the limits that are passed, and what is doubtful."""
    lines, kind = about['limits'], 'unexplained'
    if changes is not None:
        lines = changes.lines()
        kind = kind if changes.changes or changes.limits.passed() else 'none'
    elif lines:
        lines = ['limits are passed:', *lines]
    else:
        lines, kind = ['No baseline to compare with: --baseline takes the first recordings of '
                       'this machine as its normal state.'], 'unseen'
    text = '<br>'.join(kept(line.replace(' +- ', ' ± ')) for line in lines)
    yield f'<p class="verdict {kind}">{text[:1].upper()}{text[1:]}</p>'
    row = about['row']
    for remark in filter(None, (row['error'], *row['remarks'])):
        if remark not in about['said']:  # of limits
            yield f'<p>Note: {escape(remark)}.</p>'


def _limits(signals: Signals) -> Iterator[str]:
    """Return the limits that are set."""
    if signals.machine.limits:
        yield '<h2>Limits</h2>'
        yield table(('limit', 'of', 'shaft', 'channel', *LEVELS), [
            (name, limit.what, limit.shaft or '', limit.channel or 'all', *(
                 f'{limit.bounds[level]:g}{" × baseline" * bool(limit.relative)}'
                 if level in limit.bounds else '–' for level in LEVELS))
            for name, limit in signals.machine.limits.items()], kind='pairs')


# --- one shaft -----------------------------------------------------------------------------------

def _shaft(signals: Signals, series: ShaftSeries) -> Iterator[str]:
    """Return the orders, bearings and indicators of the last average."""
    amplitude, error, _ = best_amplitudes(series['order_amplitude'][-1])
    size = np.nan_to_num(amplitude)
    channels = sorted(np.argsort(-size.max(axis=1))[:_CHANNELS].tolist())
    strongest = sorted(np.argsort(-size.max(axis=0))[:_ORDERS].tolist())
    first = np.argmax(size, axis=0)  # channel on which an order is strongest
    share, doubt = (series.field(f'attenuation{end}')[-1] for end in ('', '_standard_error'))
    names = [signals.channel_names[channel] for channel in channels]
    units = [signals.units[channel] for channel in channels]
    yield f'<h2>Shaft {escape(series.shaft)}</h2>'
    yield ('<p class="quiet">The last average, of '
           f'{series["trigger_cycles"][-1]} trigger cycles, with half of the 95 % interval.</p>')
    yield table(('order', *map(_headed, names, units), 'attenuation'), [
        (signals.order(series.shaft, series.orders[place]), *(
            _interval(amplitude[channel, place], error[channel, place]) for channel in channels),
         _share(share[first[place], place], doubt[first[place], place]))
        for place in strongest], kind='pairs')
    if 'condition_indicator' in series:
        found, errors = (series[f'condition_indicator{end}'][-1] for end in ('', '_error'))
        yield table(('indicator', *names), [
            (name.replace('_', ' '), *(_interval(
                found[channel, place], errors[channel, place],
                units[number] if name in IN_UNIT else '') for number, channel in enumerate(
                    channels)))
            for place, name in enumerate(series['condition_indicator_names'].tolist())
            if np.isfinite(found[channels, place]).any()], kind='pairs')
    if 'envelope_amplitude' in series:
        lines = series['envelope_amplitude'][-1]
        yield table(('line of the squared envelope', *map(_headed, names, map(squared, units))), [
            (order_text(order, signals.machine.name_of(series.shaft, order, bearing=True)), *(
                _interval(*lines[channel, place, 2:4]) for channel in channels))
            for place, order in enumerate(lines[0, :, 0].tolist())], kind='pairs')


def _headed(name: str, unit: str) -> str:
    return f'{name} [{unit}]' if unit else name


def _interval(value: float, error: float, unit: str = '') -> str:
    """
    Return a value with half of its 95 % interval.

    >>> _interval(0.99823, 0.0061, 'g'), _interval(math.nan, 1.0)
    ('0.998 ± 0.012 g', '–')
    """
    if not math.isfinite(value):
        return '–'
    return measured_text(float(value), HALF_95 * float(error) if math.isfinite(error) else None,
                         unit)


def _share(value: float, error: float) -> str:
    return percent_text(float(value), HALF_95 * float(error)) if error < _CLEAR else '–'


# --- the keyphasor -------------------------------------------------------------------------------

def _keyphasor(signals: Signals, shafts: Sequence[ShaftSeries], row: dict[str, Any]
               ) -> Iterator[str]:
    """Return how good the pulses are, and what their errors cost."""
    rows: list[tuple[str, str]] = []
    if 'pulse_error' in shafts[0]:
        fields = dict(zip(shafts[0]['pulse_error_fields'].tolist(), shafts[0]['pulse_error'].T))
        power, noise = (float(np.nanmean(fields[name]**2)) for name in ('error', 'standard_error'))
        rows.append(('pulse errors, RMS', measured_text(math.sqrt(power - noise), None, 's')
                     if power > noise else f'below {measured_text(math.sqrt(noise), None, "s")}'))
    for series in shafts:
        doubt = np.median(series.field('attenuation_standard_error'), axis=0)
        share = np.where(doubt < _CLEAR, np.mean(series.field('attenuation'), axis=0), np.inf)
        place = np.unravel_index(np.argmin(share), share.shape)
        if np.isfinite(share[place]):
            order = series.orders[place[1]]
            rows.append((f'smallest attenuation, {series.shaft}',
                         f'{percent_text(float(share[place]))} are left of '
                         + order_words(order, signals.machine.name_of(series.shaft, order))))
    yield '<h2>Keyphasor</h2>'
    yield table(('quantity', 'value'), [*rows, (
        'averaged and dropped', f'{row["trigger_cycles"]} trigger cycles averaged; '
        f'{row["cycles_dropped"]} cycles, {row["pulses_dropped"]} pulses and '
        f'{row["samples_dropped"]} samples dropped; {row["gaps"]} gaps; '
        f'{row["corrections_refused"]} corrections refused')], kind='pairs')
