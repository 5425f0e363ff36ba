# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `synchronous_averager`: vibration and tach pulses in, synchronous averages out."""

from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.averager_parameters import (
    gear_settings, keyphasor_parameters, one_ratio, PARAMETERS, shaft_parameters, shaft_settings,
    streaming_averager)
from sa_jitter_ros.averaging.interpolator_gain import without_amplitude
from sa_jitter_ros.averaging.standing_orders import without_lines
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.nodes.averager_output import ShaftOutput
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.health import Flow
from sa_jitter_ros.nodes.messages import (
    decode_pulse_array, decode_pulse_reference, encode_geometry, known_type, PULSE_TYPES)
from sa_jitter_ros.nodes.signals import ChannelWatch, SampleInput
from sa_jitter_ros.parameters import require_shaft_names, Values
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.recordings.channel_units import channels_of
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float64, Float64MultiArray

_LATEST = 6  # averages that tell whether orders hold lines
_SUMMARY_PAUSE = 1.0  # s between summaries of averages that come once a trigger cycle
MOST_SOURCES = 100  # names of keyphasors that are remembered


class SynchronousAverager(MonitoringNode):
    """Averages `vibration` synchronously with `tach_pulse`, for every shaft."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('synchronous_averager', PARAMETERS, **node_kwargs)
        names = self.parameters.values()['shafts']
        require_shaft_names('shafts', names)
        for name in names:
            self.parameters.declare(shaft_parameters(name))
        values = self.parameters.values()
        given = self.parameters.given_values
        for name in names:
            if values[f'{name}.ratio_teeth'] and f'{name}.ratio' in given:
                raise one_ratio(values, name)
        limits = LimitWatch(self.parameters.machine, names, list(channels_of(given)),
                            labels=lambda count: self._samples.scale_of(count).labels)
        self._shafts = {name: ShaftOutput(self, name, limits) for name in names}
        self._latest = {name: deque[Average](maxlen=_LATEST) for name in names}
        self._averager = streaming_averager(values, buffer_seconds=values['buffer_seconds'])
        for name, shaft in self._shafts.items():
            shaft.use(gear_settings(values, name))
        self._values = values
        self._revolutions = keyphasor_parameters(values).revolutions_per_trigger
        self._keyphasor: str | None = values['keyphasor'] or None
        self._sources: set[str] = set()  # of tach pulses
        self._other_keyphasors, self._cycles_per_second = 0, 0.0
        self._samples = SampleInput(self, values, self.parameters.declare_channels())
        self._channels = ChannelWatch()
        pulse_type = PULSE_TYPES[known_type('tach_type', values['tach_type'], PULSE_TYPES)]
        self._speed = self.create_output(Float64, 'shaft_speed')
        self._target = self.create_output(Float64MultiArray, 'target_geometry', LATCHED_QOS)
        self._geometry: MarkOffsets | None = None  # the latest that was published
        self.create_input(self._samples.message_type, 'vibration', self._on_vibration)
        self._tach = self.create_input(
            pulse_type, 'tach_pulse', self._on_pulse_reference if pulse_type is TimeReference else
            lambda message: self._add_pulses(decode_pulse_array(message)))
        self._vibration_flow = self.watch_input(
            'vibration', 'vibration', 'look at sensor, amplifier and acquisition')
        self._pulse_flow = self.watch_input(
            'pulse', 'tach_pulse', 'does the shaft turn? look at keyphasor, cable and threshold')
        self._average_flow = self.health.add(Flow(
            'average', 'average', 'do the times of vibration and pulses overlap?',
            after=('vibration', 'pulse')))
        self.parameters.watch(check=self._check, apply=self._apply)
        self.get_logger().info(f'started: averages {values["trigger_cycles"]} trigger cycles of '
                               f'{", ".join(names)}')

    # --- parameters ---

    def _check(self, values: Values) -> None:
        keyphasor_parameters(values).validator()
        for name in self._shafts:
            shaft_settings(values, name)
            gear_settings(values, name)

    def _apply(self, values: Values) -> None:
        before, self._values = self._values, values
        keyphasor = keyphasor_parameters(values)
        self._revolutions = keyphasor.revolutions_per_trigger
        if keyphasor != keyphasor_parameters(before):
            self._averager.change_pulses(keyphasor.validator())
        changed = {name: shaft_settings(values, name) for name in self._shafts}
        if changed != {name: shaft_settings(before, name) for name in self._shafts}:
            self._averager.change(changed)
        for name, shaft in self._shafts.items():
            shaft.use(gear_settings(values, name))

    # --- messages ---

    def _on_vibration(self, message: Any) -> None:
        block = self._samples.decode(message)
        try:
            averages = self._averager.add_samples(block)
        except SignalError:
            self.counts['messages_rejected'] += 1
            raise
        self._vibration_flow.came()
        self._channels.add(block.samples)
        self._publish(averages)

    def _on_pulse_reference(self, message: Any) -> None:
        times, source = decode_pulse_reference(message)
        if self._keyphasor is None:
            self._keyphasor = source
        if source not in self._sources and len(self._sources) < MOST_SOURCES:
            self._sources.add(source)
        if source != self._keyphasor:
            self._other_keyphasors += 1
            reason = (f'pulses of keyphasor {source!r} are ignored, those of {self._keyphasor!r} '
                      f'are used: restart with keyphasor: {source} to use them')
            if not self._values['keyphasor']:
                raise SignalError(reason)
            self.refused[self._tach.topic_name] = reason
            return
        self._add_pulses(times)

    def _add_pulses(self, times: FloatArray) -> None:
        if times.size:
            self._pulse_flow.came()
        self._publish(self._averager.add_pulses(times))

    def _publish(self, averages: Sequence[tuple[str, Average]]) -> None:
        with ExitStack() as stack:  # an error of one does not keep the others
            for name, average in reversed(averages):
                stack.callback(self._publish_average, name, average)
        speed = self._averager.take_speed() * self._revolutions
        if np.isfinite(speed):
            self._speed.publish(Float64(data=float(speed)))
            self._cycles_per_second = speed / self._revolutions
        for name, doubt in self._averager.doubts.items():
            self.set_missing(f'pulses against the vibration of {name}', doubt)
        geometry = self._averager.geometry
        if geometry is not None and geometry is not self._geometry:
            self._target.publish(encode_geometry(geometry))
            self._geometry = geometry
        for line in self._averager.take_messages():
            self._average_flow.look_at = line
            self.warn(line)

    def _publish_average(self, name: str, average: Average) -> None:
        self._average_flow.came()
        self._shafts[name].publish(
            average, self._samples.scale_of(len(average.waveform)),
            0.0 if self._values['averaging'] == 'block' else _SUMMARY_PAUSE)
        self.set_missing(f'orders of {name}', without_amplitude(average.refused))
        if f'{name}.orders' in self.parameters.given_values:
            self._latest[name].append(average)
            self.set_missing(f'lines of {name}', without_lines(
                self._latest[name], fewest=_LATEST))

    # --- diagnostics ---

    def update_counts(self) -> None:
        """Collect the counts of the averager."""
        averager = self._averager
        self._samples.show_warning()
        self.counts.update(averager.totals)
        self._channels.say(self)
        if not self._values['keyphasor']:  # which makes others expected
            self.counts['pulses_dropped'] += self._other_keyphasors
        if self._cycles_per_second:
            self._average_flow.allowance = (
                self._values['trigger_cycles'] / self._cycles_per_second)
        if self._tach.msg_type is TimeReference:  # each keyphasor may have a publisher
            self.most_publishers[self._tach.topic_name] = len(self._sources)

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return the number of averages and the counts of the pulse validation."""
        averager = self._averager
        layout = averager.timeline.layout
        published = sum(shaft.published for shaft in self._shafts.values())
        values = {'trigger_cycles': averager.counts.cycles, 'averages': published,
                  'keyphasor': self._keyphasor or '', 'pulses_of_others': self._other_keyphasors,
                  **{f'pulses_{key}': count
                     for key, count in asdict(averager.pulse_counts).items()}}
        if averager.geometry is not None:
            values['target_geometry'] = averager.geometry
        for name, shaft in self._shafts.items():
            if shaft.refused:
                values |= {f'{name}.corrections_refused': shaft.refused,
                           f'{name}.refusal': shaft.refusal}
        if layout is None:
            return 'no vibration received yet', values
        values.update(channels=layout[0], sample_rate=f'{layout[1]:.10g}')
        if not averager.counts.cycles:
            return 'no trigger cycle completed yet', values
        return f'{published} averages of {averager.counts.cycles} trigger cycles', values


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(SynchronousAverager, args)


if __name__ == '__main__':
    raise SystemExit(main())
