# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The live view: published messages reach the page, through HTTP and in a real browser."""

from concurrent.futures import ThreadPoolExecutor
import http.client
import json
import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from urllib.parse import unquote

from bench import NodeBench, SteadyClock
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from hypothesis import given, strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes import health
from sa_jitter_ros.nodes import live_view_board as board
from sa_jitter_ros.nodes import live_view_server as server
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import DIAGNOSTIC_KEYS, LATCHED_QOS, RESULT_QOS
from sa_jitter_ros.nodes.live_view import LiveView
from sa_jitter_ros.nodes.live_view_server import is_name_of_this_machine, PORTS_TRIED
from std_msgs.msg import Float64, Float64MultiArray, String

ORDERS = np.array([19.0, 38.0, 57.0])
NAN = float('nan')
REPORT = {
    'missing_effects': [{
        'name': 'excess_jitter', 'evidence': 'wider than declared', 'p_value': 1e-9,
        'parameters': {'std': {'value': 1.93e-5, 'standard_error': 4e-7, 'unit': 's'}},
        'indistinguishable_from': ['phase_wander']}],
    'error_before': {'rms': 0.0123}, 'error_after': {'rms': 0.0018}, 'verdict': 'traced',
    'lines': [{'channel': 'channel 0', 'order': 19.0, 'observed': 0.9,
               'predicted_before': 0.95, 'predicted_after': 0.901}]}
CHANGE = {
    'baseline': {'averages': 200, 'complete': True},
    'changes': [{
        'shaft': 'shaft', 'channel': 0, 'kind': kind, 'name': name, 'change': change,
        'standard_error': 0.006, 'since_sequence': 5, 'since_time': 72.0, 'keyphasor_share': 0.003,
        'p_value': 1e-9} for kind, name, change in (
            ('order', '19', 0.041), ('indicator', 'rms', -0.02))]}


