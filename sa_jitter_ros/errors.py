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
Errors that the package raises for bad input.

Every message states the value, the limit and the remedy.
"""


class SaJitterError(ValueError):
    """
    Base of all errors of this package: bad input, never a bug.

    >>> import sa_jitter_ros as sa
    >>> try:
    ...     sa.average([0.0, 1.0], sample_rate=0.0, pulse_times=[0.1])
    ... except sa.SaJitterError as error:
    ...     print(type(error).__name__, '-', error)
    ParameterError - sample_rate is 0.0 Hz: give a positive rate
    """


class ParameterError(SaJitterError):
    """
    A parameter, or a combination of parameters, that cannot be used.

    >>> import sa_jitter_ros as sa
    >>> sa.Averager(5e3, ratio=-1.0)
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.ParameterError: ratio is -1.0: give at least 0.001
    """


class SignalError(SaJitterError):
    """
    Samples or pulses that cannot be used: shape, rate, NaN, order of time.

    >>> import sa_jitter_ros as sa
    >>> sa.average([0.0, 1.0, 2.0, 3.0], 1e3, [3.0, 2.0, 1.0])  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.SignalError: ...: 2 of 3 pulse times are earlier than the one before: ...
    """


class MessageError(SaJitterError):
    """
    A ROS message whose layout or content is not that of the interface.

    >>> from types import SimpleNamespace as Message
    >>> from sa_jitter_ros.recordings.message_layouts import decode_array
    >>> dims = [Message(label='sample', size=3)]
    >>> message = Message(layout=Message(dim=dims, data_offset=0), data=[0.1, 0.2])
    >>> decode_array(message, ('sample',), header_size=0)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.MessageError: layout 3 behind 0 header elements does not fit 2 elements...
    """


class RecordingError(SaJitterError):
    """
    A file that is broken or unsafe, or has not all fields of a recording.

    >>> import sa_jitter_ros as sa
    >>> sa.read('rig.npz')
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.RecordingError: rig.npz: no such file or folder: check the path
    """


class ModelError(SaJitterError):
    """
    A declared model that cannot be used, or that the data contradict.

    >>> import sa_jitter_ros as sa
    >>> sa.predict(keyphasor_rate=10e3, trigger_speed=0.0, trigger_cycles=40, orders=[19])
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.ModelError: trigger_speed is 0.0: it must be finite and above 0
    """


class DataWarning(UserWarning):
    """
    Samples or pulses that could not be used: how many, and why.

    >>> import warnings
    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> pulses = np.delete(np.arange(50) / 25.0, [20, 31])
    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter('always')
    ...     averages = sa.average(np.zeros(10_000), 5e3, pulses)
    >>> print(caught[0].category.__name__, '-', caught[0].message)
    DataWarning - 4 trigger cycles were discarded and 45 averaged; 2 missing pulses
    >>> [average.trigger_cycles for average in averages]
    [19, 9, 17]
    """


def one_line(message: object) -> str:
    """Return the text of an error or warning as one line, whole."""
    return ' '.join(str(message).split())


def quoted(message: object, longest: int = 300) -> str:
    """Return the text of an error that may quote a file, as one line of limited length."""
    text = one_line(message)
    return text if len(text) <= longest else f'{text[:longest]} ...'
