# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loop on line: functions on synthetic averages, and the node in a closed loop."""

from dataclasses import replace
import json

from bench import NodeBench, SteadyClock
import numpy as np
import pytest
from rcl_interfaces.msg import SetParametersResult
from sa_jitter_ros.effects import EFFECTS, make_effect
from sa_jitter_ros.errors import ModelError, ParameterError, SignalError
from sa_jitter_ros.inference.online import (
    Batch, compare, declared_by, Published, ReceivedAverage, require_comparable)
from sa_jitter_ros.inference.online_trace import trace_averages
from sa_jitter_ros.nodes import health, messages, residual_analyser
from sa_jitter_ros.nodes.base import LATCHED_QOS
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor, prediction_message
from sa_jitter_ros.nodes.residual_analyser import ResidualAnalyser
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.report.report import report
from sa_jitter_ros.simulation import (AdditiveNoise, band_limited, DeclaredJitter, Gearbox,
                                      make_effects, mesh)
from std_msgs.msg import Float64MultiArray, String

pytestmark = pytest.mark.usefixtures('unasked')
RATIO, SPEED, CLOCK, CYCLES = 183 / 76, 25.0, 20000.0, 25
MODEL = DeclaredModel(keyphasor_rate=CLOCK, trigger_speed=SPEED, trigger_cycles=CYCLES,
                      orders=(19.0, 38.0), ratio=RATIO)
ORDERS = np.array(MODEL.orders)


def published(*effects, **changes):
    """Return the prediction of the model with effects."""
    found = predict(replace(MODEL, **changes), effects)
    speed, rate, cycles, ratio, error, _ = found.header
    return Published(found.order, found.mean_attenuation, found.standard_deviation, speed, rate,
                     int(cycles), ratio, error)


def synthetic(count, *, std=0.0, seed=0, noise=1e-3, grid=0.0, wander=0.0):
    """
    Return averages of two channels with the declared jitter and normal errors of `std` s.

    Pulse times lie on a `grid` (Hz); the source moves by `wander` s, which the times do not show.
    """
    rng = np.random.default_rng(seed)
    edges = np.arange(count * CYCLES + 1)
    errors = rng.uniform(-0.5, 0.5, edges.size) / CLOCK + std * rng.standard_normal(edges.size)
    # the speed fluctuates, so that the pulse times alone do not show the errors
    true = edges / SPEED + 1e-4 * np.sin(0.3 * edges)
    times = true + errors
    if grid:
        times = np.ceil(true * grid) / grid
        errors = times - true
    if wander:  # below half the trigger rate
        slow = 2.0 * np.pi * rng.uniform(0.02, 0.25, (60, 1)) * edges
        errors = errors + wander * np.sqrt(2.0 / 60.0) * np.sin(
            slow + rng.uniform(0.0, 2.0 * np.pi, (60, 1))).sum(axis=0)
    found = []
    for first in range(0, count * CYCLES, CYCLES):
        rows = slice(first, first + CYCLES + 1)
        e = np.multiply.outer(ORDERS, errors[rows]) * RATIO * SPEED
        gain = np.mean(np.exp(1j * np.pi * (e[:, 1:] + e[:, :-1])) * np.sinc(np.diff(e)), axis=1)
        level = np.array([[1.0, 0.6], [0.7, 0.5]])
        corrected = level * np.exp(1j * rng.uniform(0.0, 6.0, 2))
        corrected = corrected + noise * rng.standard_normal((2, 2))
        attenuation = np.abs(corrected * gain) / np.abs(corrected)
        when = times[rows]
        found.append(ReceivedAverage(
            when[0], when[-1], CYCLES, int(CYCLES * RATIO), CYCLES / (when[-1] - when[0]), ORDERS,
            corrected * gain, corrected, attenuation,
            noise / np.abs(corrected) * np.sqrt(1.0 - attenuation**2), np.full((2, 2), noise),
            np.stack((when, errors[rows] - errors[rows].mean(), np.full(CYCLES + 1, 1e-6)),
                     axis=1)))
    return found


