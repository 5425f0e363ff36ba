# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `live_view`: a web page with the latest results of all nodes."""

from collections.abc import Sequence
from functools import partial
import json
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from sa_jitter_ros.averaging.results import AverageMessage
from sa_jitter_ros.errors import MessageError, ParameterError
from sa_jitter_ros.json_values import json_values
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, RESULT_QOS, run_node
from sa_jitter_ros.nodes.live_view_board import (
    amplitude_rows, Board, CHANNELS, HISTORY, History, HISTORY_NUMBERS, INDICATORS,
    indicators_content, OrderMap, ORDERS, orders_content, PulseErrors, pulses_content,
    spectrum_content, SPEEDS, table_content, Trend, waveform_content)
from sa_jitter_ros.nodes.live_view_server import is_loopback, PageServer
from sa_jitter_ros.nodes.messages import (
    decode_average, decode_prediction, decode_residual, PREDICTION_FIELDS, RESIDUAL_FIELDS)
from sa_jitter_ros.nodes.result_flows import AVERAGE, ResultFlows
from sa_jitter_ros.parameters import fixed, Parameter, require_shaft_names, Values
from std_msgs.msg import Float64, Float64MultiArray, String

LARGEST_REPORT = 1_000_000  # characters of a text in JSON
FLOWS = ('condition_indicator', 'pulse_error')  # results that come beside the average
KINDS = ('synchronous_average', 'standard_error', 'corrected_average', AVERAGE, *FLOWS,
         'condition_indicator_error')
NODES, NODE_VALUES = 64, 100  # nodes whose diagnostics are shown, and values of each node

PARAMETERS = (
    fixed('shafts', ['shaft'], 'names of the shafts'),
    fixed('host', '127.0.0.1', 'address to listen on'),
    fixed('port', 8420, 'port of the page, or the next free one; 0: any free port', minimum=0,
          maximum=65535),
    fixed('open_to_network', False, 'allow a host that others reach, who then see everything'),
    Parameter('vibration_unit', '', 'unit of the vibration on labels; empty: that of '
              'machine.channels'),
    Parameter('channel_names', [], 'names of the channels on labels; empty: those of '
              'machine.channels', element=str),
)


class ShaftView:
    """Puts the results of one shaft on the board, with their histories."""

    def __init__(self, shaft: str, board: Board) -> None:
        self.shaft, self._board = shaft, board
        self._errors, self._indicators = PulseErrors(), Trend()
        self._attenuations = History(HISTORY_NUMBERS, HISTORY)
        self._amplitudes = {'raw': Trend(), 'corrected': Trend()}
        self._maps = {'synchronous_average': OrderMap(), 'corrected_average': OrderMap()}

    def _put(self, kind: str, content: Any, *, by_channel: bool = False) -> None:
        if content is not None:
            self._board.put(f'{self.shaft}/{kind}', content, by_channel=by_channel)

    def show(self, kind: str, average: AverageMessage) -> None:
        """Show a result; `kind` is its topic."""
        if kind == 'order_amplitude':
            self._show_orders(average)
        elif kind == 'pulse_error':
            self._put(kind, partial(pulses_content, average, self._errors.add(average.values)))
        elif kind.startswith('condition_indicator'):
            self._put(kind, partial(indicators_content, average))
            self._put('indicator_trend', self._indicator_trend(kind, average), by_channel=True)
        else:
            self._put(kind, partial(waveform_content, average))
        if kind in self._maps:
            self._put(f'{kind}_spectrum', partial(spectrum_content, average), by_channel=True)
            self._put(f'{kind}_map', self._maps[kind].add(
                average.header.end_time, average.values[:CHANNELS]), by_channel=True)

    def _indicator_trend(self, kind: str, average: AverageMessage) -> Any:
        """Return the trend with values, or with their errors, which come after them."""
        values = average.values[:CHANNELS, :INDICATORS]
        if kind == 'condition_indicator_error':
            return self._indicators.amend(average.header.end_time, values)
        return self._indicators.add(
            average.header.end_time, average.names[:INDICATORS], values,
            values * math.nan) if average.names else None

    def _show_orders(self, average: AverageMessage) -> None:
        """Show order amplitudes and their trend."""
        shown = average.values[:CHANNELS, :ORDERS]
        history = self._attenuations.add(
            average.header.end_time, shown[..., 0].tobytes(), shown[..., 5])
        self._put('order_amplitude', partial(orders_content, average, history))
        for kind, trend in self._amplitudes.items() if len(shown) else ():
            self._put(f'{kind}_trend', trend.add(
                average.header.end_time, tuple(f'{order:.6g}' for order in shown[0, :, 0]),
                *amplitude_rows(shown, average.names, kind)), by_channel=True)


