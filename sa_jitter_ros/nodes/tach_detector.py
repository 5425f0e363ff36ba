# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `tach_detector`: the sampled keyphasor signal, or the angle of a joint, in; pulses out."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.nodes.base import MonitoringNode, run_node
from sa_jitter_ros.nodes.health import Flow
from sa_jitter_ros.nodes.messages import known_type, SAMPLE_TYPES
from sa_jitter_ros.nodes.signals import JointInput, PulseOutput, SampleInput
from sa_jitter_ros.parameters import (
    fixed, Parameter, PULSES_PER_REVOLUTION, sample_parameters, TACH_TYPE, Values)
from sa_jitter_ros.pulses.detection import detector_of
from sa_jitter_ros.pulses.detector_parameters import DECISIVE, DETECTOR_PARAMETERS
from sensor_msgs.msg import JointState

# Once the state levels are learnt, the detector finds all pulses of the window. Subscribers
# queue 200 messages and may be busy with an average: the pulses are published in portions.
BURST = 10
BURST_PERIOD = 0.01  # s

_KNOWN = 20  # pulses after which the error of those of a joint is known

JOINT_TYPE = 'sensor_msgs/JointState'
PARAMETERS = (
    *sample_parameters('tach_waveform'),
    TACH_TYPE,
    fixed('tach_waveform_type', '', 'message type of tach_waveform; empty: that of '
          f'vibration_type; {JOINT_TYPE}: its positions (rad) give the pulses'),
    fixed('joint', '', f'joint of {JOINT_TYPE} to follow; empty: the only one'),
    replace(PULSES_PER_REVOLUTION, read_only=True, description='marks on a revolution of the '
            'joint, one at angle 0'),
    fixed('imu_axis', 'z', 'axis of linear acceleration', choices=('x', 'y', 'z')),
    Parameter('keyphasor', 'keyphasor', 'name of the keyphasor: source of the pulses'),
    *DETECTOR_PARAMETERS,
)


