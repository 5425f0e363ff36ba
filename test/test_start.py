# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The scripts of nodes and commands: an interrupt while their modules load."""

import os
import subprocess
import sys

import pytest

INTERRUPTS = """
import os, signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
os.kill(os.getpid(), signal.SIGINT)
time.sleep(600)
"""


@pytest.mark.parametrize(('name', 'status'), [
    ('average', 130), ('close_loop', 130), ('design', 130), ('chain', 0), ('tach_detector', 0)])
def test_interrupt_while_modules_load_is_one_line(tmp_path, name, status):
    (tmp_path / 'numpy.py').write_text(INTERRUPTS)  # what all of them import first
    start = f'from sa_jitter_ros.start import {name}; raise SystemExit({name}())'
    found = subprocess.run(
        [sys.executable, '-c', start],
        env={**os.environ, 'PYTHONPATH': f'{tmp_path}:{os.pathsep.join(sys.path)}'},
        capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout, found.stderr) == (status, '', f'{name}: stopped\n')
