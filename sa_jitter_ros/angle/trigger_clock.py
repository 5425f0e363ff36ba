"""From accepted pulses to trigger pulses: counting teeth."""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]


class TriggerClock:
    """
    Count the teeth of runs of pulses and give the time of every `teeth_per_trigger`-th.

    A run begins at tooth 0. Its first trigger pulse is given together with the second, which makes
    it the start of a whole trigger cycle; runs without one leave no trace but a discarded cycle.
    """

    def __init__(self, *, teeth: int, teeth_per_trigger: int) -> None:
        self._teeth, self._per_trigger = teeth, teeth_per_trigger
        self._times: list[float] = []  # of the last pulse and those since the last count
        self._steps: list[int] = []
        self._target = 0  # tooth of the next trigger pulse
        self._starting = False
        self._start: float | None = None
        self._found: list[tuple[FloatArray, BoolArray, BoolArray]] = []
        self._restarted = False
        self.discarded = 0

    @property
    def running(self) -> bool:
        """Whether there is a run to which pulses can be added."""
        return bool(self._times)

    def begin(self, time: float, tooth: int) -> None:
        """Begin a run at a pulse (s) of the tooth of this number."""
        self.stop()
        self._times, self._steps = [time], [tooth]
        self._target = 0 if tooth == 0 else self._teeth
        self._starting = True

    def extend(self, times: list[float], steps: list[int]) -> None:
        """Add pulses (s) to the run, each `steps` teeth after the one before."""
        self._times += times
        self._steps += steps

    def stop(self) -> None:
        """End the run and discard its unfinished trigger cycle."""
        if self.running:
            self._count()
            self.discarded += not self._starting or self._start is not None
        self._times, self._steps, self._start = [], [], None

    def restart(self) -> None:
        """Mark the start of the next run as one for which time ran back."""
        self._restarted = True

    def take(self) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Return the new trigger pulses (s), which start a run, and which do after a restart."""
        if self.running:
            self._count()
        found, self._found = self._found, []
        if not found:
            return np.empty(0), np.empty(0, np.bool_), np.empty(0, np.bool_)
        times, starts, restarts = (np.concatenate(part) for part in zip(*found, strict=True))
        return times, starts, restarts

    def _count(self) -> None:
        teeth = np.cumsum(self._steps)
        targets = np.arange(self._target, teeth[-1] + 1, self._per_trigger)
        # Teeth that are missing stand evenly between their neighbours.
        times = np.interp(targets, teeth, self._times)
        self._target += targets.size * self._per_trigger
        self._times, self._steps = self._times[-1:], [int(teeth[-1]) - self._target]
        self._target = 0
        if self._starting:
            times = np.append([] if self._start is None else self._start, times)
            if times.size < 2:
                self._start = float(times[0]) if times.size else None
                return
        if times.size:
            starts, restarts = np.zeros((2, times.size), np.bool_)
            if self._starting:
                starts[0], restarts[0] = True, self._restarted
                self._starting = self._restarted = False
                self._start = None
            self._found.append((times, starts, restarts))
