# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""`find_pulses`: pulse times of the tach shaft from vibration alone, or the reason why not."""

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike
from sa_jitter_ros.arrays import BoolArray, FloatArray
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.parameters import number, numbers
from sa_jitter_ros.pulses.resampling import FULL_BAND
from sa_jitter_ros.tacholess.found import among, FoundPulses
from sa_jitter_ros.tacholess.phase import Phase, phase_of, UNKNOWN
from sa_jitter_ros.tacholess.rough import PRESENT, Rough, rough_speed

_MOST_ORDERS = 8  # of which the phase is looked at
_MOST_CELLS = 20_000
_FEWEST_CELLS = 16
_LOST = 0.02  # turns of the highest order by which its angle may be unknown from node to node
_MOST_TURNS = 1.0  # of the highest order, that the angle may be unknown


def find_pulses(vibration: ArrayLike, sample_rate: float, *,
                speed_range: Sequence[float], orders: Sequence[float] | None = None,
                machine: Machine | None = None, start_time: float = 0.0,
                hold_out: Collection[float] = (), maximum_rate: float = 0.5) -> FoundPulses:
    """
    Return when the tach shaft begins its revolutions, found from the vibration alone.

    `vibration` (channel, sample), or (sample,) for one channel, has lines at `orders`, multiples
    of the speed of the tach shaft; with a `machine` they are those of its meshes. The speed is
    sought within `speed_range`, (lowest, highest) in Hz; it changes by at most `maximum_rate`,
    relative and per s. Samples that are not finite are gaps. The phase of orders in `hold_out` is
    not used: averages of them are free of bias. Where phase 0 lies on the shaft is arbitrary.

    Raises ParameterError for parameters that cannot be used, and SignalError where the vibration
    does not tell the speed: nothing stands out, two speeds fit, or it is too short. Sources: a
    comb over orders, as in Hou et al., "Comparison of tacholess order tracking", MSSP (2016), its
    path by dynamic programming (Viterbi), and a Rauch-Tung-Striebel smoother of the phase.

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> time = np.arange(60_000) / 5e3
    >>> angle = 25.0 * time + 0.3 * np.sin(time)  # revolutions
    >>> vibration = np.cos(2.0 * np.pi * 19.0 * angle) + 0.5 * np.cos(2.0 * np.pi * 38.0 * angle)
    >>> vibration += np.random.default_rng(1).normal(0.0, 1.0, time.size)
    >>> found = sa.find_pulses(vibration, 5e3, orders=[19.0, 38.0], speed_range=(18.0, 33.0))
    >>> error = np.interp(found.times, time, angle) % 1.0
    >>> bool(np.ptp(error) < 1e-3), found.reason
    (True, '')
    """
    samples = _checked(vibration)
    rate, start = number('sample_rate', sample_rate), number('start_time', start_time)
    if not (np.isfinite(rate) and rate > 0.0):
        raise ParameterError(f'sample_rate is {rate} Hz: give a positive rate')
    wanted = _orders(orders, machine)
    low, high = _range(speed_range, rate, wanted)
    if not (np.isfinite(maximum_rate) and maximum_rate > 0.0):
        raise ParameterError(f'maximum_rate is {maximum_rate} per s: give a positive one')
    begin, end = _longest(np.asarray(np.isfinite(samples).any(axis=0)),
                          int(rate / high))
    if begin == end:
        raise SignalError('vibration has no finite sample: give another recording')
    lacking = '' if end - begin == samples.shape[1] else (
        f'outside {start + begin / rate:.4g} to {start + end / rate:.4g} s samples are lacking')
    samples, start = samples[:, begin:end], start + begin / rate
    rough = rough_speed(samples, rate, wanted, (low, high), maximum_rate)
    kept = ~among(wanted, [*hold_out]) & (rough.evidence > PRESENT) & (
        wanted * rough.speed.max() < FULL_BAND * rate)
    strongest = np.argsort(-rough.evidence * kept)[:_MOST_ORDERS]
    used = np.sort(wanted[strongest[kept[strongest]]])
    if not used.size:
        raise SignalError('no line is strong enough to follow its phase: give other orders, '
                          'fewer in hold_out, or a sensor nearer to their source')
    phase = _phase(samples, rate, rough, used)
    first, last, reason = _stretch(phase, start)
    found = FoundPulses.between(phase, first, last, start, wanted, '; '.join(
        filter(None, [lacking, reason])))
    if used.max() * np.median(found.standard_errors * found.speed) > _MOST_TURNS:
        raise SignalError(UNKNOWN)
    return found