# --- core ----------------------------------------------------------------------------------------


def test_residual_of_the_declared_jitter_is_random():
    z, p_values = [], []
    for seed in range(20):
        table, found = compare(synthetic(16, seed=seed), published())
        np.testing.assert_array_equal(table[:, 0], ORDERS)
        np.testing.assert_allclose(table[:, 1] - table[:, 2], table[:, 3], atol=1e-12)
        np.testing.assert_allclose(table[:, 3] / table[:, 4], table[:, 5])
        z.append(table[:, 5])
        p_values.append(found.p_value)
    # the two orders share their pulses: 20 independent z values each
    assert np.abs(np.mean(z, axis=0)).max() < 4.0 / np.sqrt(20.0)
    assert min(p_values) > 1e-3


def test_residual_is_the_attenuation_that_the_prediction_lacks():
    std = 5e-5
    table, found = compare(synthetic(30, std=std), published())
    truth = published(make_effect('excess_jitter', std=std))
    error = truth.standard_deviation / np.sqrt(30.0)
    assert (np.abs(table[:, 1] - truth.mean) < 4.0 * error).all()
    assert found.p_value < 1e-6
    assert found.rms == pytest.approx(np.sqrt(np.mean((truth.mean - published().mean) ** 2)),
                                      rel=0.2)
    assert compare(synthetic(30, std=std), truth)[1].p_value > 0.01


def test_channels_without_signal_do_not_count():
    averages = synthetic(8)
    spoilt = [replace(
        item, corrected=item.corrected * [[1.0, 1.0], [1e-3, 1.0]],
        attenuation=np.where([[False, False], [True, False]], 3.0, item.attenuation))
        for item in averages]
    np.testing.assert_allclose(compare(spoilt, published())[0], compare(averages, published())[0],
                               rtol=0.05, atol=1e-5)
    with pytest.raises(SignalError, match='none of the orders 19, 38 stands ten times above'):
        compare([replace(item, noise=item.noise + 1.0) for item in averages], published())


@pytest.mark.parametrize(('change', 'reason'), [
    ({'trigger_cycles': 40}, 'for 40 trigger cycles and the averages have 25'),
    ({'ratio': 1.0}, 'for the ratio 1, which makes 25 fundamental cycles'),
    ({'ratio': 2.476}, 'fundamental cycles, and an average has 60 whole ones'),
    ({'trigger_speed': 30.0}, 'for 30 Hz and the tach shaft turns at 25 Hz'),
    ({'orders': (5.0,)}, 'orders 19, 38 and the prediction 5'),
])
def test_prediction_of_another_average_is_not_compared(change, reason):
    averages = synthetic(4)
    require_comparable(averages, published())
    with pytest.raises(ModelError, match=reason):
        require_comparable(averages, published(**change))


@pytest.mark.machines
def test_trace_names_the_effect_and_its_size():
    found = trace_averages(synthetic(20, std=5e-5), MODEL)
    assert found.verdict == 'traced'
    (effect,) = found.findings
    assert effect.name == 'excess_jitter'
    assert effect.effect.std == pytest.approx(5e-5, abs=4.0 * effect.standard_errors['std'])
    assert found.after.rms < 0.2 * found.before.rms
    reasons = {item.name: item.rejected_because for item in found.candidates}
    assert 'run close_loop on a recording' in reasons['speed_fluctuation']


def test_trace_finds_the_grid_of_a_clock():
    found = trace_averages(synthetic(20, grid=4000.0), MODEL, name_of='mesh {:g}'.format)
    assert {item['name'] for item in report(found)['lines']} == {
        f'mesh {order:g}' for order in MODEL.orders}
    assert found.verdict == 'traced'
    assert [item.name for item in found.findings] == ['keyphasor_quantisation']
    assert found.findings[0].effect.clock_rate == pytest.approx(4000.0, rel=1e-6)
    assert found.after.rms < 0.1 * found.before.rms


