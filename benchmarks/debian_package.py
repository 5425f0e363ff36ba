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
Build the Debian package of a ROS 2 distribution as its build farm does, and look into it.

    python benchmarks/debian_package.py --ros-distro jazzy --output build/debian

bloom makes `debian/` of package.xml, dpkg-buildpackage builds it. rosdep is given the keys of
package.xml alone, so that nothing is downloaded: a key `python3-...` is the Debian package of that
name, any other is a package of the distribution. Needs bloom (pip), what `design` imports, and of
Debian 12 or Ubuntu 24.04 dpkg-dev, debhelper, dh-python, python3-all-dev and python3-setuptools.
ROS 2 need not be installed. Exit status 2, after one line: a tool is missing.
"""

import argparse
import os
from pathlib import Path
import shutil
import subprocess
import sys

ROOT = Path(__file__).resolve().parents[1]
NAME = 'sa_jitter_ros'
SERIES = {'jazzy': 'noble', 'kilted': 'noble'}
TOOLS = {'bloom-generate': 'pip install bloom', 'rosdep': 'pip install bloom',
         'dpkg-buildpackage': 'apt install dpkg-dev', 'dh': 'apt install debhelper',
         'pybuild': 'apt install dh-python python3-all-dev python3-setuptools'}


def run(*command, **options):
    """Run a command that must succeed and return what it printed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    if done.returncode != 0:
        raise SystemExit(f'{" ".join(map(str, command))}:\n{done.stdout}{done.stderr}')
    return done.stdout


def local_rosdep(folder, distro):
    """Write sources of rosdep with the keys of package.xml and return the environment."""
    from catkin_pkg.package import parse_package

    package = parse_package(str(ROOT / 'package.xml'))
    names = {item.name for item in (*package.buildtool_depends, *package.build_depends,
                                    *package.exec_depends, *package.test_depends)}
    folder.mkdir(parents=True)
    debian = {name: name if name.startswith('python3-') else ros_name(name, distro)
              for name in names}
    (folder / 'keys.yaml').write_text(
        ''.join(f'{key}: {{ubuntu: [{name}]}}\n' for key, name in debian.items()))
    (folder / 'sources').mkdir()
    (folder / 'sources' / '10-local.list').write_text(f'yaml {(folder / "keys.yaml").as_uri()}\n')
    (folder / 'distribution.yaml').write_text(
        '%YAML 1.1\n---\nrelease_platforms: {ubuntu: [' + SERIES[distro] + ']}\n'
        'repositories: {}\ntype: distribution\nversion: 2\n')
    (folder / 'index-v4.yaml').write_text(
        f'%YAML 1.1\n---\ndistributions:\n  {distro}:\n    distribution: [distribution.yaml]\n'
        '    distribution_status: active\n    distribution_type: ros2\n    python_version: 3\n'
        'type: index\nversion: 4\n')
    environment = {
        **os.environ, 'ROS_HOME': str(folder / 'home'),
        'ROSDEP_SOURCE_PATH': str(folder / 'sources'),
        'ROSDISTRO_INDEX_URL': (folder / 'index-v4.yaml').as_uri()}
    run('rosdep', 'update', '--rosdistro', distro, env=environment)
    return environment


def ros_name(name, distro):
    """Return the name of the Debian package of a ROS package."""
    return f'ros-{distro}-{name.replace("_", "-")}'


def build(folder, distro):
    """Build the package in a folder and return the path of the .deb."""
    source = folder / NAME
    shutil.copytree(ROOT, source, ignore=shutil.ignore_patterns(
        '.*', '__pycache__', '*.so', 'build', 'install', 'log', 'out'))
    environment = local_rosdep(folder / 'rosdep', distro)
    run('bloom-generate', 'rosdebian', '--os-name', 'ubuntu', '--os-version', SERIES[distro],
        '--ros-distro', distro, cwd=source, env=environment)
    # -d: packages of ROS 2 are among the build dependencies, and building does not need them
    run('dpkg-buildpackage', '-b', '-d', '-uc', '-us', cwd=source,
        env={**environment, 'DEB_BUILD_OPTIONS': 'nocheck'})
    made, = folder.glob(f'{ros_name(NAME, distro)}_*.deb')
    return made


def main(arguments=None):
    """Build the package, print what it depends on and installs, and start a command of it."""
    parser = argparse.ArgumentParser(description=__doc__.strip().partition('\n')[0])
    parser.add_argument('--ros-distro', choices=SERIES, default='jazzy')
    parser.add_argument('--output', type=Path, default=ROOT / 'build' / 'debian')
    options = parser.parse_args(arguments)
    for tool, remedy in TOOLS.items():
        if shutil.which(tool) is None:
            print(f'debian_package: {tool} is missing: {remedy}', file=sys.stderr)
            return 2

    folder = options.output.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    made = build(folder, options.ros_distro)
    run('dpkg-deb', '--extract', made, folder / 'installed')
    prefix = folder / 'installed' / 'opt' / 'ros' / options.ros_distro
    scripts = sorted(path.name for path in (prefix / 'lib' / NAME).iterdir())
    library, = prefix.glob(f'lib/python3*/site-packages/{NAME}')
    run(sys.executable, prefix / 'lib' / NAME / 'design', '--help',
        env={**os.environ, 'PYTHONPATH': str(library.parent)})

    print(made, f'({made.stat().st_size / 1024:.0f} kB)')
    print('depends on:', run('dpkg-deb', '--field', made, 'Depends').strip())
    print('homepage:', run('dpkg-deb', '--field', made, 'Homepage').strip())
    print('ros2 run finds:', ' '.join(scripts))
    print('on the PATH:', ' '.join(path.name for path in prefix.glob('bin/*')) or 'nothing')
    print('configurations:', ' '.join(sorted(
        path.name for path in (prefix / 'share' / NAME / 'config').iterdir())))
    return 0


if __name__ == '__main__':
    sys.exit(main())
