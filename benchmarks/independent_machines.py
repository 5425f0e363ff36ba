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
Machines of another simulator, which uses nothing of `sa_jitter_ros`.

A machine turns by a closed-form angle, so that pulses and samples are exact at any time: a tach
shaft whose marks make pulses; gears on a shaft of interest whose orders, sidebands and undeclared
orders make the vibration. All is drawn at random. The declared model is: steady speed, independent
pulse errors, uniform over one keyphasor sample, and white noise. `Disturbance` holds deviations
from it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import gcd
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

Array = NDArray[Any]
Generator = np.random.Generator

_NODES = 24
_TERMS = 19  # of a series: the next is 1e-17
_MOST_VALUES = 600_000  # in a drawn recording


@dataclass(frozen=True)
class Waves:
    """A sum of sinusoids: `rate` (Hz), peak `size` and `phase` (rad), all (wave,)."""

    rate: Array
    size: Array
    phase: Array

    def __call__(self, time: Array, *, slope: bool = False) -> Array:
        """Return the value, or the slope per second, at `time` (any shape)."""
        time = np.asarray(time, float)
        total, rates = np.zeros(time.shape), 2.0 * np.pi * self.rate
        if not rates.size or not time.size:
            return total
        fastest = float(rates.max())
        if np.ptp(time) * fastest * rates.size < time.size * (rates.size - 2 * _TERMS):
            return self._by_series(time, rates, slope)
        for rate, size, phase in zip(rates, self.size, self.phase):
            total += size * rate * np.cos(rate * time + phase) if slope else (
                size * np.sin(rate * time + phase))
        return total

    def _by_series(self, time: Array, rates: Array, slope: bool) -> Array:
        """Return the same by Taylor series about places 2 rad of the fastest wave apart."""
        fastest = rates.max()
        off = (time - time.min()) * fastest
        place = np.rint(0.5 * off)
        off -= 2.0 * place  # -1 to 1
        places, which = np.unique(place, return_inverse=True)
        which = which.reshape(time.shape)
        turned = self.size * np.exp(1j * (
            np.outer(2.0 * places / fastest + time.min(), rates) + self.phase))
        steps = np.arange(1.0, _TERMS)
        powers = np.cumprod(np.vstack([np.ones(rates.size), np.outer(
            1.0 / steps, rates / fastest)]) * np.append(1.0, np.full(steps.size, 1j))[:, None],
            axis=0)
        terms = powers @ (turned * (1j * rates if slope else 1.0)).T
        total = np.zeros(time.shape)
        for term in terms.imag[::-1]:
            total *= off
            total += term[which]
        return total

    def scaled(self, factor: float) -> 'Waves':
        """Return the waves times a factor."""
        return replace(self, size=factor * self.size)


def band(rng: Generator, low: float, high: float, count: int = 400) -> Waves:
    """
    Return nearly normal noise of standard deviation 1 between two frequencies (Hz).

    So many waves a recording does not tell apart; it does 24, which are no noise then.
    """
    edges = np.linspace(low, high, count + 1)
    return Waves(rng.uniform(edges[:-1], edges[1:]), np.full(count, np.sqrt(2.0 / count)),
                 rng.uniform(0.0, 2.0 * np.pi, count))


