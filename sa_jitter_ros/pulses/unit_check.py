# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Pulse times that are not in seconds, not in order, or not on the clock of the vibration."""

from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array

_FEWEST = 3  # pulses that tell a unit
_MUCH = 10.0  # pulses that span so many times the vibration are in another unit
_FACTOR = 2.0  # by which spans may differ in the right unit
# Spread of the logarithm of the spans: a tach is often shorter than the vibration, seldom longer.
_SHORTER, _LONGER = 0.5, 0.1
_FEW_REVOLUTIONS = 40  # pulses that tell a length
_SAME_SPAN = 0.005  # relative, of lengths that are alike
_TOGETHER = 0.8  # of the longer one, that pulses and vibration have in common
_EPOCH = 1e8  # s; later first pulses are counted since 1970


# A waveform: its least number of values, the share of them that do not rise, or stay, and the
# share of the number of samples of the vibration, of which a keyphasor shows far fewer pulses.
_WAVEFORM, _FALLING, _STAYING, _DENSE = 16, 0.25, 0.5, 0.25


def is_waveform(times: Array, samples: int) -> bool:
    """
    Return whether pulse times beside so many samples of vibration are a sampled tach signal.

    >>> wave = np.sin(0.1 * np.arange(1000))
    >>> is_waveform(wave, 1000), is_waveform(np.sign(wave), 9000), is_waveform(np.sort(wave), 1000)
    (True, True, False)
    """
    if times.ndim != 1 or times.size < _WAVEFORM or times.dtype.kind not in 'biuf':
        return False
    rise = np.diff(times.astype(np.float64))
    return bool(np.mean(rise == 0.0) >= _STAYING or (
        np.mean(rise <= 0.0) >= _FALLING and times.size >= _DENSE * samples))


@dataclass(frozen=True)
class Mistake:
    """
    One explanation of pulse times that do not fit the vibration.

    `code` names it, `text` says it with the remedy. Pulse times are in s after `shift` was
    subtracted from them and `scale` multiplied; the sampling rate is `rate_scale` times as high.
    `probability` is that among all explanations.
    """

    code: str
    text: str
    scale: float = 1.0
    shift: float = 0.0
    rate_scale: float = 1.0
    probability: float = 1.0


def likely_mistake(pulses: Array, start: float, end: float, rate: float) -> str:
    """
    Return what is probably wrong with pulse times that do not fit the vibration, '' if they fit.

    The vibration is sampled at `rate` (Hz) from `start` to `end` (s).

    >>> likely_mistake(np.arange(0.0, 4000.0, 40.0), 0.0, 4.0, 5e3)  # doctest: +ELLIPSIS
    'the pulses span 3960 s, the vibration spans 4 s: the pulse times look like milliseconds; ...'
    """
    found = find_mistakes(pulses, start, end, rate)
    return found[0].text if found else ''


def other_rate(pulses: Array, start: float, end: float, rate: float) -> str:
    """
    Return that the vibration may have half or twice the rate (Hz), '' if its length is another.

    Its times would then be those of the pulses.

    >>> other_rate(np.arange(0.0, 10.0, 0.05), 0.0, 20.0, 2.5e3)  # doctest: +ELLIPSIS
    'the pulses span 9.95 s, the vibration spans 20 s, as with half its rate: ... 5000 Hz?'
    """
    factor = rate_factor(pulses, start, end)
    if factor == 1.0:
        return ''
    return (f'{_spans(pulses, end - start)}, as with {"half" if factor > 1.0 else "twice"} its '
            f'rate: is it sampled at {factor * rate:.10g} Hz?')


def rate_factor(pulses: Array, start: float, end: float) -> float:
    """Return 2.0 or 0.5 where the vibration is as long as the pulses with that much more rate."""
    times = pulses[np.isfinite(pulses)]
    if times.size < _FEW_REVOLUTIONS:
        return 1.0
    span = float(np.ptp(times))
    room = 2.0 * float(np.median(np.diff(np.sort(times))))  # of the first and the last pulse
    return next((factor for factor in (2.0, 0.5) if abs(
        factor * (span + 0.5 * room) - (end - start)) < factor * (room + _SAME_SPAN * span)), 1.0)