class LiveView(MonitoringNode):
    """Serves a page with the latest results of the other nodes."""

    _server: PageServer | None = None  # until the parameters are checked

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('live_view', PARAMETERS, **node_kwargs)
        values = self.parameters.values()
        require_shaft_names('shafts', values['shafts'])
        if not (is_loopback(values['host']) or values['open_to_network']):
            raise ParameterError(f'other machines can reach host {values["host"]!r}: set host to '
                                 '127.0.0.1, or allow it by open_to_network: true')
        self._channels = self.parameters.declare_channels()
        self._board = Board()
        self._averages = 0
        self._speeds: list[float] = []
        self._nodes: dict[str, dict[str, Any]] = {}
        self._apply(values)
        for shaft in values['shafts']:
            view = ShaftView(shaft, self._board)
            for kind in KINDS:
                self.create_input(Float64MultiArray, f'{shaft}/{kind}',
                                  partial(self._on_result, view, kind), RESULT_QOS)
        self._flows = ResultFlows(self, values['shafts'], FLOWS)
        self._prediction_flow, self._change_flow = (
            self.watch_input(name, name, f'see the status of the {node}', once=True, optional=True)
            for name, node in (('prediction', 'predictor'), ('change', 'change monitor')))
        # Several shafts have a prediction each, and an analyser each if their topics are remapped.
        for prefix in ('', *(f'{shaft}/' for shaft in values['shafts'])):
            for kind, topic, callback, qos in (
                    (Float64MultiArray, 'prediction', self._on_prediction, LATCHED_QOS),
                    (Float64MultiArray, 'residual', self._on_residual, RESULT_QOS),
                    (String, 'missing_effect', self._on_object, LATCHED_QOS)):
                self.create_input(kind, prefix + topic, partial(callback, prefix + topic), qos)
        self.create_input(String, 'change', partial(self._on_object, 'change'), LATCHED_QOS)
        self.create_input(Float64, 'shaft_speed', self._on_speed, RESULT_QOS)
        self.create_input(DiagnosticArray, '/diagnostics', self._on_diagnostics, RESULT_QOS,
                          most_publishers=0)
        self.parameters.watch(check=lambda values: None, apply=self._apply)
        self._server = PageServer(self._board.since, host=values['host'], port=values['port'])
        if self._server.port != values['port'] != 0:
            self.warn(f'port {values["port"]} is in use: the page is on port '
                      f'{self._server.port}')
        self.get_logger().info(f'started: open {self._server.address} in a browser')

    def destroy_node(self) -> None:
        """Stop the page and destroy the node."""
        if self._server is not None:
            self._server.close()
        super().destroy_node()

    def _apply(self, values: Values) -> None:
        units = {item['unit'] for item in self._channels.values()}
        self._labels = shown = {
            'shafts': values['shafts'],
            'vibration_unit': values['vibration_unit'] or (
                units.pop() if len(units) == 1 else ''),
            'channel_names': values['channel_names'] or [*self._channels],
            'order_names': {
                shaft: [*machine.gear_orders(shaft).items()] for shaft in values['shafts']
                if shaft in (machine := self.parameters.machine).shafts}}
        self._board.put('settings', lambda: shown, data=False)

    # --- messages ---

    def _on_result(self, view: ShaftView, kind: str, message: Float64MultiArray) -> None:
        average = decode_average(kind, message)
        view.show(kind, average)
        if kind in (AVERAGE, *FLOWS):
            self._flows.came(view.shaft, kind, average)
        if kind == AVERAGE:
            self._averages += 1
            names, channels = self._labels['channel_names'], len(average.values)
            self.set_missing('names of the channels', (
                f'channel_names has {len(names)} and {view.shaft} has {channels} channels: name '
                'each' if names and len(names) != channels else ''))

    def _on_prediction(self, topic: str, message: Float64MultiArray) -> None:
        prediction = decode_prediction(message)
        self._prediction_flow.came()
        self._prediction_flow.what = self.resolve_topic_name(topic)
        if prediction.trigger_speed > 0.0:
            self._flows.expect(prediction.trigger_cycles / prediction.trigger_speed)
        self._board.put(topic, partial(table_content, prediction, PREDICTION_FIELDS), data=False)

    def _on_residual(self, topic: str, message: Float64MultiArray) -> None:
        residual = decode_residual(message)
        self._board.put(topic, partial(table_content, residual, RESIDUAL_FIELDS))

    def _on_object(self, topic: str, message: String) -> None:
        """Show a JSON object of another node."""
        if len(message.data) > LARGEST_REPORT:
            raise MessageError(f'{len(message.data)} characters: send at most {LARGEST_REPORT}')
        try:
            report = json.loads(message.data, parse_constant=lambda name: None,
                                parse_float=lambda text: json_values(float(text)))
        except (RecursionError, ValueError) as error:
            raise MessageError(f'the text is no JSON: {error}') from None
        if not isinstance(report, dict):
            raise MessageError(f'the text is a JSON {type(report).__name__}: send an object')
        if topic == 'change':
            self._change_flow.came()
        self._board.put(topic, lambda: report, data=False)

    def _on_speed(self, message: Float64) -> None:
        if not math.isfinite(message.data):
            raise MessageError(f'speed is {message.data} Hz: publish a finite number')
        self._speeds = speeds = [*self._speeds, message.data][-SPEEDS:]
        self._board.put('shaft_speed', lambda: {'value': speeds[-1], 'history': speeds})

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        nodes = dict(self._nodes)  # a thread may be sending the one before
        for status in message.status:
            nodes.pop(status.name, None)
            nodes[status.name] = {
                'level': int.from_bytes(status.level, 'little'), 'message': status.message,
                'values': {item.key: item.value for item in status.values[:NODE_VALUES]},
                'received': time.monotonic()}
        self._nodes = nodes = dict([*nodes.items()][-NODES:])
        self._board.put('/diagnostics', lambda: nodes, data=False)

    # --- diagnostics ---

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return the address of the page and the number of averages on it."""
        assert self._server is not None
        silence = self._board.silence()
        state = 'no data received yet' if silence is None else (
            f'{self._averages} averages shown' if silence < 3.0 else
            f'no data for {silence:.0f} s')
        return f'{state}; page at {self._server.address}', {
            'address': self._server.address, 'averages': self._averages,
            'requests': self._server.requests, 'requests_refused': self._server.refused}


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(LiveView, args)


if __name__ == '__main__':
    raise SystemExit(main())
