# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recordings with pulses made worse, whose original pulses become the reference."""

from dataclasses import replace

import numpy as np
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.prediction.distributions import PulseErrorDistribution
from sa_jitter_ros.recordings.recording import Recording


def with_added_jitter(recording: Recording, distribution: PulseErrorDistribution, *, seed: int
                      ) -> Recording:
    """
    Return the recording with random errors added to its pulses, which become the reference.

    Section 5.2 of Camerini et al. 2019.
    """
    times = recording.keyphasor_pulses(interpolate=False)
    errors = distribution.draw(np.random.default_rng(seed), times.size)
    return replace(recording, pulse_times=np.sort(times + errors), tach=None,
                   reference_pulse_times=times)


def with_slower_clock(recording: Recording, clock_rate: float) -> Recording:
    """
    Return the recording with its pulses timed by a clock of `clock_rate` Hz, rounded up.

    The unrounded pulses become the reference. Section 5.1.2 of Camerini et al. 2019.
    """
    if not clock_rate > 0.0:
        raise ModelError(f'clock_rate is {clock_rate} Hz: give a positive rate')
    better = recording.reference_pulse_times
    times = recording.keyphasor_pulses(interpolate=False) if better is None else better
    return replace(recording, pulse_times=np.ceil(times * clock_rate) / clock_rate, tach=None,
                   tach_rate=clock_rate, reference_pulse_times=times)
