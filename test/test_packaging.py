# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The package as colcon and pip see it: manifest, dependencies, scripts, installed copies."""

import ast
import importlib
from importlib.metadata import entry_points
from importlib.util import find_spec
import os
from pathlib import Path
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig

import pytest
import sa_jitter_ros
from sa_jitter_ros import start
import setuptools
from test_architecture import is_ros, MODULES, needs

ROOT = Path(__file__).resolve().parents[1]
NAME = 'sa_jitter_ros'
PYPI_NAMES = {'nptdms': 'npTDMS', 'yaml': 'PyYAML'}
OPTIONAL = {  # package to extra
    'asammdf': 'mdf', 'distributed': 'fleet', 'h5py': 'mat73', 'nptdms': 'tdms', 'pyuff': 'uff',
    'rosbags': 'bags'}
# Keys of rosdep that are Debian packages of Ubuntu 24.04 or of ROS 2, no names of pip.
ROSDEP_KEYS = {
    'ament_copyright', 'ament_flake8', 'ament_pep257', 'diagnostic_msgs', 'python3-dev',
    'python3-hypothesis', 'python3-matplotlib', 'python3-numpy', 'python3-pytest',
    'python3-scipy', 'python3-yaml',
    'launch', 'launch_ros', 'rcl_interfaces', 'rclpy', 'sensor_msgs', 'std_msgs'}


def setup_called(*arguments):
    """Return what setup.py, called with arguments, tells setuptools."""
    keywords_of_setup = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(setuptools, 'setup', lambda **keywords: keywords_of_setup.update(keywords))
        patch.setattr(sys, 'argv', ['setup.py', *arguments])
        patch.chdir(ROOT)
        runpy.run_path('setup.py')
    return keywords_of_setup


def scripts_of(keywords_of_setup):
    """Return the console scripts: name to module."""
    lines = keywords_of_setup['entry_points']['console_scripts']
    entries = (line.split(f' = {NAME}.start:') for line in lines)
    return {script: f'{NAME}.{getattr(start, name).args[0]}' for script, name in entries}


@pytest.fixture(scope='module')
def setup():
    """Return what setup.py tells setuptools when pip builds a wheel."""
    return setup_called('bdist_wheel')


@pytest.fixture(scope='module')
def scripts():
    """Return the console scripts for `ros2 run`: name to module."""
    return scripts_of(setup_called('build', 'install'))


@pytest.fixture(scope='module')
def manifest():
    """Return package.xml, checked against the rules of its format."""
    warnings = []
    parser = pytest.importorskip('catkin_pkg.package')
    package = parser.parse_package(str(ROOT / 'package.xml'), warnings=warnings)
    assert not warnings
    return package


@pytest.fixture(scope='module')
def packages():
    """Return all packages that are imported and neither ours, nor Python's, nor of tests only."""
    modules = {path.stem for path in MODULES} | {path.parent.name for path in MODULES}
    return set().union(*map(needs, MODULES)) - modules - {'pytest'}


def test_manifest_is_of_format_3_for_ament_python(manifest):
    assert manifest.package_format == 3
    assert {export.tagname: export.content for export in manifest.exports} == {
        'build_type': 'ament_python', 'rosdoc2': 'rosdoc2.yaml'}
    assert (ROOT / 'rosdoc2.yaml').is_file()
    assert manifest.licenses == ['Apache-2.0']
    assert (ROOT / manifest.licenses[0].file).is_file()


def test_names_and_versions_agree(manifest, setup):
    assert manifest.name == setup['name'] == NAME
    assert manifest.version == setup['version'] == sa_jitter_ros.__version__
    assert (ROOT / 'resource' / NAME).is_file()


def test_manifest_declares_what_is_imported(manifest, packages):
    declared = {dependency.name for dependency in manifest.exec_depends}
    assert {package if is_ros(package) else f'python3-{package}'
            for package in packages - set(OPTIONAL)} <= declared


def test_manifest_declares_nothing_that_apt_lacks(manifest):
    needed = (*manifest.build_depends, *manifest.exec_depends, *manifest.test_depends)
    assert {item.name for item in needed} <= ROSDEP_KEYS
    assert {url.type for url in manifest.urls} == {'bugtracker', 'repository', 'website'}


def test_setup_requires_what_is_imported_from_pypi(setup, packages):
    required = {re.match(r'[\w-]+', line)[0] for line in setup['install_requires']}
    assert {PYPI_NAMES.get(name, name)
            for name in packages - set(OPTIONAL) if not is_ros(name)} == required
    for package, extra in OPTIONAL.items():
        assert package in packages
        assert re.match(r'[\w-]+', setup['extras_require'][extra][0])[0] == PYPI_NAMES.get(
            package, package)


def test_every_script_has_a_main(scripts):
    for name, module in scripts.items():
        assert name == module.rpartition('.')[2]
        loaded = importlib.import_module(module)
        assert callable(loaded.main)
        assert "if __name__ == '__main__':" in Path(loaded.__file__).read_text()  # python -m


def test_every_main_has_a_script(scripts):
    mains = {
        f'{NAME}.{path.parent.name}.{path.stem}'
        for path in MODULES
        if any(
            isinstance(node, ast.FunctionDef) and node.name == 'main'
            for node in ast.parse(path.read_text(encoding='utf-8')).body
        )
    }
    assert mains == set(scripts.values())


