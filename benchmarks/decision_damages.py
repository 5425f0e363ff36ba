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
What goes wrong with a recording or its declaration, on machines of `independent_machines`.

Each damage is one of those that the loop once took for something else, or that users make.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline


@dataclass
class Measurement:
    """
    Fields of a recording, those `more` that a second one has otherwise, and the declared text.

    `true` (pulse,) are the true times of the pulses in s, lost ones included.
    """

    fields: dict[str, Any]
    text: str
    true: NDArray[np.float64]
    rng: np.random.Generator
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def interval(self) -> float:
        """Return the mean time between pulses in s."""
        return float(np.diff(self.true).mean())

    @property
    def orders(self) -> list[float]:
        """Return the declared orders."""
        return [float(item) for item in self.text.split(' orders: [')[1].split(']')[0].split(',')]

    @property
    def speed(self) -> float:
        """Return the declared speed of the tach shaft in Hz."""
        return float(self.text.split(' trigger_speed: ')[1].split()[0])

    def turning(self, angle: float) -> float:
        """Return the time in s that turns the highest declared order by an angle in rad."""
        top = max(self.orders) * float(self.fields['ratio']) * self.speed
        return angle / (2.0 * np.pi * top)

    def declare(self, name: str, change: Callable[[float], Any]) -> None:
        """Change a declared number."""
        self.text = re.sub(rf'(?<= {name}: ).*', lambda found: str(change(float(found[0]))),
                           self.text)


def _replace_pulses(change: Callable[[NDArray[np.float64], Measurement], NDArray[np.float64]]
                    ) -> Callable[[Measurement], None]:
    def damage(made: Measurement) -> None:
        made.fields['pulse_times'] = np.sort(change(made.fields['pulse_times'], made))
    return damage


def _declare(name: str, factor: float) -> Callable[[Measurement], None]:
    return lambda made: made.declare(name, lambda value: factor * value)


