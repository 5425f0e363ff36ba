"""
The errors this package raises on bad input.

Every message says the offending value, the limit it broke and what to do about it.
"""


class SaJitterError(ValueError):
    """Base of all errors of this package: bad input, never a bug."""


class ParameterError(SaJitterError):
    """A parameter, or a combination of parameters, that cannot be used."""


class SignalError(SaJitterError):
    """Samples or pulses that cannot be used: shape, rate, NaN, order of time."""


class MessageError(SaJitterError):
    """A ROS message whose layout or content does not follow the contract."""


class RecordingError(SaJitterError):
    """A file that is broken, unsafe or lacks what a recording needs."""


class ModelError(SaJitterError):
    """A declared model, or data offered to it, that does not make sense."""


class DataWarning(UserWarning):
    """Samples or pulses that could not be used: how many, and why."""