def test_pip_puts_no_common_word_on_the_path(setup, scripts):
    installed = scripts_of(setup)
    assert {name: module for name, module in installed.items() if name in scripts} == {
        name: module for name, module in scripts.items() if '_' in name}
    assert {name: module for name, module in installed.items() if name not in scripts} == {
        f'sa_jitter_{name}': module for name, module in scripts.items()}


def test_every_folder_with_modules_is_installed(setup):
    folders = {path.parent.relative_to(ROOT) for path in MODULES}
    assert {'.'.join(folder.parts) for folder in folders} == set(setup['packages'])


def test_every_configuration_is_installed(setup):
    files = {file for _, files in setup['data_files'] for file in files}
    assert files >= {str(file.relative_to(ROOT)) for file in ROOT.glob('config/*')}
    assert 'package.xml' in files


def test_pip_installed_the_tree_as_it_stands(setup):
    installed = Path(sysconfig.get_path('purelib')) / NAME
    if not installed.is_dir():
        pytest.skip(f'{NAME} is not installed in {sys.prefix}: ./run installs it')
    assert modules_of(installed) == modules_of(ROOT / NAME)
    for name, module in scripts_of(setup).items():
        assert os.access(Path(sysconfig.get_path('scripts')) / name, os.X_OK)
        (entry,) = {e.value for e in entry_points(group='console_scripts', name=name)}
        assert entry == f'{NAME}.start:{module.rpartition(".")[2]}'


def modules_of(folder):
    """Return the text of every module in a folder, by its relative path."""
    return {path.relative_to(folder): path.read_text() for path in folder.rglob('*.py')}


def test_c_is_compiled_where_there_is_a_compiler():
    header = Path(sysconfig.get_path('include')) / 'Python.h'
    if shutil.which('cc') is None or not header.is_file():
        pytest.skip('no C compiler, or no header of Python: apt install gcc python3-dev')
    assert find_spec(f'{NAME}.inner_loops._in_c') is not None


@pytest.mark.build
@pytest.mark.parametrize('compiler', ['cc', 'false'])
def test_pip_installs_with_and_without_a_c_compiler(tmp_path, compiler):
    if shutil.which(compiler) is None:
        pytest.skip(f'{compiler} is not installed')
    source = tmp_path / 'source'
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns('.*', '*.so', 'build', 'out'))
    run(tmp_path, 'env', f'CC={shutil.which(compiler)}', sys.executable, '-m', 'pip', 'install',
        '--no-build-isolation', '--no-deps', '--no-compile', '--target', tmp_path / 'home',
        source)
    made = list((tmp_path / 'home').glob(f'{NAME}/inner_loops/_in_c.*.so'))
    assert len(made) == (compiler == 'cc')
    values = run(tmp_path / 'home', sys.executable, '-c', (
        'import numpy as np; from sa_jitter_ros.pulses.resampling import interpolate; '
        'print(interpolate(np.arange(40.0)[:, None], np.array([20.5]))[0, 0].round(9))'))
    assert float(values) == 20.5


@pytest.mark.build
def test_colcon_builds_what_ros2_run_looks_for(tmp_path, scripts):
    if find_spec('colcon_ros') is None:
        pytest.skip('colcon-ros is not installed')
    source = tmp_path / 'src' / NAME
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns('.*', 'build', 'install', 'out'))
    colcon = 'from colcon_core.command import main; main(argv=["build"])'
    run(tmp_path, sys.executable, '-c', colcon)

    look_up = (
        '. install/setup.bash; exec "$0" -c "'
        'from ament_index_python import get_package_prefix as prefix, get_package_share_directory;'
        f'import {NAME};'
        f'print(prefix({NAME!r}), get_package_share_directory({NAME!r}), {NAME}.__file__)"'
    )
    found = run(tmp_path, 'bash', '-c', look_up, sys.executable)
    prefix, share, module = map(Path, found.split())
    executables = (path for path in (prefix / 'lib' / NAME).iterdir() if os.access(path, os.X_OK))
    assert {path.name for path in executables} == set(scripts)
    assert module.is_relative_to(tmp_path / 'install')
    assert (share / 'package.xml').is_file()
    configured = {path.name for path in (share / 'config').iterdir()}
    assert configured == {path.name for path in ROOT.glob('config/*')}


@pytest.mark.build
def test_debian_package_where_its_tools_are(tmp_path, scripts):
    built = subprocess.run(
        [sys.executable, ROOT / 'benchmarks' / 'debian_package.py', '--output', tmp_path / 'deb'],
        capture_output=True, text=True, check=False)
    if built.returncode == 2 and built.stderr.count('\n') == 1:
        pytest.skip(built.stderr.strip())
    assert built.returncode == 0, built.stderr
    lines = dict(line.partition(': ')[::2] for line in built.stdout.splitlines())
    assert lines['ros2 run finds'].split() == sorted(scripts)
    assert lines['on the PATH'] == 'nothing'
    assert all(re.fullmatch(r'python3-\w+|ros-jazzy-[\w-]+', name)
               for name in lines['depends on'].split(', '))


def run(folder, *command):
    """Run a command that must succeed in a folder and return what it printed."""
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
