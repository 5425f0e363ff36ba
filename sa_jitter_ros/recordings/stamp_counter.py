"""Which sample a message holds that has a stamp and no index, as `sensor_msgs/Imu`."""

TIME_TOLERANCE = 0.01  # s; a clock that jumps back by more starts a new run
LOSS = 0.75  # samples later than the clock that is followed: more than jitter of 0.7 brings
FOLLOW = 0.05  # share of a deviation that the clock takes over: at 3 % of another rate it lags 0.6
EVIDENCE = 13.0  # of lateness, in variances: white jitter brings as much once in 1e8 stamps


class StampCounter:
    """
    Counts samples by their stamps; a loss is a lasting step of the stamps by whole samples.

    The stamps are compared with a clock that follows them slowly, so that a source whose rate is
    up to 3 % off `sample_rate` (Hz) loses nothing, and neither does jitter of up to 0.7 samples,
    as the next stamp comes early. Where stamps are steady, a loss is seen at once; where they are
    noisy, it takes the evidence of some stamps (Page's test), and the gap stands that much later.
    `restarts` counts jumps back, from which on samples are counted anew.
    """

    def __init__(self, sample_rate: float) -> None:
        self.restarts = 0
        self._rate = sample_rate
        self._last: float | None = None  # stamp
        self._start(0.0)

    def _start(self, time: float) -> None:
        self._index, self._expected = 0, time
        self._late, self._variance = 0.0, 0.01  # samples and samples^2, against the clock
        self._surplus, self._doubtful = 0.0, 0  # lateness, and of how many stamps

    def index(self, time: float) -> int:
        """Return the index of the next sample, stamped `time` (s)."""
        if self._last is None:
            self._start(time)
        elif time < self._last - max(TIME_TOLERANCE, 1.0 / self._rate):
            self.restarts += 1
            self._start(time)
        late = (time - self._expected) * self._rate
        self._surplus = max(0.0, self._surplus + late - LOSS)
        self._doubtful = self._doubtful + 1 if self._surplus else 0
        lost = 0
        if self._surplus > EVIDENCE * self._variance:
            lost = max(1, round(LOSS + self._surplus / self._doubtful))
            self._surplus, self._doubtful = 0.0, 0
        gain = max(FOLLOW, 1.0 / (self._index + 1.0))
        # Of differences, as another rate is no noise; with steps, so that bursts are no losses.
        self._variance += gain * (0.5 * (late - self._late)**2 - self._variance)
        late -= lost
        found = self._index + lost
        self._index, self._late, self._last = found + 1, late, time
        self._expected += (lost + 1 + gain * late) / self._rate
        return found
