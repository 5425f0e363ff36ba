# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The demo as users start it: separate processes over DDS, a table and figures."""

import os
import re
import signal
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
from sa_jitter_ros.commands import demo
from sa_jitter_ros.commands.command_line import (
    add_recording_options, Parser, player_options, read_options)
from sa_jitter_ros.commands.demo_plan import plan_recording, plan_simulation, with_machine
from sa_jitter_ros.errors import RecordingError, SaJitterError
from sa_jitter_ros.parameter_file import shipped
from sa_jitter_ros.recordings import read, Recording
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource
from sa_jitter_ros.simulation import Gearbox, make_effects, mesh
from scipy.io import wavfile

CLOCK, RATE, SPEED, SECONDS = 4000.0, 20000.0, 31.7, 6.0


def run_demo(environment, *arguments):
    """Run the demo as a separate process."""
    return subprocess.run(
        [sys.executable, '-c',
         'from sa_jitter_ros.commands.demo import main; raise SystemExit(main())', *arguments],
        env=environment, capture_output=True, text=True, timeout=600, check=False)


@pytest.fixture
def machine():
    """Return a gearbox whose keyphasor is sampled too slowly for its mesh orders."""
    return Gearbox(mesh('shaft', 23, harmonics=(1.0, 0.5, 0.25)), RATE,
                   speed=((0.0, SPEED),), seed=3, effects=make_effects(
                       {'keyphasor_quantisation': {'clock_rate': CLOCK, 'period_std': 5e-5}}))


@pytest.fixture
def recording(machine, tmp_path):
    """Return a recording of it in a file."""
    count = round(RATE * SECONDS)
    path = tmp_path / 'rig.npz'
    write_npz(path, Recording(
        ArraySource(machine.vibration(0, count)), RATE, units=('g',),
        pulse_times=machine.pulses(0.0, SECONDS).times, tach_rate=CLOCK))
    return path


def test_orders_and_averages_are_chosen_from_the_recording(recording):
    plan = plan_recording(recording, read(recording))
    assert {23.0, 46.0, 69.0} < set(plan.model.orders)
    assert plan.model.trigger_cycles == SECONDS * SPEED // 8
    assert plan.model.trigger_speed == pytest.approx(SPEED, rel=0.01)
    assert plan.model.keyphasor_rate == CLOCK


def test_trigger_cycles_are_those_of_the_recording(tmp_path):
    time = np.arange(round(RATE * SECONDS)) / RATE
    path = tmp_path / 'wheel.npz'
    write_npz(path, Recording(
        ArraySource(np.cos(2.0 * np.pi * 6.0 * SPEED * time)[None]), RATE,
        pulse_times=np.arange(0.1, SECONDS, 0.25 / SPEED), pulses_per_revolution=4,
        pulses_per_trigger=2, ratio=2.0))
    plan = plan_recording(path, read(path))
    assert plan.model.trigger_speed == pytest.approx(SPEED, rel=1e-6)
    assert plan.model.trigger_cycles == 2.0 * SPEED * SECONDS // 8
    assert 3.0 in plan.model.orders
    nodes = demo.processes(plan)
    for name in ('synchronous_averager', 'jitter_predictor'):
        assert (nodes[name]['pulses_per_revolution'], nodes[name]['pulses_per_trigger']) == (4, 2)


def test_recording_of_other_make_is_planned_by_its_fields(tmp_path):
    time = np.arange(round(RATE * SECONDS)) / RATE
    teeth = np.arange(0.1, SECONDS, 1 / 36 / SPEED)
    np.savez(tmp_path / 'other.npz', acc=np.cos(2.0 * np.pi * 12.0 * SPEED * time),
             tach=teeth[np.arange(len(teeth)) % 36 < 34])
    fields = ['vibration=acc', 'pulse_times=tach', f'sample_rate={RATE}', 'ratio=2',
              'pulses_per_revolution=36', 'missing_teeth=2', 'orders=6,12']
    parser = Parser()
    add_recording_options(parser)
    options = parser.parse_args([part for field in fields for part in ('--field', field)])
    plan = plan_recording(tmp_path / 'other.npz',
                          read(tmp_path / 'other.npz', **read_options(options)),
                          parameters=player_options(options))
    assert plan.model.trigger_speed == pytest.approx(SPEED, rel=1e-6)
    model = plan.model
    assert (model.ratio, model.orders, model.trigger_cycles) == (2.0, (6.0, 12.0), 23)
    nodes = demo.processes(plan)
    assert nodes['synchronous_averager']['missing_teeth'] == 2
    assert nodes['recording_player']['fields'] == fields


