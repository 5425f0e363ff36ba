# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The predictor node through topics and the parameter service."""

import re

import numpy as np
import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from sa_jitter_ros.effects import EFFECTS, make_effect
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from std_msgs.msg import Float64, Float64MultiArray

MODEL = {'keyphasor_rate': 5000.0, 'trigger_speed': 20.0, 'trigger_cycles': 30,
         'orders': [1.0, 10.0, 38.0], 'ratio': 2.40789}


def expected(**changes):
    """Table of the prediction for the model with changes."""
    model = {**MODEL, **changes}
    result = predict(DeclaredModel(**{**model, 'orders': tuple(model['orders'])}))
    return np.stack([getattr(result, name) for name in messages.PREDICTION_FIELDS], axis=1)


class Bench:
    """A predictor, its parameter service and what it publishes."""

    def __init__(self, graph, declared=MODEL, topics=('prediction',), **parameters):
        self.graph, self.spin = graph, graph.spin
        self.node = graph.add(JitterPredictor, {**declared, **parameters})
        captured = [graph.capture(topic, Float64MultiArray, latched=True) for topic in topics]
        self.predictions = captured[0]
        self.client = graph.node.create_client(
            SetParametersAtomically, 'jitter_predictor/set_parameters_atomically')
        self.captured = captured
        assert self.spin(lambda: all(captured) and self.client.service_is_ready())

    @property
    def received(self):
        """Return the predictions received."""
        return [messages.decode_prediction(item) for item in self.predictions]

    def latest(self, count):
        """Wait until there are `count` predictions of each shaft and return the last of each."""
        assert self.spin(lambda: all(len(received) == count for received in self.captured))
        return [messages.decode_prediction(received[-1]) for received in self.captured]

    def set_parameters(self, **values):
        """Set parameters atomically through the service and return its answer."""
        request = SetParametersAtomically.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()])
        future = self.client.call_async(request)
        assert self.spin(future.done)
        return future.result().result


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches."""
    return lambda *arguments, **parameters: Bench(ros_graph, *arguments, **parameters)


def test_prediction_is_latched_and_contains_its_conditions(bench):
    message = bench().received[0]
    np.testing.assert_array_equal(message.values, expected())
    assert (message.trigger_speed, message.keyphasor_rate, message.trigger_cycles,
            message.ratio) == (20.0, 5000.0, 30, 2.40789)
    assert message.pulse_error_standard_deviation == pytest.approx(1.0 / 5000.0 / np.sqrt(12.0))


def test_parameter_change_is_published_at_once(bench):
    b = bench()
    assert b.set_parameters(keyphasor_rate=9000, orders=[4, 19]).successful
    assert b.spin(lambda: len(b.received) == 2)
    message = b.received[-1]
    np.testing.assert_array_equal(
        message.values, expected(keyphasor_rate=9000.0, orders=[4.0, 19.0]))


@pytest.mark.parametrize(('change', 'reason'), [
    ({'keyphasor_rate': -1.0}, 'keyphasor_rate is -1.0 Hz: give more than 0.0'),
    ({'keyphasor_rate': 15.0}, 'pulses could swap'),
    ({'noise_std': 1.0}, 'sample_rate'),
    ({'noise_std': 1.0, 'sample_rate': 1000.0}, 'above the Nyquist order'),
    ({'jitter_distribution': 'table'}, 'table'),
    ({'orders': ['a']}, 'orders'),
    ({'trigger_cycles': 0}, 'trigger_cycles'),
    ({'effects.interpolation_loss.enabled': True}, 'declare sample_rate'),
    ({'angle_law': 'cubic'}, 'one of linear, quadratic, spline'),
    ({'angle_law': 'spline', 'effects.missing_pulses.enabled': True}, 'no forward model'),
])
def test_inconsistent_parameters_are_refused_with_the_reason(bench, change, reason):
    b = bench()
    result = b.set_parameters(**change)
    assert not result.successful
    assert reason in result.reason
    b.graph.settle()
    assert len(b.received) == 1
    assert b.set_parameters(trigger_cycles=31).successful
    assert b.spin(lambda: len(b.received) == 2)
    np.testing.assert_array_equal(b.received[-1].values, expected(trigger_cycles=31))


def test_angle_law_is_that_of_the_averager(bench):
    b = bench()
    assert b.set_parameters(angle_law='spline').successful
    assert b.spin(lambda: len(b.received) == 2)
    np.testing.assert_array_equal(b.received[-1].values, expected(angle_law='spline'))


def test_speed_is_followed_when_asked(bench):
    b = bench(follow_shaft_speed=True)
    for speed in (20.01, float('nan'), -3.0, 22.0):  # within tolerance, bad, bad, worth it
        b.graph.publish('shaft_speed', Float64(data=speed))
    assert b.spin(lambda: len(b.received) == 2)
    np.testing.assert_array_equal(b.received[-1].values, expected(trigger_speed=22.0))
    assert b.node.counts['messages_rejected'] == 2
    # another parameter does not lose the measured speed
    assert b.set_parameters(trigger_cycles=10).successful
    assert b.spin(lambda: len(b.received) == 3)
    assert b.received[-1].trigger_speed == 22.0


def test_measured_speed_is_ignored_by_default(bench):
    b = bench()
    b.graph.publish('shaft_speed', Float64(data=22.0))
    b.graph.settle()
    assert len(b.received) == 1


def test_effects_enter_the_prediction_and_leave_it_again(bench):
    b = bench()
    assert b.set_parameters(**{'effects.excess_jitter.enabled': True,
                               'effects.excess_jitter.std': 5e-5}).successful
    assert b.spin(lambda: len(b.received) == 2)
    model = DeclaredModel(**{**MODEL, 'orders': tuple(MODEL['orders'])})
    with_effect = predict(model, (make_effect('excess_jitter', std=5e-5),))
    np.testing.assert_array_equal(b.received[-1].values[:, 1], with_effect.mean_attenuation)
    assert (b.received[-1].values[:, 1] < expected()[:, 1]).all()
    refused = b.set_parameters(**{'effects.excess_jitter.std': -1.0})
    assert not refused.successful
    assert 'effects.excess_jitter.std' in refused.reason
    assert b.set_parameters(**{'effects.excess_jitter.enabled': False}).successful
    assert b.spin(lambda: len(b.received) == 3)
    np.testing.assert_array_equal(b.received[-1].values, expected())


@pytest.mark.parametrize('name', EFFECTS)
def test_every_effect_has_its_parameters(bench, name):
    b = bench(sample_rate=20000.0)
    assert b.set_parameters(**{f'effects.{name}.enabled': True}).successful
    assert b.spin(lambda: len(b.received) == 2)
    assert np.isfinite(b.received[-1].values).all()


def test_unusable_start_parameters_raise(ros_graph):
    with pytest.raises(ModelError, match='pulses could swap'):
        ros_graph.add(JitterPredictor, {'keyphasor_rate': 3.0})


# --- shafts ---


SHAFTS = {**{name: value for name, value in MODEL.items() if name not in ('ratio', 'orders')},
          'shafts': ['input', 'output'], 'input.ratio': 2.40789, 'input.orders': [19.0, 38.0],
          'output.orders': [4.0]}
TOPICS = ('input/prediction', 'output/prediction')


def test_each_of_several_shafts_has_its_prediction(bench):
    b = bench(SHAFTS, TOPICS)
    first, second = b.latest(1)
    np.testing.assert_array_equal(first.values, expected(orders=[19.0, 38.0]))
    np.testing.assert_array_equal(second.values, expected(ratio=1.0, orders=[4.0]))
    assert (first.ratio, second.ratio) == (2.40789, 1.0)
    assert '/prediction' not in dict(b.graph.node.get_topic_names_and_types())


def test_changes_of_one_shaft_and_of_all_and_the_speed_reach_every_shaft(bench):
    b = bench(SHAFTS, TOPICS, follow_shaft_speed=True)
    assert b.set_parameters(**{'output.ratio': 0.4137, 'trigger_cycles': 31}).successful
    first, second = b.latest(2)
    np.testing.assert_array_equal(first.values, expected(orders=[19.0, 38.0], trigger_cycles=31))
    np.testing.assert_array_equal(
        second.values, expected(ratio=0.4137, orders=[4.0], trigger_cycles=31))
    b.graph.publish('shaft_speed', Float64(data=22.0))
    assert [item.trigger_speed for item in b.latest(3)] == [22.0, 22.0]
    refused = b.set_parameters(**{'output.ratio': 1e4})
    assert not refused.successful
    assert re.search('output.ratio .*1000.0', refused.reason)


@pytest.mark.parametrize('prefix', ['', 'output.'])
def test_one_named_shaft_has_the_topic_of_one(bench, prefix):
    of_shaft = {f'{prefix}{name}': MODEL[name] for name in ('ratio', 'orders')}
    b = bench({**{name: SHAFTS[name] for name in ('keyphasor_rate', 'trigger_speed',
                                                  'trigger_cycles')},
               'shafts': ['output'], **of_shaft})
    np.testing.assert_array_equal(b.latest(1)[0].values, expected())
    assert b.set_parameters(**{f'{prefix}ratio': 2.0}).successful
    np.testing.assert_array_equal(b.latest(2)[0].values, expected(ratio=2.0))


@pytest.mark.parametrize(('given', 'message'), [
    ({'shafts': ['a', 'b'], 'ratio': 2.0},
     'ratio is given together with the shafts a, b: give a.ratio'),
    ({'shaft.orders': [1.0], 'orders': [1.0]}, 'orders is given together with the shafts shaft'),
    ({'shafts': ['a', 'a']}, "shafts is 'a', 'a': give different names"),
    ({'shafts': ['a', 'b'], 'b.ratio': 0.0}, 'b.ratio is 0.0: give at least 0.001'),
])
def test_shafts_declared_in_both_forms_or_wrongly_are_refused(ros_graph, given, message):
    with pytest.raises(ParameterError, match=message):
        ros_graph.add(JitterPredictor, given)
