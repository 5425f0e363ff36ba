"""The averager node through real publishers and subscribers."""

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter
from sa_jitter_ros.averaging.timeline import SampleBlock
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.base import INPUT_QOS, RESULT_QOS
from sa_jitter_ros.nodes.synchronous_averager import SynchronousAverager
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float64, Float64MultiArray

RATE = 12800.0
SPEED = 33.3
SECONDS = 4.0
AMPLITUDES = {1.0: (1.0, 0.4), 7.0: (0.5, -1.1), 23.0: (0.2, 2.0)}  # order: amplitude, phase


def signal(times, ratio=1.0, channels=2):
    """Channel c holds every order at (c + 1) times its amplitude."""
    wave = sum(a * np.cos(2.0 * np.pi * g * ratio * SPEED * times + phase)
               for g, (a, phase) in AMPLITUDES.items())
    return np.arange(1, channels + 1)[:, None] * wave


class Bench:
    """A publisher of inputs and a recorder of results around one averager."""

    def __init__(self, context, executor_for, **parameters):
        overrides = [Parameter(name.replace('__', '.'), value=value)
                     for name, value in parameters.items()]
        self.node = SynchronousAverager(context=context, parameter_overrides=overrides)
        self.bench = Node('bench', context=context)
        self.vibration = self.bench.create_publisher(Float64MultiArray, 'vibration', INPUT_QOS)
        self.pulse = self.bench.create_publisher(TimeReference, 'tach_pulse', INPUT_QOS)
        self.received = {}
        self.listen(Float64MultiArray, 'shaft/order_amplitude')
        self.listen(Float64MultiArray, 'shaft/synchronous_average')
        self.listen(Float64MultiArray, 'shaft/condition_indicator')
        self.listen(Float64, 'shaft_speed')
        self.listen(DiagnosticArray, '/diagnostics')
        self.spin = executor_for(self.node, self.bench)
        assert self.spin(lambda: self.vibration.get_subscription_count() > 0
                         and self.pulse.get_subscription_count() > 0)

    def listen(self, kind, topic):
        """Record a topic."""
        self.received[topic] = []
        self.bench.create_subscription(kind, topic, self.received[topic].append, RESULT_QOS)

    def amplitudes(self):
        """Return the order amplitudes received."""
        return [messages.decode_average('order_amplitude', item)
                for item in self.received['shaft/order_amplitude']]

    def send_pulses(self, times):
        """Publish pulses, one message each."""
        for time in times:
            self.pulse.publish(messages.encode_pulse_reference(float(time), 'kp'))

    def play(self, *, block=400, seconds=SECONDS, samples=signal, skip=()):
        """Publish pulses and vibration of one run, in blocks; `skip` are lost blocks."""
        count = int(seconds * RATE)
        pulses = np.arange(0.0, seconds, 1.0 / SPEED)
        for number, index in enumerate(range(0, count, block)):
            times = np.arange(index, min(index + block, count)) / RATE
            self.send_pulses(pulses[(pulses >= index / RATE) & (pulses < (index + block) / RATE)])
            if number not in skip:
                self.vibration.publish(messages.encode_samples(
                    SampleBlock(samples(times), index / RATE, RATE, index)))
            self.spin(lambda: True)
            self.spin(timeout=0.002)

    def status(self):
        """Return the averager's counts in the next diagnostics."""
        self.received['/diagnostics'].clear()
        assert self.spin(lambda: self.received['/diagnostics'], timeout=5.0)
        values = self.received['/diagnostics'][-1].status[0].values
        return {item.key: item.value for item in values}


@pytest.fixture
def bench(ros_context, executor_for):
    """Return a maker of benches."""
    return lambda **parameters: Bench(ros_context, executor_for, **parameters)


def test_amplitudes_phases_and_waveform_are_those_of_the_machine(bench):
    b = bench(trigger_cycles=20, shaft__orders=list(AMPLITUDES))
    b.play()
    assert b.spin(lambda: len(b.amplitudes()) == 6)
    for number, average in enumerate(b.amplitudes()):
        assert average.names == messages.AMPLITUDE_FIELDS
        assert average.header.sequence == number
        assert average.header.trigger_cycles == 20 == average.header.fundamental_cycles
        assert average.header.mean_trigger_speed == pytest.approx(SPEED, rel=1e-6)
        # pulse times travel in whole nanoseconds
        assert average.header.start_time == pytest.approx(20 * number / SPEED, abs=1e-9)
        for channel in range(2):
            for row, (order, (amplitude, phase)) in zip(average.values[channel],
                                                        AMPLITUDES.items()):
                assert row[0] == order
                assert row[1] == pytest.approx((channel + 1) * amplitude, rel=2e-5)
                assert row[2] == pytest.approx(phase, abs=2e-5)
                assert np.isnan(row[3:7]).all()
                assert row[7] < 1e-4
    waveform = messages.decode_average('synchronous_average',
                                       b.received['shaft/synchronous_average'][-1])
    angle = np.arange(waveform.values.shape[1]) / waveform.values.shape[1]
    np.testing.assert_allclose(waveform.values, signal(angle / SPEED), atol=1e-4)
    speeds = [item.data for item in b.received['shaft_speed']]
    np.testing.assert_allclose(speeds, SPEED, rtol=1e-6)
    indicators = messages.decode_average('condition_indicator',
                                         b.received['shaft/condition_indicator'][-1])
    assert indicators.names[0] == 'rms'
    assert indicators.values[0, 0] == pytest.approx(
        np.sqrt(sum(a * a for a, _ in AMPLITUDES.values()) / 2.0), rel=1e-4)


def test_lost_block_costs_the_cycles_it_belongs_to_and_nothing_else(bench):
    b = bench(trigger_cycles=10, shaft__orders=list(AMPLITUDES))
    b.play(skip={40})
    assert b.spin(lambda: len(b.amplitudes()) >= 11)
    gap = 40 * 400 / RATE, 41 * 400 / RATE
    for average in b.amplitudes():
        header = average.header
        assert header.end_time <= gap[0] or header.start_time >= gap[1]
        np.testing.assert_allclose(
            average.values[0, :, 1], [a for a, _ in AMPLITUDES.values()], rtol=3e-4)
    status = b.status()
    assert status['gaps'] == '1'
    assert int(status['cycles_dropped']) in (2, 3)
