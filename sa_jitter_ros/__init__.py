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
Synchronous averaging of vibration, and what jitter of the keyphasor does to it.

    import sa_jitter_ros as sa

| function | what it does |
|---|---|
| `read` | open a recording |
| `detect_pulses` | find the pulses of a keyphasor in its waveform |
| `find_pulses` | find the pulses of a machine without a tach, from its own orders |
| `pulses_from_angle` | find when a sampled angle or a counter passes the marks of a target |
| `Machine` | a machine by its gears, planetary stages and bearings: ratios, and names of orders |
| `average`, `Averager` | average vibration synchronously with a shaft, at once or on line |
| `predict` | predict what jitter does to the order amplitudes of an average |
| `design` | find how fast the keyphasor must be sampled, and how many cycles averaged |
| `close_loop` | find what the declared model lacks in recordings of a machine |

Arrays go in, frozen dataclasses come out; times are in s, rates in Hz, phases in rad. Keywords are
the parameter names of the ROS 2 nodes. Nothing here needs ROS 2.
"""

from importlib import import_module
from typing import TYPE_CHECKING

from sa_jitter_ros.version import __version__  # noqa: F401

if TYPE_CHECKING:
    from sa_jitter_ros.averaging.average import Average, Correction
    from sa_jitter_ros.averaging.averager import average, Averager
    from sa_jitter_ros.effects.library import predict
    from sa_jitter_ros.errors import (
        DataWarning, MessageError, ModelError, ParameterError, RecordingError, SaJitterError,
        SignalError)
    from sa_jitter_ros.loop import close_loop, Loop
    from sa_jitter_ros.machine.train import Machine
    from sa_jitter_ros.prediction.design import Design, design
    from sa_jitter_ros.prediction.prediction import Prediction
    from sa_jitter_ros.pulses.detection import detect_pulses
    from sa_jitter_ros.pulses.sampled_angle import pulses_from_angle
    from sa_jitter_ros.recordings.reading import read
    from sa_jitter_ros.recordings.recording import Recording
    from sa_jitter_ros.tacholess.find import find_pulses
    from sa_jitter_ros.tacholess.found import FoundPulses

__all__ = [
    'Average', 'Averager', 'Correction', 'DataWarning', 'Design', 'FoundPulses', 'Loop', 'Machine',
    'MessageError', 'ModelError', 'ParameterError', 'Prediction', 'Recording',
    'RecordingError', 'SaJitterError', 'SignalError', 'average', 'close_loop', 'design',
    'detect_pulses', 'find_pulses', 'predict', 'pulses_from_angle', 'read']

# Modules are loaded when a name of theirs is first used: importing the package costs nothing.
_HOMES = {
    'averaging.average': ('Average', 'Correction'),
    'averaging.averager': ('Averager', 'average'),
    'effects.library': ('predict',),
    'errors': ('DataWarning', 'MessageError', 'ModelError', 'ParameterError', 'RecordingError',
               'SaJitterError', 'SignalError'),
    'loop': ('Loop', 'close_loop'),
    'machine.train': ('Machine',),
    'prediction.design': ('Design', 'design'),
    'prediction.prediction': ('Prediction',),
    'pulses.detection': ('detect_pulses',),
    'pulses.sampled_angle': ('pulses_from_angle',),
    'recordings.reading': ('read',),
    'recordings.recording': ('Recording',),
    'tacholess.find': ('find_pulses',),
    'tacholess.found': ('FoundPulses',),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    value = getattr(import_module(f'{__name__}.{_HOME[name]}'), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
