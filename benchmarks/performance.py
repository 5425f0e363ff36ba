"""
Measure everything that docs/performance.md says, and write it there.

    .venv/bin/python benchmarks/performance.py

takes a quarter of an hour. Peers are installed into `benchmarks/.venv` (phonometry needs a
`python3.13` in PATH); what cannot be installed is skipped and named. The tables between the
markers of the page are replaced, the figures drawn again, and all numbers kept in
`out/performance.json`.
"""

import argparse
from collections.abc import Sequence
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from performance_page import draw, fill, sections

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PEERS = (('numpy', 'scipy'), ('rota-order',), ('acoular',), ('--pre', 'phonometry'))
# What the wheels of ROS 2 leave for child processes, wrong for another environment's Python.
WHEELS = '_ROS_WHEELS_BOOTSTRAP_COMPLETE'


def plain_environment() -> dict[str, str]:
    """Environment for a Python without ROS: one thread of linear algebra, this source tree."""
    environment = {key: value for key, value in os.environ.items()
                   if key not in (WHEELS, 'PYTHONHOME')
                   and not (key == 'LD_LIBRARY_PATH' and WHEELS in os.environ)}
    return {**environment, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)}


def peer_python() -> str:
    """Python of the environment that holds the peers, which is made at the first call."""
    python = HERE / '.venv' / 'bin' / 'python'
    if not python.exists():
        newest = shutil.which('python3.13')
        usable = newest and not subprocess.run([newest, '-c', ''], capture_output=True).returncode
        subprocess.run([newest if usable else sys.executable, '-m', 'venv', HERE / '.venv'],
                       check=True, env=plain_environment())
    for names in PEERS:
        done = subprocess.run(
            [python, '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check', *names],
            env=plain_environment(), capture_output=True, text=True, check=False)
        if done.returncode:
            print(f'performance: cannot install {names[-1]}: '
                  f'{done.stderr.strip().splitlines()[-1]}', file=sys.stderr)
    return str(python)


def run(python: str, script: str, arguments: Sequence[str], environment: dict[str, str]) -> Any:
    """Run a script of this folder and return the JSON that it prints."""
    done = subprocess.run([python, '-W', 'ignore', HERE / script, *arguments], env=environment,
                          stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def measure(quick: bool) -> dict[str, Any]:
    """Run the three benchmarks."""
    environment = {**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': os.pathsep.join(
        filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))}
    small = ['--scale', '0.1', '--rounds', '2'] if quick else []
    brief = ['--seconds', '6', '--channels', '8', '--large', '8', '--latency-seconds', '0'
             ] if quick else []
    return {'core': run(peer_python(), 'core_speed.py', small, plain_environment()),
            'loop': run(sys.executable, 'loop_speed.py', small, environment),
            'graph': run(sys.executable, 'graph_speed.py', brief, environment)}


def main() -> int:
    """Measure, keep the numbers, and write the page."""
    parser = argparse.ArgumentParser(description='Measure what docs/performance.md says.')
    parser.add_argument('--quick', action='store_true', help='small sizes: a check, not a result')
    parser.add_argument('--only-write', action='store_true', help='from the numbers of last time')
    parser.add_argument('--numbers', type=Path, default=ROOT / 'out' / 'performance.json')
    parser.add_argument('--page', type=Path, default=ROOT / 'docs' / 'performance.md')
    parser.add_argument('--figures', type=Path, default=ROOT / 'docs' / 'figures')
    options = parser.parse_args()
    if not options.only_write:
        found = measure(options.quick)
        options.numbers.parent.mkdir(parents=True, exist_ok=True)
        options.numbers.write_text(json.dumps(found, indent=1) + '\n')
    found = json.loads(options.numbers.read_text())
    draw(found, options.figures)
    options.page.write_text(fill(options.page.read_text(), sections(found)))
    print(f'numbers: {options.numbers}\npage: {options.page}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
