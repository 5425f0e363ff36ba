"""The predictor node through topics and the parameter service."""

import numpy as np
import pytest
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter import Parameter
from sa_jitter_ros.effects import EFFECTS, make_effect, predict_with
from sa_jitter_ros.errors import ModelError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import INPUT_QOS, LATCHED_QOS
from sa_jitter_ros.nodes.jitter_predictor import JitterPredictor
from sa_jitter_ros.statistics.prediction import DeclaredModel, predict
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

    def __init__(self, context, executor_for, **parameters):
        self.node = JitterPredictor(context=context, parameter_overrides=[
            Parameter(name, value=value) for name, value in {**MODEL, **parameters}.items()])
        self.bench = Node('bench', context=context)
        self.received = []
        self.bench.create_subscription(
            Float64MultiArray, 'prediction',
            lambda item: self.received.append(messages.decode_prediction(item)), LATCHED_QOS)
        self.speed = self.bench.create_publisher(Float64, 'shaft_speed', INPUT_QOS)
        self.client = self.bench.create_client(
            SetParametersAtomically, 'jitter_predictor/set_parameters_atomically')
        self.spin = executor_for(self.node, self.bench)
        assert self.spin(lambda: self.received and self.client.service_is_ready()
                         and self.speed.get_subscription_count())

    def set_parameters(self, **values):
        """Set parameters atomically through the service and return its answer."""
        request = SetParametersAtomically.Request(parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()])
        future = self.client.call_async(request)
        assert self.spin(future.done)
        return future.result().result


@pytest.fixture
def bench(ros_context, executor_for):
    """Return a maker of benches."""
    return lambda **parameters: Bench(ros_context, executor_for, **parameters)


def test_prediction_is_latched_and_says_what_it_holds_for(bench):
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
    assert not b.spin(lambda: len(b.received) > 1, timeout=0.1)
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
        b.speed.publish(Float64(data=speed))
    assert b.spin(lambda: len(b.received) == 2)
    np.testing.assert_array_equal(b.received[-1].values, expected(trigger_speed=22.0))
    assert b.node.counts['messages_rejected'] == 2
    # another parameter does not lose the measured speed
    assert b.set_parameters(trigger_cycles=10).successful
    assert b.spin(lambda: len(b.received) == 3)
    assert b.received[-1].trigger_speed == 22.0


def test_speed_is_left_alone_unless_asked(bench):
    b = bench()
    b.speed.publish(Float64(data=22.0))
    assert not b.spin(lambda: len(b.received) > 1, timeout=0.2)


def test_effects_enter_the_prediction_and_leave_it_again(bench):
    b = bench()
    assert b.set_parameters(**{'effects.excess_jitter.enabled': True,
                               'effects.excess_jitter.std': 5e-5}).successful
    assert b.spin(lambda: len(b.received) == 2)
    model = DeclaredModel(**{**MODEL, 'orders': tuple(MODEL['orders'])})
    with_effect = predict_with(model, (make_effect('excess_jitter', std=5e-5),))
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


def test_unusable_start_parameters_raise(ros_context):
    with pytest.raises(ModelError, match='pulses could swap'):
        JitterPredictor(context=ros_context,
                        parameter_overrides=[Parameter('keyphasor_rate', value=3.0)])
