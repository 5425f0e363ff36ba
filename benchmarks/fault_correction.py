"""
Whether a corrected average is true, and the pulse errors that were taken out of it.

The average must be exactly that between the pulses less the errors it was published with, and the
errors those of the teeth, but for a common delay, which cannot be seen, and their own standard
errors. Both together make the corrected values true within what they claim of themselves.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from fault_check import AMPLITUDE, Place, waveform_agrees, WrongAverageError
from fault_graph import Received
from fault_machine import TEETH, Window
import numpy as np

LIMIT = 6.0  # standard errors: two of a thousand million normal variables are farther out
MEAN = 1e-12  # s that recovered errors may be off on average: rounding


def check_correction(name: str, received: Received, place: Place,
                     settings: Sequence[Mapping[str, Any]]) -> bool:
    """
    Return whether an average that was found at `place` is corrected; raises `WrongAverageError`.

    `settings` are the parameters that may be in force.
    """
    amplitude = received.amplitude
    if received.corrected is None or received.pulse_error is None:
        return False
    if not any(values.get('correct_jitter') for values in settings):
        raise WrongAverageError(f'{name}: corrected without correct_jitter')
    header, table = amplitude.header, amplitude.values
    if not header == received.corrected.header == received.pulse_error.header:
        raise WrongAverageError(f'{name}: corrected average or pulse errors are not of {header}')
    run, step = place.run, place.values['pulses_per_trigger'] or TEETH
    teeth = np.arange(place.first, place.last + 1, step)
    times, errors, standard_errors = received.pulse_error.values.T
    if [run.tooth_at(time) for time in times] != teeth.tolist():
        raise WrongAverageError(f'{name}: pulses at {times} s are not those of {header}')
    true = run.errors(teeth)
    true -= true.mean()
    apart = np.abs(errors - true) / standard_errors
    if abs(errors.mean()) > MEAN or not apart.max() < LIMIT:
        raise WrongAverageError(f'{name}: errors of the pulses are {1e6 * true} us and not '
                                f'{1e6 * errors}, {apart.max():.3g} standard errors apart')
    ratio = place.values[f'{name}.ratio'] * step / TEETH
    measured = run.times(teeth)
    raw, corrected, truth = (Window(run, pulses, ratio, header.trigger_cycles)
                             for pulses in (measured, measured - errors, measured - true))
    gain = np.arange(1, run.channels + 1)[:, None]
    orders, known = table[0, :, 0], np.isfinite(table[0, :, 3])
    limit = AMPLITUDE * run.scale
    expected = corrected.amplitudes(orders).mean(axis=0)
    found = table[..., 3] * np.exp(1j * table[..., 4]) / gain
    for zero in place.zeros:
        start = (place.first - zero) // step
        turn = np.exp(-2j * np.pi * ratio * start * orders)
        if (np.abs(found - expected * turn)[:, known].max() < limit and waveform_agrees(
                corrected, start, received.corrected, place.values, gain)):
            break
    else:
        raise WrongAverageError(f'{name}: corrected values of {header} are not those between the '
                                'corrected pulses')
    amplitudes, jittered = (np.abs(item.amplitudes(orders).mean(axis=0)) for item in (truth, raw))
    attenuation = jittered / amplitudes
    allowed = LIMIT * table[..., 6] + limit * (1.0 + attenuation) / amplitudes
    wrong = np.abs(table[..., 5] - attenuation) - allowed
    if wrong[:, known].max() > 0.0:
        raise WrongAverageError(f'{name}: attenuation is {attenuation} and not {table[..., 5]} '
                                f'with standard errors {table[..., 6]}')
    return True
