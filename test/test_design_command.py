"""The command `design`: its table keeps the limits, its figure is a figure, bad input one line."""

import os
from pathlib import Path
import re
import shlex
import subprocess
import sys

import numpy as np
import pytest
from sa_jitter_ros.commands import design
from sa_jitter_ros.statistics.design import assess
from sa_jitter_ros.statistics.prediction import DeclaredModel

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'choosing_keyphasor_and_revolutions.md'
BENCH = ['--orders', '19', '38', '--trigger-speed', '41.5', '--ratio', '2.40789']


def rows(text):
    """Return order, attenuation and variation of each line of the printed table."""
    found = re.findall(r'^ +([\d.]+) +[\d.]+ +(-?[\d.]+) +([\d.]+)  \w', text, re.MULTILINE)
    return np.array(found, float)


def settings(text):
    """Return the keyphasor rate and the number of trigger cycles that were printed."""
    return (float(re.search(r'keyphasor rate +(\S+) Hz', text)[1]),
            int(re.search(r'trigger cycles +(\d+)', text)[1]))


def model(rate, cycles, **others):
    """Return the declared model of the bench."""
    return DeclaredModel(keyphasor_rate=rate, trigger_speed=41.5, trigger_cycles=cycles,
                         orders=(19.0, 38.0), ratio=2.40789, **others)


def test_chosen_settings_are_the_smallest_that_keep_both_limits(tmp_path, capsys):
    output = tmp_path / 'design.png'
    noise = {'noise_std': 0.5, 'sample_rate': 50000.0}
    assert design.main([*BENCH, '--attenuation', '0.03', '--variation', '0.01', '--noise-std',
                        '0.5', '--sample-rate', '50000', '--output', str(output)]) == 0
    text = capsys.readouterr().out
    rate, cycles = settings(text)
    assert 'chosen for an attenuation of at most 0.03' in text
    assert 'broken' not in text
    kept = assess(model(rate, cycles, **noise))
    np.testing.assert_allclose(
        rows(text), np.transpose([kept.order, kept.attenuation, kept.coefficient_of_variation]),
        atol=6e-6)
    assert kept.attenuation.max() <= 0.03 < assess(model(0.999 * rate, cycles)).attenuation.max()
    assert kept.coefficient_of_variation.max() <= 0.01
    assert assess(model(rate, cycles - 1, **noise)).coefficient_of_variation.max() > 0.01
    assert output.read_bytes().startswith(b'\x89PNG')


def test_given_settings_are_assessed(tmp_path, capsys):
    output = tmp_path / 'design.svg'
    assert design.main([*BENCH, '--keyphasor-rate', '5000', '--trigger-cycles', '41',
                        '--pulses-per-revolution', '6', '--output', str(output)]) == 0
    text = capsys.readouterr().out
    assert settings(text) == (5000.0, 41)
    expected = assess(model(5000.0, 41))
    np.testing.assert_allclose(rows(text)[:, 1], expected.attenuation, atol=6e-6)
    assert text.count('(given)') == 2
    assert text.count('broken') == 2
    assert '41 revolutions of the tach shaft, 0.988 s' in text
    svg = output.read_text(encoding='utf-8')
    assert svg.count('<path') > 20


def test_the_page_shows_what_the_command_prints(tmp_path, capsys):
    examples = re.findall(r'^    \$ ros2 run sa_jitter_ros design (.*)\n((?:    .*\n|\n)+)',
                          PAGE.read_text(encoding='utf-8'), re.MULTILINE)
    assert len(examples) == 2
    for arguments, printed in examples:
        assert design.main([*shlex.split(arguments), '--output', str(tmp_path / 'a.png')]) == 0
        lines = capsys.readouterr().out.splitlines()[:-2]  # without the name of the figure
        assert [line.removeprefix('    ') for line in printed.strip('\n').splitlines()] == lines


@pytest.mark.parametrize('orders', [['0.001'], ['38', '400']])
def test_the_figure_bears_orders_without_iso_lines_and_pulses_that_could_swap(
        tmp_path, capsys, orders):
    assert design.main(['--orders', *orders, '--trigger-speed', '41.5', '--keyphasor-rate', '100',
                        '--trigger-cycles', '41', '--output', str(tmp_path / 'a.png')]) == 0
    assert (tmp_path / 'a.png').exists()


@pytest.mark.parametrize(('arguments', 'message'), [
    ([], 'required: --orders, --trigger-speed'),
    ([*BENCH, '--attenuation', '1.5'], '--attenuation is 1.5: give a fraction'),
    ([*BENCH, '--variation', 'nan'], '--variation is nan: give a fraction'),
    ([*BENCH, '--keyphasor-rate', '0'], 'keyphasor_rate is 0.0'),
    ([*BENCH, '--keyphasor-rate', '30'], 'pulses could swap'),
    ([*BENCH, '--trigger-cycles', '0'], 'trigger_cycles is 0'),
    ([*BENCH, '--trigger-cycles', 'few'], "invalid int value: 'few'"),
    ([*BENCH, '--noise-std', '1'], 'set sample_rate'),
    ([*BENCH, '--jitter-distribution', 'cauchy'], "invalid choice: 'cauchy'"),
    ([*BENCH, '--output', 'design.doc'], '--output design.doc: end the name in .png'),
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


def test_it_runs_as_a_process_and_explains_units(tmp_path):
    result = subprocess.run(
        [sys.executable, '-m', 'sa_jitter_ros.commands.design', '--help'], cwd=tmp_path,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)}, capture_output=True,
        text=True, check=True)
    for word in ('Hz', 'fraction', "units of the component's amplitude", 'examples:'):
        assert word in ' '.join(result.stdout.split())
