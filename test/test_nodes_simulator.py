# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The machine simulator through real subscribers."""

import dataclasses
from itertools import pairwise
import os
import signal
import subprocess
import sys

from bench import NodeBench
import numpy as np
import pytest
from rclpy.parameter import Parameter
from sa_jitter_ros.effects import EFFECTS, parameter_ranges
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes import messages
from sa_jitter_ros.nodes.machine_simulator import EFFECT_DEFAULTS, MachineSimulator
from sa_jitter_ros.simulation import effects as simulation_effects
from sensor_msgs.msg import TimeReference
from std_msgs.msg import Float64MultiArray

FAST = {'rate': 20.0, 'duration': 2.0, 'sample_rate': 5000.0, 'waveform_rate': 12_000.0}


class Bench(NodeBench):
    """A simulator and what it publishes."""

    def __init__(self, graph, **parameters):
        super().__init__(graph, MachineSimulator, inputs={}, **{**FAST, **parameters}, outputs={
            'vibration': Float64MultiArray, 'tach_waveform': Float64MultiArray,
            'tach_pulse': TimeReference})

    @property
    def pulses(self):
        """Return the pulse times received."""
        return [messages.decode_pulse_reference(item)[0][0]
                for item in self.received['tach_pulse']]

    def play(self):
        """Simulate to the end and receive the last messages."""
        assert self.spin(lambda: not self.node.get_parameter('playing').value)
        self.settle()

    def samples(self, topic):
        """Return the samples of a topic, checked to be on time and without gaps."""
        decoder = messages.SampleDecoder('std_msgs/Float64MultiArray', sample_rate=0.0)
        blocks = [decoder.decode(item) for item in self.received[topic]]
        for block, following in pairwise(blocks):
            assert following.index == block.end_index
            assert following.start_time == pytest.approx(
                blocks[0].start_time + following.index / following.sample_rate)
        return np.concatenate([block.samples for block in blocks], axis=1)


@pytest.fixture
def bench(ros_graph):
    """Return a maker of benches."""
    return lambda **parameters: Bench(ros_graph, **parameters)


def test_published_signals_are_those_of_the_machine(bench):
    simulator = bench(tach='both', start_time=100.0, channel_gains=[1.0, 0.5],
                      pulses_per_revolution=2, seed=3, speed_fluctuation_std=1e-3,
                      **{'machine.channels.1.sensitivity': 0.25})
    simulator.play()
    machine = simulator.node.machine
    np.testing.assert_array_equal(simulator.samples('vibration'),  # volts
                                  machine.vibration(0, 10_000) * [[1.0], [0.25]])
    np.testing.assert_array_equal(simulator.samples('tach_waveform')[0],
                                  machine.tach_waveform(0, 24_000))
    wanted = machine.pulses(0.0, 2.0)
    np.testing.assert_allclose(simulator.pulses, 100.0 + wanted.times, rtol=0, atol=1e-9)
    assert np.std(wanted.errors) == pytest.approx(1e-4 / np.sqrt(12), rel=0.25)


def test_several_shafts_with_a_chipped_tooth(bench):
    simulator = bench(shafts=['pinion', 'gear'], **{
        'pinion.ratio': 1, 'gear.ratio': 0.31, 'gear.teeth': 30, 'gear.chipped_tooth': -0.5,
        'gear.harmonics': [2], 'noise_std': 0.0})
    machine = simulator.node.machine
    assert abs(machine.amplitude(23, 'pinion')) == pytest.approx(1.0)
    assert abs(machine.amplitude(29, 'gear')) != pytest.approx(0.4, abs=1e-6)
    assert abs(machine.amplitude(25, 'gear')) > 1e-3


def test_the_simulator_knows_the_effects_and_parameters_of_the_registry():
    registered = {name: set(parameter_ranges(kind)) for name, kind in EFFECTS.items()}
    assert registered.keys() == simulation_effects.EFFECTS.keys()
    for name, kind in simulation_effects.EFFECTS.items():
        assert registered[name] <= {item.name for item in dataclasses.fields(kind)}
    assert EFFECT_DEFAULTS.keys() <= {
        f'{name}.{key}' for name, keys in registered.items() for key in keys}


