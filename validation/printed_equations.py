# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Equations 5 to 18: angle law, comb filter, jittered cycles, as printed and as they hold."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.prediction.comb import comb_response
from sa_jitter_ros.pulses.angle_law import angle_law, cycle_times
from validation.analytic import uniform_mean
from validation.order_tracking import synchronous_average
from validation.results import agreement, Effort, Finding, Progress, Results

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_EXACT = 1e-9
_POINTS = 128  # angles of a cycle
_CYCLES = 25
_CHANNELS = 64  # of independent noise
_ORDINARY = 4.0  # standard errors
_WIDTH = 0.4  # of the pulse error where two models are compared


@dataclass(frozen=True)
class Erratum:
    """The largest errors of an equation, as it is printed and as it is right."""

    equation: str
    printed_error: float
    right_error: float


def slope_of_the_linear_law() -> Erratum:
    """Compare Eq. 5 with the linear law of the package, at pulses that do not begin at 0."""
    rng = np.random.default_rng(5)
    pulses = 0.3 + np.cumsum(rng.uniform(0.9, 1.1, 9))
    u = np.linspace(0.0, 1.0, 17)[:-1]
    errors = []
    for begin in (0.0, 1.0):  # begin of the time of a cycle: as printed, and right
        off = [np.abs((cycle_times(angle_law('linear'), pulses, k, u) - begin * pulses[k])
                      / (pulses[k + 1] - pulses[k]) + k - (k + u)).max()
               for k in range(pulses.size - 1)]
        errors.append(float(max(off)))
    return Erratum('5', *errors)


def sum_of_the_cycles() -> Erratum:
    """Compare Eq. 7 with the mean of cycles of a tone (Eq. 6)."""
    theta = np.arange(_POINTS) / _POINTS
    errors = np.zeros(2)
    for order in np.arange(0.1, 4.0, 0.13):
        tone = np.exp(2j * np.pi * order * theta)
        cycles = np.exp(2j * np.pi * order * (np.arange(_CYCLES)[:, None] + theta))
        response = comb_response(order, _CYCLES)
        for k, factor in enumerate((_CYCLES, 1.0)):
            errors[k] = max(errors[k], np.abs(cycles.mean(axis=0) - factor * response * tone
                                              ).max())
    return Erratum('7', *errors.tolist())


def phase_of_a_cycle(length: float, order: float) -> Erratum:
    """Compare Eq. 17 with the cycles of its signal, of a cycle of some `length` Theta."""
    theta, phase = length * np.arange(_POINTS) / _POINTS, 0.2
    errors = np.zeros(2)
    for k in range(_CYCLES):
        cycle = np.exp(2j * np.pi * (order * (theta + k * length) + phase))
        for number, factor in enumerate((1.0, order)):
            given = np.exp(2j * np.pi * (order * theta + phase + factor * k * length))
            errors[number] = max(errors[number], np.abs(cycle - given).max())
    return Erratum('17', *errors.tolist())


def jittered_cycles(order: float, phase: float) -> tuple[ComplexArray, ComplexArray]:
    """
    Return fundamental cycles read between jittered pulses, and those of Eq. 18.

    Both (cycle, angle), of a shaft at constant speed with three cycles of length 1 a trigger
    cycle. The first are read by the linear law of the package.
    """
    ratio, slope = 3, 0.04  # fundamental cycles a trigger cycle; s a fundamental cycle (lambda)
    rng = np.random.default_rng(18)
    errors = rng.uniform(-0.1, 0.1, 9) * slope  # s
    pulses = slope * ratio * np.arange(errors.size) + errors
    theta = np.arange(_POINTS) / _POINTS
    read, given = [], []
    for i in range(errors.size - 1):
        stretch = 1.0 + (errors[i + 1] - errors[i]) / (ratio * slope)
        for k in range(ratio):
            times = cycle_times(angle_law('linear'), pulses, i, (theta + k) / ratio)
            read.append(np.exp(2j * np.pi * (order * times / slope + phase)))
            given.append(np.exp(2j * np.pi * (
                order * stretch * (theta + k) + phase + errors[i] / slope * order)))
    return np.array(read), np.array(given)


def initial_phase() -> Erratum:
    """Compare the factor for an initial phase that the text below Eq. 22 gives."""
    phase = 0.2
    without, _ = jittered_cycles(4.0, 0.0)
    with_phase, _ = jittered_cycles(4.0, phase)
    return Erratum('text below 22', *(
        float(np.abs(np.exp(1j * turn * phase) * without - with_phase).max())
        for turn in (1.0, 2.0 * np.pi)))


