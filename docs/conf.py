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
Sphinx: the pages of this folder and the reference, which is read from the docstrings.

`sphinx-build -W --keep-going -b html docs build/docs` builds them, and rosdoc2 does. ROS 2 is
mocked: neither rclpy nor a message package need be installed.
"""

from pathlib import Path
import re
import shutil
import sys
from typing import NewType

import numpy.typing

# rosdoc2 executes this file from another one, in a copy of this folder, which names the original.
_original = re.search(r'exec\(open\("(.+)"\)', Path(__file__).read_text(encoding='utf-8'))
sys.path.insert(0, str(Path(_original[1] if _original else __file__).resolve().parents[1]))

# What a user may give is an array; numpy spells out every type that it turns into one.
numpy.typing.ArrayLike = NewType('ArrayLike', object)
numpy.typing.ArrayLike.__module__ = 'numpy.typing'

project = 'sa_jitter_ros'
author = 'sa_jitter_ros contributors'
extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.autosummary',
    'sphinx.ext.napoleon',
    'sphinx.ext.viewcode',
]
templates_path = ['_templates']
# What rosdoc2 adds: the output of apidoc, and copies of README and others, whose links are broken.
exclude_patterns = [
    'modules.rst', 'sa_jitter_ros*.rst', '__readme_include.rst', 'standards.rst', 'standard_docs']
default_role = 'code'  # what docstrings have between single backticks

autodoc_default_options = {'members': True, 'show-inheritance': True}
autodoc_member_order = 'bysource'
autodoc_typehints = 'description'

myst_heading_anchors = 3
smartquotes = False  # '' in a docstring is an empty string

rosdoc2_settings = {'override_theme': False}
html_theme = 'alabaster'
html_show_copyright = False
html_theme_options = {
    'description': 'Synchronous averaging of vibration, and what keyphasor jitter does to it',
    'page_width': '1200px',
    'sidebar_width': '260px',
}


def keep_bars(app, what, name, obj, options, lines):
    """Let |X| in a docstring's text be a formula, not a substitution of reST."""
    lines[:] = [line if line.startswith('    ') else re.sub(
        r'(`[^`]*`)|\|', lambda found: found[1] or r'\|', line) for line in lines]


def mock_imports(app, config):
    """Mock ROS 2 and pytest; here, because rosdoc2 overwrites autodoc_mock_imports above."""
    config.autodoc_mock_imports = [
        *config.autodoc_mock_imports, 'builtin_interfaces', 'diagnostic_msgs', 'pytest',
        'rcl_interfaces', 'rclpy', 'sensor_msgs', 'std_msgs']


def setup(app):
    """Clear what autosummary wrote for modules that may have gone since."""
    shutil.rmtree(Path(app.srcdir) / 'reference', ignore_errors=True)
    app.connect('config-inited', mock_imports)
    app.connect('autodoc-process-docstring', keep_bars)
