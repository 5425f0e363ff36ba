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
How an effect shows in pulse times and in the errors that are recovered from the vibration.

Time moves in one of three directions: the pulses err (`PULSES`), the source of the vibration moves
and the pulses are right (`SOURCE`), or the shaft moves and both with it (`MOTION`). An effect is a
random error with a spectrum in one of these directions, or a known pattern of an unknown size.
Sizes are in parts of a `unit` (s), frequencies in cycles a trigger cycle.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.model import DeclaredModel
from scipy import special

PULSES, SOURCE, MOTION = 'pulses', 'source', 'motion'
#: Logarithms of a power, in unit^2, below which there is as good as none, and that none exceeds.
FAINT, LARGE = -12.0, 20.0
#: Half of the digits of a number: a share that counts for nothing.
ROUNDING = float(np.sqrt(np.finfo(np.float64).eps))


@dataclass(frozen=True)
class Setting:
    """
    The pulses of one unbroken stretch that patterns refer to.

    `index` (pulse,) counts trigger pulses from the first of the recording, which came at `begin`
    (s); `times` (pulse,) in s are the measured ones and `true_times` those less their recovered
    errors, of which the vibration shows all but a turn that is common to `fitted`, the times of
    pulses of which these may be a part; `clock_errors`
    (pulse,) in s are what the grid of a clock makes of a smooth motion, None without a clock of
    `clock_rate` Hz.
    """

    model: DeclaredModel
    unit: float
    index: Array
    times: Array
    true_times: Array
    begin: float
    fitted: Array
    clock_errors: Array | None = None
    clock_rate: float = 0.0

    @property
    def common_period(self) -> float:
        """Return the mean trigger period (s) of all pulses that have the turn in common."""
        return float(np.diff(self.fitted).mean())


@dataclass(frozen=True)
class Spectrum:
    """
    A random error: `density` (parameters, frequency) in unit^2 per cycle a trigger cycle.

    Each parameter is a number, or an array that broadcasts with the frequencies.
    `starts` are values of its parameters from which a fit begins, one after the other: the first
    parameter is the logarithm of its power. `lower` and `upper` are bounds; `lower` None stands
    for the lowest frequency that a recording resolves, as a logarithm, and `upper` None for the
    longest memory, as artanh of a correlation. `limited` are those from which on limits are
    stated, where they are others than `lower`.
    """

    direction: str
    density: Callable[[Array, Array], Array]
    starts: tuple[tuple[float, ...], ...]
    lower: tuple[float | None, ...]
    upper: tuple[float | None, ...]
    limited: tuple[float | None, ...] = ()


@dataclass(frozen=True)
class Pattern:
    """
    Known errors of unknown sizes: `columns` of a setting (column, pulse), in parts of the unit.

    With `off_by` the effect prescribes the size of the column: 1, and it may be off by so much.
    `replaces_jitter` says that the declared jitter is no longer of known size. Errors
    that do not `show_in_times` are those of all pulses alike, relative to the vibration; they may
    absorb a part of what is none of them. `usual` returns the size that machines have, in units:
    a normal prior, None for any size.
    """

    columns: Callable[[Setting], Array]
    off_by: float = math.inf
    replaces_jitter: bool = False
    show_in_times: bool = True
    usual: Callable[[Setting], float] | None = None


def white(parameters: Array, frequency: Array) -> Array:
    """Return the density of independent errors: the same at all frequencies."""
    return np.asarray(np.exp(parameters[0]) * np.ones_like(frequency))


def autoregressive(parameters: Array, frequency: Array) -> Array:
    """Return the density of first-order autoregressive errors; artanh of their correlation."""
    rho = np.tanh(parameters[1])
    return np.asarray(np.exp(parameters[0]) * (1.0 - rho**2)
                      / ((1.0 - rho) ** 2 + 4.0 * rho * np.sin(np.pi * frequency) ** 2))


def low_passed(parameters: Array, frequency: Array) -> Array:
    """Return a Butterworth density: logarithms of power, width and half the order of its slope."""
    width, slope = np.exp(parameters[1]), np.exp(parameters[2])
    flat = 0.5 * np.pi / slope
    with np.errstate(divide='ignore'):  # frequency 0
        above = np.log(np.abs(frequency)) - parameters[1] + np.log(flat / np.sin(flat))
    return np.asarray(np.exp(parameters[0]) / (2.0 * width) * special.expit(-2.0 * slope * above))