class TachDetector(MonitoringNode):
    """Finds the pulses in `tach_waveform` and publishes them as `tach_pulse`."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('tach_detector', PARAMETERS, **node_kwargs)
        values = self.parameters.values()
        self._values, self._keyphasor = values, values['keyphasor']
        kind = values['tach_waveform_type'].replace('/msg/', '/')
        self._joint = JointInput(
            values['joint'], marks=values['pulses_per_revolution'],
            time_tolerance=values['time_tolerance']) if kind == JOINT_TYPE else None
        self._declared = False  # whether the error of the pulses was logged
        self._samples = SampleInput(self, values if self._joint or not kind else {
            **values, 'vibration_type': known_type('tach_waveform_type', kind, {
                **SAMPLE_TYPES, JOINT_TYPE: JointState})})
        self._timeline = VibrationTimeline(time_tolerance=values['time_tolerance'])
        self._detector = detector_of(values)
        self._run = 0, 0.0  # epoch and sampling rate of what the detector follows
        # The last three are of earlier detectors.
        self._pulses = self._unsendable = self._too_close = self._unused = self._spikes = 0
        self._waiting: deque[float] = deque()
        self._output = PulseOutput(self, values['tach_type'])
        if self._joint:  # several publishers may send the joints of a robot
            self.create_input(JointState, 'tach_waveform', self._on_joint, most_publishers=64)
        else:
            self.create_input(self._samples.message_type, 'tach_waveform', self._on_waveform)
        self._waveform_flow = self.watch_input(
            'waveform', 'tach_waveform', 'look at the acquisition of the keyphasor')
        self._pulse_flow = self.health.add(Flow(
            'pulse', 'pulse in the waveform', 'does the shaft turn? look at keyphasor, cable and '
            'threshold', after=('waveform',)))
        self._burst = self.create_steady_timer(BURST_PERIOD, self._send_waiting)
        self._burst.cancel()  # it runs while pulses wait
        self.parameters.watch(check=detector_of, apply=self._apply)
        self.get_logger().info(f'started: pulses of keyphasor {self._keyphasor!r}')

    def _apply(self, values: Values) -> None:
        self._keyphasor = values['keyphasor']
        if any(values[name] != self._values[name] for name in DECISIVE):
            self._begin(values)
        self._values = values

    def _begin(self, values: Values) -> None:
        """Start another detector, which learns the state levels again."""
        state = self._detector.state
        self._too_close += state.too_close
        self._unused += state.waiting
        self._spikes += state.spikes
        self._detector = detector_of(values)

    def _on_waveform(self, message: Any) -> None:
        block = self._samples.decode(message)
        try:
            if block.samples.shape[0] != 1:
                raise SignalError(f'{block.samples.shape[0]} channels: send only the channel of '
                                  'the keyphasor')
            self._timeline.add(block)
        except SignalError:
            self.counts['messages_rejected'] += 1
            raise
        self._waveform_flow.came()
        for epoch, samples in self._timeline.take():
            if (epoch, samples.sample_rate) != self._run:  # the learnt levels are of another one
                self._begin(self._values)
                self._run = epoch, samples.sample_rate
            self._publish(self._detector.update(
                samples.samples[0], samples.start_time, samples.sample_rate))
        for line in self._timeline.messages:
            self.warn(line)
        self._timeline.messages.clear()

    def _on_joint(self, message: JointState) -> None:
        assert self._joint is not None
        times = self._joint.pulses(message)
        if times is None:
            self.refused[self._waveform_flow.what] = (
                f'joint {self._joint.joint} is not in it, only {", ".join(message.name[:6])}: set '
                'the parameter joint')
            return
        self._waveform_flow.came()
        self._publish(times)
        error = self._joint.crossings.state.pulse_error_std
        if not self._declared and self._pulses >= _KNOWN and np.isfinite(error):
            self._declared = True
            self.get_logger().info(
                f'joint {self._joint.joint}: pulses have an error of {1e6 * error:.3g} us; '
                'declare it to jitter_predictor: jitter_distribution normal, '
                f'jitter_std {error:.3g}')

    def _publish(self, times: FloatArray) -> None:
        self._pulses += len(times)
        if len(times):
            self._pulse_flow.came()
        if self._output.single:
            self._waiting.extend(times.tolist())
            self._send_waiting()
        else:
            self._send(times)

    def _send_waiting(self) -> None:
        count = min(max(BURST, len(self._waiting) // 100), len(self._waiting))
        self._send(np.array([self._waiting.popleft() for _ in range(count)]))
        if not self._waiting:
            self._burst.cancel()
        elif self._burst.is_canceled():
            self._burst.reset()

    def _send(self, times: FloatArray) -> None:
        self._unsendable += self._output.publish(times, self._keyphasor)

    def update_counts(self) -> None:
        """Collect the counts of timeline and detector."""
        self._samples.show_warning()
        samples, state = self._timeline.counts, self._detector.state
        self.counts.update(
            samples_dropped=samples.samples_dropped + self._unused,
            pulses_dropped=self._too_close + state.too_close + self._unsendable,
            gaps=samples.gaps, restarts=samples.restarts,
            clock_deviation=samples.clock_deviation, repeats=samples.repeats,
            samples_lost=samples.samples_lost, spikes=self._spikes + state.spikes)
        if self._joint:
            joint = self._joint.crossings.state
            self.counts.update(samples_dropped=joint.dropped, gaps=joint.gaps,
                               restarts=joint.restarts)

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return the numbers of pulses found and of subscribers, the levels, the threshold."""
        values: dict[str, object] = {
            'pulses': self._pulses, 'subscribers': self._output.subscribers}
        if self._joint:
            text, others = self._joint.summary()
            return text, {**others, **values}
        state = self._detector.state
        values = {**{key: f'{getattr(state, key):.6g}' for key in ('low', 'high', 'threshold')},
                  'polarity': state.polarity, **values}
        if self._timeline.layout is None:
            return 'no waveform received yet', values
        if np.isnan(state.threshold):
            return 'learning the state levels', values
        return f'{self._pulses} pulses at threshold {state.threshold:.6g}', values


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(TachDetector, args)


if __name__ == '__main__':
    raise SystemExit(main())
