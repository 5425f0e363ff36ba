# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
CPU time of the command `average` on a recording of eight channels at 93.75 kHz.

    python benchmarks/average_speed.py

makes the recording (60 s, 45 million samples), averages it without figures in processes of their
own, with and without correction, and prints how many times faster than the machine that is. Of
several rounds the fastest counts: other programs only slow one down. Modules are compiled once,
as those of an installed package.
"""

import argparse
import os
from pathlib import Path
import resource
import subprocess
import sys
import tempfile

import numpy as np
from page import table
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import ArraySource, Recording
from sa_jitter_ros.simulation import DeclaredJitter, Gearbox, mesh

ROOT = Path(__file__).resolve().parents[1]
RATE, CHANNELS, SPEED, RATIO, CLOCK = 93_750.0, 8, 16.6, 2.40789, 3000.0


def recording(seconds: float) -> Recording:
    """Return a recording of a gear of 19 teeth, in noise of its own on each channel."""
    machine = Gearbox(mesh('input', 19, harmonics=(1.0, 0.5, 0.25)), RATE, seed=1,
                      shafts={'input': RATIO}, speed=((0.0, SPEED),),
                      effects=(DeclaredJitter('uniform', 1.0 / CLOCK / np.sqrt(12.0)),))
    samples = machine.vibration(0, round(RATE * seconds))[0]
    noise = np.random.default_rng(1).standard_normal((CHANNELS, samples.size))
    return Recording(ArraySource(np.linspace(1.0, 0.5, CHANNELS)[:, None] * samples + 0.4 * noise),
                     RATE, pulse_times=machine.pulses(0.0, seconds).times)


def cpu_seconds(*arguments: str) -> float:
    """Return the CPU time of a process of Python, which keeps compiled modules."""
    def used() -> float:
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return children.ru_utime + children.ru_stime

    before = used()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, env={
        **os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT),
        'PYTHONDONTWRITEBYTECODE': ''})
    return used() - before


def measured(seconds: float, rounds: int) -> dict[str, float]:
    """Return the CPU seconds of starting, averaging, and averaging with correction."""
    with tempfile.TemporaryDirectory() as folder:
        write_npz(Path(folder, 'rig.npz'), recording(seconds))

        def average(correct: str, number: int) -> float:
            return cpu_seconds(
                '-m', 'sa_jitter_ros.commands.average', f'{folder}/rig.npz', '--params',
                str(ROOT / 'config' / 'machine.yaml'), '-p', f'correct_jitter:={correct}',
                '--output', f'{folder}/{correct}{number}', '--no-figures', '--quiet')

        turns = [(cpu_seconds('-c', 'import sa_jitter_ros.commands.average'),
                  average('false', number), average('true', number)) for number in range(rounds)]
    return dict(zip(('start', 'average', 'corrected'), map(min, zip(*turns))))


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--seconds', type=float, default=60.0)
    parser.add_argument('--rounds', type=int, default=5)
    options = parser.parse_args()
    found = measured(options.seconds, options.rounds)
    print(table(('averages', 'CPU s', 'times real time', 'without the start of the program'), [
        [name, f'{found[key]:.2f}', f'{options.seconds / found[key]:.0f}',
         f'{options.seconds / (found[key] - found["start"]):.0f}']
        for key, name in (('average', 'raw'), ('corrected', 'with correction'))]))
    print(f'start of the program: {found["start"]:.2f} s')


if __name__ == '__main__':
    main()
