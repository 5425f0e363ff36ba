# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The command `design`: its table, its figure, and one line for bad input."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
import re
import shlex

from matplotlib.figure import Figure
import numpy as np
import pytest
from sa_jitter_ros.commands import design
from sa_jitter_ros.prediction.design import design as designed

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'choosing_keyphasor_and_revolutions.md'
BENCH = ['--orders', '19', '38', '--trigger-speed', '41.5', '--ratio', '2.40789']


KEYWORDS = {'orders': (19.0, 38.0), 'trigger_speed': 41.5, 'ratio': 2.40789}
LINE = re.compile(r'^ +([\d.]+) +[\d.]+ +(-?[\d.]+) +([\d.]+)(?: +([\d.]+))?  [a-z]', re.MULTILINE)


def rows(text):
    """Return order, loss, variation and detection (NaN: none) of each line of the table."""
    return np.array([[float(value or 'nan') for value in found] for found in LINE.findall(text)])


def settings(text):
    """Return the keyphasor rate and the number of trigger cycles that were printed."""
    return (float(re.search(r'keyphasor rate +(\S+) Hz', text)[1]),
            int(re.search(r'trigger cycles +(\d+)', text)[1]))


@pytest.fixture
def no_figure(monkeypatch):
    """Leave the figure empty, whose iso-lines take seconds."""
    monkeypatch.setattr(design, 'draw', lambda *arguments: Figure())


@pytest.mark.usefixtures('no_figure')
@pytest.mark.parametrize('name', ['--loss', '--attenuation'])
def test_the_table_is_what_the_library_chooses(tmp_path, capsys, name):
    output = tmp_path / 'design.png'
    assert design.main([*BENCH, name, '0.03', '--variation', '0.01', '--noise-std', '0.5',
                        '--sample-rate', '50000', '--output', str(output)]) == 0
    text = capsys.readouterr().out
    found = designed(**KEYWORDS, maximum_loss=0.03, maximum_variation=0.01, noise_std=0.5,
                     sample_rate=5e4)
    assert settings(text) == (found.keyphasor_rate, found.trigger_cycles)
    assert 'chosen for a loss of at most 0.03' in text
    assert 'exceeded' not in text
    np.testing.assert_allclose(
        rows(text)[:, :3], np.transpose([found.orders, found.loss, found.variation]), atol=6e-6)
    assert output.read_bytes().startswith(b'\x89PNG')


@pytest.fixture(scope='module')
def given(tmp_path_factory):
    """Return what is printed and drawn of given settings."""
    output, printed = tmp_path_factory.mktemp('given') / 'design.svg', StringIO()
    with redirect_stdout(printed):
        assert design.main([*BENCH, '--keyphasor-rate', '5000', '--trigger-cycles', '41',
                            '--pulses-per-revolution', '6', '--output', str(output)]) == 0
    return printed.getvalue(), output.read_text(encoding='utf-8')


@pytest.mark.machines
def test_given_settings_are_assessed(given):
    text, svg = given
    assert settings(text) == (5000.0, 41)
    expected = designed(**KEYWORDS, keyphasor_rate=5000.0, trigger_cycles=41)
    np.testing.assert_allclose(rows(text)[:, 1], expected.loss, atol=6e-6)
    assert text.count('(given)') == 2
    assert text.count('exceeded') == 2
    assert '41 revolutions of the tach shaft, 0.988 s' in text
    assert svg.count('<path') > 20


@pytest.mark.machines
def test_interfering_components_and_detection_are_in_table_and_figure(given, tmp_path, capsys):
    output = tmp_path / 'design.svg'
    assert design.main([
        *BENCH, '--loss', '0.03', '--variation', '0.005', '--others', '18.6886', '--tones', '50',
        '1850', '--change', '-0.05', '--false-alarm-rate', '0.01', '--output', str(output)]) == 0
    text = capsys.readouterr().out
    found = designed(**KEYWORDS, maximum_loss=0.03, maximum_variation=0.005, others=[18.6886],
                     tones=[50.0, 1850.0], change=-0.05, false_alarm_rate=0.01)
    assert settings(text) == (found.keyphasor_rate, found.trigger_cycles)
    assert '-5 % detected' in text
    np.testing.assert_allclose(rows(text)[:, 3], found.detection, atol=6e-5)
    leakage = found.leakage
    printed = re.findall(
        r'^(order 18.6886|50 Hz .*\)|1850 Hz .*\)) +([\d.]+) +([\d.]+) +([\d.]+)$', text,
        re.MULTILINE)
    np.testing.assert_allclose(np.array([line[1:] for line in printed], float),
                               np.column_stack([leakage.share, leakage.waveform_share]), atol=6e-6)
    table = text.split('with the smallest shares')[1]
    best, shares = (np.array(re.search(rf'^{name} +(.*)$', table, re.MULTILINE)[1].split(), float)
                    for name in ('trigger cycles', 'largest share'))
    assert best.tolist() == leakage.best(5).tolist()
    np.testing.assert_allclose(shares, [leakage.largest_share[count - leakage.candidates[0]]
                                        for count in best.astype(int)], atol=6e-6)
    assert output.read_text(encoding='utf-8').count('<path') > 1.3 * given[1].count('<path')


