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
A gearbox like that of the paper's bench test (Section 5.1, Table 4), with known truth.

A pinion of 19 teeth at 100 Hz, so that the first mesh harmonic lies at 1900 Hz, and one keyphasor
pulse per revolution of a shaft that turns 2.40789 times slower. The speed wanders slowly by 0.2 %,
enough for the pulses to fall anywhere between two ticks of the keyphasor's clock.
"""

from collections.abc import Sequence
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.simulation import (
    AdditiveNoise, band_limited, ChippedTooth, Component, Gearbox, mesh)

Array = NDArray[Any]

TEETH = 19
RATIO = 2.40789
PINION_SPEED = 100.0  # Hz
TRIGGER_SPEED = PINION_SPEED / RATIO
TRIGGER_CYCLES = 41
#: Sampling rates of the keyphasor, Hz; the slow clock has every fourth tick of the fast one.
FAST, SLOW = 93750.0, 23437.5

SPEED_STD, _SPEED_BAND = 2e-3, (0.2, 4.0)  # relative; Hz
_MARGIN = 10  # trigger cycles recorded beyond the average, which a spline law reads


def machine(
    *, sample_rate: float, seed: int, channel_gains: Sequence[float] = (1.0,),
    noise_std: float = 0.0, load: float = 1.0, chip: float = 0.0,
) -> Gearbox:
    """
    Return one acquisition of the bench.

    `load` scales everything but the noise; at load 1 the first two mesh harmonics have amplitudes
    1 and 0.6 and the burst of a broken tooth has `chip`.
    """
    gains = load * np.asarray(channel_gains, float)
    pinion = mesh('pinion', TEETH, harmonics=(1.0, 0.6, 0.2), channel_gains=gains.tolist(),
                  sidebands={1.0: 0.08, 2.0: 0.04}, seed=1)
    others = tuple(
        Component('bevel', order, tuple(size * gains), (0.3 * order,) * gains.size)
        for order, size in ((1.0, 0.1), (29.0, 0.4), (58.0, 0.2)))
    tooth = ChippedTooth('pinion', TEETH, tuple(chip * gains), width=0.02, place=0.14)
    return Gearbox(
        components=(*pinion, *others), faults=(tooth,) if chip else (), sample_rate=sample_rate,
        shafts={'pinion': RATIO, 'bevel': 1.0}, speed=((0.0, TRIGGER_SPEED),),
        fluctuation=band_limited(std=SPEED_STD, band=_SPEED_BAND, seed=seed, name='bench speed'),
        effects=(AdditiveNoise(noise_std),), seed=seed)


def acquire(gearbox: Gearbox) -> tuple[Array, Array]:
    """Return vibration (sample, channel) and exact pulse times in s of one acquisition."""
    seconds = (TRIGGER_CYCLES + _MARGIN) / TRIGGER_SPEED
    vibration = gearbox.vibration(0, math.ceil(seconds * gearbox.sample_rate)).T
    pulses = gearbox.pulses(0.0, seconds - 1.0 / TRIGGER_SPEED).times
    return vibration, pulses