@pytest.mark.machines
def test_trace_names_indistinguishable_effects():
    found = trace_averages(synthetic(20, wander=3e-5), MODEL)
    assert [item.name for item in found.findings] == ['phase_wander']
    assert 'speed_fluctuation' in report(found)['missing_effects'][0]['indistinguishable_from']


@pytest.mark.machines
def test_trace_does_not_repeat_declared_effects():
    found = trace_averages(synthetic(20, std=5e-5), MODEL,
                           declared=(make_effect('excess_jitter', std=5e-5),))
    assert found.verdict == 'none'
    assert [item.name for item in found.declared] == ['excess_jitter']


@pytest.mark.machines
def test_trace_takes_the_longest_stretch_without_a_gap():
    averages = synthetic(14, std=5e-5)
    del averages[3]
    averages[-1] = replace(averages[-1], pulses=None)
    found = trace_averages(averages, MODEL)
    assert (len(found.fit), len(found.held_out)) == (5, 4)
    with pytest.raises(ModelError, match='3 acquisitions of 25 trigger cycles'):
        trace_averages(averages[:5], MODEL)
    with pytest.raises(SignalError, match='set correct_jitter: true'):
        trace_averages(averages[-1:], MODEL)


@pytest.mark.parametrize('change', [
    {}, {'jitter_distribution': 'normal', 'jitter_std': 3e-5},
    {'pulses_per_revolution': 6, 'pulses_per_trigger': 2, 'trigger_speed': SPEED / 3.0}])
def test_declared_model_is_recovered_from_the_prediction(change):
    model = replace(MODEL, **change)
    averages = [replace(item, trigger_speed=model.trigger_speed) for item in synthetic(4)]
    found = declared_by(averages, published(**change))
    np.testing.assert_allclose(predict(found).mean_attenuation,
                               predict(model).mean_attenuation)


def test_batch_keeps_independent_averages_of_one_run():
    batch, averages = Batch(3), synthetic(6)
    for item in averages[:2]:
        batch.add(item)
    batch.add(replace(averages[2], start_time=averages[2].start_time - 0.5))  # a sliding average
    assert (len(batch.averages), batch.overlapping, batch.full) == (2, 1, False)
    for item in averages[2:]:
        batch.add(item)
    assert batch.full
    assert batch.averages == averages[3:]
    batch.add(averages[0])  # a restart
    assert batch.averages == averages[:1]
    batch.add(replace(averages[1], orders=ORDERS + 1.0))
    assert len(batch.averages) == 1


# --- node ----------------------------------------------------------------------------------------


