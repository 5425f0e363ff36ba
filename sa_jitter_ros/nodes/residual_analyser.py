# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `residual_analyser`: compares measured with predicted attenuation and finds its cause."""

from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent import futures
from dataclasses import replace
from functools import partial
import json
import threading
import time
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterType
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.task import Future
from sa_jitter_ros.averaging.results import AverageMessage
from sa_jitter_ros.averaging.shortfall import Shortfall
from sa_jitter_ros.declaration import declaration_of, predictor_parameters, SHAFTS
from sa_jitter_ros.effects import Effect
from sa_jitter_ros.errors import MessageError, SaJitterError
from sa_jitter_ros.inference.online import (
    Batch, compare, declared_by, Published, ReceivedAverage, require_comparable)
from sa_jitter_ros.inference.online_trace import trace_averages
from sa_jitter_ros.inference.scoring import FEWEST_ACQUISITIONS
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.messages import (
    decode_average, decode_prediction, encode_residual, ResidualMessage)
from sa_jitter_ros.nodes.parameters import as_ros_parameter, require_node_name
from sa_jitter_ros.nodes.result_flows import ResultFlows, UNCORRECTED
from sa_jitter_ros.parameters import fixed, Parameter, require_shaft_names, Values
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.report.report import report
from std_msgs.msg import Float64MultiArray, String

Found = TypeVar('Found')
#: What is found after some calls of the timer.
Waiting = Generator[None, None, Found]

PARAMETERS = (
    fixed('shaft', 'shaft', 'shaft whose averages are compared'),
    fixed('predictor', 'jitter_predictor', 'node whose predictions are compared and whose effects '
          'are set'),
    Parameter('acquisitions', 20, 'averages compared at once; at least 4 to find a missing effect',
              minimum=2, maximum=10000),
    Parameter('close_loop', False, "add each missing effect to the predictor's parameters"),
)
_SIGNIFICANT = 0.02  # p value of a residual that is no chance
_PERIOD = 0.2  # s between the steps of the loop
_FIND_TIMEOUT = 3.0  # s to find the predictor
_ANSWER_TIMEOUT = 15.0  # s for its answer, which comes after a new prediction


