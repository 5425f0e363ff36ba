# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What was repaired of the pulses: the places where most of them were rejected or are missing."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.recordings.recording import Recording

Rejected = Sequence[tuple[float, str]]

_PLACES, _AROUND = 5, 6.0  # panels, and pulse intervals on either side of a place
_MOST_SAMPLES = 20_000  # of a waveform in a panel
_SAME = 1e-6  # of an interval, by which the times of one pulse may differ
_DPI = 110
_ACCEPTED, _BAD, _WAVE = 'tab:blue', 'tab:red', '0.6'
_WORDS = {'doubles': 'double', 'early': 'stray', 'late': 'late', 'missing': 'missing',
          'unlocked': 'no steady interval', 'out_of_order': 'out of order'}


def repairs_figure(name: str, recording: Recording, pulses: FloatArray, rejected: Rejected
                   ) -> Figure | None:
    """
    Return tach, accepted pulses and rejected ones around the five worst places, None without any.

    `pulses` (n,) in s are all that came; `rejected` are times (s) of those that were not taken as
    they came, and of missing ones, each with the reason.
    """
    intervals = np.diff(pulses)
    if not rejected or not (intervals > 0.0).any():
        return None
    interval = float(np.median(intervals[intervals > 0.0]))  # doubles are at the same time
    bad = np.array([time for time, _ in rejected])
    reach = _AROUND * interval
    spans = [(place - reach, place + reach) for place in worst_places(bad, reach)]
    figure = Figure(figsize=(9.0, 1.5 * len(spans) + 1.0), layout='constrained')
    panels = figure.subplots(len(spans), 1, squeeze=False).ravel()
    figure.suptitle(f'{name}: {len(rejected)} pulses were rejected or are missing; '
                    f'the {len(spans)} worst places\n'
                    'grey: tach; blue: accepted pulses; red: rejected; dotted: missing',
                    fontsize='medium')
    waves = _waveforms(recording, spans)
    for panel, (low, high), (times, wave) in zip(panels, spans, waves):
        if times.size:
            span = max(float(np.ptp(wave)), np.finfo(np.float64).tiny)
            panel.plot(times, (wave - wave.min()) / span, color=_WAVE, linewidth=0.8)
        inside = pulses[(pulses >= low) & (pulses <= high)]
        same = np.isclose(inside[:, None], bad, rtol=0.0, atol=_SAME * interval).any(axis=1)
        panel.vlines(inside[~same], 0.0, 1.0, color=_ACCEPTED, linewidth=1.2)
        for time, why in rejected:
            if low <= time <= high:
                panel.vlines(time, 0.0, 1.0, color=_BAD, linewidth=1.2,
                             linestyle='dotted' if why == 'missing' else 'solid')
                panel.text(time, 1.05, _WORDS.get(why, why), color=_BAD, fontsize='small',
                           rotation=25.0, clip_on=True)
        panel.set(xlim=(low, high), ylim=(-0.05, 1.45), yticks=[])
    panels[-1].set_xlabel('time [s]')
    return figure


def write_repairs(folder: Path, name: str, recording: Recording, pulses: FloatArray,
                  rejected: Rejected) -> bool:
    """Write `repairs.png` if anything was repaired; return whether. Raises OSError."""
    figure = repairs_figure(name, recording, pulses, rejected)
    if figure is not None:
        figure.savefig(folder / 'repairs.png', dpi=_DPI)
    return figure is not None


def worst_places(times: FloatArray, reach: float) -> list[float]:
    """
    Return where most `times` (n,) in s are, the middles of at most five places in their order.

    >>> worst_places(np.array([1.0, 5.0, 5.1, 5.2, 9.0]), 0.5)
    [1.0, 5.1, 9.0]
    """
    left, found = np.sort(times), list[float]()
    while left.size and len(found) < _PLACES:
        count = np.searchsorted(left, left + reach, side='right') - np.arange(left.size)
        first = int(np.argmax(count))
        near = left[first:first + int(count[first])]
        found.append(float(0.5 * (near[0] + near[-1])))
        left = left[np.abs(left - found[-1]) > reach]
    return sorted(found)


def _waveforms(recording: Recording, spans: Sequence[tuple[float, float]]
               ) -> list[tuple[FloatArray, FloatArray]]:
    """Return times (s) and samples of the tach waveform in each span, none without a waveform."""
    parts: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in spans]
    rate, begin = recording.tach_rate, recording.start_time
    if recording.tach is not None and rate:
        index = 0
        for block in recording.tach_blocks():
            times = begin + (index + np.arange(block.shape[1])) / rate
            for part, (low, high) in zip(parts, spans):
                if times[0] <= high and times[-1] >= low:
                    inside = (times >= low) & (times <= high)
                    part.append((times[inside], block[0, inside]))
            index += block.shape[1]
    none = np.empty(0), np.empty(0)
    return [_thinned(*map(np.concatenate, zip(*part))) if part else none for part in parts]


def _thinned(times: FloatArray, wave: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the samples, every few of them if there are too many to draw."""
    step = max(1, times.size // _MOST_SAMPLES)
    return times[::step], wave[::step]
