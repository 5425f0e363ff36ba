"""The front door: what `import sa_jitter_ros` gives, and what it loads."""

import json
import subprocess
import sys

import sa_jitter_ros

SLOW = ('rclpy', 'matplotlib', 'scipy')


def in_new_process(source):
    """Run a program that prints JSON, without rclpy and matplotlib, and return what it says."""
    blocked = 'import sys\nfor name in "rclpy", "matplotlib": sys.modules[name] = None\n'
    done = subprocess.run([sys.executable, '-c', blocked + source], capture_output=True,
                          text=True, check=True)
    return json.loads(done.stdout)


def test_the_import_loads_less_than_that_of_numpy():
    count = 'import json, sys\nbefore = set(sys.modules)\n{}\nprint(json.dumps(sorted(' \
            'set(sys.modules) - before)))'
    numpy = in_new_process(count.format('import numpy'))
    package = in_new_process(count.format('import sa_jitter_ros'))
    assert len(package) <= 0.3 * len(numpy)
    assert not {name.partition('.')[0] for name in package} & set(SLOW)


def test_every_public_name_works_without_ros_and_matplotlib():
    names = in_new_process(
        'import json, sa_jitter_ros as sa\n'
        'print(json.dumps([name for name in sa.__all__ if getattr(sa, name).__doc__]))')
    assert names == sa_jitter_ros.__all__


def test_the_public_names_are_those_that_can_be_had():
    assert sorted(sa_jitter_ros._HOME) == sa_jitter_ros.__all__
    assert set(sa_jitter_ros.__all__) <= set(dir(sa_jitter_ros))
    assert not hasattr(sa_jitter_ros, 'avrage')


def test_all_errors_of_the_library_are_value_errors():
    for name in sa_jitter_ros.__all__:
        if name.endswith('Error'):
            assert issubclass(getattr(sa_jitter_ros, name), sa_jitter_ros.SaJitterError)
    assert issubclass(sa_jitter_ros.SaJitterError, ValueError)