class ViewBench(NodeBench):
    """A bench around the view: publishers of all that it shows, and a client of its page."""

    def __init__(self, graph, **parameters):
        latched = {'prediction': Float64MultiArray, 'missing_effect': String, 'change': String}
        inputs = {f'shaft/{kind}': Float64MultiArray for kind in (
            'synchronous_average', 'standard_error', 'corrected_average', 'order_amplitude',
            'pulse_error', 'condition_indicator', 'condition_indicator_error')}
        super().__init__(
            graph, LiveView, qos=RESULT_QOS, outputs={},
            inputs={**inputs, 'residual': Float64MultiArray, 'shaft_speed': Float64},
            **{'port': 0, **parameters})
        for topic, kind in latched.items():
            graph.publisher(topic, kind, qos=LATCHED_QOS)
        self.port = int(re.search(r':(\d+)/', self.diagnostics()[2]['address'])[1])

    def ask(self, path='/snapshot.json', method='GET', host=None):
        """Return status, headers and body of an answer; the node is served meanwhile."""
        def talk():
            connection = http.client.HTTPConnection('127.0.0.1', self.port, timeout=60.0)
            connection.request(method, path, headers={
                'Host': f'127.0.0.1:{self.port}' if host is None else host})
            answer = connection.getresponse()
            result = answer.status, dict(answer.headers), answer.read()
            connection.close()
            return result
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(talk)
            assert self.spin(asked.done)
        return asked.result()

    def snapshot(self, since=0, channel=0):
        """Return a snapshot once all that was sent is on the board."""
        self.settle()
        status, headers, body = self.ask(f'/snapshot.json?since={since}&channel={channel}')
        assert status == 200
        assert headers['Content-Type'] == 'application/json'
        return json.loads(body)

    def part(self, name, channel=0):
        """Return the content of one part."""
        return self.snapshot(channel=channel)['parts'][name]['content']


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches around the view."""
    return lambda **parameters: ViewBench(ros_graph, **parameters)


def header(sequence=7):
    """Return the header of an average."""
    return messages.AverageHeader(10.0 * sequence, 10.0 * sequence + 2.0, sequence, 30, 72, 15.0)


def average(kind, values, names=(), sequence=7):
    """Return a message of one average."""
    return messages.encode_average(kind, messages.AverageMessage(header(sequence), values, names))


def amplitudes(attenuation=0.9, channels=2):
    """Return a table (channel, order, field) of order amplitudes."""
    table = np.full((channels, len(ORDERS), len(messages.AMPLITUDE_FIELDS)), 0.25)
    table[..., 0] = ORDERS
    table[..., 1] = 0.4321 * attenuation
    table[..., 3] = 0.4321
    table[..., 5] = attenuation
    table[..., 6] = 0.0123
    table[..., 8] = 0.021
    table[..., 10] = 0.032
    return table


def prediction():
    """Return the message of a prediction, of ratio 2.4: 72 revolutions in 30 cycles."""
    table = np.stack([ORDERS, *(np.full(3, value) for value in (
        0.8765, 1e-4, 0.01, 0.85, 0.88, 0.93))], axis=1)
    return messages.encode_prediction(
        messages.PredictionMessage(table, 15.0, 1e4, 30, 2.4, 2.9e-5, 0.0))


def pulse_errors(first=70.0, count=31):
    """Return a table (pulse, field) of pulse errors."""
    number = np.arange(count)
    return np.stack([first + number / 15.0, 1e-5 * np.cos(number), np.full(count, 1e-6),
                     np.append(np.ones(count - 1), 0.0)], axis=1)


def publish_all(b):
    """Publish one message of everything; return the waveforms."""
    angle = 2.0 * np.pi * np.arange(512) / 512
    raw = np.stack([np.sin(19.0 * angle), 0.5 * np.sin(38.0 * angle)])
    b.send('shaft/synchronous_average', average('synchronous_average', raw))
    b.send('shaft/standard_error', average('standard_error', np.full(raw.shape, 0.05)))
    b.send('shaft/condition_indicator', average(
        'condition_indicator', np.array([[0.7071, NAN], [0.3536, 1.523]]), ('rms', 'fm0')))
    b.send('shaft/condition_indicator_error', average(
        'condition_indicator_error', np.array([[0.0123, NAN], [0.01, 0.2]]), ('rms', 'fm0')))
    b.send('shaft/corrected_average', average('corrected_average', 1.1 * raw))
    b.send('shaft/order_amplitude', average(
        'order_amplitude', amplitudes(), messages.AMPLITUDE_FIELDS))
    b.send('shaft/pulse_error', average(
        'pulse_error', pulse_errors(), messages.PULSE_ERROR_FIELDS))
    b.send('prediction', prediction())
    table = np.stack([ORDERS, *(np.full(3, value) for value in (
        0.90, 0.91, -0.01, 0.004, -2.5))], axis=1)
    b.send('residual', messages.encode_residual(
        messages.ResidualMessage(table, 20, 1.07, 0.38, 0.01)))
    b.send('missing_effect', String(data=json.dumps(REPORT)))
    b.send('change', String(data=json.dumps(CHANGE)))
    b.send('shaft_speed', Float64(data=16.625))
    b.send('/diagnostics', DiagnosticArray(status=[DiagnosticStatus(
        level=DiagnosticStatus.WARN, name='rig/averager', message='pulses_dropped increased',
        values=[KeyValue(key='pulses_dropped', value='321')])]))
    assert b.spin(lambda: 'rig/averager' in b.node._nodes)
    b.settle()
    return raw


# --- what is published is what is served ---


def test_snapshot_holds_what_was_published(bench):
    b = bench(vibration_unit='g', channel_names=['casing', 'shaft end'])
    raw = publish_all(b)
    news = b.snapshot()
    parts = {name: item['content'] for name, item in news['parts'].items()}
    assert set(parts) == {
        'settings', 'shaft/synchronous_average', 'shaft/standard_error',
        'shaft/corrected_average', 'shaft/order_amplitude', 'shaft/pulse_error',
        'shaft/synchronous_average_spectrum', 'shaft/corrected_average_spectrum',
        'shaft/synchronous_average_map', 'shaft/corrected_average_map',
        'shaft/condition_indicator', 'shaft/condition_indicator_error', 'shaft/indicator_trend',
        'shaft/raw_trend', 'shaft/corrected_trend', 'prediction', 'residual', 'missing_effect',
        'change', 'shaft_speed', '/diagnostics'}
    assert parts['settings'] == {'shafts': ['shaft'], 'vibration_unit': 'g',
                                 'channel_names': ['casing', 'shaft end'], 'order_names': {}}
    assert parts['shaft/synchronous_average']['header'] == vars(header())
    for kind, factor in (('synchronous_average', 1.0), ('corrected_average', 1.1)):
        np.testing.assert_allclose(parts[f'shaft/{kind}']['channels'], factor * raw, atol=2e-5)
        assert parts[f'shaft/{kind}']['points'] == 512
        for channel, (order, amplitude) in enumerate(((19, 1.0), (38, 0.5))):
            found = b.part(f'shaft/{kind}_spectrum', channel)
            assert found['channel'] == channel
            assert len(found['amplitude']) == 255
            assert found['amplitude'][order - 1] == pytest.approx(factor * amplitude, rel=1e-3)
            assert max(np.delete(found['amplitude'], order - 1)) < 1e-12
            assert found['phase'][order - 1] == pytest.approx(-np.pi / 2.0, abs=1e-3)
    assert parts['shaft/standard_error']['channels'] == [[0.05] * 512] * 2
    assert parts['shaft/condition_indicator'] == {
        'header': vars(header()), 'names': ['rms', 'fm0'],
        'values': [[0.7071, None], [0.3536, 1.523]]}
    assert parts['shaft/indicator_trend']['value'] == [[0.7071, None]]
    assert parts['shaft/indicator_trend']['error'] == [[0.0123, None]]
    assert parts['shaft/condition_indicator_error']['values'] == [[0.0123, None], [0.01, 0.2]]
    for name, values in zip(messages.AMPLITUDE_FIELDS, np.moveaxis(amplitudes(), -1, 0)):
        assert parts['shaft/order_amplitude'][name] == values.tolist()
    for name, values in zip(messages.PULSE_ERROR_FIELDS, pulse_errors().T):
        assert parts['shaft/pulse_error'][name] == values.tolist()
    assert parts['prediction']['mean_attenuation'] == [0.8765] * 3
    assert parts['prediction']['ratio'] == 2.4
    assert parts['residual']['z'] == [-2.5] * 3
    assert parts['residual']['acquisitions'] == 20
    assert parts['missing_effect'] == REPORT
    assert parts['change'] == CHANGE
    assert parts['shaft_speed'] == {'value': 16.625, 'history': [16.625]}
    node = parts['/diagnostics']['rig/averager']
    assert (node['level'], node['message']) == (1, 'pulses_dropped increased')
    assert node['values'] == {'pulses_dropped': '321'}
    assert news['silence'] >= 0.0


def test_trends_grow_and_begin_anew_where_time_runs_back(bench):
    b, table = bench(), amplitudes()
    for number in range(3):
        b.send('shaft/order_amplitude', average(
            'order_amplitude', table * [1.0, *[1.0 + number] * (table.shape[-1] - 1)],
            messages.AMPLITUDE_FIELDS, sequence=number))
    b.settle()
    trend = b.part('shaft/corrected_trend')
    assert trend['time'] == [2.0, 12.0, 22.0]
    assert (trend['averages'], trend['names']) == (3, ['19', '38', '57'])
    first = dict(zip(messages.AMPLITUDE_FIELDS, np.moveaxis(table, -1, 0)))
    np.testing.assert_allclose(trend['value'], np.multiply.outer(
        [1.0, 2.0, 3.0], first['corrected_amplitude'][0]), rtol=1e-4)
    np.testing.assert_allclose(trend['error'][2], 3.0 * first['corrected_standard_error'][0],
                               rtol=1e-2)
    b.send('shaft/order_amplitude', average(
        'order_amplitude', table, messages.AMPLITUDE_FIELDS, sequence=0))
    b.settle()
    assert len(b.part('shaft/raw_trend')['time']) == 1


def test_errors_that_come_later_belong_to_their_average():
    trend, values = board.Trend(), np.ones((1, 2))
    assert trend.amend(1.0, values) is None  # of an average that never came
    trend.add(1.0, ('a', 'b'), values, values * NAN)
    assert trend.amend(0.5, values) is None
    assert trend.amend(1.0, np.ones((1, 3))) is None
    assert trend.amend(1.0, 0.25 * values)(0)['error'] == [[0.25, 0.25]]
    shown = trend.add(2.0, ('a', 'b'), values, values * NAN)(0)
    assert shown['error'] == [[0.25, 0.25], [None, None]]


def test_a_long_trend_is_bounded_in_memory_and_on_the_line():
    trend, values = board.Trend(), np.ones((4, 50))
    for number in range(board.TREND_AVERAGES):
        content = trend.add(float(number), ('a',) * 50, values, values)
    shown = content(3)
    assert shown['averages'] == board.TREND_NUMBERS // (2 * values.size)
    assert 1 < len(shown['value']) * 2 * 50 <= board.TREND_SENT
    assert content(4)['value'] == []  # no such channel
    assert shown['time'][-1] == board.TREND_AVERAGES - 1.0


def test_order_map_shows_amplitudes_in_decibels_and_is_bounded(monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(board, 'time', clock)
    angle, orders = 2.0 * np.pi * np.arange(4096) / 4096, board.OrderMap()
    wave = np.cos(19.0 * angle) + 0.02 * np.cos(1500.0 * angle)
    for end_time, factor in ((4.0, 1.0), (7.0, 0.1)):
        content = orders.add(end_time, factor * np.stack((0.0 * wave, wave)))
        # a sliding average, too early
        assert orders.add(end_time + 0.1, np.stack((wave, wave))) is None
        clock.now += board.MAP_PERIOD
    found = content(1)
    assert (found['pool'], found['step'], found['span']) == (7, 1, 80.0)  # 2000 orders
    assert found['peak'] == pytest.approx(1.0)
    assert found['time'] == [4.0, 7.0]
    level = np.array([[ord(item) - ord('0') for item in row] for row in found['rows']])
    assert level.shape == (2, 286)
    # order 19 is in column 2; 63 levels are 80 dB
    assert level[:, 2].tolist() == [63, round(63 * (1.0 - 20.0 / 80.0))]
    weak = -20.0 * np.log10(0.02)
    assert level[:, 1499 // 7].tolist() == [
        round(63 * (1.0 - (weak + more) / 80.0)) for more in (0.0, 20.0)]
    assert np.delete(level[0], [2, 1499 // 7]).max() == 0
    assert content(0)['peak'] == 0.0
    assert content(7)['rows'] == []
    for number in range(board.MAP_AVERAGES + 5):
        content = orders.add(8.0 + number, np.stack((wave, wave)))
        clock.now += board.MAP_PERIOD
    found = content(0)
    assert len(found['rows']) == len(found['time']) <= board.MAP_ROWS
    assert found['time'][-1] == 8.0 + number
    assert found['step'] * len(found['rows']) <= board.MAP_NUMBERS // (2 * 2000) + found['step']
    assert len(orders.add(3.0, np.stack((wave, wave)))(0)['rows']) == 1  # time ran back


def test_each_shaft_has_its_prediction_and_residual(bench):
    b = bench(shafts=['input', 'output'])
    b.graph.publisher('output/prediction', Float64MultiArray, qos=LATCHED_QOS)
    b.graph.publish('output/prediction', prediction())
    b.settle()
    assert b.part('output/prediction')['ratio'] == 2.4
    assert 'prediction' not in b.snapshot()['parts']


def test_channel_names_that_do_not_fit_are_a_warning_until_they_do(bench):
    b = bench(channel_names=['casing'])
    publish_all(b)
    for _ in range(2):
        level, text, _ = b.diagnostics()
        assert level == DiagnosticStatus.WARN
        assert text == ('names of the channels: channel_names has 1 and shaft has 2 channels: '
                        'name each')
    assert b.set_parameter('channel_names', ['casing', 'end'])[0]
    publish_all(b)
    assert b.diagnostics()[0] == DiagnosticStatus.OK


def test_only_changes_since_a_version_are_served(bench):
    b = bench()
    publish_all(b)
    known = b.snapshot()
    b.send('shaft_speed', Float64(data=17.0))
    news = b.snapshot(known['version'])
    assert 'shaft_speed' in news['parts']
    assert set(news['parts']) <= {'shaft_speed', '/diagnostics'}
    assert news['version'] > known['version']
    assert news['run'] == known['run']


def test_undefined_numbers_are_null(bench):
    b = bench()
    assert b.snapshot()['silence'] is None
    table = amplitudes(attenuation=NAN)
    b.send('shaft/order_amplitude', average(
        'order_amplitude', table, messages.AMPLITUDE_FIELDS))
    b.send('missing_effect', String(data='{"a": NaN, "b": -Infinity, "c": 1e999, "d": 1.5}'))
    b.send('shaft/synchronous_average', average('synchronous_average', np.full((1, 8), NAN)))
    assert b.part('shaft/order_amplitude')['attenuation'] == [[None] * 3] * 2
    assert b.part('shaft/order_amplitude')['corrected_amplitude'] == [[0.4321] * 3] * 2
    assert b.part('shaft/synchronous_average')['channels'] == [[None] * 8]
    assert b.part('missing_effect') == {'a': None, 'b': None, 'c': None, 'd': 1.5}


@pytest.mark.machines
def test_histories_follow_time_and_are_bounded(bench):
    b = bench()
    for k in range(40):
        b.send('shaft/order_amplitude', average(
            'order_amplitude', amplitudes(0.5 + 0.01 * k), messages.AMPLITUDE_FIELDS, k))
        b.send('shaft/pulse_error', average(
            'pulse_error', pulse_errors(2.0 * k), messages.PULSE_ERROR_FIELDS, k))
        b.send('shaft_speed', Float64(data=float(k)))
        b.settle()
    history = np.array(b.part('shaft/order_amplitude')['history'])
    np.testing.assert_allclose(history[:, 0, 0], 0.5 + 0.01 * np.arange(10, 40))
    time = np.array(b.part('shaft/pulse_error')['time'])
    # An average's last pulse is the next one's first: 30 of each are kept.
    np.testing.assert_allclose(time, (np.arange(-len(time), 0) + 1) / 15.0 + 80.0)
    assert len(time) == board.PULSES
    assert b.part('shaft_speed')['history'] == [float(k) for k in range(40)]
    b.send('shaft/pulse_error', average(
        'pulse_error', pulse_errors(0.0), messages.PULSE_ERROR_FIELDS))  # a restart
    assert b.part('shaft/pulse_error')['time'] == pulse_errors(0.0)[:, 0].tolist()
    b.send('shaft/order_amplitude', average(
        'order_amplitude', amplitudes(0.7, channels=1), messages.AMPLITUDE_FIELDS))
    assert b.part('shaft/order_amplitude')['history'] == [[[0.7] * 3]]


def test_snapshot_has_a_limited_size(bench, rng):
    b = bench()
    b.send('shaft/synchronous_average', average(
        'synchronous_average', rng.normal(size=(100, 20000))))
    table = np.full((100, 400, len(messages.AMPLITUDE_FIELDS)), 0.5)
    for _ in range(3):
        b.send('shaft/order_amplitude', average(
            'order_amplitude', table, messages.AMPLITUDE_FIELDS))
    part = b.part('shaft/order_amplitude')
    assert np.shape(part['order']) == (board.CHANNELS, board.ORDERS)
    assert len(part['history']) == 1
    assert b.part('shaft/synchronous_average')['count'] == 100
    channels = b.part('shaft/synchronous_average')['channels']
    assert np.shape(channels) == (board.CHANNELS, board.ALL_POINTS // board.CHANNELS)


@given(values=arrays(float, st.tuples(st.integers(1, 3), st.integers(1, 400)),
                     elements=st.floats(-1e6, 1e6)), half=st.integers(1, 60))
def test_an_envelope_keeps_every_peak(values, half):
    shown = board.envelope(values, 2 * half)
    assert shown.shape[1] <= 2 * half
    np.testing.assert_array_equal(shown.max(axis=1), values.max(axis=1))
    np.testing.assert_array_equal(shown.min(axis=1), values.min(axis=1))
    limit = 1e-5 * np.abs(values).max() + 1e-300  # where digits of a float end
    np.testing.assert_allclose(board.rounded(values), values, atol=limit, rtol=0.0)


# --- what must not be ---


BAD = {
    'label': ('shaft/synchronous_average', lambda: messages.encode_array(
        np.zeros((1, 4)), ('wire', 'angle'), (0.0,) * 6)),
    'count': ('shaft/synchronous_average', lambda: messages.encode_array(
        np.zeros((1, 4)), ('channel', 'angle'), (0.0, 1.0, NAN, 1.0, 1.0, 1.0))),
    'fields': ('shaft/order_amplitude', lambda: messages.encode_array(
        np.zeros((1, 2, 3)), ('channel', 'order', 'field'), (0.0,) * 6)),
    'pulse fields': ('shaft/pulse_error', lambda: messages.encode_array(
        np.zeros((5, 2)), ('pulse', 'field'), (0.0,) * 6)),
    'prediction': ('prediction', lambda: messages.encode_array(
        np.zeros((2, 3)), ('order', 'field'), (0.0,) * 6)),
    'residual': ('residual', lambda: messages.encode_array(
        np.zeros((2, 3)), ('order', 'field'), (0.0,) * 4)),
    'speed': ('shaft_speed', lambda: Float64(data=NAN)),
    'no JSON': ('missing_effect', lambda: String(data='{"verdict":')),
    'nested JSON': ('missing_effect', lambda: String(data='[' * 200000)),
    'JSON list': ('missing_effect', lambda: String(data='[1]')),
    'long JSON': ('missing_effect', lambda: String(data=' ' * 1000001)),
    'change': ('change', lambda: String(data='"none"')),
}


@pytest.mark.machines
@pytest.mark.parametrize('bad', BAD)
def test_a_malformed_message_is_counted_and_not_shown(bench, bad):
    b = bench()
    topic, message = BAD[bad]
    b.send(topic, message())
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    assert topic in text
    assert values['messages_rejected'] == '1'
    assert topic not in b.snapshot()['parts']
    publish_all(b)
    assert topic in b.snapshot()['parts']


def test_only_get_is_served(bench):
    b = bench()
    methods = ('HEAD', 'POST', 'PUT', 'DELETE', 'OPTIONS', 'PATCH')
    for method in methods:
        status, headers, _ = b.ask('/', method=method)
        assert status == 405
        assert headers['Allow'] == 'GET'
    assert b.status()['requests_refused'] == len(methods)


def test_connections_that_drip_are_ended_and_the_page_stays(bench, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(server, 'time', clock)
    b = bench()
    slow = [socket.create_connection(('127.0.0.1', b.port)) for _ in range(server.CONNECTIONS)]
    for connection in slow:
        connection.sendall(b'GET / HT')
    assert b.spin(lambda: len(b.node._server._deadlines) == len(slow))
    clock.now += server.REQUEST_SECONDS / 2
    slow[0].sendall(b'TP/1.1\r\nHost: localhost\r\n\r\n')  # this one arrives in time
    assert slow[0].recv(100).startswith(b'HTTP')
    for connection in slow[1:]:
        connection.sendall(b'T')  # a byte more does not prolong it
    clock.now += server.REQUEST_SECONDS / 2 + 1.0
    assert [connection.recv(100) for connection in slow[1:]] == [b''] * (len(slow) - 1)
    assert b.ask('/')[0] == 200
    for connection in slow:
        connection.close()


def test_a_request_takes_the_place_of_the_slowest_connection(bench):
    b = bench()
    slow = [socket.create_connection(('127.0.0.1', b.port)) for _ in range(server.CONNECTIONS)]
    for connection in slow:
        connection.sendall(b'GET / HT')
    assert b.spin(lambda: len(b.node._server._asking) == len(slow))
    assert b.ask('/')[0] == 200
    assert slow[0].recv(100) == b''
    slow[1].sendall(b'TP/1.1\r\nHost: localhost\r\n\r\n')
    assert slow[1].recv(100).startswith(b'HTTP')
    for connection in slow:
        connection.close()


def test_other_paths_are_not_found(bench):
    b = bench()
    for path in ('/nothing', '/../live_view.py', '/%2e%2e/live_view.py', '//etc/passwd', '*',
                 '/live_view_page/', '/page.js/', '/snapshot'):
        assert b.ask(path)[0] == 404
    assert b.ask('/page.js')[0] == 200


def test_a_bad_version_is_refused(bench):
    b = bench()
    for since in ('-1', 'x', '1.5', '1' * 30, '%C2%B2'):
        assert b.ask(f'/snapshot.json?since={since}')[0] == 400
        assert b.ask(f'/snapshot.json?channel={since}')[0] == 400


def test_foreign_host_name_is_refused(bench):
    b = bench()
    hosts = ('evil.example', 'evil.example:8420', '127.0.0.1.evil.example', '', '[::1',
             'localhost.evil', 'x@evil.example')
    for host in hosts:
        for path in ('/', '/snapshot.json'):
            status, _, body = b.ask(path, host=host)
            assert status == 403
            assert b'run' not in body
    assert b.status()['requests_refused'] == 2 * len(hosts)


@pytest.mark.parametrize('host', [
    'localhost', 'localhost:9', '127.0.0.1:80', '[::1]:8420', '192.0.2.7', socket.gethostname()])
def test_addresses_and_names_of_this_host_are_served(host):
    assert is_name_of_this_machine(host)


def test_page_is_complete_and_requests_nothing_elsewhere(bench):
    b = bench()
    status, headers, body = b.ask('/')
    assert status == 200
    assert headers['Content-Type'].startswith('text/html')
    assert "default-src 'self'" in headers['Content-Security-Policy']
    assert headers['X-Content-Type-Options'] == 'nosniff'
    needed = re.findall(r'(?:src|href)="([^"]+)"', body.decode())
    texts = {name: b.ask(f'/{name}') for name in needed if not name.startswith('data:')}
    assert set(texts) == {'style.css', 'page.js'}
    imported = re.findall(r"from '\./(\w+\.js)'", texts['page.js'][2].decode())
    texts.update({name: b.ask(f'/{name}') for name in imported})
    for status, headers, content in texts.values():
        assert status == 200
        assert headers['Content-Type'].split(';')[0] in ('text/css', 'text/javascript')
        assert not re.sub(rb'http://www.w3.org/2000/svg', b'', content).count(b'://')
        assert b'innerHTML' not in content


# --- starting and stopping ---


@pytest.mark.parametrize('host', ['0.0.0.0', '::', '192.0.2.7', 'rig.example'])
def test_other_machines_are_admitted_only_on_request(ros_graph, host):
    with pytest.raises(ParameterError, match='open_to_network'):
        ros_graph.add(LiveView, {'host': host, 'port': 0})


def test_opened_to_the_network_it_listens_there(ros_graph):
    node = ros_graph.add(LiveView, {'host': '0.0.0.0', 'open_to_network': True, 'port': 0})
    assert socket.gethostname() in node.summary()[1]['address']


def test_address_of_another_host_is_refused(ros_graph):
    with pytest.raises(ParameterError, match=r'cannot listen on 192\.0\.2\.7'):
        ros_graph.add(LiveView, {'host': '192.0.2.7', 'open_to_network': True, 'port': 0})


@pytest.mark.parametrize('shaft', ['Shaft', 'a b', ''])
def test_names_that_no_topic_can_have_are_refused(ros_graph, shaft):
    with pytest.raises(ParameterError, match='small letters'):
        ros_graph.add(LiveView, {'shafts': [shaft], 'port': 0})


def test_port_in_use_is_replaced_by_the_next(bench):
    first = bench()
    second = bench(port=first.port)
    assert first.port < second.port < first.port + PORTS_TRIED
    assert second.snapshot()['run'] != first.snapshot()['run']


def test_the_port_is_free_again_after_the_node(ros_graph):
    node = LiveView(context=ros_graph.context, parameter_overrides=[Parameter('port', value=0)])
    port = int(re.search(r':(\d+)/', node.summary()[1]['address'])[1])
    node.destroy_node()
    with socket.socket() as probe:
        assert probe.connect_ex(('127.0.0.1', port)) != 0


def test_what_stays_away_is_named(bench, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(health, 'time', clock)
    b = bench(stale_after=5.0, shafts=['shaft', 'other'])
    publish_all(b)
    b.graph.node.destroy_publisher(b.graph.publisher('prediction', Float64MultiArray))
    assert b.spin(lambda: not b.node.count_publishers('prediction'))
    clock.now += 8.0
    b.send('shaft/order_amplitude', average(
        'order_amplitude', amplitudes(), messages.AMPLITUDE_FIELDS))
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.WARN
    for name in ('/prediction', '/other/order_amplitude', '/shaft/condition_indicator',
                 '/shaft/pulse_error'):
        assert f'no {name} ' in text
    assert '/change' not in text  # is latched, and its publisher is there
    assert values['shaft.average_age'] == '0.0'


def test_labels_change_while_it_runs(bench):
    b = bench()
    assert b.set_parameter('vibration_unit', 'g') == (True, '')
    assert b.part('settings')['vibration_unit'] == 'g'
    assert not b.set_parameter('port', 1)[0]


def test_diagnostics_contain_the_address_and_the_number_of_averages(bench, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(board, 'time', clock)
    b = bench()
    level, text, values = b.diagnostics()
    assert level == DiagnosticStatus.OK
    assert text == f'no data received yet; page at http://127.0.0.1:{b.port}/'
    assert set(DIAGNOSTIC_KEYS) <= values.keys()
    publish_all(b)
    assert b.diagnostics()[1].startswith('1 averages shown')
    clock.now += 10.0
    assert b.diagnostics()[1].startswith('no data for 10 s')


# --- the page in a browser ---


BROWSER = next(filter(None, map(shutil.which, (
    'chromium', 'chromium-browser', 'google-chrome'))), None)
FLAGS = (
    '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
    '--disable-background-networking', '--disable-component-update', '--disable-sync',
    '--window-size=1300,2000')
DUMP = ('--dump-dom', '--virtual-time-budget=2500')


def shown(b, *flags, page='', until=None):
    """
    Return the page's document after two seconds in a browser; the node is served meanwhile.

    With `until` the browser stays open until that is true, and there is no document.
    """
    if BROWSER is None:
        pytest.skip('no chromium: apt install chromium')
    mode = [*DUMP, *flags] if until is None else ['--remote-debugging-port=0']
    with (tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
          tempfile.TemporaryFile() as output):
        process = subprocess.Popen(
            [BROWSER, *FLAGS, f'--user-data-dir={profile}', *mode,
             f'http://127.0.0.1:{b.port}/{page}'], stdout=output, stderr=subprocess.DEVNULL,
            env={**os.environ, 'DBUS_SESSION_BUS_ADDRESS': 'disabled:'})
        try:
            assert b.spin(until or (lambda: process.poll() is not None), timeout=600.0)
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        return output.read().decode()


def text_of(document, name):
    """Return the text in the element with an id."""
    found = re.search(rf'<(\w+) [^>]*id="{name}"[^>]*>(.*?)</\1>', document, re.DOTALL)
    return re.sub(r'<[^>]+>', ' ', found[2]).replace('&nbsp;', ' ')


PARTS = {'tach_shaft': 'shaft', 'gears.g.shaft': 'shaft', 'gears.g.teeth': 19,
         'gears.g.mate_shaft': 'out', 'gears.g.mate_teeth': 38}


def test_orders_have_the_names_of_the_parts_that_make_them(bench):
    b = bench(**{f'machine.{name}': value for name, value in PARTS.items()})
    publish_all(b)
    names = dict(b.part('settings')['order_names']['shaft'])
    assert names['mesh shaft-out 2x'] == 38.0
    page = shown(b)
    assert re.search(r'mesh shaft-out 1x \(19\) +0.389', text_of(page, 'orders'))
    assert 'mesh shaft-out 1x (19): +4.10 ± 0.60 % since' in page  # a trend
    limit = {**CHANGE['changes'][0], 'kind': 'limit', 'name': 'mesh shaft-out 2x', 'p_value': None,
             'level': 'alarm', 'value': 0.913, 'value_error': 0.016, 'limit': 0.8,
             'keyphasor_share': None}
    b.send('change', String(data=json.dumps({**CHANGE, 'changes': [limit]})))
    b.settle()
    said = re.sub(r'\s+', ' ', text_of(shown(b), 'attention'))
    assert 'mesh shaft-out 2x of shaft, channel 0: 0.913 ± 0.016 above 0.8 (alarm) since' in said


def test_the_browser_shows_the_numbers(bench):
    b = bench(vibration_unit='g', channel_names=['casing', '<b>end</b>'])
    publish_all(b)
    page = shown(b)
    assert re.fullmatch(r'live|no data for \d+ s', text_of(page, 'state'))
    assert text_of(page, 'speed') == '16.625 Hz'
    assert text_of(page, 'average') == 'No. 7'
    assert text_of(page, 'average-note') == '30 trigger cycles, 72 revolutions of shaft'
    rms = 1e6 * math.sqrt((pulse_errors()[:, 1]**2).mean())
    assert text_of(page, 'pulses') == f'{rms:.3g} µs RMS'
    assert text_of(page, 'pulses-note') == '31 pulses; declared 29 µs'
    assert text_of(page, 'band') == '100 %'
    assert text_of(page, 'error') == '0.012 → 0.0018'
    rows = text_of(page, 'orders').split()
    row = ('19', '0.389', '±', '0.021', '0.432', '±', '0.032', '0.25', '0.900', '±', '0.012',
           '0.8765', '0.85', 'to', '0.93', 'yes')
    assert ' '.join(row) in ' '.join(rows)
    assert 'raw [g]' in text_of(page, 'orders')
    assert text_of(page, 'indicators').split() == [
        'channel', 'rms', '[g]', 'fm0', 'casing', '0.707', '±', '0.012', '–',
        '&lt;b&gt;end&lt;/b&gt;', '0.354', '±', '0.010', '1.52', '±', '0.20']
    assert page.count('class="spread" d="M') == 2
    assert 'excess_jitter (std = 19.3 ± 0.4 µs)' in text_of(page, 'effects')
    assert 'not distinguishable from phase_wander' in text_of(page, 'effects')
    assert re.search(r'rig/averager\s+WARN\s+pulses_dropped increased\s+pulses_dropped 321',
                     text_of(page, 'nodes'))
    # waveforms of two channels, spectrum, average over the circle; the speed has a curve, too
    assert page.count('class="curve raw"') == page.count('class="curve corrected"') - 1 == 4
    assert text_of(page, 'spectrum-note').startswith('point at an order; click, or type')
    attention = re.sub(r'\s+', ' ', text_of(page, 'attention'))
    assert attention.strip() == (
        'order 19 of shaft, casing: +4.10 ± 0.60 % since average 5; the keyphasor explains 0.3 % '
        'rms of shaft, casing: -2.00 ± 0.60 % since average 5; the keyphasor explains 0.3 % '
        'rig/averager: pulses_dropped increased')
    assert (text_of(page, 'change'), text_of(page, 'change-note')) == (
        '2', 'baseline of 200 averages')
    for title in ('order 19: +4.10 ± 0.60 %', 'rms: -2.00 ± 0.60 %'):
        assert f'>{title} since average 5<' in page  # trends
    assert page.count('>CSV</button>') == page.count('>PNG</button>') + 2 == 11  # 2 tables
    assert page.count('class="change"') == 1 + 2  # in the legend, and where they began
    assert page.count('<image href="data:image/png') == 1
    assert page.count('class="mark measured"') == 6  # attenuations and residuals of 3 orders
    assert page.count('class="mark corrected"') == 3 + 31 + 1 + 1 + 1
    assert page.count('<rect class="band"') == 3 + 1
    assert '&lt;b&gt;end' in page
    assert '<b>end' not in page


# Keeps a cursor, saves what a chart shows, and tells the server what it found.
TEST_PAGE = """<!DOCTYPE html><html><head><link rel="stylesheet" href="style.css">
<script type="module" src="test.js"></script></head><body><section>
<div id="both"><div id="box"></div>
<div id="map"></div></div></section>
</body></html>"""
TEST_SCRIPT = """
import {Chart, linear} from './charts.js';
import {addButtons, csv} from './export.js';
const found = {csv: csv({columns: ['a', 'b "c", d'], rows: [[1.5, null], [2, 'x']]}), seen: []};
const make = URL.createObjectURL;
let saved;
const blob = type => new Promise(done => { saved = blob => blob.type === type && done(blob); });
URL.createObjectURL = blob => { saved(blob); return make(blob); };
HTMLAnchorElement.prototype.click = function() { found.name = this.download; };
const box = document.getElementById('box');
const chart = new Chart(box, 200, () => {
  chart.axes({x: linear([0, 10]), y: linear([0, 1]), xLabel: 'x', yLabel: 'y'});
  chart.curve('raw', i => i, [0, 1, 0, 1]);
  chart.follow(position => { found.seen.push(position); });
});
const dot = document.createElement('canvas');
dot.width = dot.height = 300;
const noise = dot.getContext('2d').createImageData(300, 300);
noise.data.forEach((_, i, data) => { data[i] = i % 4 % 2 ? 190 + 65 * Math.random() : 0; });
noise.data.forEach((_, i, data) => { if (i % 4 === 3) data[i] = 255; });
dot.getContext('2d').putImageData(noise, 0, 0);
new Chart(document.getElementById('map'), 200, map => {
  map.axes({x: linear([0, 10]), y: linear([0, 1]), xLabel: 'x', yLabel: 'y'});
  map.picture(dot.toDataURL());
});
addButtons(document.getElementById('both'), () => ({columns: ['x'], rows: [[1]]}), () => 'file');
const wait = time => new Promise(done => setTimeout(done, time));
await wait(200);
const place = chart.svg.getBoundingClientRect();
const event = (kind, x) => new MouseEvent(kind, {clientX: place.left + 62 + x * chart.inner});
chart.svg.onclick(event('click', 0.5));
chart.render();  // new data
chart.svg.onpointermove(event('pointermove', 0.75));
found.kept = chart.svg.querySelector('.cursor.kept')?.getAttribute('visibility');
const [first, second] = document.querySelectorAll('.save button');
const text = blob('text/csv');
first.onclick();
found.text = await (await text).text();
const image = blob('image/png');
second.onclick();
const picture = await createImageBitmap(await image);
found.size = [picture.width, picture.height, 2 * chart.svg.clientWidth];
const canvas = document.createElement('canvas').getContext('2d');
canvas.canvas.width = picture.width;
canvas.canvas.height = picture.height;
canvas.drawImage(picture, 0, 0);
const pixels = canvas.getImageData(0, 0, picture.width, picture.height).data;
Object.assign(found, {red: 0, green: 0});
for (let i = 0; i < pixels.length; i += 4) {
  found.red += pixels[i] > 180 && pixels[i + 1] < 100 && pixels[i + 2] < 80;
  found.green += pixels[i] < 10 && pixels[i + 1] > 180 && pixels[i + 2] < 10;
}
fetch(`found?${encodeURIComponent(JSON.stringify(found))}`);
"""


def test_charts_keep_a_cursor_and_are_saved_as_csv_and_png(bench, monkeypatch, tmp_path):
    pages = tmp_path / 'live_view_page'
    shutil.copytree(server.files('sa_jitter_ros.nodes').joinpath('live_view_page'), pages)
    (pages / 'test.html').write_text(TEST_PAGE)
    (pages / 'test.js').write_text(TEST_SCRIPT)
    monkeypatch.setattr(server, 'files', lambda package: tmp_path)
    told, get = [], server._Handler.do_GET

    def listen(handler):
        told.extend(re.findall(r'^/found[?](.*)', handler.path))
        get(handler)

    monkeypatch.setattr(server._Handler, 'do_GET', listen)
    shown(bench(), page='test.html', until=lambda: told)
    found = json.loads(unquote(told[0]))
    assert found['csv'] == 'a,"b ""c"", d"\n1.5,\n2,x\n'
    assert found['kept'] == 'visible'
    # clicked, drawn again, pointed elsewhere
    np.testing.assert_allclose(found['seen'][-3:], 0.5, atol=2e-3)
    assert (found['name'], found['text']) == ('file.png', 'x\n1\n')
    assert found['size'][:2] == [found['size'][2], 800]
    assert found['red']
    assert found['green'] == (found['size'][2] - 2 * 76) * 2 * 136  # the pixels within its axes


def test_malformed_report_does_not_disturb_the_page(bench):
    b = bench()
    publish_all(b)
    b.send('missing_effect', String(data='{"lines": [null], "missing_effects": 3}'))
    page = shown(b)
    assert text_of(page, 'speed') == '16.625 Hz'
    assert 'rig/averager' in text_of(page, 'nodes')


def test_the_browser_shows_that_there_is_no_data(bench):
    page = shown(bench())
    assert text_of(page, 'state') == 'no data received yet'
    assert 'no synchronous average received yet' in page
    assert 'live_view' in text_of(page, 'nodes')
    assert 'NaN' not in page


@pytest.mark.processes
def test_the_demo_prints_an_address_that_answers(process_environment, tmp_path):
    demo = subprocess.Popen(
        [sys.executable, '-c',
         'from sa_jitter_ros.commands.demo import main; raise SystemExit(main())', '--live',
         '--output', str(tmp_path)], env={**process_environment, 'PYTHONUNBUFFERED': '1'},
        stdout=subprocess.PIPE, text=True)
    try:
        address = next(filter(None, (re.search(r'http://127\.0\.0\.1:(\d+)/', line)
                                     for line in demo.stdout)))
        connection = http.client.HTTPConnection('127.0.0.1', int(address[1]), timeout=60.0)
        connection.request('GET', '/snapshot.json')
        parts = json.loads(connection.getresponse().read())['parts']
        connection.close()
        assert parts['settings']['content']['vibration_unit'] == 'm/s^2'
        assert parts['settings']['content']['channel_names'] == [
            'input bearing', 'output bearing']
    finally:
        demo.send_signal(signal.SIGINT)
        demo.communicate(timeout=600.0)  # reads on: it may be printing
        assert demo.returncode == 130
    with socket.socket() as probe:
        assert probe.connect_ex(('127.0.0.1', int(address[1]))) != 0