def test_recording_without_keyphasor_is_refused(machine, tmp_path):
    path = tmp_path / 'mute.npz'
    write_npz(path, Recording(ArraySource(machine.vibration(0, 20000)), RATE))
    with pytest.raises(RecordingError, match='no keyphasor'):
        plan_recording(path, read(path))


@pytest.mark.processes
def test_demo_corrects_the_amplitudes_of_a_recording(recording, process_environment, tmp_path):
    done = run_demo(process_environment, str(recording), '--output', str(tmp_path / 'out'))
    assert done.returncode == 0, done.stderr
    assert re.search(r'speed +31\.\d+ Hz \| averages +\d', done.stdout)
    table = {float(row[0]): row for row in map(str.split, done.stdout.splitlines())
             if row and re.fullmatch(r'\d+', row[0])}
    for order, amplitude in ((23.0, 1.0), (46.0, 0.5), (69.0, 0.25)):
        *_, raw, corrected, _, attenuation, predicted, _, _, _ = table[order]
        assert float(corrected) == pytest.approx(amplitude, rel=0.01)
        assert float(raw) < float(corrected)
        assert float(attenuation) == pytest.approx(float(raw) / float(corrected), abs=0.01)
        assert 0.0 < float(predicted) < 1.0
    for name in ('waveform', 'orders', 'spectrum', 'order_map', 'tracked_orders'):
        assert (tmp_path / 'out' / f'{name}.png').read_bytes().startswith(b'\x89PNG')
    arrays = np.load(tmp_path / 'out' / 'averages.npz')
    assert arrays['shaft_order_amplitude'].shape == (
        arrays['sequence'].size, 1, len(table), arrays['shaft_order_amplitude_fields'].size)
    assert arrays['shaft_corrected_average'].shape == arrays['shaft_waveform'].shape
    assert len((tmp_path / 'out' / 'averages.csv').read_text().splitlines()) == (
        1 + arrays['sequence'].size * len(table))


@pytest.mark.processes
def test_a_measured_recording_in_a_wav_with_a_tach_channel_gives_averages_whose_loss_is_known(
        shared_data, process_environment, tmp_path):
    measured, path = read(shared_data / 'motor_30V_100kHz.npz'), tmp_path / 'rig.wav'
    both = np.stack((measured.read()[0], measured.read_tach()), axis=1)
    wavfile.write(path, round(measured.sample_rate), both.astype(np.float32))
    done = run_demo(process_environment, str(path), '--tach-channel', '1', '--field',
                    'pulses_per_revolution=8', '--output', str(tmp_path / 'out'))
    assert done.returncode == 0, done.stderr
    assert '1 channels' in done.stdout
    rows = [row for row in map(str.split, done.stdout.splitlines())
            if row and re.fullmatch(r'\d+', row[0])]
    attenuation = np.array([float(row[-5]) for row in rows])
    assert len(rows) >= 5
    np.testing.assert_allclose(attenuation, 1.0, atol=0.01, err_msg=done.stdout)
    with pytest.raises(RecordingError, match='--tach-channel'):
        plan_recording(path, read(path))


def test_an_averager_that_is_busy_is_waited_for(monkeypatch):
    """On a loaded computer the first average may come long after the signals have ended."""
    plan, now = plan_simulation(shipped('machine.yaml')), [0.0]
    watcher = SimpleNamespace(
        subscribe=lambda shafts: None, progress=lambda: '', predictions={plan.shaft: None},
        count_subscribers=lambda topic: 1, count_publishers=lambda topic: 1,
        averages=lambda: {plan.shaft: [{}] if now[0] > 20.0 else []},
        status={plan.source: {'message': 'ended'}}, status_time={'synchronous_averager': 1.0})

    def spin_once(timeout_sec):
        now[0] += timeout_sec
        watcher.status_time[plan.source] = now[0]
        if now[0] > 20.0:
            watcher.status_time['synchronous_averager'] = now[0]

    monkeypatch.setattr(demo.time, 'monotonic', lambda: now[0])
    monkeypatch.setattr(demo, 'AsyncParameterClient', lambda *arguments: SimpleNamespace(
        services_are_ready=lambda: True, set_parameters=lambda parameters: None))
    demo.watch(plan, watcher, SimpleNamespace(spin_once=spin_once), [])
    assert 20.0 + demo.LAST_AVERAGE < now[0] < 20.0 + demo.LAST_AVERAGE + 5.0


def test_a_refused_correction_is_noted(recording, monkeypatch, tmp_path, capsys):
    plan = plan_recording(recording, read(recording))
    monkeypatch.setattr(demo, 'write_results', lambda *arguments: '')
    refused = {f'{plan.shaft}.corrections_refused': '3', f'{plan.shaft}.refusal': 'no order'}
    demo.write_report(plan, SimpleNamespace(
        averages=lambda: {plan.shaft: [{}]}, predictions={},
        status={'synchronous_averager': refused}), tmp_path)
    assert 'note: the correction of 3 averages was refused: no order\n' in capsys.readouterr().out


