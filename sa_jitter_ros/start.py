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
What the scripts of nodes and commands call: Ctrl-C ends them well also while their modules load.

That takes a second. Afterwards a node ends with status 0 and a command with 130, as they do later.
"""

from functools import partial
from importlib import import_module
import sys


def _run(module: str, interrupted: int) -> int:
    """Return the status of the `main` of a module, `interrupted` and one line after Ctrl-C."""
    try:
        return int(import_module(f'sa_jitter_ros.{module}').main())
    except KeyboardInterrupt:
        print(f'{module.rpartition(".")[2]}: stopped', file=sys.stderr)
        return interrupted


average = partial(_run, 'commands.average', 130)
chain = partial(_run, 'commands.chain', 0)  # of nodes
change_monitor = partial(_run, 'nodes.change_monitor', 0)
check_keyphasor = partial(_run, 'commands.check_keyphasor', 130)
close_loop = partial(_run, 'commands.close_loop', 130)
demo = partial(_run, 'commands.demo', 130)
design = partial(_run, 'commands.design', 130)
jitter_predictor = partial(_run, 'nodes.jitter_predictor', 0)
layouts = partial(_run, 'commands.layouts', 130)
live_view = partial(_run, 'nodes.live_view', 0)
machine_simulator = partial(_run, 'nodes.machine_simulator', 0)
recording_player = partial(_run, 'nodes.recording_player', 0)
residual_analyser = partial(_run, 'nodes.residual_analyser', 0)
synchronous_averager = partial(_run, 'nodes.synchronous_averager', 0)
tach_detector = partial(_run, 'nodes.tach_detector', 0)
