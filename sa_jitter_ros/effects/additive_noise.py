"""Additive noise: white noise on the vibration that the declared model lacks."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from sa_jitter_ros.effects.effect import Array, Effect, parameter
from sa_jitter_ros.effects.evidence import absent, Evidence, Finding
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.statistics.moments import noise_line_variance
from sa_jitter_ros.statistics.prediction import DeclaredModel


@dataclass(frozen=True)
class AdditiveNoise(Effect):
    """White noise of `std` per vibration sample, on top of the declared noise."""

    name: ClassVar[str] = 'additive_noise'
    summary: ClassVar[str] = 'white noise on the vibration'
    scatters: ClassVar[bool] = True
    std: float = parameter(0.0, 'standard deviation per sample, units as noise_std', '1',
                           minimum=0.0)

    def line_variance(self, model: DeclaredModel) -> Array:
        """Return E|n|^2 of a peak amplitude; raise ModelError without a sample rate."""
        if self.std > 0.0 and not model.sample_rate > 0.0:
            raise ModelError('sample_rate is 0: additive_noise.std is per sample, so declare '
                             'sample_rate')
        variance = (noise_line_variance(self.std, model.sample_rate, model.duration)
                    if self.std > 0.0 else 0.0)
        return np.full(len(model.orders), variance)

    @classmethod
    def fit(cls, evidence: Evidence) -> Finding:
        """Fit the noise around the lines, beyond what was declared."""
        lines = evidence.lines
        known = evidence.model.noise_std**2 + sum(
            effect.std**2 for effect in evidence.explained if isinstance(effect, cls))
        excess = lines.noise_density**2 - known
        value = float(np.median(excess))
        count = lines.radial.shape[0] * lines.radial.shape[1]
        error = 1.5 * float(np.median(lines.noise_density**2)) * np.sqrt(
            2.0 / count / max(excess.size, 1))
        if value <= 4.0 * error:
            return absent(cls.name, 'the noise around the lines is the declared one')
        std = float(np.sqrt(value))
        text = (f'the lines scatter as white noise of {np.sqrt(value + known):.3g} per sample '
                f'would make them, {np.sqrt(known):.3g} was declared')
        return Finding(cls.name, cls(std), {'std': error / (2.0 * std)}, 1e-9, text)
