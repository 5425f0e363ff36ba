"""
Sphinx: the pages of this folder and the reference, which is read from the docstrings.

`sphinx-build -W --keep-going -b html docs build/docs` builds them, and rosdoc2 does. ROS 2 is
mocked: neither rclpy nor a message package need be installed.
"""

from pathlib import Path
import re
import shutil
import sys

# rosdoc2 executes this file from another one, in a copy of this folder, which names the original.
_original = re.search(r'exec\(open\("(.+)"\)', Path(__file__).read_text(encoding='utf-8'))
sys.path.insert(0, str(Path(_original[1] if _original else __file__).resolve().parents[1]))

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
exclude_patterns = ['modules.rst', 'sa_jitter_ros*.rst']  # rosdoc2 has apidoc write them
default_role = 'code'  # what docstrings have between single backticks

autodoc_default_options = {'members': True, 'show-inheritance': True}
autodoc_member_order = 'bysource'
autodoc_mock_imports = [
    'builtin_interfaces', 'diagnostic_msgs', 'pytest', 'rcl_interfaces', 'rclpy', 'sensor_msgs',
    'std_msgs']
autodoc_typehints = 'description'

myst_heading_anchors = 3

html_theme = 'alabaster'
html_theme_options = {
    'description': 'Synchronous averaging of vibration, and what keyphasor jitter does to it',
    'page_width': '1200px',
    'sidebar_width': '260px',
}


def keep_bars(app, what, name, obj, options, lines):
    """Let |X| in a docstring's text be a formula, not a substitution of reST."""
    lines[:] = [line if line.startswith('    ') else re.sub(
        r'(`[^`]*`)|\|', lambda found: found[1] or r'\|', line) for line in lines]


def setup(app):
    """Clear what autosummary wrote for modules that may have gone since."""
    shutil.rmtree(Path(app.srcdir) / 'reference', ignore_errors=True)
    app.connect('autodoc-process-docstring', keep_bars)
