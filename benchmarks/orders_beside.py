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
Corrections that are accepted and wrong, with an undeclared order beside one that is declared.

`python benchmarks/orders_beside.py` prints a table for docs/theory.md. Every scene is one average
of a machine drawn at random: one to four channels, two to six orders, 10 to 40 trigger cycles, r
of 0.6 to 2.4, jitter of 0.05 to 0.6 rad. Wrong is an amplitude that differs from the one that all
lines of the machine together, fitted between the true pulses, have in the same noise, by more than
three of its standard errors and 0.5 %.
"""

import argparse
from dataclasses import dataclass, replace

from correction_campaign import averaged, PERIOD, SAMPLES, SPARE
import numpy as np
from numpy.typing import NDArray
from page import table

FloatArray = NDArray[np.float64]

KINDS = ('no other order', 'an order 0.02 to 1.5 orders beside', 'an order half an order beside',
         'the order modulated instead')


@dataclass(frozen=True)
class Scene:
    """
    A machine and the vibration of one average.

    `size` (channel, order) are peak amplitudes at `orders`, `beside` (channel,) those of the order
    `apart` from number `target`, `depth` and `turns` (a trigger cycle) the modulation of this one,
    `jitter` the standard deviation of the pulse errors in fundamental cycles, `noise` that of a
    sample, `scale` the true over the declared jitter.
    """

    seed: int
    ratio: float
    cycles: int
    orders: FloatArray
    size: FloatArray
    target: int
    jitter: float
    scale: float
    normal: bool
    noise: float
    apart: float
    beside: FloatArray
    depth: float = 0.0
    turns: float = 0.0


def draw(seed: int, kind: str) -> Scene:
    """Draw a scene of one of `KINDS`."""
    rng = np.random.default_rng([seed, 77])
    ratio = 1.0 if kind == KINDS[2] else float(rng.choice([1.0, 2.40789, 0.6, 1.7]))
    cycles = round(np.exp(rng.uniform(np.log(10.0), np.log(40.0))))
    channels, count = rng.integers(1, 5), rng.integers(2, 7)
    mesh = rng.integers(9, 24) * np.arange(1, 4)
    mesh = mesh[mesh <= 50][:rng.integers(1, 4)]
    others = np.setdiff1d(np.arange(1, 51), mesh)
    orders = np.sort(np.concatenate((mesh, rng.permutation(others)[:max(count - mesh.size, 0)])))
    size = 10.0 ** (-(rng.uniform(0.0, 20.0, (channels, orders.size))
                      + rng.uniform(0.0, 10.0, orders.size)) / 20.0)
    target = int(rng.integers(orders.size))
    size[:, target] = 10.0 ** (-rng.uniform(0.0, 10.0, channels) / 20.0)
    phase = np.exp(rng.uniform(np.log(0.05), np.log(0.6)))  # rad of the target
    level = rng.uniform(-20.0, 10.0) + rng.uniform(-6.0, 6.0, channels)
    points = round(SAMPLES * max(ratio, 1.0))
    scene = Scene(
        seed, ratio, cycles, orders.astype(np.float64), size, target,
        jitter=min(phase / orders[target], 1.5 / orders[-1]) / (2.0 * np.pi),
        scale=float(rng.choice([1.0, 1.0, 0.5, 2.0])), normal=bool(rng.random() < 0.2),
        noise=np.sqrt(points / 4.0) * 10.0 ** (-rng.uniform(10.0, 50.0) / 20.0),
        apart=rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(np.log(0.02), np.log(1.5))),
        beside=size[:, target] * 10.0 ** (level / 20.0))
    if kind == KINDS[0]:
        return replace(scene, beside=0.0 * scene.beside)
    if kind == KINDS[2]:
        return replace(scene, apart=float(np.copysign(0.5, scene.apart)))
    if kind == KINDS[3]:
        return replace(scene, beside=0.0 * scene.beside, depth=rng.uniform(0.05, 0.5),
                       turns=rng.uniform(0.02, 0.5))
    return scene


def judge(scene: Scene) -> tuple[bool, bool]:
    """Return whether the correction is accepted, and whether it is and is wrong."""
    rng = np.random.default_rng([scene.seed, 78])
    channels, orders = len(scene.size), scene.orders
    rate = round(SAMPLES * max(scene.ratio, 1.0)) / PERIOD
    speed = scene.ratio / PERIOD
    pulses = PERIOD * (2.0 + np.arange(scene.cycles + 1 + SPARE))
    times = np.arange(round((scene.cycles + 4 + SPARE) * PERIOD * rate)) / rate
    angle = speed * (times - pulses[0])
    phases = np.exp(2j * np.pi * rng.uniform(size=(channels, orders.size + 1)))
    waves = np.exp(2j * np.pi * np.outer(orders, angle))
    waves[scene.target] *= 1.0 + scene.depth * np.cos(
        2.0 * np.pi * (scene.turns * times / PERIOD + rng.random()))
    samples = ((scene.size * phases[:, :-1]) @ waves).real
    other = orders[scene.target] + scene.apart
    samples += np.real(np.multiply.outer(scene.beside * phases[:, -1],
                                         np.exp(2j * np.pi * other * angle)))
    samples += scene.noise * rng.standard_normal(samples.shape)
    std = scene.jitter / speed
    late = pulses + std * (rng.standard_normal(pulses.size) if scene.normal
                           else np.sqrt(3.0) * rng.uniform(-1.0, 1.0, pulses.size))
    average, _, first = averaged(
        samples, rate, pulses, late, declared=std / scene.scale, ratio=scene.ratio, orders=orders,
        trigger_cycles=scene.cycles)
    found = average.correction
    assert found is not None
    if not found.accepted:
        return False, False
    true = _fitted(scene, samples, times, angle, (times >= pulses[first])
                   & (times < pulses[first + scene.cycles]))
    off = np.abs(np.abs(found.amplitudes) - true)
    return True, bool(np.any((off > 3.0 * found.amplitude_errors.amplitude) & (off > 5e-3 * true)))


def _fitted(scene: Scene, samples: FloatArray, times: FloatArray, angle: FloatArray,
            inside: NDArray[np.bool_]) -> FloatArray:
    """Return the amplitudes (channel, order) that all lines fit best between the true pulses."""
    turns = [order * angle[inside] for order in scene.orders]
    if scene.beside.any():
        turns.append((scene.orders[scene.target] + scene.apart) * angle[inside])
    if scene.depth:
        turns += [turns[scene.target] + sign * scene.turns * times[inside] / PERIOD
                  for sign in (-1.0, 1.0)]
    waves = np.exp(2j * np.pi * np.array(turns)).T
    parts = np.linalg.lstsq(np.concatenate((waves.real, waves.imag), axis=1),
                            samples[:, inside].T, rcond=None)[0]
    return np.hypot(*np.split(parts, 2))[:scene.orders.size].T


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--scenes', type=int, default=500, help='of each kind')
    parser.add_argument('--seed', type=int, default=1, help='of the first scene')
    options = parser.parse_args()
    rows = []
    for kind in KINDS:
        judged = np.array([judge(draw(options.seed + number, kind))
                           for number in range(options.scenes)])
        accepted, wrong = judged.sum(axis=0)
        rows.append((kind, str(options.scenes), str(accepted), str(wrong)))
    print(table(('beside a declared order', 'averages', 'accepted', 'wrong'), rows))


if __name__ == '__main__':
    main()
