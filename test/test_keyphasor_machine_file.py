# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What `check_keyphasor` writes, `average` and `close_loop` take."""

import json
from types import SimpleNamespace
import warnings

import numpy as np
import pytest
from sa_jitter_ros.commands import average, check_keyphasor, close_loop
from sa_jitter_ros.keyphasor_check.vibration import path_delay

RATE = 5120.0


def write_rig(path, *, turns, marks=1, missing=0, speed=20.0, torsion=0.0, jitter=2e-6,
              orders=(1, 5, 8), seed=1):
    """Write a shaft whose angle swings by `torsion` (rad) twice a turn, and its wheel."""
    rng = np.random.default_rng(seed)
    fine = np.linspace(0.0, turns / speed + 0.1, int((turns / speed + 0.1) * 20e3))
    angle = 2.0 * np.pi * speed * (fine - 0.02) + torsion * np.sin(4.0 * np.pi * speed * fine)
    time = np.arange(int(fine[-1] * RATE)) / RATE
    turned = np.interp(time, fine, angle)
    numbers = np.arange(turns * marks + 1)
    numbers = numbers[numbers % marks < marks - missing]
    pulses = np.interp(2.0 * np.pi * numbers / marks, angle, fine)
    np.savez(path, sample_rate=RATE, pulse_times=pulses + rng.normal(0.0, jitter, pulses.size),
             vibration=[sum(np.cos(g * turned + g) for g in orders)
                        + 0.05 * rng.normal(size=time.size)])


def run_all(path, folder, capsys):
    """Run the three commands; return the text that the last two print, and the report."""
    machine = str(folder / 'machine.yaml')
    assert check_keyphasor.main([str(path), '--output', str(folder), '--quiet']) == 0
    capsys.readouterr()
    assert average.main([str(path), '--params', machine, '--output', str(folder / 'averages'),
                         '--no-figures', '--quiet']) == 0
    assert close_loop.main([str(path), '--declared', machine, '--output', str(folder / 'loop'),
                            '--quiet']) == 0
    return ''.join(capsys.readouterr()), json.loads((folder / 'loop/report.json').read_text())


@pytest.mark.parametrize(('turns', 'marks'), [(16, 6), (9, 1)])
def test_a_short_recording_is_averaged_and_says_what_is_too_short(tmp_path, capsys, turns, marks):
    write_rig(tmp_path / 'rig.npz', turns=turns, marks=marks)
    text, report = run_all(tmp_path / 'rig.npz', tmp_path / 'out', capsys)
    assert 'averages of 1 recording' in text
    assert report['verdict'] == 'none'
    assert 'record longer' in report['not_testable'][0]['reason']


def test_a_wheel_whose_shaft_twists_by_more_than_half_a_tooth_is_taken(tmp_path, capsys):
    write_rig(tmp_path / 'rig.npz', turns=48, marks=60, missing=2, torsion=np.radians(3.4))
    text, _ = run_all(tmp_path / 'rig.npz', tmp_path / 'out', capsys)
    assert 'averages of 1 recording' in text


def test_an_order_that_one_average_refuses_gives_no_delay_and_no_warning():
    def item(speed, refused):
        return SimpleNamespace(
            trigger_speed=speed, orders=np.array([1.0, 2.0]),
            amplitudes=np.array([[np.exp(0.01j * speed), np.nan if refused else 1.0]]),
            noise=np.array([[0.01, np.nan if refused else 0.01]]))

    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for refused in ((False, True), (True, True)):
            items = [item(20.0 + k, refused[k % 2]) for k in range(8)]
            assert path_delay(items, 1.0) == (
                None, 'fewer than two orders stand clear of their noise at all speeds')
