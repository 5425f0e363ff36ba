"""Machines of another simulator, drawn at random within what one meets."""

from dataclasses import replace
from math import gcd

from independent_machines import band, Generator, Machine
import numpy as np

_MOST_VALUES = 600_000


def draw_machine(rng: Generator, *, marks: bool = False, width: tuple[float, float] = (0.1, 0.6),
                 top: tuple[float, float] = (0.02, 0.3), steady: bool = False,
                 waveform: bool = True, white: bool = False) -> Machine:
    """
    Draw a machine.

    `marks`: its trigger pulses come from different marks; `width`: range of the jitter's width in
    cycles of the highest order; `top`: that order's frequency over the sample rate; `steady`: a
    synchronous motor; `white`: no coloured noise.
    """
    while True:
        found = _draw(rng, width, top, steady, waveform, white)
        if found is not None and (not marks or found.pulses_per_revolution > gcd(
                found.pulses_per_revolution, found.pulses_per_trigger)):
            return found


def _log_uniform(rng: Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _draw(rng: Generator, width: tuple[float, float], top: tuple[float, float], steady: bool,
          waveform: bool, white: bool) -> Machine | None:
    rate = round(_log_uniform(rng, 1e4, 1e5), -2)
    speed = _log_uniform(rng, 8.0, 60.0)
    per = int(rng.choice([1, 1, 1, 2, 3, 4, 6, 12]))
    step = per if rng.uniform() < 0.6 else int(rng.integers(1, 2 * per + 1))
    ratio = [float(rng.integers(1, 5)), rng.integers(20, 70) / rng.integers(11, 40),
             rng.uniform(0.6, 5.0), rng.uniform(0.15, 0.9)][rng.integers(4)]
    cycle, period = ratio * step / per, step / per / speed
    teeth, harmonics = int(rng.integers(9, 70)), int(rng.integers(2, 5))
    components = [float(teeth * k) for k in range(1, harmonics + 1)]
    sizes = [rng.uniform(0.25, 1.0) for _ in components]
    if rng.uniform() < 0.4:  # a second mesh, two shafts on
        other = int(rng.integers(13, 60)) * teeth / int(rng.integers(17, 80))
        components += [other, 2.0 * other]
        sizes += [rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.5)]
    if rng.uniform() < 0.3:
        components.append(1.0)
        sizes.append(rng.uniform(0.2, 0.6))
    orders = np.array(components)
    mate = teeth / int(rng.integers(15, 90))
    for k in range(1, harmonics + 1):  # a modulated mesh, and the mating shaft's
        for side in (1.0, mate):
            depth = rng.uniform(0.02, 0.25)
            components += [teeth * k - side, teeth * k + side]
            sizes += [depth * sizes[k - 1]] * 2
    components += [mate, 2.0]
    sizes += rng.uniform(0.02, 0.3, 2).tolist()
    cycles, channels = int(rng.integers(10, 81)), int(rng.integers(1, 9))
    most = int(min(40.0, _MOST_VALUES / (channels * rate * period * cycles)))
    count = int(rng.integers(10, max(most, 10) + 1))
    line = ratio * speed
    keyphasor = orders.max() * line / rng.uniform(*width)
    apart = np.abs(np.subtract.outer(orders, np.array(components)))
    close = np.any((apart > 1e-9) & (apart * cycles * cycle < 3.0))
    fits = (rate * period > 60.0 and cycle * teeth > 2.0 and cycles * cycle > 4.0
            and top[0] * rate < orders.max() * line < top[1] * rate
            and max(components) * line < 0.4 * rate and keyphasor > 6.0 * per * speed
            and most >= 10)
    if close or not fits or cycles * count < 200:
        return None
    peaks = np.array(sizes) * rng.uniform(0.3, 3.0, (channels, 1)) * np.exp(
        0.4 * rng.standard_normal((channels, len(sizes)))
        + 2j * np.pi * rng.uniform(size=(channels, len(sizes))))
    relative = _log_uniform(rng, 5e-5, 5e-4) if steady else _log_uniform(rng, 5e-4, 5e-3)
    length = cycles * count * period
    drift = band(rng, 0.5 / length, max(1.0 / length, 0.015 / period), 6)
    drift = replace(drift, size=drift.size * relative * speed / (2.0 * np.pi * drift.rate))
    # acceleration in trigger cycles/s^2: the linear law must follow it
    acceleration = np.sqrt(0.5 * np.sum((drift.size * (2.0 * np.pi * drift.rate) ** 2) ** 2)
                           ) / speed / period
    bend = (2.0 * np.pi * orders.max() * cycle) ** 2 * period**4 * acceleration**2 / 240.0
    if bend > 5e-4:
        drift, relative = drift.scaled(np.sqrt(5e-4 / bend)), relative * np.sqrt(5e-4 / bend)
    power = 0.5 * float(np.mean(np.sum(np.abs(peaks) ** 2, axis=1)))
    coloured = not white and rng.uniform() < 0.25
    decibel = rng.uniform(25.0, 40.0) if coloured else rng.uniform(0.0, 40.0)
    return Machine(
        rate, speed, ratio, per, step, cycles, count, float(keyphasor), orders,
        np.array(components), peaks, float(np.sqrt(power) * 10.0 ** (-decibel / 20.0)),
        rng.uniform(0.5, 0.95) if coloured else 0.0, drift, relative,
        float(rng.choice([0.0, 12.3])), bool(rng.uniform() < 0.3),
        bool(waveform and rng.uniform() < 0.2 and keyphasor < 0.25 * rate))
