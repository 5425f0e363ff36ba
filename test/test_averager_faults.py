"""
Random faults, seeded: every average that the node publishes is that of the cycles it claims.

The scenes are those of `benchmarks/fault_campaign.py`, which plays them to processes by the
thousand; here they go to one node in this process, so that its counts can be read between any two.
"""

from collections import Counter

from bench import AveragerBench
from fault_check import ShaftChecker, WrongAverageError
from fault_graph import DIRECT, ORDERS
from fault_machine import RATE
from fault_source import FaultySource, KEYPHASOR
from machine import Machine
import numpy as np
import pytest
from rclpy.qos import QoSProfile
from sa_jitter_ros.averaging.timeline import SampleBlock
from sa_jitter_ros.nodes import messages

SHAFTS = ('tach', 'gear')
JUDGED = ('accepted', 'doubles', 'early', 'out_of_order', 'non_finite', 'unlocked')


class SceneBench:
    """The averager, a faulty source, and a checker for each shaft."""

    def __init__(self, context, executor_for, seed, **parameters):
        self.settings = [{**DIRECT, **parameters}]
        options = {name.replace('.', '__'): value for name, value in self.settings[0].items()}
        del options['shafts']
        self.bench = AveragerBench(context, executor_for, shafts=SHAFTS,
                                   result_qos=QoSProfile(depth=1000), **options)
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


@pytest.mark.parametrize(('averaging', 'seed'), [
    ('block', 1), ('block', 2), ('sliding', 3), ('exponential', 4)])
def test_every_average_is_true_whatever_happens(ros_context, executor_for, averaging, seed):
    b = SceneBench(ros_context, executor_for, seed, averaging=averaging)
    for _ in range(2):
        missing = set(SHAFTS) - b.play()
        if missing:  # within buffer_seconds of faultless input
            missing -= b.play(changes=False, faults=False)
        assert not missing - b.play(changes=False, faults=False)
    status = b.bench.status()
    assert sum(b.faults.values()) > 10
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
    assert status['samples_lost'] >= status['gaps']
    assert status['samples_dropped'] >= status['repeats']
    assert status['cycles_dropped'] > 0


def test_changes_of_parameters_at_any_time_mix_nothing(ros_context, executor_for, rng):
    b = SceneBench(ros_context, executor_for, 5)
    for name, value in (('trigger_cycles', 9), ('gear.ratio', 0.41), ('pulses_per_trigger', 1),
                        ('tach.orders', [2.5]), ('missing_pulses', 'bridge'),
                        ('interval_tolerance', 0.2)):
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


def test_the_check_sees_what_is_wrong(ros_context, executor_for):
    """An average of other cycles, phases, samples or counts is told from a true one."""
    b = SceneBench(ros_context, executor_for, 3)
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


def test_node_goes_on_after_nonsense_of_every_kind(ros_context, executor_for):
    """Random layouts, headers and data: rejected or used, never raised; then it still works."""
    rng = np.random.default_rng(5)
    b = AveragerBench(ros_context, executor_for, shafts=('tach',), trigger_cycles=6,
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


def test_memory_is_bounded_without_pulses_and_without_vibration(ros_context, executor_for):
    b = AveragerBench(ros_context, executor_for, buffer_seconds=0.5, trigger_cycles=6,
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
