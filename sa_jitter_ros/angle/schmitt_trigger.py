"""Threshold crossings that a signal confirms by leaving a band around the threshold."""

import numpy as np
import numpy.typing as npt

__all__ = ['SchmittTrigger']

FloatArray = npt.NDArray[np.float64]


class SchmittTrigger:
    """
    Find the threshold crossings of one stream of finite samples, whatever its blocks.

    :param interpolate: False puts a crossing on the first sample past the threshold.
    """

    def __init__(self, *, interpolate: bool) -> None:
        self._interpolate = interpolate
        self._previous: float | None = None
        self._high: bool | None = None
        self._crossing: float | None = None  # the last one, not yet confirmed

    def update(
        self, samples: FloatArray, index: int, threshold: float, band: float,
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """
        Return the crossings that these samples (n,) confirm and which of them rise, (c,) each.

        `index` is the place of the first sample in the stream; crossings are such places, not
        whole numbers if interpolated. `band` is half the hysteresis, in the unit of the samples.
        What the signal does before it first leaves the band is no crossing.
        """
        if self._previous is None:
            self._previous = float(samples[0])
        signal = np.concatenate(([self._previous], samples))
        above = signal >= threshold
        after = np.flatnonzero(above[1:] != above[:-1])  # first sample past the threshold
        positions = (index + after).astype(np.float64)
        if self._interpolate:
            before, past = signal[after], signal[after + 1]
            positions += (threshold - before) / (past - before) - 1.0
        high = samples >= threshold + band
        decided = np.flatnonzero(high | (samples < threshold - band))
        level = high[decided]
        if self._high is None and decided.size:
            self._high = bool(level[0])
        changes = np.flatnonzero(level != np.append(bool(self._high), level)[:-1])
        confirmed, rising = decided[changes], level[changes]
        # The last crossing before the decision has the direction of the change, whatever noise
        # made the signal cross inside the band before.
        last = np.searchsorted(after, confirmed, side='right') - 1
        held = np.nan if self._crossing is None else self._crossing
        found = np.where(last >= 0, np.append(positions, held)[last], held)
        found = np.where(np.isnan(found), index + confirmed, found)
        if after.size:
            self._crossing = float(positions[-1])
        if decided.size:
            self._high = bool(level[-1])
            if not after.size or after[-1] <= decided[-1]:
                self._crossing = None
        self._previous = float(samples[-1])
        return found, rising