def _with_strays(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times with one stray behind every twelfth of them on average."""
    chosen = times[made.rng.uniform(size=times.size) < 1.0 / 12.0]
    return np.append(times, chosen + made.interval * made.rng.uniform(0.2, 0.8, chosen.size))


def _of_no_shaft(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    return made.rng.uniform(times[0], times[-1], times.size)


def _swaying(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times that come early and late eleven times in a recording, as no effect is."""
    size = 1.5 * float(np.std(times - made.true))
    return np.asarray(
        times + size * np.sin(2.0 * np.pi * 11.3 * (times - times[0]) / np.ptp(times)))


def _interrupted(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times without a sixth of them in a row."""
    return np.delete(times, slice(times.size // 3, times.size // 2))


def _slow_clock(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times of a clock that is slow by 2e-5, too little to change an average."""
    return np.asarray(times + 2e-5 * (times - times[0]))


def _late(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times that are late by as much as the speed of the machine shows."""
    return times + 0.012


def _fast_clock(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times of a clock that is fast by 3e-3, as much as a wrong gear."""
    return np.asarray(times - 3e-3 * (times - times[0]))


def _displaced(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times of which one in forty comes far from its place."""
    chosen = np.arange(20, times.size - 20, 40)
    moved = times.copy()
    moved[chosen] += made.interval * made.rng.uniform(-0.15, 0.15, chosen.size)
    return moved


def _lost(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times without one in sixty."""
    return np.delete(times, np.arange(20, times.size - 20, 60))


def _torsion(frequency: float, angle: float) -> Callable[[Measurement], None]:
    """Let the source turn to and fro, so many times an interval, the top order by `angle` rad."""
    def damage(made: Measurement) -> None:
        vibration, rate = made.fields['vibration'], float(made.fields['sample_rate'])
        time = np.arange(vibration.shape[-1]) / rate
        turn = 2.0 * np.pi * frequency / made.interval
        made.fields['vibration'] = CubicSpline(time, vibration, axis=-1)(
            time + made.turning(angle) * np.sin(turn * time))
    return damage


def _drifting(times: NDArray[np.float64], made: Measurement) -> NDArray[np.float64]:
    """Return pulse times that come later and later, by less and less."""
    return np.asarray(times - made.turning(2.0) * np.exp(-4.0 * times / times[-1]))


def _one_order(made: Measurement) -> None:
    """Let the highest declared order turn by itself by 0.8 rad, slower than the trigger rate."""
    vibration, rate = made.fields['vibration'], float(made.fields['sample_rate'])
    place = float(made.fields['ratio']) * max(made.orders) * made.speed
    frequency = np.fft.fftfreq(vibration.shape[-1], 1.0 / rate)
    line = 2.0 * np.fft.ifft(np.fft.fft(vibration) * (
        np.abs(frequency - place) < 0.2 * made.speed))
    slow = np.abs(frequency) < 0.1 * made.speed
    turn = np.fft.ifft(np.fft.fft(made.rng.standard_normal(frequency.size)) * slow).real
    made.fields['vibration'] = vibration + np.real(
        line * np.expm1(0.8j * turn / np.std(turn)))


def _slow_beat(made: Measurement) -> None:
    """Interpolate samples of a clock that is slower by seven samples in the recording."""
    vibration = made.fields['vibration']
    index = np.arange(vibration.shape[-1])
    other = np.linspace(0.0, index[-1], index.size - 7)
    found = CubicSpline(index, vibration, axis=-1)(other)
    made.fields['vibration'] = np.stack([np.interp(index, other, row) for row in found])


def _move(made: Measurement, when: Callable[[NDArray[np.float64]], NDArray[np.float64]],
          delay: float = 0.0) -> None:
    """
    Let the machine be at each time where it was, as it is, at another one.

    Its pulses are late by so many intervals.
    """
    vibration, rate = made.fields['vibration'], float(made.fields['sample_rate'])
    time = np.arange(vibration.shape[-1]) / rate
    errors = made.fields['pulse_times'] - made.true + delay * made.interval
    kept = (made.true > 0.0) & (made.true < time[-1])
    made.true = np.interp(made.true[kept], when(time), time)
    made.fields['pulse_times'] = made.true + errors[kept]
    made.fields['vibration'] = CubicSpline(time, vibration, axis=-1)(when(time))


def _run_up(delay: float) -> Callable[[Measurement], None]:
    """Let the machine run up from 0.6 to 1.4 times its speed."""
    return lambda made: _move(made, lambda time: time * (0.6 + 0.4 * time / time[-1]), delay)


def _twisting(made: Measurement) -> None:
    """Let the shaft twist steadily, with a mark."""
    turn = 2.0 * np.pi * 0.3 / made.interval
    _move(made, lambda time: time + made.turning(1.05) * np.sin(turn * time))


def _fading(made: Measurement) -> None:
    """Let the amplitudes fall to 0.4 for a fiftieth of the recording, twice."""
    vibration = made.fields['vibration'].copy()
    count = vibration.shape[-1]
    for begin in (0.3, 0.7):
        vibration[..., int(begin * count):int((begin + 0.02) * count)] *= 0.4
    made.fields['vibration'] = vibration


def _weak_order(made: Measurement) -> None:
    """Declare the second order alone, far below the lines that show the pulse errors."""
    made.text = re.sub(r'(?<= orders: \[).*(?=\])', '2.0', made.text)


def _foreign_shaft(made: Measurement) -> None:
    """Add the lines of a shaft whose speed varies by itself, as that of a second motor."""
    vibration, rate = made.fields['vibration'], float(made.fields['sample_rate'])
    time = np.arange(vibration.shape[-1]) / rate
    speed, slow = 2.42 / made.interval, 2.3 / time[-1]
    turns = speed * (time + 1e-3 * np.sin(2.0 * np.pi * slow * time) / (2.0 * np.pi * slow))
    for order in (1, 2, 3, 5):
        made.fields['vibration'] = made.fields['vibration'] + 0.3 * np.std(vibration) * np.cos(
            2.0 * np.pi * order * turns + order)


def _coarse_clock(made: Measurement) -> float:
    """Let a clock of 17.5 ticks an interval time the pulses, and declare it; return its rate."""
    rate = 17.5 / made.interval
    made.fields['pulse_times'] = np.ceil(rate * made.true) / rate
    made.declare('keyphasor_rate', lambda _: rate)
    return rate


def _dithered(made: Measurement) -> None:
    """Let a clock time pulses that a jitter of half a tick moves, and declare errors as large."""
    rate = 70.5 / made.interval
    moved = rate * made.true + 0.5 * made.rng.standard_normal(made.true.size)
    made.fields['pulse_times'] = np.ceil(moved) / rate
    made.declare('keyphasor_rate', lambda _: rate / math.sqrt(1.0 + 12.0 * 0.25))


def _two_clocks(made: Measurement) -> None:
    """Let a clock that is faster by 3 % time the pulses of a second recording."""
    rate = 1.03 * _coarse_clock(made)
    made.more = {'pulse_times': np.ceil(rate * made.true) / rate}


def _reference(begin: float, end: float) -> Callable[[Measurement], None]:
    """Add a reference keyphasor for a part of the recording, from `begin` to `end`."""
    def damage(made: Measurement) -> None:
        count = made.true.size
        made.fields['reference_pulse_times'] = made.true[int(begin * count):int(end * count)]
    return damage


def _short(made: Measurement) -> None:
    """Leave the first eighth of a recording."""
    for name in ('pulse_times', 'vibration'):
        made.fields[name] = made.fields[name][..., :made.fields[name].shape[-1] // 8]


def _poor_reference(made: Measurement) -> None:
    """Add a reference keyphasor with a third more jitter than the pulses have."""
    error = np.sqrt(np.mean((made.fields['pulse_times'] - made.true) ** 2))
    made.fields['reference_pulse_times'] = made.true + 4.0 / 3.0 * error * (
        made.rng.standard_normal(made.true.size))


def _louder(made: Measurement) -> None:
    """Add a second recording at another load."""
    made.more = {'vibration': 8.0 * made.fields['vibration']}


def _other_ratio(made: Measurement) -> None:
    made.fields['ratio'] *= 1.0 + 5e-5


#: What is done to a recording or its declaration, by the third word of a case.
DAMAGES: Mapping[str, Callable[[Measurement], Any]] = {
    'faster': _declare('trigger_speed', 1.12),
    'fast_at_times': _declare('trigger_speed', 1.103),
    'other_ratio': _other_ratio,
    'much_jitter': _declare('keyphasor_rate', 0.1),
    'little_jitter': _declare('keyphasor_rate', 10.0),
    'strays': _replace_pulses(_with_strays),
    'no_shaft': _replace_pulses(_of_no_shaft),
    'two_pulses': _replace_pulses(lambda times, made: times[[0, -1]]),
    'swaying': _replace_pulses(_swaying),
    'interrupted': _replace_pulses(_interrupted),
    'gap': _replace_pulses(_interrupted),
    'slow_clock': _replace_pulses(_slow_clock),
    'late': _replace_pulses(_late),
    'foreign_shaft': _foreign_shaft,
    'fast_clock': _replace_pulses(_fast_clock),
    'displaced': _replace_pulses(_displaced),
    'lost': _replace_pulses(_lost),
    'torsion': _torsion(0.73, 0.35),
    'slow_torsion': _torsion(0.11, 0.42),
    'drifting': _replace_pulses(_drifting),
    'one_order': _one_order,
    'slow_beat': _slow_beat,
    'run_up': _run_up(0.0),
    'twisting': _twisting,
    'late_run_up': _run_up(0.3),
    'fading': _fading,
    'weak_order': _weak_order,
    'coarse_clock': _coarse_clock,
    'two_clocks': _two_clocks,
    'dithered': _dithered,
    'late_reference': _reference(0.1, 1.0),
    'short_reference': _reference(0.0, 0.3),
    'poor_reference': _poor_reference,
    'short': _short,
    'louder': _louder}
