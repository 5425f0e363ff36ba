# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `change_monitor`: tells whether the machine has changed, and keeps its baseline."""

from collections.abc import Sequence
from functools import partial
import json
import math
import os
from pathlib import Path
import time
from typing import Any
from urllib.parse import quote

from rclpy.parameter import Parameter as RosParameter
from sa_jitter_ros.errors import MessageError, ParameterError, RecordingError
from sa_jitter_ros.machine import LEVELS
from sa_jitter_ros.monitoring.limits import LimitWatch
from sa_jitter_ros.monitoring.machine_monitor import MachineMonitor
from sa_jitter_ros.monitoring.monitor import PARAMETERS as TEST_PARAMETERS, Settings
from sa_jitter_ros.monitoring.operating import OperatingState
from sa_jitter_ros.monitoring.quantities import KINDS
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.health import first_of, Flow
from sa_jitter_ros.nodes.messages import decode_average, known_type
from sa_jitter_ros.nodes.result_flows import ResultFlows, UNCORRECTED
from sa_jitter_ros.parameters import (
    fixed, HARDWARE_ID, Parameter, require_shaft_names, STALE_AFTER, Values)
from sa_jitter_ros.recordings.channel_units import channels_of, scale_of
from std_msgs.msg import Float64, Float64MultiArray, String

#: Message types of `operating_state`.
STATE_TYPES: dict[str, type] = {
    'std_msgs/Float64': Float64, 'std_msgs/Float64MultiArray': Float64MultiArray}
PARAMETERS = (
    fixed('shafts', ['shaft'], 'names of the shafts'),
    *TEST_PARAMETERS,
    Parameter('severe_change', 0.25, 'relative change that is an error, if larger by two standard '
              'errors; others are warnings', above=0.0, maximum=1e6),
    fixed('baseline_file', '', 'file of the baseline; empty: '
          'sa_jitter_ros/<hardware_id>.<node>.npz in ROS_HOME, by default ~/.ros; none: not kept'),
    Parameter('relearn', False, 'learn a new baseline; the old file is kept, with a number '
              'in its name'),
    fixed('operating_state_type', 'std_msgs/Float64', 'message type of operating_state; '
          'std_msgs/Float64MultiArray is [time on the clock of the averages, value]'),
)
_NOT_KEPT = 'none'
_SAVE_PERIOD = 60.0  # s between writings of the file, unless something happens


