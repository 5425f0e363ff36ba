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
Undeclared orders: orders in the vibration that nobody declared and that leak into declared ones.

Sidebands, other meshes and other shafts leak into the declared orders of a trigger cycle unless
they are lines of that cycle. The search takes lines of the spectrum over angle, with the pulse
errors removed: those that a shaft must have, and those that keep their order while the speed
drifts. A line that keeps its frequency is a tone.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.cycle import cycle_grid
from sa_jitter_ros.inference.cycle_reader import CycleReader, recover
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.prediction.model import DeclaredModel

FloatArray = NDArray[np.float64]

_TRIED = 6
_MOST = 16
# Amplitude in parts of the channel's strongest declared order, and over what surrounds it.
_STRONG, _PROMINENT = 0.03, 6.0
# The main lobe of the window in lines of the average, and values of the spectrum a line.
_LOBE, _PADDED = 2.5, 4
_NEIGHBOURHOOD = 100
# What stays with the angle: its places scatter less than those of a tone would by so much, which
# the speed must make at least so many lines; and it keeps at least half its size at its place.
_STEADIER, _DRIFT, _KEPT = 2.0, 0.05, 0.5
# Lines of the average within which an order is one that the shafts are known to have.
_ON_LINE = 0.1


def undeclared_orders(reader: CycleReader, pulses: RecordPulses, model: DeclaredModel,
                      starts: Sequence[int], rows: tuple[int, ...]) -> list[float]:
    """Return the strongest orders beside the declared ones, in some acquisitions of a record."""
    spectra, speeds = [], []
    count = model.trigger_cycles
    whole = [first for first in starts if not pulses.missing[first:first + count].any()]
    for first in whole[::max(1, len(whole) // _TRIED)][:_TRIED]:
        part = slice(pulses.number[first], pulses.number[first + count] + 1)
        times = pulses.bridged[part] if pulses.reference is None else pulses.reference[part]
        recovery = recover(reader, times, model, rows, with_ripple=True)
        if recovery.accepted:
            better = times - recovery.errors
            cycles = cycle_grid(reader.cycles(better), method=reader.method,
                                period=1.02 * model.trigger_period)
            flat = cycles.reshape(-1, cycles.shape[2])
            window = np.hanning(len(flat) + 1)[:-1, None]
            spectra.append(np.fft.rfft(flat * window, _PADDED * len(flat), axis=0)
                           * 2.0 / window.sum())
            speeds.append(count / (better[-1] - better[0]))
    if not spectra:
        return []
    return _lines(np.abs(spectra), np.array(speeds), model)


def _lines(spectra: FloatArray, speeds: FloatArray, model: DeclaredModel) -> list[float]:
    """Return orders of lines in `spectra` (acquisition, bin, channel), strongest first."""
    step = 1.0 / (_PADDED * model.trigger_cycles * model.cycle_length)
    mean = np.sqrt(np.mean(spectra**2, axis=0))
    declared = np.rint(np.array(model.orders) / step).astype(int)
    level = mean[declared[declared < len(mean)]].max(axis=0)
    share = mean / level
    reach = _LOBE * _PADDED
    free = np.all(np.abs(np.arange(len(mean))[:, None] - declared) > reach, axis=1)
    strength = np.where(free, share.max(axis=1), 0.0)
    strength[:int(reach)] = strength[-int(0.1 * len(mean)):] = 0.0
    found: list[float] = []
    for _ in range(4 * _MOST):
        peak = int(np.argmax(strength))
        if strength[peak] < _STRONG or len(found) == _MOST:
            break
        strength[max(0, peak - int(reach)):peak + int(reach) + 1] = 0.0
        channel = int(np.argmax(share[peak]))
        around = mean[max(0, peak - _NEIGHBOURHOOD * _PADDED):peak + _NEIGHBOURHOOD * _PADDED,
                      channel]
        stands_out = mean[peak, channel] > _PROMINENT * np.median(around) and (
            mean[peak, channel] == mean[peak - _PADDED:peak + _PADDED + 1, channel].max())
        places = np.array([_place(item[:, channel], peak) for item in spectra])
        order = float(places.mean()) * step
        exact = _exact(order, model)
        if stands_out and (exact is not None
                           or _stays(places, spectra[:, peak, channel], speeds)):
            found.append(order if exact is None else exact)
    return found


def _exact(order: float, model: DeclaredModel) -> float | None:
    """Return the line of the trigger cycle, or the whole order, that an order is; or None."""
    near = _ON_LINE / (model.trigger_cycles * model.cycle_length)
    for exact in (round(order * model.cycle_length) / model.cycle_length, float(round(order))):
        if abs(order - exact) < near:
            return exact
    return None


def _stays(places: FloatArray, sizes: FloatArray, speeds: FloatArray) -> bool:
    """Tell whether a line keeps its place and size in the spectra while the speed drifts."""
    moved = float((places * speeds / speeds.mean()).std())
    return bool(moved > max(_STEADIER * places.std(), _DRIFT * _PADDED)
                and np.median(sizes) > _KEPT * sizes.max())


def _place(spectrum: FloatArray, near: int) -> float:
    """Return the place of the largest value near a bin, between bins by a parabola."""
    low = max(near - _PADDED, 1)
    peak = low + int(np.argmax(spectrum[low:near + _PADDED + 1]))
    left, middle, right = np.log(np.maximum(spectrum[peak - 1:peak + 2], 1e-300))
    bend = left - 2.0 * middle + right
    return peak + (0.5 * (left - right) / bend if bend < 0.0 else 0.0)