def _checked(vibration: ArrayLike) -> FloatArray:
    samples = np.asarray(vibration)
    if samples.ndim == 1:
        samples = samples[None]
    if samples.ndim != 2 or samples.dtype.kind not in 'fiu' or not samples.size:
        raise SignalError(f'vibration has type {samples.dtype} and shape {samples.shape}: give '
                          'real numbers, (channel, sample) or (sample,)')
    if samples.shape[0] > samples.shape[1]:
        raise SignalError(f'vibration has {samples.shape[0]} channels of {samples.shape[1]} '
                          'samples: give (channel, sample), transpose it')
    return np.where(np.isfinite(samples), samples, np.nan).astype(np.float64)


def _longest(present: BoolArray, gap: int) -> tuple[int, int]:
    """Return begin and end of the longest stretch (item,) without a gap of more than `gap`."""
    known = np.flatnonzero(present)
    if not known.size:
        return 0, 0
    cuts = np.flatnonzero(np.diff(known) > gap)
    begins, ends = known[np.r_[0, cuts + 1]], known[np.r_[cuts, known.size - 1]] + 1
    longest = int(np.argmax(ends - begins))
    return int(begins[longest]), int(ends[longest])


def _orders(orders: Sequence[float] | None, machine: Machine | None) -> FloatArray:
    """Return the orders of the comb, in ascending order; raises ParameterError."""
    if orders is None and machine is None:
        raise ParameterError('neither orders nor machine is given: give the orders of the tach '
                             'shaft at which the machine has lines')
    if orders is None:
        if not isinstance(machine, Machine):
            raise ParameterError(f'machine is of type {type(machine).__name__}: give a Machine, '
                                 'Machine.read(path)')
        orders = [*machine.meshes().values()]
    found = np.unique(np.round(numbers('orders', orders), 9))
    if not found.size or not np.all(np.isfinite(found)) or found[0] <= 0.0:
        raise ParameterError(f'orders are {found.tolist()}: give one or more, all above 0')
    return np.asarray(found, dtype=np.float64)


def _range(speed_range: Sequence[float], rate: float, orders: FloatArray) -> tuple[float, float]:
    """Return the lowest and highest speed; raises ParameterError."""
    found = numbers('speed_range', speed_range)
    if len(found) != 2 or not np.all(np.isfinite(found)) or not 0.0 < found[0] < found[1]:
        raise ParameterError(f'speed_range is {[*found]}: give (lowest, highest) speed in Hz, '
                             'both above 0, the lowest first')
    if orders[0] * found[1] > FULL_BAND * rate:
        raise ParameterError(
            f'speed_range goes to {found[1]:g} Hz, where the lowest order {orders[0]:g} is at '
            f'{orders[0] * found[1]:g} Hz: a sample_rate of {rate:g} Hz shows up to '
            f'{FULL_BAND * rate:g} Hz')
    return float(found[0]), float(found[1])


def _phase(samples: FloatArray, rate: float, rough: Rough, orders: FloatArray) -> Phase:
    """Return the phase in cells that part the orders of lines from each other."""
    spacing = float(np.min(np.diff(np.concatenate([[0.0], orders]))))
    angle = rough.angle(rate, samples.shape[1])
    revolutions = max(int(np.ceil(2.0 / spacing)), 1,
                      int(np.ceil((angle[-1] - angle[0]) / _MOST_CELLS)))
    if (angle[-1] - angle[0]) / revolutions < _FEWEST_CELLS:
        raise SignalError(f'{angle[-1] - angle[0]:.3g} revolutions: at least '
                          f'{_FEWEST_CELLS * revolutions} are needed to follow the phase; give a '
                          'longer recording')
    return phase_of(samples, rate, angle, revolutions, orders)


def _stretch(phase: Phase, start: float) -> tuple[int, int, str]:
    """Return the first and last node of the longest stretch in which the phase is known."""
    pairs, width = phase.posterior.pairs, phase.posterior.mode.shape[1]
    step = np.sqrt(pairs[:, 0, 0] + pairs[:, width, width] - 2.0 * pairs[:, 0, width])
    known = step / (2.0 * np.pi) < _LOST
    known[[0, -1]] = False  # no cell beyond it
    first, last = _longest(known, 1)
    if last - first < _FEWEST_CELLS:
        raise SignalError(UNKNOWN)
    nodes = phase.seen.nodes + start
    lost = [f'{side} {nodes[k]:.4g} s' for side, k, end in (
        ('before', first, 1), ('after', last, len(known) - 1)) if k != end]
    return first, last, (f'{" and ".join(lost)} the lines are too weak, or change too fast, to '
                         'follow their phase' if lost else '')
