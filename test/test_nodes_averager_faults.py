# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Random faults, seeded: every average that the node publishes is that of the cycles it claims.

The scenes are those of `benchmarks/fault_campaign.py`, which plays them to processes by the
thousand; here they go to one node in this process, so that its counts can be read between any two.
"""

from collections import Counter
from dataclasses import replace
import json

from bench import AveragerBench
from fault_check import check_correction, ShaftChecker, WrongAverageError
from fault_graph import DETECTED, DIRECT, Inbox, KINDS, ORDERS
from fault_machine import RATE
from fault_residual import check_report, ResidualChecker, WrongResidualError
from fault_source import FaultySource, KEYPHASOR
from machine import Machine
import numpy as np
import pytest
from sa_jitter_ros.inference.online import compare, Published
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.residual_analyser import average_of
from sa_jitter_ros.samples import SampleBlock

SHAFTS = ('tach', 'gear')
JUDGED = ('accepted', 'doubles', 'early', 'out_of_order', 'non_finite', 'unlocked')


class SceneBench:
    """The averager, a faulty source, and a checker for each shaft."""

    def __init__(self, graph, seed, **parameters):
        self.settings = [{**DIRECT, **parameters}]
        options = {name.replace('.', '__'): value for name, value in self.settings[0].items()}
        del options['shafts']
        self.bench = AveragerBench(graph, shafts=SHAFTS, **options)
        self.source = FaultySource(np.random.default_rng(seed))
        self.checkers = {name: ShaftChecker(name, self.source.runs, self.settings, delivered=True)
                         for name in SHAFTS}
        self.faults, self.sent, self.rejected = Counter(), Counter(), 0

    def play(self, **options):
        """Play a scene; return which shafts had an average of its tail."""
        scene, well = self.source.scene(**options), set()
        for number, (_, topic, message) in enumerate(scene.events):
            if topic != 'tach_waveform':
                self.bench.send(topic, message)
            if topic == 'tach_pulse':
                self.sent[message.source] += 1
            if number % 40 == 0:
                well |= self.check(scene)
        self.bench.settle()
        self.faults += scene.faults
        self.rejected += scene.rejected
        return well | self.check(scene)

    def check(self, scene):
        """Check what has come."""
        well = set()
        for name, checker in self.checkers.items():
            amplitudes, waveforms = (self.bench.received[f'{name}/{kind}'] for kind in (
                'order_amplitude', 'synchronous_average'))
            while amplitudes and waveforms:
                place = checker.check(
                    messages.decode_average('order_amplitude', amplitudes.pop(0)),
                    messages.decode_average('synchronous_average', waveforms.pop(0)))
                if place.run is scene.run and place.first >= scene.tail:
                    well.add(name)
        return well


@pytest.mark.machines
@pytest.mark.parametrize(('averaging', 'seed', 'scenes'), [('block', 1, 2), ('sliding', 3, 1)])
def test_every_average_is_true_in_spite_of_faults(ros_graph, averaging, seed, scenes):
    b = SceneBench(ros_graph, seed, averaging=averaging)
    for _ in range(scenes):
        missing = set(SHAFTS) - b.play()
        if missing:  # within buffer_seconds of faultless input
            missing -= b.play(changes=False, faults=False)
        assert not missing - b.play(changes=False, faults=False)
    status = b.bench.status()
    assert sum(b.faults.values()) > 5 * scenes
    for checker in b.checkers.values():
        assert checker.checked > 20
    assert status['averages'] == sum(checker.checked for checker in b.checkers.values())
    assert status['messages_rejected'] == b.rejected
    assert 0 <= b.sent[KEYPHASOR] - sum(status[f'pulses_{key}'] for key in JUDGED) <= 3
    faults = {kind: b.faults[f'vibration: {kind}'] for kind in (
        'lost', 'repeated', 'swapped', 'late', 'not finite', 'time', 'channels', 'rate')}
    assert status['clock_deviation'] >= faults['time']
    assert status['repeats'] >= faults['repeated'] + faults['swapped'] + faults['late']
    assert status['gaps'] >= faults['lost'] + faults['swapped'] + faults['late']
    assert status['samples_lost'] >= faults['lost']
    # a gap of samples that came and were refused is counted with those, not as a loss
    refused = faults['time'] + faults['channels'] + faults['rate']
    assert status['samples_lost'] >= (
        status['gaps'] - refused - b.faults['source: other channels'])
    assert status['samples_dropped'] >= status['repeats']
    assert status['cycles_dropped'] > 0


@pytest.mark.machines
def test_no_average_mixes_old_and_new_parameters(ros_graph, rng):
    b = SceneBench(ros_graph, 5)
    for name, value in (('trigger_cycles', 9), ('gear.ratio', 0.41), ('pulses_per_trigger', 1),
                        ('tach.orders', [2.5]), ('missing_pulses', 'bridge'),
                        ('interval_tolerance', 0.03)):
        scene = b.source.scene()
        at = int(rng.integers(len(scene.events) // 2))
        for number, (_, topic, message) in enumerate(scene.events):
            if number == at:
                b.bench.settle()
                b.check(scene)
                assert b.bench.set_parameter(name, value) == (True, '')
                b.settings.append({**b.settings[-1], name: value})
            if topic != 'tach_waveform':
                b.bench.send(topic, message)
            b.sent[topic, getattr(message, 'source', '')] += 1
        b.bench.settle()
        b.check(scene)
        del b.settings[:-1]
    status = b.bench.status()
    judged = sum(status[f'pulses_{key}'] for key in JUDGED)  # totals outlive a new validator
    assert 0 <= b.sent['tach_pulse', KEYPHASOR] - judged <= 3
    assert status['averages'] == sum(checker.checked for checker in b.checkers.values()) > 100


def test_check_of_averages_detects_errors(ros_graph):
    """Averages of other cycles, phases, samples or counts are detected."""
    b = SceneBench(ros_graph, 3)
    scene = b.source.scene(changes=False, faults=False)
    for _, topic, message in scene.events:
        if topic != 'tach_waveform':
            b.bench.send(topic, message)
    b.bench.settle()
    pairs = [(messages.decode_average('order_amplitude', amplitude),
              messages.decode_average('synchronous_average', waveform))
             for amplitude, waveform in zip(b.bench.received['gear/order_amplitude'],
                                            b.bench.received['gear/synchronous_average'])]
    checker = b.checkers['gear']
    assert len(pairs) > 5
    for spoil in ('amplitude', 'phase', 'waveform', 'time', 'cycles', 'sequence', 'speed'):
        amplitude, waveform = (messages.AverageMessage(
            item.header, item.values.copy(), item.names) for item in pairs[0])
        if spoil == 'amplitude':
            amplitude.values[:, 1, 1] *= 1.01
        elif spoil == 'phase':
            amplitude.values[:, 1, 2] += 0.01
        elif spoil == 'waveform':
            waveform.values[0, 7] += 0.1
        else:
            change = {'time': ('start_time', amplitude.header.start_time + 1e-6),
                      'cycles': ('fundamental_cycles', 15), 'sequence': ('sequence', 1),
                      'speed': ('mean_trigger_speed', 30.1)}[spoil]
            header = messages.AverageHeader(**{**vars(amplitude.header), change[0]: change[1]})
            amplitude, waveform = (messages.AverageMessage(header, item.values, item.names)
                                   for item in (amplitude, waveform))
        with pytest.raises(WrongAverageError):
            checker.check(amplitude, waveform)
    assert checker.check(*pairs[0]).first >= 0
    with pytest.raises(WrongAverageError, match='sequence'):  # one of them is missing
        checker.check(*pairs[2])


@pytest.fixture
def corrected(ros_graph):
    """Return averages with their corrections, and their positions in the record."""
    settings = [dict(DETECTED)]
    options = {name.replace('.', '__'): value for name, value in DETECTED.items()}
    b = AveragerBench(ros_graph, **options)
    inbox = Inbox(b.graph.node, 'shaft')
    assert b.spin(lambda: all(b.graph.node.count_publishers(f'shaft/{kind}') for kind in KINDS))
    source = FaultySource(np.random.default_rng(3))
    checker = ShaftChecker('shaft', source.runs, settings, delivered=True)
    for scene in (source.scene(), source.scene(changes=False, faults=False)):
        for _, topic, message in scene.events:
            if topic != 'tach_waveform':
                b.send(topic, message)
        b.settle()
    found = [(item, checker.check(item.amplitude, item.waveform)) for item in inbox.take()]
    assert inbox.incomplete == 0
    return [(item, place) for item, place in found
            if check_correction('shaft', item, place, settings)]


def with_value(message, place, change):
    """Return a message with one element of its values changed by a function."""
    values = message.values.copy()
    values[place] = change(values[place])
    return replace(message, values=values)


def test_check_of_corrected_averages_detects_errors(corrected):
    assert len(corrected) > 5
    largest = [np.abs(item.pulse_error.values[:, 1]).max() for item, _ in corrected]
    assert max(largest) > 2e-5
    item, place = corrected.pop(int(np.argmax(largest)))
    errors = item.pulse_error.values
    spoilt = {
        'not those between': [
            replace(item, amplitude=with_value(item.amplitude, (0, 2, 3), lambda x: 1.2 * x)),
            replace(item, amplitude=with_value(item.amplitude, (0, 2, 4), lambda x: x + 0.2)),
            replace(item, corrected=with_value(item.corrected, (0, 7), lambda x: x + 1.0))],
        'standard errors apart': [
            replace(item, pulse_error=with_value(  # with the same standard error
                item.pulse_error, (2, 1), lambda x: x + 8.0 * errors[2, 2])),
            replace(item, pulse_error=with_value(
                item.pulse_error, (slice(None), 1), lambda x: x + 1e-6))],
        'attenuation is': [replace(item, amplitude=with_value(
            item.amplitude, (0, 2, 5), lambda x: x + 0.05))],
        'are not those of': [replace(item, pulse_error=with_value(
            item.pulse_error, (3, 0), lambda x: x + 1e-6))],
        'are not of': [replace(item, pulse_error=corrected[0][0].pulse_error),
                       replace(item, corrected=corrected[0][0].corrected)]}
    for what, wrong in spoilt.items():
        for received in wrong:
            with pytest.raises(WrongAverageError, match=what):
                check_correction('shaft', received, place, [DETECTED])
    with pytest.raises(WrongAverageError, match='without correct_jitter'):
        check_correction('shaft', item, place, [{**DETECTED, 'correct_jitter': False}])


@pytest.mark.machines
def test_check_of_residuals_detects_errors(corrected):
    amplitudes = [item.amplitude for item, _ in corrected]
    order = amplitudes[0].values[0, :, 0]
    table = np.stack((order, *np.tile([[0.9], [0.01], [0.1], [0.8], [0.9], [1.0]], 3)), axis=1)
    prediction = messages.PredictionMessage(table, 25.0, RATE, 6, 1.0, 4.5e-5, 0.0)
    checker = ResidualChecker()
    checker.add_prediction(prediction)
    for amplitude in amplitudes:
        checker.add_average(amplitude)
    rows, found = compare([average_of(item) for item in amplitudes[-4:]], Published(
        order, table[:, 1], table[:, 3], 25.0, RATE, 6, 1.0, 4.5e-5))
    residual = messages.ResidualMessage(rows, 4, found.chi2_per_dof, found.p_value, found.rms)
    checker.check(residual)
    assert checker.checked == 1
    for change, says in (({'acquisitions': 3}, 'of no averages'), ({'p_value': 1.5}, 'residual'),
                         ({'rms': 1.1 * found.rms}, 'agree with itself'),
                         ({'chi2_per_dof': 1.1 * found.chi2_per_dof}, 'of no averages')):
        with pytest.raises(WrongResidualError, match=says):
            checker.check(replace(residual, **change))
    for column in range(6):
        with pytest.raises(WrongResidualError):
            checker.check(with_value(residual, (1, column), lambda x: 1.01 * x + 0.001))


def test_check_of_reports_detects_errors():
    whole = {'declared': {}, 'acquisitions': {'fit': 2, 'held_out': 2}, 'orders': [1.0],
             'missing_effects': [], 'candidates': [], 'error_before': {}, 'error_after': {},
             'verdict': 'none'}
    assert check_report(json.dumps(whole)) == 'none'
    effect = {'name': 'clock_skew', 'evidence': 'it drifts', 'p_value': 1e-5,
              'parameters': {'skew': {'value': None}}}
    for change, says in (({'verdict': 'maybe'}, 'maybe'), ({'verdict': 'traced'}, 'traced'),
                         ({'orders': [float('nan')]}, 'NaN'),
                         ({'verdict': 'traced', 'missing_effects': [effect]}, 'clock_skew')):
        with pytest.raises(WrongResidualError, match=says):
            check_report(json.dumps({**whole, **change}))
    del whole['candidates']
    with pytest.raises(WrongResidualError, match='candidates'):
        check_report(json.dumps(whole))


def test_node_works_after_random_messages(ros_graph):
    """Random layouts, headers and data are rejected or used; afterwards the node still works."""
    rng = np.random.default_rng(5)
    b = AveragerBench(ros_graph, shafts=('tach',), trigger_cycles=6,
                      tach__orders=ORDERS)
    wild = [0.0, 1.0, -1.0, 0.5, 1e6, 1e300, -1e300, np.nan, np.inf, 2.0**53, 6400.0]
    for _ in range(300):
        message = messages.encode_samples(SampleBlock(
            rng.standard_normal(rng.integers(1, (4, 50))), 0.0, RATE, 0))
        for position in range(3):
            if rng.random() < 0.5:
                message.data[position] = float(rng.choice(wild))
        if rng.random() < 0.2:
            message.layout.dim[int(rng.integers(2))].size = int(rng.integers(0, 60))
        if rng.random() < 0.1:
            message.layout.data_offset = int(rng.integers(0, 5))
        if rng.random() < 0.1:
            message.layout.dim.clear()
        b.send('vibration', message)
        if rng.random() < 0.3:
            pulse = messages.encode_pulse_reference(float(rng.uniform(-10, 10)), 'kp')
            pulse.time_ref.sec = int(rng.choice([0, 1, -2**31, 2**31 - 1, pulse.time_ref.sec]))
            b.send('tach_pulse', pulse)
    assert b.status()['messages_rejected'] > 50
    machine = Machine(speed=25.0, rate=RATE)
    before = len(b.amplitudes('tach'))
    b.play(machine, 8.0, start=20.0)
    later = b.amplitudes('tach')[before:]
    assert len(later) >= 2
    for average in later[1:]:
        np.testing.assert_allclose(average.values[0, 0, 1], 1.0, atol=5e-3)


def test_memory_is_bounded_without_pulses_and_without_vibration(ros_graph):
    b = AveragerBench(ros_graph, buffer_seconds=0.5, trigger_cycles=6,
                      shaft__orders=ORDERS)
    machine = Machine(speed=25.0, rate=RATE)
    for index in range(0, 64000, 3200):
        b.send('vibration', messages.encode_samples(machine.block(index, 3200)))
    b.settle()
    status = b.status()
    assert status['samples_dropped'] == 64000 - 3200
    b.send_pulses(machine.pulses(10.0, 20.0))
    b.settle()
    assert b.status()['pulses_dropped'] > 200
    assert 'waited longer than buffer_seconds' in b.diagnostics()[1] or (
        b.status()['cycles_dropped'] > 200)
    b.play(machine, 2.0, start=40.0)
    assert len(b.amplitudes()) >= 4
