# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The front door: what `import sa_jitter_ros` gives, and what it loads."""

from dataclasses import replace
import json
import subprocess
import sys

import numpy as np
import pytest
import sa_jitter_ros
import sa_jitter_ros as sa
from sa_jitter_ros.recordings.recording import ArraySource

SLOW = ('rclpy', 'matplotlib', 'scipy')


def in_new_process(source):
    """Run a program that prints JSON, without rclpy and matplotlib, and return what it says."""
    blocked = 'import sys\nfor name in "rclpy", "matplotlib": sys.modules[name] = None\n'
    done = subprocess.run([sys.executable, '-c', blocked + source], capture_output=True,
                          text=True, check=True)
    return json.loads(done.stdout)


def test_the_import_loads_less_than_that_of_numpy():
    count = 'import json, sys\nbefore = set(sys.modules)\n{}\nprint(json.dumps(sorted(' \
            'set(sys.modules) - before)))'
    numpy = in_new_process(count.format('import numpy'))
    package = in_new_process(count.format('import sa_jitter_ros'))
    assert len(package) <= 0.3 * len(numpy)
    assert not {name.partition('.')[0] for name in package} & set(SLOW)


@pytest.mark.machines
def test_every_public_name_works_without_ros_and_matplotlib():
    names = in_new_process(
        'import json, sa_jitter_ros as sa\n'
        'print(json.dumps([name for name in sa.__all__ if getattr(sa, name).__doc__]))')
    assert names == sa_jitter_ros.__all__


def test_the_public_names_are_those_that_can_be_had():
    assert sorted(sa_jitter_ros._HOME) == sa_jitter_ros.__all__
    assert set(sa_jitter_ros.__all__) <= set(dir(sa_jitter_ros))
    assert not hasattr(sa_jitter_ros, 'avrage')


def test_all_errors_of_the_library_are_value_errors():
    for name in sa_jitter_ros.__all__:
        if name.endswith('Error'):
            assert issubclass(getattr(sa_jitter_ros, name), sa_jitter_ros.SaJitterError)
    assert issubclass(sa_jitter_ros.SaJitterError, ValueError)


MACHINE = {'keyphasor_rate': 10e3, 'trigger_speed': 25.0, 'trigger_cycles': 20, 'orders': [8.0]}


def test_predict_and_design_take_the_numbers_of_an_npz_file():
    """They are 0-d arrays."""
    arrays = {name: np.array(value) for name, value in MACHINE.items()}
    skew = {'clock_skew': {'skew': 1e-4}, 'target_geometry': {'pulse_angles': [0.0, 1e-3]}}
    expected = sa.predict(**MACHINE, effects=skew)
    found = sa.predict(**arrays, effects={
        'clock_skew': {'skew': np.array(1e-4)},
        'target_geometry': {'pulse_angles': np.array([0.0, 1e-3])}})
    assert found.model == expected.model
    assert np.array_equal(found.mean_attenuation, expected.mean_attenuation)
    assert sa.design(**arrays).model == sa.design(**MACHINE).model


@pytest.mark.parametrize(('function', 'arguments', 'text'), [
    (sa.predict, {'effects': {'clock_skew': 1e-4}},
     "clock_skew is 0.0001: give its parameters by name, {'clock_skew': {'skew': ...}}"),
    (sa.predict, {'effects': ['clock_skew']}, "effects is ['clock_skew']: give a mapping"),
    (sa.predict, {'trigger_speed': '25'}, "trigger_speed is '25': it must be finite"),
    (sa.predict, {'jitter_table': 1e-5}, 'jitter_table is 1e-05: give a list of numbers, [1e-05]'),
    (sa.design, {'others': 1.5}, 'others is 1.5: give a list of numbers, [1.5]'),
    (sa.design, {'maximum_loss': '5 %'}, "maximum_loss is '5 %': give a number"),
    (sa.detect_pulses, {'tach': np.zeros(9), 'sample_rate': 'fast'}, "is 'fast': give a number")])
def test_arguments_of_a_wrong_type_are_named(function, arguments, text):
    machine = {} if function is sa.detect_pulses else MACHINE
    with pytest.raises(sa.SaJitterError) as caught:
        function(**{**machine, **arguments})
    assert text in str(caught.value)


@pytest.mark.filterwarnings('ignore:none of the orders')
def test_every_result_is_one_short_line_in_a_notebook():
    rate, orders = 5000.0, range(1, 41)
    vibration = np.random.default_rng(3).normal(0.0, 1.0, (3, 20_000))
    pulses = np.arange(100) / 25.0
    average, = sa.average(vibration, rate, pulses, orders=orders, correct_jitter=True)
    refused = average.correction
    accepted = replace(refused, accepted=True)
    recording = sa.Recording(ArraySource(vibration), rate, pulse_times=pulses, path='rig.npz')
    model = {**MACHINE, 'orders': orders}
    results = [average, refused, accepted, recording, sa.predict(**model), sa.design(**model)]
    for result in results:
        text = repr(result)
        assert text.startswith(f'{type(result).__name__}(')
        assert '\n' not in text
        assert len(text) < 200, text
    assert 'refused: ' in repr(refused)
    assert repr(recording) == (
        "Recording('rig.npz', 3 channels of 20000 samples at 5000 Hz (4 s), 100 pulse_times, "
        'ratio 1)')
