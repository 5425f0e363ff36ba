# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Install the package: into a colcon workspace or, by pip, into any Python environment."""

from glob import glob
import sys

from setuptools import Extension, find_packages, setup

NAME = 'sa_jitter_ros'
HOME = 'https://sa-jitter-ros.example'
NODES = (
    'change_monitor',
    'jitter_predictor',
    'live_view',
    'machine_simulator',
    'recording_player',
    'residual_analyser',
    'synchronous_averager',
    'tach_detector',
)
COMMANDS = (
    'average', 'chain', 'check_keyphasor', 'close_loop', 'demo', 'design', 'layouts')


def scripts():
    """
    Return the names of the console scripts, with what each of them starts.

    colcon and Debian packages call the command `install` or `develop` and put scripts where only
    `ros2 run` looks (setup.cfg). pip builds a wheel, whose scripts are on everybody's PATH: each
    has the prefix `sa_jitter_`, and a short name beside it unless that is a common word.
    """
    names = (*NODES, *COMMANDS)
    if {'develop', 'install'}.intersection(sys.argv):
        return {name: name for name in names}
    return {f'sa_jitter_{name}': name for name in names} | {
        name: name for name in names if '_' in name}


setup(
    name=NAME,
    version='1.0.0',
    description='Synchronous averaging of vibration, with the effect of keyphasor jitter',
    author='sa_jitter_ros contributors',
    maintainer='sa_jitter_ros maintainers',
    maintainer_email='maintainers@sa-jitter-ros.example',
    url=HOME,
    project_urls={'Source': f'{HOME}/{NAME}', 'Bug tracker': f'{HOME}/{NAME}/issues'},
    license='Apache-2.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: ['py.typed', 'nodes/live_view_page/*'], f'{NAME}.inner_loops': ['*.pyi']},
    # Without a C compiler numpy and scipy do the same, in a few times the time.
    ext_modules=[Extension(f'{NAME}.inner_loops._in_c', [f'{NAME}/inner_loops/_in_c.c'],
                           depends=[f'{NAME}/inner_loops/loops.h'],
                           extra_compile_args=['-O3'], optional=True)],
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/config', sorted(glob('config/*'))),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
    ],
    python_requires='>=3.10',
    install_requires=[
        'matplotlib>=3.6',
        'numpy>=1.24',
        'PyYAML>=6.0',
        'scipy>=1.10',
    ],
    extras_require={
        'bags': ['rosbags>=0.10'],
        'fleet': ['distributed>=2023.5'],
        'mat73': ['h5py>=3.7'],
        'mdf': ['asammdf>=7.3'],
        'tdms': ['npTDMS>=1.4'],
        'uff': ['pyuff>=2.1'],
        'docs': ['myst-parser>=2,<6', 'sphinx>=7.2,<10'],
        'test': [
            'catkin_pkg',
            'colcon-bash',
            'codespell>=2.2',
            'colcon-ros',
            'distributed>=2023.5',
            'flake8-import-order',
            'h5py>=3.7',
            'hypothesis>=6.60,<7',
            'mypy==2.4.1',
            'pytest>=7.2,<10',
            'pytest-cov>=4,<8',
            'pytest-timeout>=2.1,<3',
            'pytest-xdist>=3.1,<4',
            'radon>=6',
            'rosbags>=0.10',
            'ruff==0.17.6',
            "tomli>=2; python_version < '3.11'",
        ],
    },
    zip_safe=True,
    entry_points={
        'console_scripts': [f'{script} = {NAME}.start:{name}'
                            for script, name in scripts().items()],
    },
)
