"""Target geometry: marks off their even places, an error that repeats with the pulse index."""

from dataclasses import dataclass
import math
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import (
    Array, Effect, most_scenarios, parameter, Pulses, require_in_turn)
from sa_jitter_ros.effects.evidence import absent, Evidence, Finding
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.statistics.prediction import DeclaredModel
from scipy import stats

_LONGEST = 24
_SIGNIFICANT = 1e-4
# In favour of the number of marks that the target has.
_KNOWN = 10.0


@dataclass(frozen=True)
class TargetGeometry(Effect):
    """Pulse k comes late by `pulse_angles`[k mod n] rad of the tach shaft."""

    name: ClassVar[str] = 'target_geometry'
    summary: ClassVar[str] = 'marks of the target off their even places'
    of_pulses: ClassVar[bool] = True
    pulse_angles: tuple[float, ...] = parameter(
        (), 'angle by which each mark of the target is late', 'rad')

    def __post_init__(self) -> None:
        """Check every angle."""
        if not isinstance(self.pulse_angles, tuple):
            raise ParameterError(f'target_geometry.pulse_angles is {self.pulse_angles}: give a '
                                 'list of angles in rad, one for each mark')
        super().__post_init__()

    def _at(self, model: DeclaredModel, index: Array) -> Array:
        """Return the errors in s of the trigger pulses `index`."""
        step = model.pulses_per_trigger or model.pulses_per_revolution
        angles = np.asarray(self.pulse_angles)[index * step % len(self.pulse_angles)]
        return np.asarray(angles / (2.0 * np.pi * model.trigger_speed))

    def scenarios(self, model: DeclaredModel) -> Array | None:
        """Return the errors for every mark that an average may begin with."""
        if not any(self.pulse_angles):
            return None
        require_in_turn('the spread of target_geometry.pulse_angles', (
            max(self.pulse_angles) - min(self.pulse_angles)) / (2.0 * np.pi * model.trigger_speed),
            model)
        kept = most_scenarios(model, len(self.pulse_angles))
        first = (np.arange(kept) * len(self.pulse_angles) // kept)[:, None]
        return self._at(model, first + np.arange(model.trigger_cycles + 1))

    def pattern(self, model: DeclaredModel, pulses: Pulses) -> Array | None:
        """Return the errors of the pulses at hand."""
        return self._at(model, pulses.index) if self.pulse_angles else None

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fold the pulse errors by the pulse index, with every period that fits several times."""
        model = evidence.model
        count = evidence.errors.shape[1]
        marks = model.pulses_per_revolution
        step = model.pulses_per_trigger or marks
        own = marks // math.gcd(marks, step)
        periods = {own, *range(2, min(_LONGEST, count // 2) + 1)} & set(range(2, count - 2))
        if len(evidence.errors) < 3 or not periods:
            return absent(cls.name, 'too few pulses to fold by the pulse index')
        folds = {p: _folded(evidence, p) for p in sorted(periods)}
        best = min(folds, key=lambda p: folds[p][3] - (_KNOWN if p == own else 0.0))
        mean, log_p_value, error, _ = folds[best]
        choices = 1 if best == own else len(folds)
        p_value = min(1.0, math.exp(max(log_p_value, -690.0)) * choices)
        size = float(np.sqrt(np.mean(mean**2)))
        text = (f'the pulse errors repeat every {best} trigger pulses with {size:.3g} s, '
                f'p = {p_value:.2g}')
        if p_value > _SIGNIFICANT:
            return absent(cls.name, 'the pulse errors do not repeat with the pulse index: best '
                          f'period {best}, p = {p_value:.2g}', p_value=p_value)
        length = marks if best == own and own * step >= marks and marks > 1 else best * step
        angles, errors = np.zeros(length), np.zeros(length)
        places = (np.arange(best) * step) % length
        angles[places] = 2.0 * np.pi * model.trigger_speed * mean
        errors[places] = 2.0 * np.pi * model.trigger_speed * error
        return Finding(cls.name, cls(tuple(angles.tolist())),
                       {'pulse_angles': errors.tolist()}, p_value, text)


def _folded(evidence: Evidence, period: int) -> tuple[Array, float, float, float]:
    """
    Return each phase's mean error, log p value of their repeating, standard error, and BIC.

    The p value comes from how acquisitions agree, which any memory of the errors leaves valid; the
    Bayesian information criterion compares periods. Errors at the ends are rough and left out.
    """
    table, phases = [], []
    for row, pulses in zip(evidence.errors, evidence.pulses):
        phase = pulses.index[1:-1] % period
        folded = np.bincount(phase, row[1:-1], period) / np.bincount(phase, minlength=period)
        table.append(folded - folded.mean())
        phases.append(phase)
    rows = np.array(table)
    count = len(rows)
    mean = rows.mean(axis=0)
    between = np.sum((rows - mean) ** 2) / ((count - 1) * (period - 1))
    ratio = count * np.sum(mean**2) / (period - 1) / max(between, 1e-300)
    log_p_value = float(stats.f.logsf(ratio, period - 1, (count - 1) * (period - 1)))
    left = evidence.errors[:, 1:-1] - mean[np.array(phases)]
    left = left - left.mean(axis=1, keepdims=True)
    criterion = left.size * math.log(float(np.mean(left**2))) + period * math.log(left.size)
    error = float(np.sqrt(between * (period - 1) / period / count))
    return mean, log_p_value, error, criterion