def comb_error() -> float:
    """Return the largest difference of averaged tones from Eq. 8, of the package's averager."""
    orders = np.array([1.0, 2.0, 3.4, 3.47, 4.02, 5.5])
    rate = 2048.0  # 128 samples a cycle
    angle = np.arange((_CYCLES + 4) * _POINTS) / _POINTS - 1.0
    tones = np.cos(2.0 * np.pi * orders * angle[:, None])
    found = _averaged(tones, rate)
    theta = np.arange(_POINTS) / _POINTS
    expected = np.real(comb_response(orders, _CYCLES)[:, None]
                       * np.exp(2j * np.pi * orders[:, None] * theta))
    return float(np.abs(found - expected).max())


def noise_left() -> tuple[float, float]:
    """Return what the average leaves of white noise, times the root of N; and its error."""
    noise = np.random.default_rng(6).normal(size=((_CYCLES + 4) * _POINTS, _CHANNELS))
    found = _averaged(noise, 2048.0)
    return (float(np.std(found)) * _CYCLES**0.5, (2.0 * found.size) ** -0.5)


def _averaged(samples: FloatArray, rate: float) -> FloatArray:
    """Return waveforms (channel, angle) of cycles of 128 samples, from the second one on."""
    settings = AverageSettings(trigger_cycles=_CYCLES, orders=(1.0,),
                               samples_per_revolution=_POINTS)
    pulses = (1.0 + np.arange(_CYCLES + 1)) * _POINTS / rate
    return synchronous_average(samples, rate, pulses, settings).waveform


def run(effort: Effort, progress: Progress) -> Results:
    """Check Eqs. 5 to 18; what is computed does not depend on the effort."""
    errata = (slope_of_the_linear_law(), sum_of_the_cycles(), phase_of_a_cycle(0.5, 10.0),
              initial_phase())
    parametrised = phase_of_a_cycle(1.0, 4.0)
    read, given = jittered_cycles(4.0, 0.2)
    jittered = float(np.abs(read - given).max())
    comb = comb_error()
    noise, standard_error = noise_left()
    shifted, stretched = float(np.sinc(_WIDTH)), float(uniform_mean(_WIDTH))
    progress(1.0)
    numbers = {
        'errata': {item.equation: {'as_printed': item.printed_error, 'right': item.right_error}
                   for item in errata},
        'equation_17_with_theta_1': parametrised.printed_error, 'equation_18': jittered,
        'equation_8': comb, 'equation_12': shifted, 'equation_38': stretched,
        'noise_times_root_of_n': {'value': noise, 'standard_error': standard_error}}
    return Results(
        'Angle law, comb filter, jittered cycles: Eqs. 5 to 18', numbers,
        (Finding('Eq. 8', 'a comb filter of unit gain at whole orders',
                 f'{_CYCLES} cycles, six tones: largest difference {comb:.1e}',
                 agreement(comb < 1e-6)),
         Finding('Section 2.2', 'stationary noise is attenuated by 1/sqrt(N)',
                 f'after {_CYCLES} cycles, times sqrt(N): {noise:.4f} +- '
                 f'{standard_error:.4f}',
                 agreement(abs(noise - 1.0) < _ORDINARY * standard_error)),
         Finding('Eqs. 9-12', 'random shifts of cycles are no model of order tracking',
                 f'gain at D = {_WIDTH}: shifts {shifted:.4f} (Eq. 12), linear law '
                 f'{stretched:.4f} (Eq. 38)', agreement(stretched - shifted > 0.05)),
         Finding('Eqs. 16, 18', 'jitter stretches a cycle and moves it',
                 f'r = 3: largest difference from Eq. 18 {jittered:.0e}',
                 agreement(jittered < _EXACT)),
         Finding('Eqs. 5, 7, 17', 'as printed', 'largest errors '
                 + ', '.join(f'{item.printed_error:.2g}' for item in errata[:3]) + '; corrected '
                 + ', '.join(f'{item.right_error:.0e}' for item in errata[:3]),
                 agreement(*(item.printed_error < _EXACT for item in errata[:3])),
                 '[Errata](theory.md#errata-of-the-paper), which no later equation has.')),
        {}, ('Largest errors are in trigger cycles (Eq. 5), or of a component of amplitude 1. '
             'Eq. 17 with Theta = 0.5, gamma* = 10.',))