class AnalyserBench(NodeBench):
    """A bench around the analyser, with topics of synthetic averages."""

    def __init__(self, graph, **parameters):
        topics = ('shaft/order_amplitude', 'shaft/pulse_error')
        super().__init__(
            graph, ResidualAnalyser, inputs=dict.fromkeys(topics, Float64MultiArray),
            outputs={'residual': Float64MultiArray, 'missing_effect': String},
            **{'acquisitions': 8, **parameters})
        graph.publisher('prediction', Float64MultiArray, qos=LATCHED_QOS)

    def predict(self, **changes):
        """Publish a prediction."""
        self.send('prediction', messages.encode_prediction(
            prediction_message(predict(replace(MODEL, **changes)))))
        self.settle()

    def average(self, averages, *, corrected=True, pulses=True):
        """Publish averages."""
        for number, item in enumerate(averages):
            header = messages.AverageHeader(
                item.start_time, item.end_time, number, CYCLES, item.fundamental_cycles,
                item.trigger_speed)
            table = np.stack((
                np.broadcast_to(ORDERS, (2, 2)), np.abs(item.raw), np.angle(item.raw),
                np.abs(item.corrected), np.angle(item.corrected), item.attenuation,
                item.attenuation_standard_error, item.noise), axis=-1)
            if not corrected:
                table[..., 3:7] = np.nan
            self.send('shaft/order_amplitude', messages.encode_average(
                'order_amplitude', messages.AverageMessage(header, table)))
            if corrected and pulses:
                self.send('shaft/pulse_error', messages.encode_average(
                    'pulse_error', messages.AverageMessage(header, item.pulses)))
        self.settle()

    def give_up(self, clock):
        """Let the analyser wait in vain for an answer of the predictor."""
        assert self.spin(lambda: self.node._activity.startswith('waiting for'))
        clock.now += 20.0

    def reported(self, text):
        """Return whether a status contains the text, up to the one that is published now."""
        self.node.publish_diagnostics()
        return any(text in item.status[0].message for item in self.received['/diagnostics'])

    def residuals(self):
        """Return the residuals received."""
        return [messages.decode_residual(item) for item in self.received['residual']]

    def reports(self):
        """Return the missing effects received."""
        return [json.loads(item.data) for item in self.received['missing_effect']]


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    """Return the clock by which analysers wait for the predictor; it stands still."""
    found = SteadyClock()
    monkeypatch.setattr(residual_analyser, 'time', found)
    return found


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches."""
    return lambda **options: AnalyserBench(ros_graph, **options)


@pytest.mark.machines
def test_batch_is_compared_and_traced_without_a_predictor(bench, clock):
    b = bench()
    b.predict()
    averages = synthetic(8, std=5e-5)
    b.average(averages)
    b.give_up(clock)
    assert b.spin(b.reports)
    (residual,), (content,) = b.residuals(), b.reports()
    table, found = compare(averages, published())
    np.testing.assert_allclose(residual.values, table)
    assert residual.acquisitions == 8
    assert residual.p_value == pytest.approx(found.p_value, rel=1e-6)
    assert content['verdict'] == 'traced'
    assert content['missing_effects'][0]['name'] == 'excess_jitter'
    assert content['acquisitions'] == {'fit': 4, 'held_out': 4}
    assert {'declared', 'orders', 'candidates', 'error_before', 'error_after'} <= content.keys()
    # the next batch needs new averages
    b.average(synthetic(7))
    assert len(b.residuals()) == 1


def test_missing_effect_is_latched(bench, clock):
    b = bench()
    b.predict()
    b.average(synthetic(8))
    b.give_up(clock)
    assert b.spin(b.reports)
    late = b.graph.capture('missing_effect', String, latched=True)
    assert b.spin(lambda: late)
    assert json.loads(late[0].data)['verdict'] == 'none'


@pytest.mark.machines
def test_absent_predictor_is_a_diagnostic(bench, clock):
    b = bench(close_loop=True, predictor='elsewhere')
    b.predict()
    b.average(synthetic(8, std=5e-5))
    b.give_up(clock)
    assert b.spin(lambda: b.reported('elsewhere does not answer: independent jitter'))
    assert b.spin(b.reports)
    assert b.reports()[0]['verdict'] == 'traced'
    b.give_up(clock)
    assert b.spin(lambda: b.reported('elsewhere does not answer: its effects cannot be set'))


@pytest.mark.parametrize(('change', 'reason'), [
    ({'trigger_cycles': 40}, 'set trigger_cycles'), ({'ratio': 1.0}, 'set ratio')])
def test_mismatch_is_reported_until_it_is_corrected(bench, change, reason):
    b = bench()
    b.predict(**change)
    b.average(synthetic(8))
    assert b.spin(lambda: b.reported(reason))
    assert not b.residuals()
    b.predict()
    assert b.spin(b.residuals)


@pytest.mark.parametrize(('name', 'value', 'reason'), [
    ('shaft', 'Gear', 'small letters'), ('predictor', '0', 'give the name of a node'),
    ('predictor', 'a b', 'give the name of a node')])
def test_names_that_no_topic_or_node_can_have_are_refused(ros_graph, name, value, reason):
    with pytest.raises(ParameterError, match=reason):
        ros_graph.add(ResidualAnalyser, {name: value})


def test_averages_without_correction_are_refused(bench):
    b = bench()
    b.predict()
    b.average(synthetic(8), corrected=False)
    assert b.spin(lambda: b.reported('set correct_jitter: true in the averager; if the averager '
                                     'refuses') and b.reported('better keyphasor'))
    values = b.diagnostics()[2]
    assert values['uncorrected'] == '8'
    assert values['averages'] == '0'
    b.average([replace(item, start_time=item.start_time + 100.0, end_time=item.end_time + 100.0)
               for item in synthetic(3)])
    assert b.spin(lambda: b.diagnostics()[2]['averages'] == '3')
    assert b.diagnostics()[1].startswith('comparison: without 7 of the latest 10 averages, ')


@pytest.mark.machines
def test_averages_with_unresolved_pulses_are_counted(bench):
    # the graph's node, which is no predictor, has parameter services, not the parameters
    b = bench(predictor='test')
    b.predict()
    averages = synthetic(8, std=5e-5)
    for number, pulse in ((1, 3), (1, 4), (6, 0)):
        averages[number].pulses[pulse, 1:] = np.nan
    b.average(averages)
    assert b.spin(lambda: b.reported('test does not answer: independent jitter'))
    assert b.spin(b.reports)  # of averages 2 to 5
    assert sum(b.reports()[0]['acquisitions'].values()) == 4
    assert b.reports()[0]['declared']['keyphasor_rate'] == CLOCK
    assert b.spin(lambda: b.diagnostics()[2]['averages_not_traced'] == '4')
    assert b.diagnostics()[2]['averages_with_unresolved_pulses'] == '2'
    assert not b.reported('tell no cause')
    shift = averages[-1].end_time
    for item in averages:
        item.pulses[5, 1:] = np.nan
        item.pulses[:, 0] += shift
    b.average([replace(item, start_time=item.start_time + shift, end_time=item.end_time + shift)
               for item in averages])
    assert b.spin(lambda: b.reported('8 of 8 averages have pulses whose error the vibration'))
    assert b.spin(lambda: b.diagnostics()[2]['averages_not_traced'] == '12')
    assert b.diagnostics()[2]['averages_with_unresolved_pulses'] == '10'


def test_a_batch_too_small_for_a_cause_says_how_many_it_takes(bench):
    b = bench(acquisitions=3)
    b.predict()
    b.average(synthetic(3))
    assert b.spin(lambda: b.reported('3 averages at once tell no cause, at least 4 do'))
    assert not b.reported('ambiguous')


def test_silent_inputs_are_named(bench, monkeypatch):
    clock = SteadyClock()
    monkeypatch.setattr(health, 'time', clock)
    b = bench(stale_after=5.0)
    b.predict()
    b.average(synthetic(1))
    assert b.diagnostics()[0] == b'\x00'
    for seconds, expected in ((8.0, b'\x01'), (12.0, b'\x02')):
        clock.now += seconds
        b.average(synthetic(1), pulses=False)
        level, text, _ = b.diagnostics()
        assert (level, 'no /shaft/pulse_error for' in text) == (expected, True)
        assert 'prediction' not in text  # it is latched
    b.average(synthetic(1), corrected=False)  # has no pulse errors
    assert 'pulse_error' not in b.diagnostics()[1]
    b.average(synthetic(1))
    assert 'no /' not in b.diagnostics()[1]
    b.graph.node.destroy_publisher(b.graph.publisher('prediction', Float64MultiArray))
    assert b.spin(lambda: not b.node.count_publishers('prediction'))
    for seconds, expected, silence in ((8.0, b'\x01', 8), (12.0, b'\x02', 20)):
        clock.now += seconds
        b.average(synthetic(1))
        level, text, _ = b.diagnostics()
        assert (level, text.partition(': start')[0]) == (
            expected, f'no /prediction for {silence} s: nobody publishes it')
    again = b.graph.node.create_publisher(Float64MultiArray, 'prediction', LATCHED_QOS)
    again.publish(messages.encode_prediction(prediction_message(predict(MODEL))))
    assert b.spin(lambda: 'no /' not in b.diagnostics()[1])


def test_bad_messages_are_counted(bench):
    b = bench()
    (good,) = synthetic(1)
    header = messages.AverageHeader(0.0, 1.0, 0, CYCLES, 60, SPEED)

    def encoded(kind, shape, **changes):
        return messages.encode_average(kind, messages.AverageMessage(
            replace(header, **changes), np.ones(shape)))

    for message in (Float64MultiArray(), encoded('order_amplitude', (0, 2, 8)),
                    encoded('order_amplitude', (2, 2, 7)),
                    encoded('order_amplitude', (2, 2, 8), end_time=float('nan'))):
        b.send('shaft/order_amplitude', message)
    for message in (encoded('pulse_error', (CYCLES, 3)), encoded('pulse_error', (CYCLES + 1, 2)),
                    messages.encode_average('pulse_error', messages.AverageMessage(
                        header, np.full(good.pulses.shape, np.nan)))):
        b.send('shaft/pulse_error', message)
    b.settle()
    table = prediction_message(predict(MODEL))
    for message in (Float64MultiArray(data=[1.0]),
                    messages.encode_prediction(replace(table, values=table.values[:, :6])),
                    messages.encode_prediction(replace(table, trigger_speed=float('nan')))):
        b.send('prediction', message)
        b.settle()
    assert b.status()['messages_rejected'] == 10
    assert b.diagnostics()[2]['averages'] == '0'


@pytest.mark.machines
def test_effects_are_set_in_the_predictor_and_a_refusal_is_reported(bench, ros_graph):
    predictor = ros_graph.add(JitterPredictor, {
        'keyphasor_rate': CLOCK, 'trigger_speed': SPEED, 'trigger_cycles': CYCLES,
        'ratio': RATIO, 'orders': list(MODEL.orders)})
    asked = []

    def refuse(parameters):
        asked.append([item.name for item in parameters])
        return SetParametersResult(successful=len(asked) > 1, reason='not today')

    predictor.add_on_set_parameters_callback(refuse)
    b = bench(close_loop=True, acquisitions=12)
    b.average(synthetic(12, std=5e-5))
    assert b.spin(lambda: b.reported('refuses the effects: not today'))
    b.average(synthetic(12, std=5e-5, seed=1))
    name = 'effects.excess_jitter'
    assert b.spin(lambda: predictor.get_parameter(f'{name}.enabled').value)
    assert asked == 2 * [[f'{name}.enabled', f'{name}.std']]
    # of 12 averages of 26 pulses, half of which are fitted: four standard errors
    assert predictor.get_parameter(f'{name}.std').value == pytest.approx(
        5e-5, rel=4.0 / np.sqrt(2.0 * 156))


@pytest.mark.machines
def test_one_of_several_predicted_shafts_is_compared(bench, ros_graph):
    ros_graph.add(JitterPredictor, {
        'keyphasor_rate': CLOCK, 'trigger_speed': SPEED, 'trigger_cycles': CYCLES,
        'shafts': ['other', 'shaft'], 'other.ratio': 1.0, 'other.orders': [1.0],
        'shaft.ratio': RATIO, 'shaft.orders': list(MODEL.orders),
        'effects.excess_jitter.enabled': True, 'effects.excess_jitter.std': 5e-5})
    b = bench(acquisitions=30)
    b.average(synthetic(30, std=5e-5))
    assert b.spin(b.reports)
    (report_of_shaft,) = b.reports()
    assert report_of_shaft['declared']['ratio'] == RATIO
    assert report_of_shaft['declared']['orders'] == list(MODEL.orders)
    assert report_of_shaft['declared']['effects'] == {'excess_jitter': {'std': 5e-5}}
    assert report_of_shaft['verdict'] == 'none'


class Chain:
    """Averager, predictor and analyser in one process, fed at full speed by a simulator."""

    def __init__(self, graph, effects, acquisitions):
        self.rate = 8192.0
        self.machine = Gearbox(
            mesh('shaft', 19, harmonics=(1.0, 0.6), seed=3), self.rate, seed=5,
            shafts={'shaft': RATIO}, speed=((0.0, SPEED),),
            fluctuation=band_limited(std=2e-4, band=(0.1, 2.0), seed=5, name='speed'),
            effects=(DeclaredJitter('uniform', 1.0 / (CLOCK * np.sqrt(12.0))),
                     AdditiveNoise(0.05), *make_effects(effects)))
        orders = list(MODEL.orders)
        common = {'trigger_cycles': CYCLES, 'keyphasor_rate': CLOCK}
        graph.add(SynchronousAverager, {
            **common, 'shaft.ratio': RATIO, 'shaft.orders': orders, 'correct_jitter': True,
            'tach_type': 'std_msgs/Float64MultiArray'})
        self.predictor = graph.add(JitterPredictor, {
            **common, 'ratio': RATIO, 'orders': orders, 'trigger_speed': SPEED})
        self.analyser = graph.add(
            ResidualAnalyser, {'acquisitions': acquisitions, 'close_loop': True})
        self.graph, self.at = graph, 0
        self._residuals = graph.capture('residual', Float64MultiArray)
        self._reports = graph.capture('missing_effect', String)

    @property
    def residuals(self):
        """Return the residuals received."""
        return [messages.decode_residual(item) for item in self._residuals]

    @property
    def reports(self):
        """Return the missing effects received."""
        return [json.loads(item.data) for item in self._reports]

    def play(self, until):
        """
        Play the machine in blocks of a second until something has happened.

        The machine stands still while the analyser traces or asks the predictor, so that the speed
        of the computer changes nothing.
        """
        size = int(self.rate)
        for _ in range(150):
            assert self.graph.spin(lambda: not self.analyser._activity, timeout=600.0)
            if until():
                return
            start, stop = self.at / self.rate, (self.at + size) / self.rate
            self.graph.publish('tach_pulse', messages.encode_pulse_array(
                self.machine.pulses(start, stop).times))
            self.graph.publish('vibration', messages.encode_samples(messages.SampleBlock(
                self.machine.vibration(self.at, self.at + size), start, self.rate, self.at)))
            self.at += size
            self.graph.settle()
        raise AssertionError(f'nothing happened: {self.analyser.summary()}')


@pytest.mark.machines
def test_loop_closes_from_simulator_to_smaller_residual(ros_graph):
    name, effect = 'correlated_jitter', {'std': 5e-5, 'correlation': 0.7}
    chain = Chain(ros_graph, {name: effect}, acquisitions=12)
    chain.play(lambda: chain.reports)
    before = chain.residuals[0]
    assert before.acquisitions == 12
    assert before.p_value < 1e-4
    assert before.chi2_per_dof > 10.0
    assert [item['name'] for item in chain.reports[0]['missing_effects']] == [name]
    assert ros_graph.spin(lambda: chain.predictor.get_parameter(f'effects.{name}.enabled').value)
    assert not any(chain.predictor.get_parameter(f'effects.{other}.enabled').value
                   for other in EFFECTS if other != name)
    # 12 averages of 26 pulses, half of them fitted, of which the correlation leaves a third
    found = chain.predictor.get_parameter(f'effects.{name}.std').value
    assert found == pytest.approx(effect['std'], rel=4.0 / np.sqrt(2.0 * 156 / 3.0))
    chain.play(lambda: len(chain.reports) > 1)
    after = chain.residuals[1]
    assert after.rms < 0.3 * before.rms
    assert after.chi2_per_dof < 3.0
    assert (np.abs(after.values[:, 5]) < 4.0).all()
    assert 'effects' in chain.predictor.summary()[1]
    assert chain.predictor.summary()[1]['effects'] == name