def test_unusable_recording_is_one_line_and_status_2(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(demo, 'Watcher', None)
    monkeypatch.setattr(demo.signal, 'signal', lambda *handler: None)
    path = tmp_path / 'broken.npz'
    path.write_bytes(b'PK\x03\x04 and nothing else')
    assert demo.main([str(path), '--output', str(tmp_path / 'out')]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert len(captured.err.splitlines()) == 1
    assert str(path) in captured.err


@pytest.mark.parametrize('place', ['file/out', 'file'])
def test_unusable_output_is_one_line_and_status_2_before_the_run(
        monkeypatch, tmp_path, capsys, place):
    monkeypatch.setattr(demo, 'Watcher', None)
    monkeypatch.setattr(demo.signal, 'signal', lambda *handler: None)
    (tmp_path / 'file').touch()
    assert demo.main(['--output', str(tmp_path / place)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ''
    assert re.fullmatch(f"demo: .*{tmp_path / 'file'}.*\n", captured.err)


def test_output_that_fails_at_the_end_is_one_line_and_status_2(monkeypatch, tmp_path, capsys):
    def report(*arguments):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(demo, 'Watcher', lambda **node_kwargs: demo.rclpy.create_node(
        'watcher', **node_kwargs))
    monkeypatch.setattr(demo, 'processes', lambda plan, live=False: {})
    monkeypatch.setattr(demo, 'watch', lambda *arguments, **options: None)
    monkeypatch.setattr(demo, 'write_report', report)
    monkeypatch.setattr(demo.signal, 'signal', lambda *handler: None)
    assert demo.main(['--output', str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith(f'demo: {tmp_path}: No space left on device: ')


def test_node_that_does_not_end_is_killed(monkeypatch):
    deaf = subprocess.Popen([sys.executable, '-c', (
        'import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); '
        'print(flush=True); time.sleep(600)')], stdout=subprocess.PIPE)
    assert deaf.stdout.readline() == b'\n'
    monkeypatch.setattr(demo, 'STOP_TIMEOUT', 0.1)
    demo.stop([deaf])
    assert deaf.returncode == -signal.SIGKILL
    deaf.stdout.close()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_live_demo_stays_until_a_signal(number):
    node = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])
    before = signal.signal(number, signal.default_int_handler)
    sender = threading.Timer(0.1, os.kill, (os.getpid(), number))
    sender.start()
    try:
        assert demo.stay([node]) == 0
    finally:
        signal.signal(number, before)
        demo.stop([node])


def test_live_demo_ends_with_the_status_of_a_node_that_ends():
    node = subprocess.Popen([sys.executable, '-c', 'raise SystemExit(3)'])
    assert demo.stay([node]) == 3


@pytest.mark.parametrize('live', [False, True])
def test_simulated_gearbox_is_that_of_the_machine_file(live):
    path = shipped('machine.yaml')
    plan = plan_simulation(path)
    model = plan.model
    assert (plan.shaft, model.trigger_speed, model.ratio, model.keyphasor_rate,
            model.trigger_cycles) == ('input', 16.6, 183.0 / 76.0, 3000.0, 30)
    assert plan.channels == ('input bearing', 'output bearing')
    nodes = demo.processes(plan, live=live)
    assert nodes['machine_simulator'] == {
        'playing': False, 'wait_seconds': 60.0, 'duration': 0.0 if live else plan.seconds}
    assert ('live_view' in nodes) == live
    command = demo.node_command('jitter_predictor', nodes['jitter_predictor'], plan.params)
    assert command[command.index('--params-file') + 1] == str(path)


def test_machine_file_is_for_recordings_too(recording):
    plan = with_machine(plan_recording(recording, read(recording)), shipped('machine.yaml'))
    assert (plan.source, plan.shaft, plan.model.orders[0]) == ('recording_player', 'input', 18.0)
    assert demo.processes(plan, live=True)['recording_player']['loop'] is True


@pytest.mark.parametrize('chosen', [None, 'OFF'])
def test_discovery_stays_on_this_host_unless_opened(monkeypatch, tmp_path, capsys, chosen):
    name = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
    monkeypatch.setenv(name, chosen or '')
    if chosen is None:
        monkeypatch.delenv(name)

    def watcher(**node_kwargs):
        raise SaJitterError(f'range {os.environ[name]}')

    monkeypatch.setattr(demo, 'Watcher', watcher)
    monkeypatch.setattr(demo.signal, 'signal', lambda *handler: None)
    assert demo.main(['--output', str(tmp_path)]) == 2
    assert capsys.readouterr().err == f'demo: range {chosen or "LOCALHOST"}\n'
