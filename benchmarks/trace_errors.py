"""
Are fitted parameters within their stated standard errors? Simulated machines tell.

Run `python benchmarks/trace_errors.py --seeds 20`; for each effect, size (in parts of the one that
`trace_confusion.py` documents) and number of acquisitions it prints mean and root mean square of
z = (fitted - true) / standard error of each parameter, the shares beyond 2 and 3, and how often
the held-out residual, less its standard error in quadrature, falls at least five-fold.
"""

import argparse
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.closure.trace import Trace
from trace_confusion import EFFECTS, fell, run, sized

# What no pulse tells: a delay that all marks share, and a name.
_RELATIVE, _NAMES = ('pulse_angles',), ('method',)


def scores(found: Trace, name: str, truth: Mapping[str, Any]) -> Mapping[str, NDArray[Any]]:
    """Return z of each number of the effect `name`, nothing where it was not found."""
    for finding in found.findings:
        if finding.name == name and finding.effect is not None:
            return {key: _z(finding.effect.values[key], truth[key], error, key in _RELATIVE)
                    for key, error in finding.standard_errors.items() if key not in _NAMES}
    return {}


def _z(value: Any, true: Any, error: Any, relative: bool) -> NDArray[Any]:
    value, true = np.atleast_1d(value), np.atleast_1d(true)
    if value.shape != true.shape:
        return np.full(true.shape, np.inf)
    off = value - true
    return np.asarray((off - off.mean() if relative else off) / np.atleast_1d(error))


def one(seed: int, name: str, size: float, acquisitions: int
        ) -> tuple[Mapping[str, NDArray[Any]], bool]:
    """Return z of each parameter, and whether the residual fell, of one machine."""
    found = run(seed, (name,), acquisitions=acquisitions, size=size)
    return scores(found, name, sized(name, size)), fell(found)


def report(rows: Sequence[tuple[Mapping[str, NDArray[Any]], bool]]) -> Sequence[str]:
    """Return lines that summarise some runs."""
    found = [item for item, _ in rows if item]
    lines = [f'found in {len(found)} of {len(rows)}, five-fold fall in {sum(f for _, f in rows)}']
    for key in found[0] if found else ():
        z = np.concatenate([item[key] for item in found])
        lines.append(f'{key}: z {z.mean():+.2f}, RMS {np.sqrt(np.mean(z**2)):.2f}, '
                     f'beyond 2: {np.mean(np.abs(z) > 2.0):.0%}, '
                     f'beyond 3: {np.mean(np.abs(z) > 3.0):.0%}')
    return lines


def main() -> None:
    """Print the calibration."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=20)
    parser.add_argument('--effects', nargs='*', default=list(EFFECTS))
    parser.add_argument('--sizes', type=float, nargs='*', default=[0.5, 1.0, 2.0])
    parser.add_argument('--acquisitions', type=int, nargs='*', default=[12, 24, 48])
    parser.add_argument('--workers', type=int, default=1)
    options = parser.parse_args()
    with ProcessPoolExecutor(options.workers) as pool:
        for name, size, count in product(options.effects, options.sizes, options.acquisitions):
            rows = list(pool.map(partial(one, name=name, size=size, acquisitions=count),
                                 range(options.seeds)))
            print(f'\n{name}, size {size:g}, {count} acquisitions')
            for line in report(rows):
                print(f'  {line}', flush=True)


if __name__ == '__main__':
    main()
