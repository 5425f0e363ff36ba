# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""How the benchmarks measure: interleaved runs, and what the machine can do at best."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import os
from pathlib import Path
import platform
from statistics import median
import time
from typing import Any

import numpy as np
import scipy


@dataclass(frozen=True)
class Timing:
    """CPU seconds of one call: the least and the median of `runs` calls."""

    best: float
    median: float
    runs: int


def interleaved(calls: Mapping[str, Callable[[], object]], *, rounds: int = 5,
                budget: float = 8.0) -> dict[str, Timing]:
    """
    Time calls in turns (A, B, A, B, ...), so that all of them see the same machine.

    CPU time of this process, which a machine that does other things as well disturbs least. A
    call takes part in `rounds` turns or as long as it has used less than `budget` seconds.
    """
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            if sum(seconds[name]) < budget:
                start = time.process_time()
                call()
                seconds[name].append(time.process_time() - start)
    return {name: Timing(min(runs), median(runs), len(runs)) for name, runs in seconds.items()}


def machine() -> dict[str, str]:
    """Processor, memory, load and versions, for the record."""
    processor, cache = platform.processor() or platform.machine(), ''
    info, index = Path('/proc/cpuinfo'), Path('/sys/devices/system/cpu/cpu0/cache')
    if info.exists():
        fields = dict(line.split(':', 1) for line in info.read_text().splitlines() if ':' in line)
        fields = {key.strip(): value.strip() for key, value in fields.items()}
        processor = (f'{fields.get("model name", processor)} (family '
                     f'{fields.get("cpu family", "?")}, model {fields.get("model", "?")}), '
                     f'{float(fields.get("cpu MHz", "nan")) / 1e3:.2g} GHz')
    if index.exists():
        levels = {(level / 'level').read_text().strip(): (level / 'size').read_text().strip()
                  for level in sorted(index.glob('index*'))}
        cache = ', '.join(f'L{level} {size}' for level, size in levels.items())
    memory = os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30
    return {
        'processor': processor, 'cores': str(os.cpu_count()), 'caches of a core': cache,
        'memory': f'{memory:.0f} GiB', 'system': platform.platform(terse=True),
        'python': platform.python_version(), 'numpy': np.__version__, 'scipy': scipy.__version__,
        'BLAS threads': os.environ.get('OMP_NUM_THREADS', 'all'),
        'load': f'{os.getloadavg()[0]:.1f}'}


def memory_bandwidth(megabytes: int = 256) -> float:
    """Bytes per second that one core reads from memory (sum of an array beyond all caches)."""
    array = np.ones(megabytes * 131072)
    timing = interleaved({'read': array.sum}, rounds=7)
    return array.nbytes / timing['read'].best


def multiply_adds(size: int = 512) -> float:
    """Multiply-adds per second of one core at its best: a product of square matrices in cache."""
    matrix: Any = np.ones((size, size))
    timing = interleaved({'product': lambda: matrix @ matrix}, rounds=15)
    return float(size**3 / timing['product'].best)
