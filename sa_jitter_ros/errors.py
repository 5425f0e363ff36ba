"""
Errors that the package raises for bad input.

Every message states the value, the limit and the remedy.
"""


class SaJitterError(ValueError):
    """Base of all errors of this package: bad input, never a bug."""


class ParameterError(SaJitterError):
    """A parameter, or a combination of parameters, that cannot be used."""


class SignalError(SaJitterError):
    """Samples or pulses that cannot be used: shape, rate, NaN, order of time."""


class MessageError(SaJitterError):
    """A ROS message whose layout or content is not that of the interface."""


class RecordingError(SaJitterError):
    """A file that is broken or unsafe, or has not all fields of a recording."""


class ModelError(SaJitterError):
    """A declared model that cannot be used, or that the data contradict."""


class DataWarning(UserWarning):
    """Samples or pulses that could not be used: how many, and why."""