class ResidualAnalyser(MonitoringNode):
    """
    Publishes `residual` for every batch of averages, and `missing_effect` after its trace.

    The trace runs in a thread beside the executor. With `close_loop` the effects that it finds are
    set in the predictor; the next batch waits for the prediction with these effects.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('residual_analyser', PARAMETERS, **node_kwargs)
        self._values = self.parameters.values()
        require_shaft_names('shaft', [self._values['shaft']])
        require_node_name('predictor', self._values['predictor'])
        self._batch = Batch(self._values['acquisitions'])
        self._pulses: dict[float, NDArray[np.float64]] = {}
        self._prediction: Published | None = None
        self._significant = self._waited = False
        self._added: set[str] = set()  # names of the effects that were set in the predictor
        self._verdict = self._activity = ''
        self._batches = self._uncorrected = self._interrupted = self._unresolved = 0
        self._skipped, self._skipped_because = Shortfall(), ''
        self._untraced, self._predictor_name = 0, self._values['predictor']
        self._predictor = AsyncParameterClient(self, self._predictor_name)
        shaft = self._values['shaft']
        self._residual = self.create_output(Float64MultiArray, 'residual')
        self._missing_effect = self.create_output(String, 'missing_effect', LATCHED_QOS)
        self.create_input(Float64MultiArray, f'{shaft}/order_amplitude', self._on_average)
        self.create_input(Float64MultiArray, f'{shaft}/pulse_error', self._on_pulse_error)
        # A predictor of several shafts publishes one prediction for each.
        for topic in ('prediction', f'{shaft}/prediction'):
            self.create_input(Float64MultiArray, topic, partial(self._on_prediction, topic),
                              LATCHED_QOS)
        self._flows = ResultFlows(self, [shaft], ['pulse_error'])
        self._prediction_flow = self.watch_input(
            'prediction', 'prediction', 'see the status of the predictor', once=True)
        steps = self._loop()
        self.create_steady_timer(_PERIOD, lambda: next(steps))
        self.parameters.watch(check=lambda values: None, apply=self._apply)
        self.get_logger().info(f'started: compares {self._values["acquisitions"]} averages of '
                               f'{shaft} at once with {self._predictor_name}')

    def _apply(self, values: Values) -> None:
        self._values = values
        self._batch.size = values['acquisitions']

    # --- messages ---

    def _on_average(self, message: Float64MultiArray) -> None:
        decoded = decode_average('order_amplitude', message)
        average = average_of(decoded)
        self._flows.came(self._values['shaft'], 'order_amplitude', decoded)
        corrected = bool(np.isfinite(average.attenuation).any())
        interrupted = bool(decoded.header.discarded_cycles)
        if interrupted:
            self._interrupted += 1
            self._skipped_because = (
                'discarded trigger cycles between those of an average, and the prediction is that '
                'of consecutive ones: look at the pulses (see the diagnostics of the averager)')
        elif corrected:
            self._batch.add(average)
        else:
            self._uncorrected += 1
            self._skipped_because = UNCORRECTED
        self._skipped.add(interrupted or not corrected)
        self.set_missing('comparison', f'without {self._skipped}, {self._skipped_because}'
                         if self._skipped else '')

    def _on_pulse_error(self, message: Float64MultiArray) -> None:
        received = decode_average('pulse_error', message)
        self._flows.came(self._values['shaft'], 'pulse_error', received)
        if received.header.discarded_cycles:
            return
        values = received.values[:, :3]  # time, error and its standard error
        count, cycles = len(values), received.header.trigger_cycles
        if count != cycles + 1 or not np.isfinite(values[:, 0]).all():
            raise MessageError(f'{count} pulses for {cycles} trigger cycles: send finite times, '
                               'for one pulse more than cycles')
        self._unresolved += not _resolved(values)
        self._pulses[received.header.start_time] = values
        while len(self._pulses) > 2 * self._batch.size + 10:
            del self._pulses[next(iter(self._pulses))]

    def _on_prediction(self, topic: str, message: Float64MultiArray) -> None:
        received = decode_prediction(message)
        table = received.values
        if not (np.isfinite(table[:, :4]).all() and received.trigger_speed > 0.0
                and received.keyphasor_rate > 0.0 and received.trigger_cycles > 0):
            raise MessageError(f'prediction at {received.trigger_speed} Hz: send finite numbers, '
                               'a positive speed and a positive keyphasor rate')
        self._prediction_flow.came()
        self._prediction_flow.what = self.resolve_topic_name(topic)
        self._flows.expect(received.trigger_cycles / received.trigger_speed)
        self._prediction = Published(
            table[:, 0], table[:, 1], table[:, 3], received.trigger_speed,
            received.keyphasor_rate, received.trigger_cycles, received.ratio,
            received.pulse_error_standard_deviation)

    # --- the loop: at each `yield` it waits for the next call of the timer ---

    def _loop(self) -> Waiting[None]:
        """Compare each full batch with the prediction, and search the cause of the residual."""
        while True:
            self._activity = ''
            yield
            averages = self._compare()
            if averages and self._prediction is not None:
                try:
                    model, effects = yield from self._declared(averages, self._prediction)
                    yield from self._trace(averages, model, effects)
                except SaJitterError as error:
                    self.warn(f'{self._predictor_name}: {error}')

    def _compare(self) -> list[ReceivedAverage]:
        """Publish the residual of a full batch, and return its averages; [] without one."""
        if not self._batch.full or self._prediction is None:
            return []
        pulses = [self._pulses.get(item.start_time) for item in self._batch.averages]
        averages = [replace(item, pulses=values if _resolved(values) else None)
                    for item, values in zip(self._batch.averages, pulses)]
        if pulses[-1] is None and not self._waited:
            self._waited = True  # the pulse errors of an average are published after it
            return []
        self._waited = False
        try:
            require_comparable(averages, self._prediction)
            table, found = compare(averages, self._prediction)
        except SaJitterError as error:
            self.set_missing('residual', str(error))
            return []
        self.set_missing('residual', '')
        ambiguous = sum(values is not None and not _resolved(values) for values in pulses)
        few = ''
        if len(averages) < FEWEST_ACQUISITIONS:
            few = (f'{len(averages)} averages at once tell no cause, at least '
                   f'{FEWEST_ACQUISITIONS} do: raise acquisitions')
        elif len(averages) - ambiguous < FEWEST_ACQUISITIONS:
            few = (f'{ambiguous} of {len(averages)} averages have pulses whose error the '
                   'vibration leaves ambiguous, and tell no cause: declare stronger or lower '
                   'orders in the averager, or use a better keyphasor')
        self.set_missing('cause', few)
        self._batch.averages.clear()
        self._batches += 1
        self._significant = found.p_surest < _SIGNIFICANT
        self._residual.publish(encode_residual(ResidualMessage(
            table, len(averages), found.chi2_per_dof, found.p_value, found.rms)))
        return averages

    def _declared(self, averages: Sequence[ReceivedAverage], prediction: Published
                  ) -> Waiting[tuple[DeclaredModel, tuple[Effect, ...]]]:
        """Ask for the predictor's declared model and effects; else make one of its prediction."""
        shaft = self._values['shaft']
        for parameters in (predictor_parameters(),
                           predictor_parameters([shaft], [f'{shaft}.ratio'])):
            response = yield from self._answer(partial(
                self._predictor.get_parameters, [item.name for item in parameters]))
            if response is None:
                break
            unset = ParameterType.PARAMETER_NOT_SET in {item.type for item in response.values}
            if not unset and len(response.values) >= len(parameters):
                found = self._declaration(parameters, response)
                self.set_missing('declared model', '')
                return found
        self.set_missing('declared model', f'{self._predictor_name} does not answer: independent '
                         'jitter without effects is assumed; start the node, or set the '
                         'parameter predictor to its name')
        return declared_by(averages, prediction), ()

    def _declaration(self, parameters: Sequence[Parameter], response: Any
                     ) -> tuple[DeclaredModel, tuple[Effect, ...]]:
        """Return the predictor's model and its effects, except those that were set here."""
        values: Values = {}
        for item, value in zip(parameters, response.values):
            converted = parameter_value_to_python(value)
            values[item.name] = list(converted) if item.is_list else converted
        values[SHAFTS.name] = [self._values['shaft']]
        self._added = {name for name in self._added if values[f'effects.{name}.enabled']}
        values.update({f'effects.{name}.enabled': False for name in self._added})
        declaration = declaration_of(values)
        return declaration.model, declaration.effects

    def _trace(self, averages: Sequence[ReceivedAverage], model: DeclaredModel,
               effects: Sequence[Effect]) -> Waiting[None]:
        """Trace in a thread, that the executor goes on; with `close_loop`, set what it finds."""
        name_of = partial(self.parameters.machine.name_of, self._values['shaft'])
        job = _in_thread(partial(
            trace_averages, averages, model, declared=effects, name_of=name_of))
        self._activity = 'tracing'
        while not job.done():
            yield
        if error := job.exception():
            self._untraced += len(averages)
            self.warn('the cause of the residual could not be searched: '
                      f'{error if isinstance(error, SaJitterError) else repr(error)}')
            return
        trace = job.result()
        content = report(trace)
        self._untraced += len(averages) - sum(content['acquisitions'].values())
        self._verdict = content['verdict']
        self._missing_effect.publish(String(data=json.dumps(content, allow_nan=False)))
        found = {item.name: item.effect.values for item in (*trace.findings, *trace.refinements)
                 if item.effect is not None}
        # Effects that are set stay as they are until a residual is significant with them.
        due = self._significant if self._added else bool(found)
        if self._values['close_loop'] and due:
            yield from self._set_effects(found)

    def _set_effects(self, found: Mapping[str, Mapping[str, Any]]) -> Waiting[None]:
        """Set the predictor's effects and wait for the prediction with them."""
        wanted: dict[str, Any] = {
            f'effects.{name}.enabled': False for name in self._added - found.keys()}
        for name, parameters in found.items():
            wanted[f'effects.{name}.enabled'] = True
            wanted.update({f'effects.{name}.{key}': list(value) if isinstance(value, tuple)
                           else value for key, value in parameters.items()})
        before = self._prediction
        response = yield from self._answer(partial(
            self._predictor.set_parameters_atomically,
            [as_ros_parameter(name, value) for name, value in wanted.items()]))
        refused = ''
        if response is None:
            refused = ('does not answer: its effects cannot be set; start the node, or set the '
                       'parameter predictor to its name')
        elif not response.result.successful:
            refused = f'refuses the effects: {response.result.reason}'
        self.set_missing('closed loop', refused and f'{self._predictor_name} {refused}')
        if not refused:
            self._added = set(found)
            self._activity = 'waiting for the prediction with the effects'
            while self._prediction is before:
                yield

    def _answer(self, call: Callable[[], Future]) -> Waiting[Any]:
        """Call a service of the predictor; return its response, None after a timeout."""
        self._activity = f'waiting for {self._predictor_name}'
        end = time.monotonic() + _FIND_TIMEOUT
        while not self._predictor.services_are_ready():
            if time.monotonic() > end:
                return None
            yield
        future, end = call(), time.monotonic() + _ANSWER_TIMEOUT
        while not future.done():
            if time.monotonic() > end:
                future.cancel()
                return None
            yield
        return future.result()

    # --- diagnostics ---

    def update_counts(self) -> None:
        """Count averages that overlap; say early that the prediction is of other averages."""
        self.counts.update(averages_overlapping=self._batch.overlapping)
        if self._batch.averages and self._prediction is not None:
            try:
                require_comparable(self._batch.averages[-1:], self._prediction)
            except SaJitterError as error:
                self.set_missing('residual', str(error))

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return the number of averages in the batch and the last verdict."""
        count = len(self._batch.averages)
        values = {'shaft': self._values['shaft'], 'averages': count, 'batches': self._batches,
                  'verdict': self._verdict, 'uncorrected': self._uncorrected,
                  'averages_with_discarded_cycles': self._interrupted,
                  'averages_with_unresolved_pulses': self._unresolved,
                  'averages_not_traced': self._untraced,
                  'effects_set': ', '.join(sorted(self._added))}
        if self._prediction is None:
            return 'no prediction received yet', values
        if not (count or self._batches or self._uncorrected or self._interrupted):
            topic = self.resolve_topic_name(f"{self._values['shaft']}/order_amplitude")
            return (f'nothing received on {topic} yet: is the parameter shaft one of the '
                    'averager?', values)
        activity = self._activity or (
            f'last verdict: {self._verdict}' if self._verdict else 'nothing compared yet')
        return f'{count} of {self._batch.size} averages; {activity}', values


def _in_thread(work: Callable[[], Trace]) -> 'futures.Future[Trace]':
    """Do work in a daemon thread; a bug in it must not stop the node."""
    job: futures.Future[Trace] = futures.Future()

    def run() -> None:
        try:
            job.set_result(work())
        except Exception as error:
            job.set_exception(error)
    threading.Thread(target=run, daemon=True).start()
    return job


def _resolved(pulses: NDArray[np.float64] | None) -> bool:
    """Return whether the vibration shows the errors of all `pulses`, if they came."""
    return pulses is not None and bool(np.isfinite(pulses).all())


def average_of(message: AverageMessage) -> ReceivedAverage:
    """Return the average in a message of order amplitudes; raises MessageError."""
    header, table = message.header, message.values
    if len(table) == 0 or not (
            header.end_time > header.start_time and header.trigger_cycles > 0):
        raise MessageError(
            f'{len(table)} channels, from {header.start_time} s to {header.end_time} s, '
            f'{header.trigger_cycles} trigger cycles: send at least one channel and one trigger '
            'cycle, and an end after the start')
    raw, corrected = (table[..., k] * np.exp(1j * table[..., k + 1]) for k in (1, 3))
    return ReceivedAverage(
        header.start_time, header.end_time, header.trigger_cycles, header.fundamental_cycles,
        header.mean_trigger_speed, table[0, :, 0], raw, corrected, table[..., 5], table[..., 6],
        table[..., 7])


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(ResidualAnalyser, args)


if __name__ == '__main__':
    raise SystemExit(main())
