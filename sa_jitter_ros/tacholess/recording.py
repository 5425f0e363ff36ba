# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""A recording with pulses that were found without a tach, or where its tach was lost."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.machine import Machine
from sa_jitter_ros.recordings.recording import Recording
from sa_jitter_ros.tacholess.find import find_pulses
from sa_jitter_ros.tacholess.found import FoundPulses


@dataclass(frozen=True)
class Tacholess:
    """
    How pulses are found: the range of the speed of the tach shaft (Hz), and the orders of a comb.

    Without `orders` they are those of the machine, else those of the recording. With `bridge` the
    pulses of the tach stay, and only those are added that it lost.
    """

    speed_range: tuple[float, ...]
    orders: tuple[float, ...] = ()
    bridge: bool = False

    def pulses_of(self, recording: Recording, machine: Machine
                  ) -> tuple[Recording, FoundPulses | None]:
        """
        Return a recording with the pulses found, and their errors, None where a tach is bridged.

        A remark says what was found. Raises ParameterError and SignalError as `find_pulses`.
        """
        orders: Sequence[float] | None = self.orders or None
        if orders is None and not machine.shafts:
            orders = [order * recording.ratio for order in recording.orders]
            if not orders:
                raise ParameterError('no orders to find pulses from: give --comb, the machine by '
                                     'its parts, or --field orders=...')
        found = find_pulses(recording.read(), recording.sample_rate, orders=orders,
                            machine=machine, speed_range=self.speed_range,
                            start_time=recording.start_time)
        if self.bridge:
            times = recording.keyphasor_pulses()
            bridged = found.bridged(times, recording.pulses_per_revolution)
            return replace(recording, pulse_times=bridged, tach=None, remarks=(
                *recording.remarks, f'{len(bridged) - len(times)} pulses that the tach lost were '
                f'found in the vibration')), None
        return replace(
            recording, pulse_times=found.times, tach=None, tach_rate=None,
            pulses_per_revolution=1, pulses_per_trigger=None, missing_teeth=0, target_angles=(),
            reference_pulse_times=None, remarks=(*recording.remarks, summary(found))), found


def summary(found: FoundPulses) -> str:
    """Return one line: what was found, how well, and what is arbitrary."""
    errors = 1e6 * float(np.median(found.standard_errors))
    orders = ', '.join(f'{order:g}' for order in found.used)
    return (f'no tach: {len(found.times)} pulses from orders {orders}, at {found.speed.min():.5g} '
            f'to {found.speed.max():.5g} Hz, +- {errors:.3g} us; phase 0 is arbitrary, and '
            'the bias of these orders is corrected'
            + (f'; {found.reason}' if found.reason else ''))