@pytest.mark.usefixtures('no_figure')
def test_the_page_shows_what_the_command_prints(tmp_path, capsys):
    examples = re.findall(r'^    \$ ros2 run sa_jitter_ros design (.*)\n((?:    .*\n|\n)+)',
                          PAGE.read_text(encoding='utf-8'), re.MULTILINE)
    assert len(examples) == 2
    for arguments, printed in examples:
        assert design.main([*shlex.split(arguments), '--output', str(tmp_path / 'a.png')]) == 0
        lines = capsys.readouterr().out.splitlines()[:-2]  # without the name of the figure
        assert [line.removeprefix('    ') for line in printed.strip('\n').splitlines()] == lines


@pytest.mark.machines
@pytest.mark.usefixtures('undrawn')
@pytest.mark.parametrize('orders', [['0.001'], ['38', '100']])
def test_figure_of_orders_without_iso_lines_and_of_pulses_that_could_swap(
        tmp_path, capsys, orders):
    assert design.main(['--orders', *orders, '--trigger-speed', '41.5', '--keyphasor-rate', '100',
                        '--trigger-cycles', '41', '--output', str(tmp_path / 'a.png')]) == 0
    assert (tmp_path / 'a.png').exists()


@pytest.mark.usefixtures('no_figure')
@pytest.mark.parametrize(('arguments', 'message'), [
    ([], 'required: --orders, --trigger-speed'),
    ([*BENCH, '--loss', '1.5'], '--loss is 1.5: give a fraction'),
    ([*BENCH, '--variation', 'nan'], '--variation is nan: give a fraction'),
    ([*BENCH, '--variation', '1e-9', '--noise-std', '1', '--sample-rate', '20000'],
     'needs more than 1000000 trigger cycles'),
    ([*BENCH, '--change', '0.1'], 'change is given without --false-alarm-rate'),
    ([*BENCH, '--false-alarm-rate', '0.1'], '--false-alarm-rate is given without change'),
    ([*BENCH, '--change', '0.1', '--false-alarm-rate', '1'], '--false-alarm-rate is 1.0: give'),
    ([*BENCH, '--others', '19'], 'interfering order 19 is synchronous'),
    ([*BENCH, '--tones', '-50'], 'tones hold -50 Hz'),
    ([*BENCH, '--tones', '9000', '--sample-rate', '10000'], 'of 9000 Hz is above half'),
    ([*BENCH, '--keyphasor-rate', '0'], '--keyphasor-rate is 0.0'),
    ([*BENCH, '--keyphasor-rate', '30'], 'pulses could swap'),
    ([*BENCH, '--trigger-cycles', '0'], '--trigger-cycles is 0'),
    ([*BENCH, '--trigger-cycles', 'few'], "invalid int value: 'few'"),
    ([*BENCH, '--noise-std', '1'], 'set --sample-rate'),
    ([*BENCH, '--jitter-distribution', 'cauchy'], "invalid choice: 'cauchy'"),
    ([*BENCH, '--output', 'design.doc'], '--output design.doc: give a file that ends in .png'),
    ([*BENCH, '--output', '/nowhere/design.png'], 'No such file'),
])
def test_bad_input_is_one_line_and_status_2(capsys, arguments, message):
    try:
        status = design.main(arguments)
    except SystemExit as stop:
        status = stop.code
    error = capsys.readouterr().err
    assert status == 2
    assert message in error
    assert error.count('\n') == 1
    assert error.startswith('design: ')


def test_its_help_explains_units(capsys):
    with pytest.raises(SystemExit) as stop:
        design.main(['--help'])
    assert stop.value.code == 0
    text = ' '.join(capsys.readouterr().out.split())
    for word in ('Hz', 'fraction', 'of components of amplitude 1', 'examples:'):
        assert word in text