NOTHING = Waves(np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Machine:
    """
    A machine that follows its declared model; frequencies in Hz.

    `components` (component,) are orders of the shaft of interest, the first of them the declared
    `orders`; `peaks` (channel, component) complex amplitudes; `drift` the angle of the tach shaft
    in revolutions beyond its mean speed. `noise_colour` is the pole of a first-order low pass.
    """

    sample_rate: float
    speed: float
    ratio: float
    pulses_per_revolution: int
    pulses_per_trigger: int
    trigger_cycles: int
    acquisitions: int
    keyphasor_rate: float
    orders: Array
    components: Array
    peaks: Array
    noise_std: float
    noise_colour: float
    drift: Waves
    relative_drift: float
    start_time: float
    reference: bool
    waveform: bool

    @property
    def trigger_period(self) -> float:
        """Return the trigger period in s."""
        return self.pulses_per_trigger / self.pulses_per_revolution / self.speed

    @property
    def cycle_length(self) -> float:
        """Return the fundamental cycles in a trigger cycle."""
        return self.ratio * self.pulses_per_trigger / self.pulses_per_revolution

    @property
    def average(self) -> float:
        """Return the length of an average in s."""
        return self.trigger_cycles * self.trigger_period

    @property
    def top(self) -> float:
        """Return the frequency of the highest declared order."""
        return float(self.orders.max() * self.ratio * self.speed)

    @property
    def noise_at_orders(self) -> float:
        """Return the standard deviation of white noise that is as dense at the middle order."""
        angle = 2.0 * np.pi * self.orders * self.ratio * self.speed / self.sample_rate
        pole = self.noise_colour
        gain = np.sqrt(1.0 - pole**2) / np.abs(1.0 - pole * np.exp(-1j * angle))
        return float(self.noise_std * np.median(gain))

    @property
    def levels(self) -> Array:
        """Return the peaks (channel, order) of the declared orders."""
        return np.abs(self.peaks[:, :self.orders.size])


@dataclass(frozen=True)
class Disturbance:
    """
    What happens beyond the declared model.

    `ripple` (revolutions of the tach shaft), `wander` (cycles of the shaft of interest) and `gain`
    (relative) act on the motion and the source; `marks` (rad), `errors` (a function of generator,
    machine and true times, s), `clock` (Hz), `skew` and `lost` on the pulses; `resampled` is the
    relative offset of the clock from whose samples the record was interpolated linearly; `paths`
    (channel, component, state) and `dwell` (s) switch the peaks; `resonance` is a natural
    frequency in Hz and its damping.
    """

    ripple: Waves = NOTHING
    wander: Waves = NOTHING
    gain: Waves = NOTHING
    marks: Array | None = None
    errors: Callable[[Generator, Machine, Array], Array] | None = None
    clock: float = 0.0
    skew: float = 0.0
    lost: float = 0.0
    resampled: float = 0.0
    noise: float = 0.0
    tone: tuple[float, float] = (0.0, 0.0)
    paths: Array | None = None
    dwell: float = 0.0
    resonance: tuple[float, float] = (0.0, 0.0)


def revolutions(machine: Machine, what: Disturbance, time: Array) -> Array:
    """Return the angle of the tach shaft."""
    return np.asarray(machine.speed * time + machine.drift(time) + what.ripple(time))


def crossings(machine: Machine, what: Disturbance, angle: Array) -> Array:
    """Return when the tach shaft is at `angle` (revolutions): a quickly contracting iteration."""
    time = angle / machine.speed
    for _ in range(60):
        step = (revolutions(machine, what, time) - angle) / machine.speed
        time = time - step
        if np.max(np.abs(step)) < 1e-14 * max(1.0, float(np.max(np.abs(time)))):
            break
    return np.asarray(time)


def pulses(machine: Machine, what: Disturbance, rng: Generator) -> tuple[Array, Array]:
    """Return measured and true pulse times; only the measured ones lack the lost pulses."""
    per = machine.pulses_per_revolution
    count = per + int(per * machine.speed * machine.average * machine.acquisitions
                      * 1.002) + machine.pulses_per_trigger
    base = revolutions(machine, what, np.array(machine.start_time + 0.01)) + rng.uniform() / per
    angle = base + np.arange(count) / per
    true = crossings(machine, what, angle)
    late = np.zeros(count) if what.marks is None else np.resize(what.marks, count) / (2.0 * np.pi)
    time = crossings(machine, what, angle + late)
    jitter = rng.uniform(-0.5, 0.5, count) / machine.keyphasor_rate
    if what.errors is not None:
        time = time + what.errors(rng, machine, true)
    if what.clock:
        time = np.ceil(time * what.clock) / what.clock
    else:
        time = time + jitter
    time = time + what.skew * (time - machine.start_time)
    return time[rng.uniform(size=count) >= what.lost], true


def attenuation(machine: Machine, what: Disturbance, rng: Generator) -> Array:
    """
    Return |X| (acquisition, order) of unit components, by the definition.

    The angle is read linearly between the measured pulses and the source followed at those times.
    """
    times = pulses(machine, what, rng)[0][::machine.pulses_per_trigger]
    per = machine.trigger_cycles
    count = (times.size - 1) // per
    u = (np.arange(_NODES) + 0.5) / _NODES
    starts = times[:-1, None] + np.diff(times)[:, None] * u
    angle = machine.ratio * revolutions(machine, what, starts) + what.wander(starts)
    error = angle - machine.cycle_length * (np.arange(times.size - 1)[:, None] + u)
    waves = np.exp(2j * np.pi * machine.orders[:, None, None] * error)[:, :count * per]
    return np.abs(waves.reshape(machine.orders.size, count, -1).mean(axis=2)).T


def vibration(machine: Machine, what: Disturbance, rng: Generator) -> Array:
    """Return what every channel measures (channel, sample)."""
    duration = machine.average * machine.acquisitions + 3.0 * machine.trigger_period + 0.1
    time = machine.start_time + np.arange(int(duration * machine.sample_rate)
                                          ) / machine.sample_rate
    if not what.resampled:
        samples = _clean(machine, what, time, rng)
    else:
        rate = machine.sample_rate * (1.0 + what.resampled)
        place = (1.0 + what.resampled) * np.arange(time.size)
        samples = _clean(machine, what, time[0] + np.arange(int(place[-1]) + 2) / rate, rng)
        index = place.astype(int)
        samples = samples[:, index] + (place - index) * (
            samples[:, index + 1] - samples[:, index])
    for std, pole in ((machine.noise_std, machine.noise_colour), (what.noise, 0.0)):
        if std:
            noise = rng.standard_normal(samples.shape)
            samples += std * np.sqrt(1.0 - pole**2) * signal.lfilter([1.0], [1.0, -pole], noise)
    return samples


def _clean(machine: Machine, what: Disturbance, time: Array, rng: Generator) -> Array:
    turns = machine.ratio * revolutions(machine, what, time) + what.wander(time)
    fundamental = machine.ratio * (machine.speed + machine.drift(time, slope=True)
                                   + what.ripple(time, slope=True))
    state = np.zeros(time.size, int)
    if what.paths is not None:
        stays = rng.exponential(what.dwell, 3 * int(np.ptp(time) / what.dwell) + 50)
        state = np.searchsorted(time[0] + np.cumsum(stays), time) % 2
    total = np.zeros((machine.peaks.shape[0], time.size))
    for i, order in enumerate(machine.components):
        wave = np.exp(2j * np.pi * order * turns)
        natural, damping = what.resonance
        if natural:
            x = order * fundamental / natural
            wave = wave * 2.0 * damping / (1.0 - x**2 + 2j * damping * x)
        for c, peak in enumerate(machine.peaks[:, i]):
            factor = peak if what.paths is None else peak * what.paths[c, i][state]
            total[c] += (factor * wave).real
    frequency, amplitude = what.tone
    total *= 1.0 + what.gain(time)
    if amplitude:
        phase = rng.uniform(0.0, 2.0 * np.pi, (total.shape[0], 1))
        total += amplitude * np.cos(2.0 * np.pi * frequency * time + phase)
    return total


def record(machine: Machine, what: Disturbance, rng: Generator) -> dict[str, Any]:
    """Return the fields of a `.npz` recording."""
    measured, true = pulses(machine, what, rng)
    fields: dict[str, Any] = {
        'vibration': vibration(machine, what, rng), 'sample_rate': machine.sample_rate,
        'start_time': machine.start_time, 'ratio': machine.ratio,
        'pulses_per_revolution': machine.pulses_per_revolution,
        'pulses_per_trigger': machine.pulses_per_trigger}
    if machine.reference:
        fields['reference_pulse_times'] = true + rng.uniform(
            -0.005, 0.005, true.size) / machine.keyphasor_rate
    if machine.waveform:
        time = machine.start_time + np.arange(fields['vibration'].shape[1]) / machine.sample_rate
        width, ramp = 0.2 * float(np.diff(true).min()), 3.0 / machine.sample_rate
        last = np.clip(np.searchsorted(measured - ramp, time) - 1, 0, measured.size - 1)
        since = time - measured[last]
        level = np.clip(since / ramp + 0.5, 0.0, 1.0) - np.clip(
            (since - width) / ramp + 0.5, 0.0, 1.0)
        fields['tach'] = 5.0 * level + 0.02 * rng.standard_normal(time.size)
        fields['tach_rate'] = machine.sample_rate
    else:
        fields['pulse_times'] = measured
    return fields


def declared(machine: Machine) -> str:
    """Return the parameter file of `jitter_predictor` that declares the machine."""
    values = {
        'keyphasor_rate': machine.keyphasor_rate, 'trigger_speed': machine.speed,
        'pulses_per_revolution': machine.pulses_per_revolution,
        'pulses_per_trigger': machine.pulses_per_trigger,
        'trigger_cycles': machine.trigger_cycles, 'ratio': machine.ratio,
        'orders': [float(g) for g in machine.orders], 'sample_rate': machine.sample_rate,
        'noise_std': 0.0 if machine.noise_colour else machine.noise_std}
    return 'jitter_predictor:\n  ros__parameters:\n' + ''.join(
        f'    {name}: {value}\n' for name, value in values.items())


# --- drawn at random, within what one meets ------------------------------------------------------

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
