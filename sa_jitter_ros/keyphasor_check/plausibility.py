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

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.averager import Averager
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.keyphasor_check.jitter import measure_jitter
from sa_jitter_ros.keyphasor_check.teeth import FEWEST, number_pulses
from sa_jitter_ros.pulses.unit_check import likely_mistake
from sa_jitter_ros.recordings.recording import Recording

FloatArray = NDArray[np.float64]

_FIRST_SECONDS = 20.0
_MOST_VALUES = 4_000_000
_MOST_PULSES = 4000
_SHORT = 0.8  # of the vibration
_CYCLES = 20  # at least 4, of which the noise is measured
_CLEAR = 4.0  # amplitude over its noise, which noise alone exceeds in 3e-4 of orders
_OTHER_SIZE, _SURE = 3.0, 4.0  # times as large; standard errors


def doubts(recording: Recording, pulses: FloatArray | None, *, orders: Sequence[float] = (),
           ratio: float = 1.0, pulses_per_revolution: int = 1,
           pulses_per_trigger: int | None = None, missing_teeth: int = 0,
           jitter_std: float | None = None) -> tuple[str, ...]:
    """
    Return what contradicts each other in a recording and its declaration, a sentence each.

    `pulses` (n,) are its pulse times in s, None if it has none; `orders` are those in which the
    user is interested, `jitter_std` in s is the declared one.

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
    found = []
    covered = min(end, float(pulses[-1])) - max(start, float(pulses[0]))
    usual = float(np.median(np.diff(pulses)))
    if covered + 2.0 * usual < _SHORT * recording.duration:
        found.append(f'the pulses span {np.ptp(pulses):.6g} s, the vibration spans '
                     f'{recording.duration:.6g} s: check that both were recorded together, and '
                     'their sampling rates')
    if orders:
        found += _weak(recording, pulses, orders=list(orders), ratio=ratio,
                       pulses_per_revolution=pulses_per_revolution,
                       pulses_per_trigger=pulses_per_trigger, missing_teeth=missing_teeth)
    if jitter_std:
        found += _other_jitter(pulses, jitter_std)
    return tuple(found)


def _weak(recording: Recording, pulses: FloatArray, *, orders: list[float], ratio: float,
          pulses_per_revolution: int, pulses_per_trigger: int | None, missing_teeth: int
          ) -> list[str]:
    """Return whether no order stands above its noise."""
    count = round(min(_FIRST_SECONDS * recording.sample_rate, recording.samples,
                      _MOST_VALUES / recording.channels))
    try:
        samples = next(recording.blocks(max(count, 1)))
        stop = recording.start_time + samples.shape[1] / recording.sample_rate
        averager = Averager(
            recording.sample_rate, start_time=recording.start_time, ratio=ratio, orders=orders,
            pulses_per_revolution=pulses_per_revolution, pulses_per_trigger=pulses_per_trigger,
            missing_teeth=missing_teeth, trigger_cycles=_CYCLES)
        averages = averager.update(samples, pulses[pulses <= stop])
    except SaJitterError:
        return []
    if not averages:
        return []
    with np.errstate(divide='ignore', invalid='ignore'):
        clear = np.array([np.abs(item.amplitudes) / item.noise for item in averages])
    return list(weak_orders(clear, orders, speed=float(np.median(
        [item.trigger_speed for item in averages])), ratio=ratio))


def weak_orders(clear: FloatArray, orders: Sequence[float], *, speed: float, ratio: float
                ) -> tuple[str, ...]:
    """
    Return a sentence if no order stands above its noise, nothing else.

    `clear` (average, channel, order) are amplitudes over their noise, NaN where there is none;
    `speed` of the tach shaft in Hz.

    >>> weak_orders(np.array([[[5.0, 0.8]]]), (19.0, 38.0), speed=20.0, ratio=1.0)
    ()
    """
    known = clear[:, ~np.isnan(clear).any(axis=0)]
    if not known.size or np.any(np.median(known, axis=0) > _CLEAR):
        return ()
    listed = ', '.join(f'{order:g}' for order in orders[:6])
    return (f'none of the orders {listed} stands above its noise at {speed:.4g} Hz and ratio '
            f'{ratio:.6g}: check ratio, pulses_per_revolution and sample_rate '
            '(check_keyphasor finds them)',)


def _other_jitter(pulses: FloatArray, declared: float) -> list[str]:
    """Return whether the pulses scatter by much more, or much less, than is declared."""
    numbered = number_pulses(pulses[:_MOST_PULSES])
    if numbered.times.size < FEWEST:
        return []
    found = measure_jitter(numbered.times, numbered.numbers)
    if found is None or math.isnan(found.correlation):
        return []
    factor = found.std / declared
    if 1.0 / _OTHER_SIZE < factor < _OTHER_SIZE or (
            abs(found.std - declared) < _SURE * found.std_error):
        return []
    return [f'the pulses scatter by {1e6 * found.std:.3g} us, but {1e6 * declared:.3g} us are '
            'declared: check keyphasor_rate and jitter_std']