def other_span(pulses: Array, start: float, end: float) -> str:
    """
    Return that pulses (n,) and vibration have most of the time not in common, '' if they have.

    >>> other_span(np.arange(0.0, 5.0, 0.04), 0.0, 8.0)  # doctest: +ELLIPSIS
    'the pulses span 4.96 s, the vibration spans 8 s: check that both were recorded together, ...'
    """
    covered = min(end, float(pulses[-1])) - max(start, float(pulses[0]))
    room = 2.0 * float(np.median(np.diff(pulses)))
    if covered + room >= _TOGETHER * max(end - start, float(np.ptp(pulses))):
        return ''
    return (f'{_spans(pulses, end - start)}: check that both were recorded together, and their '
            'sampling rates')


def _spans(pulses: Array, duration: float) -> str:
    times = pulses[np.isfinite(pulses)]
    return f'the pulses span {np.ptp(times):.6g} s, the vibration spans {duration:.6g} s'


def find_mistakes(pulses: Array, start: float, end: float, rate: float
                  ) -> tuple[Mistake, ...]:
    """
    Return what may be wrong with pulse times (n,) that do not fit the vibration, likeliest first.

    Arguments as those of `likely_mistake`.

    >>> mistake, = find_mistakes(1.7e9 + np.arange(0.0, 4.0, 0.04), 0.0, 4.0, 5e3)
    >>> mistake.code, mistake.shift
    ('unit_epoch', 1700000000.0)
    """
    times = pulses[np.isfinite(pulses)].astype(np.float64)
    if times.size < _FEWEST or end <= start:
        return ()
    backwards = int(np.count_nonzero(np.diff(times) < 0.0))
    if 2 * backwards >= times.size:
        return (Mistake('backwards', f'{backwards} of {times.size} pulse times are earlier than '
                        'the one before: give them in order of time, numpy.sort(pulse_times)'),)
    duration, span = end - start, float(np.ptp(times))
    spans = _spans(times, duration)
    other = Mistake('span', f'{spans}: give pulse times in s, and sample_rate in Hz')
    if span > _MUCH * duration:
        return _other_unit(spans, span / duration, rate) or (other,)
    if span * _MUCH**2 < duration:
        if 0.5 / _FACTOR < 1e3 * span / duration < _FACTOR:
            return (Mistake(
                'unit_khz', f'{spans}: the sampling rate of {rate:g} Hz looks like kHz; give '
                f'sample_rate={1e3 * rate:.10g}', rate_scale=1e3),)
        return (other,)
    if times.max() < start or times.min() > end:
        apart = (f'the pulses come from {times.min():.6g} s to {times.max():.6g} s, when there is '
                 'no vibration: ')
        first = math.floor(float(times.min()))
        if first > _EPOCH > end:
            return (Mistake(
                'unit_epoch', f'{apart}they are counted since 1970; set start_time to the time of '
                'the first sample on the clock of the pulses', shift=float(first)),)
        return (Mistake('no_overlap', f'{apart}set start_time to the time of the first sample on '
                        'the clock of the pulses', shift=float(times.min()) - start),)
    return ()


def _other_unit(spans: str, factor: float, rate: float) -> tuple[Mistake, ...]:
    """Return the units in which pulses may span `factor` times the vibration."""
    units = {'samples': ('sample indices', rate), 'ms': ('milliseconds', 1e3),
             'us': ('microseconds', 1e6), 'ns': ('nanoseconds', 1e9)}
    weights = {}
    for name, (_, unit) in units.items():
        away = math.log(factor / unit)
        if abs(away) < math.log(_FACTOR):
            weights[name] = math.exp(-0.5 * (away / (_LONGER if away > 0.0 else _SHORTER)) ** 2)
    return tuple(Mistake(
        f'unit_{name}', f'{spans}: the pulse times look like {units[name][0]}; divide them by '
        f'{units[name][1]:g} to have seconds', scale=1.0 / units[name][1],
        probability=weight / sum(weights.values()))
        for name, weight in sorted(weights.items(), key=lambda item: -item[1]))
