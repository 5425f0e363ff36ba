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
The memory of the chain, in one process and in one process for each node.

The nodes of `config/machine.yaml` average its simulated gearbox for some seconds.
`python benchmarks/chain_memory.py` prints the resident memory of each process, MB.
"""

import argparse
import os
import signal
import subprocess
import sys
import time

from graph_speed import resident
from sa_jitter_ros.commands.chain import NODES
from sa_jitter_ros.parameter_file import shipped


def start(module: str, *arguments: str) -> subprocess.Popen[bytes]:
    """Start a node or command as a process that finds others on this host only."""
    environment = {'ROS_DOMAIN_ID': '83', **os.environ, 'OMP_NUM_THREADS': '1',
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    return subprocess.Popen(
        [sys.executable, '-c',
         f'from sa_jitter_ros.{module} import main; raise SystemExit(main())', *arguments],
        env=environment, stderr=subprocess.DEVNULL)


def measure(seconds: float, commands: dict[str, list[str]]) -> dict[str, float]:
    """Return the memory of processes by name after they ran so long, MB."""
    file = str(shipped('machine.yaml'))
    running = {name: start(*command) for name, command in {
        'machine_simulator': ['nodes.machine_simulator', '--ros-args', '--params-file', file],
        **commands}.items()}
    time.sleep(seconds)
    found = {}
    for name, process in running.items():
        if (held := resident(process.pid)) is None:
            raise RuntimeError(f'{name} has ended within {seconds:g} s')
        found[name] = held
    for process in running.values():
        process.send_signal(signal.SIGTERM)
        process.wait()
    return {name: found[name] for name in commands}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=15.0, help='length of a run (15)')
    seconds = parser.parse_args().seconds
    file = str(shipped('machine.yaml'))
    names = (*NODES, 'live_view')
    alone = measure(seconds, {name: [f'nodes.{name}', '--ros-args', '--params-file', file]
                              for name in names})
    together = measure(seconds, {'chain': [
        'commands.chain', '--params', file, '--with', 'live_view']})
    for name, size in {**alone, **together}.items():
        print(f'{name:22} {size:5.0f} MB')
    print(f'one process needs {together["chain"] / sum(alone.values()):.0%} of '
          f'{sum(alone.values()):.0f} MB')


if __name__ == '__main__':
    main()