def test_every_effect_can_be_switched_on_while_it_runs(bench):
    simulator = bench(duration=0.0, rate=1.0, noise_std=0.0, pulses_per_revolution=2)
    unchanged = simulator.node.machine
    for name in EFFECTS:
        results = simulator.node.set_parameters([Parameter(f'effects.{name}.enabled', value=True)])
        assert all(item.successful for item in results)
        changed = simulator.node.machine
        assert type(changed.effects[-1]) is simulation_effects.EFFECTS[name]
        differs = (not np.array_equal(changed.vibration(0, 9000), unchanged.vibration(0, 9000))
                   or not np.array_equal(changed.pulses(0, 5).times, unchanged.pulses(0, 5).times))
        assert differs, name
        simulator.node.set_parameters([Parameter(f'effects.{name}.enabled', value=False)])
    assert simulator.spin(lambda: len(simulator.received['vibration']) > 3)
    simulator.samples('vibration')


def test_declared_jitter_of_every_kind(bench):
    simulator = bench()
    set_parameters = simulator.node.set_parameters
    for distribution in ('uniform', 'normal', 'triangular', 'table', 'sampled', 'none'):
        set_parameters([Parameter('jitter_table', value=[0.0, 2e-4])])
        assert set_parameters([Parameter('jitter_distribution', value=distribution)])[0].successful
        std = np.std(simulator.node.machine.pulses(0.0, 80.0).errors)
        wanted = {'table': 1e-4, 'none': 0.0, 'sampled': std}.get(distribution, 1e-4 / np.sqrt(12))
        # 2000 pulses; the kurtosis of no distribution exceeds 3.
        assert std == pytest.approx(wanted, rel=4 / np.sqrt(2 * 2000))
    set_parameters([Parameter('jitter_distribution', value='sampled')])
    ticks = simulator.node.machine.pulses(0.0, 1.0).times * 10_000
    np.testing.assert_allclose(ticks, np.round(ticks), rtol=0, atol=1e-8)


@pytest.mark.parametrize(('change', 'reason'), [
    ({'effects.missing_pulses.probability': 2.0}, 'missing_pulses.probability'),
    ({'jitter_distribution': 'table'}, 'give finite errors'),
    ({'keyphasor_rate': -1.0}, 'keyphasor_rate is -1.0'),
])
def test_impossible_changes_are_refused_with_the_reason(bench, change, reason):
    simulator = bench(**{'effects.missing_pulses.enabled': True})
    machine = simulator.node.machine
    result = simulator.node.set_parameters(
        [Parameter(name, value=value) for name, value in change.items()])[0]
    assert not result.successful
    assert reason in result.reason
    assert simulator.node.machine is machine


@pytest.mark.parametrize(('parameters', 'message'), [
    ({'speed': 0.0}, 'speed is 0.0'),
    ({'speed_profile': [0.0, 25.0, 1.0]}, 'give pairs'),
    ({'speed_profile': [0.0, 25.0, 0.0, 30.0]}, 'must increase from 0'),
    ({'speed_fluctuation_band': [1.0]}, 'two frequencies'),
    ({'speed_fluctuation_band': [2.0, 1.0], 'speed_fluctuation_std': 0.01}, '0 <= low < high'),
    ({'torsion_amplitude': 1.0}, 'torsion changes the speed'),
    ({'channel_gains': []}, 'channels'),
])
def test_unusable_parameters_are_refused(bench, parameters, message):
    with pytest.raises(ParameterError, match=message):
        bench(**parameters)


def test_speed_profile(bench):
    machine = bench(speed_profile=[0, 10, 2, 40]).node.machine
    np.testing.assert_allclose(machine.shaft_speed(np.array([1.0, 3.0])), [25.0, 40.0])


@pytest.mark.processes
def test_sigint_ends_the_process_cleanly(process_environment):
    code = ('import sys; from sa_jitter_ros.nodes.machine_simulator import main; '
            'sys.exit(main(["--ros-args", "-p", "wait_seconds:=0.0"]))')
    process = subprocess.Popen(
        [sys.executable, '-c', code], env=process_environment, stderr=subprocess.PIPE, text=True,
        cwd=os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    assert any('s sent' in line for line in process.stderr)
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=600) == 0
    assert 'Traceback' not in process.stderr.read()
    process.stderr.close()