class ChangeMonitor(MonitoringNode):
    """
    Publishes `change` after each average: how far the baseline is, and what has changed.

    A baseline file that cannot be used is an error that lasts: nothing is monitored, and the file
    stays as it is.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('change_monitor', PARAMETERS, **node_kwargs)
        self._values = values = self.parameters.values()
        shafts = values['shafts']
        require_shaft_names('shafts', shafts)
        if values['relearn']:
            raise ParameterError('relearn is true: set it while the node runs')
        self._path = baseline_path(values['baseline_file'], values[HARDWARE_ID.name],
                                   self.get_fully_qualified_name())
        self._state_type = STATE_TYPES[known_type(
            'operating_state_type', values['operating_state_type'], STATE_TYPES)]
        self._state = OperatingState(stamped=self._state_type is Float64MultiArray)
        self._hold()
        self._begin()
        self._change = self.create_output(String, 'change', LATCHED_QOS)
        for shaft in shafts:
            for kind in KINDS:
                self.create_input(Float64MultiArray, f'{shaft}/{kind}',
                                  partial(self._on_array, shaft, kind))
        self._flows = ResultFlows(self, shafts, KINDS[1:])
        self._state_flow: Flow | None = None
        if Settings.of(values).uses_state:
            self.create_input(self._state_type, 'operating_state', self._on_state)
            self._state_flow = self.watch_input('operating_state', 'operating_state',
                                                'averages without it are discarded')
        self.parameters.watch(check=Settings.of, apply=self._apply)
        self._publish()
        if self._monitor is not None:
            self._show()
            known = (f'baseline of {self._monitor.averages} averages in {self._path}'
                     if self._path else 'the baseline is lost when the node ends')
            self.get_logger().info(f'started: monitors {", ".join(shafts)}; {known}')

    def _begin(self, *, anew: bool = False) -> None:
        """Begin to monitor with the baseline of the file, or with none."""
        values = self._values
        self._monitor: MachineMonitor | None = None
        self._fail('baseline', '')
        parts, channels = self.parameters.machine, channels_of(self.parameters.given_values)
        limits = LimitWatch(parts, values['shafts'], list(channels),
                            labels=lambda count: scale_of(channels, count).labels)
        try:
            self._monitor = MachineMonitor(
                values[HARDWARE_ID.name], values['shafts'], Settings.of(values), self._path,
                parts=parts, limits=limits, anew=anew, state=self._state)
            self._save(self._monitor, trial=True)
        except RecordingError as error:
            self._fail('baseline', str(error))

    def _hold(self) -> None:
        """Let a value of the operating state count until it is stale."""
        self._state.hold = self.get_parameter(STALE_AFTER.name).value or math.inf

    def keep_state(self) -> None:
        """Write the baseline."""
        if self._monitor is not None:
            self._monitor.finish()
            if self._monitor.unsaved:
                self._save(self._monitor)

    def destroy_node(self) -> None:
        """Keep the baseline and destroy the node."""
        self._close()
        super().destroy_node()

    def _close(self) -> None:
        self.keep_state()
        if self._monitor is not None:
            self._monitor.close()

    def _apply(self, values: Values) -> None:
        self._values = values
        self._hold()
        if values['relearn']:
            self._close()
            self._missing.pop('the machine has changed', None)
            for shaft in values['shafts']:
                self._fail(f'baseline of {shaft}', '')
            self._begin(anew=True)
            if self._monitor is not None:
                self.get_logger().info('a new baseline is learnt')
            self._publish()
            self.set_parameters([RosParameter('relearn', value=False)])
        elif self._monitor is not None:
            self._monitor.use(Settings.of(values))
            self._show()

    def _fail(self, what: str, reason: str) -> None:
        """Show an error that lasts until the reason is ''; log it once."""
        if reason and self.faults.get(what) != reason:
            self.get_logger().error(reason)
        self.set_fault(what, reason)

    # --- messages ---

    def _on_state(self, message: Any) -> None:
        numbers = [message.data] if self._state_type is Float64 else message.data
        if len(numbers) != 1 + (self._state_type is Float64MultiArray):
            raise MessageError(f'{len(numbers)} numbers: publish [time in s, value]')
        self._state.add(numbers[-1], numbers[0])
        if self._state_flow is not None:
            self._state_flow.came()

    def _on_array(self, shaft: str, kind: str, message: Float64MultiArray) -> None:
        decoded = decode_average(kind, message)
        self._flows.came(shaft, kind, decoded)
        if self._monitor is None:
            return
        before = self._monitor.averages
        try:
            lines = self._monitor.take(shaft, kind, decoded)
        except ParameterError as error:
            self._fail(f'baseline of {shaft}', f'{self._path or "baseline"}: {error}')
            return
        if self._monitor.averages != before:
            self._fail(f'baseline of {shaft}', '')
        for line in lines:
            self.get_logger().warning(line)
        if lines or self._monitor.averages != before:
            self._show()
            self._publish()
            due = time.monotonic() - self._saved > _SAVE_PERIOD
            if lines or due or self._monitor.is_complete != self._was_complete:
                self._save(self._monitor)

    def _save(self, monitor: MachineMonitor, *, trial: bool = False) -> None:
        """Write the baseline to its file, or try to, and say if that is not possible."""
        self._saved, self._was_complete = time.monotonic(), monitor.is_complete
        try:
            (monitor.try_to_save if trial else monitor.save)()
        except RecordingError as error:
            self.set_missing('baseline file', f'{error}; it is tried again every '
                             f'{_SAVE_PERIOD:.0f} s')
        else:
            self.set_missing('baseline file', '')

    def _show(self) -> None:
        """Show limits and changes in the status: alarms and severe changes as errors."""
        assert self._monitor is not None
        passed = self._monitor.limits.passed()
        self.set_fault('limit', first_of(
            [str(item) for item in passed if item.level == LEVELS[-1]]))
        self.set_missing('a limit is passed', first_of(
            [str(item) for item in passed if item.level != LEVELS[-1]]))
        severe: list[str] = []
        others: list[str] = []
        for item in self._monitor.changes():
            least = abs(item.change) - 2.0 * item.standard_error
            (severe if least >= self._values['severe_change'] else others).append(str(item))
        self.set_fault('change', first_of(severe))
        self.set_missing('the machine has changed', first_of(others))

    def _publish(self) -> None:
        content = self._monitor.report() if self._monitor is not None else {
            'baseline': {'averages': 0, 'complete': False}, 'changes': []}
        self._change.publish(String(data=json.dumps(content, allow_nan=False)))

    # --- diagnostics ---

    def update_counts(self) -> None:
        """Count averages left out; say which shafts have no corrected amplitudes."""
        if self._monitor is None:
            return
        found = self._monitor.monitors
        for name in self._monitor.limits.names:
            self.set_missing(f'limit {name}', self._monitor.limits.missing.get(name, ''))
        self.counts.update(averages_overlapping=sum(item.overlapping for item in found.values()))
        for shaft in self._monitor.shafts:
            silent = ', '.join(map(str, found[shaft].not_judged()[0] if shaft in found else ()))
            self.set_missing(f'channels of {shaft}', (
                f'{silent} not judged, the latest averages have no values of them: look at '
                'sensor and cable') if silent else '')
        for shaft, lack in self._monitor.uncorrected.items():
            self.set_missing(f'comparison of {shaft}', (
                f'without {lack}, {UNCORRECTED}, or allow_uncorrected: true if it will never be '
                'exchanged') if lack else '')

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return what is learnt and how many quantities have changed."""
        monitor = self._monitor
        if monitor is None:
            return 'nothing is monitored', {'baseline_file': self._path}
        found = monitor.monitors
        changes = len(monitor.changes())
        values: dict[str, object] = {
            'baseline_averages': monitor.averages,
            'baseline_complete': str(monitor.is_complete).lower(), 'changes': changes,
            'limits_passed': len(monitor.limits.passed()),
            'uncorrected': sum(item.uncorrected for item in found.values()),
            'averages_discarded': monitor.discarded,
            'averages_beyond_bins': sum(item.beyond for item in found.values()),
            'baseline_file': self._path or f'{_NOT_KEPT}, lost when the node ends'}
        refusals = [f'{shaft}: {reason}' for shaft, reason in monitor.refusals.items() if reason]
        if refusals:
            return f'{monitor.discarded} averages discarded; {first_of(refusals)}', values
        if not found:
            return 'no average received yet', values
        if not monitor.is_complete:
            shaft, item = min(found.items(), key=lambda each: each[1].learned)
            enough = self._values['learning_averages']
            return (f'learning: {item.learned} of {enough} averages of {shaft} at '
                    f'{item.place}' + (
                        f', of {item.averages} in all bins: larger ones learn sooner'
                        if item.averages > enough else ''), values)
        others = [name for item in found.values() for name in item.not_judged()[1]]
        return (f'{changes} changes' if changes else f'no change in {monitor.averages} averages'
                ) + (f'; without values: {first_of(others)}' if others else ''), values


def baseline_path(file: str, machine: str, node: str) -> Path | None:
    """
    Return the path of the parameter `baseline_file`, None for `none`.

    Empty is a file of the `machine`, if it has a name, and of the full name of the `node`, where
    ROS 2 keeps its logs.
    """
    if file == _NOT_KEPT:
        return None
    if not file:
        name = '.'.join(filter(None, (machine, *node.split('/'))))
        file = os.path.join(os.environ.get('ROS_HOME') or '~/.ros', 'sa_jitter_ros',
                            f'{quote(name, safe="")}.npz')
    return Path(os.path.expanduser(file))


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(ChangeMonitor, args)


if __name__ == '__main__':
    raise SystemExit(main())
