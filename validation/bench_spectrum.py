# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figure 15: the spectrum of the bench, whose mesh harmonics stand out and are smeared."""

from typing import Any

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch
from validation.bench import FAST, machine, PINION_SPEED, SPEED_STD, TEETH
from validation.plots import panels
from validation.results import agreement, Effort, Finding, Progress, Results

Array = NDArray[Any]

HARMONICS = (1, 2, 3)
_SECONDS, _AVERAGES = 2.0, 16
_NOISE = 0.2
_BAND = (1e3, 9e3)  # Hz, that the figure shows
_REACH = 40.0  # Hz around a harmonic, clear of its sidebands
_HIGH = 10.0  # dB above the background


def spectrum(samples: Array) -> tuple[Array, Array]:
    """Return frequencies (Hz) and spectral density: Hann window, 16 averages, 50 % overlap."""
    size = 2 * samples.size // (_AVERAGES + 1)
    frequencies, density = welch(samples, FAST, window='hann', nperseg=size, noverlap=size // 2)
    return np.asarray(frequencies), np.asarray(density)


def peak(frequencies: Array, density: Array, harmonic: int) -> tuple[float, float, float]:
    """Return place (Hz), height over the background (dB) and RMS width (Hz) of a harmonic."""
    shown = (frequencies > _BAND[0]) & (frequencies < _BAND[1])
    background = float(np.median(density[shown]))
    near = np.abs(frequencies - harmonic * TEETH * PINION_SPEED) < _REACH
    f, power = frequencies[near], np.maximum(density[near] - background, 0.0)
    centre = float(np.sum(f * power) / power.sum())
    width = float(np.sqrt(np.sum((f - centre)**2 * power) / power.sum()))
    return centre, 10.0 * float(np.log10(density[near].max() / background)), width


def run(effort: Effort, progress: Progress) -> Results:
    """Reproduce Fig. 15; what is computed does not depend on the effort."""
    gearbox = machine(sample_rate=FAST, seed=15, noise_std=_NOISE)
    frequencies, density = spectrum(gearbox.vibration(0, round(_SECONDS * FAST))[0])
    found = {harmonic: peak(frequencies, density, harmonic) for harmonic in HARMONICS}
    progress(1.0)
    numbers = {f'harmonic {harmonic}': {
        'frequency': centre, 'height_over_background_db': height, 'rms_width': width}
        for harmonic, (centre, height, width) in found.items()}
    centres, heights, widths = zip(*found.values())
    return Results(
        'Spectrum of the bench: Fig. 15', numbers,
        (Finding('Fig. 15', 'two mesh harmonics, from 1900 Hz, are high above the noise',
                 'at ' + ' and '.join(f'{centre:.0f} Hz' for centre in centres[:2]) + ', '
                 + ' and '.join(f'{height:.0f}' for height in heights[:2])
                 + ' dB above the median', agreement(
                     abs(centres[0] - 1900.0) < 20.0, min(heights[:2]) > _HIGH),
                 'The noise is our choice.'),
         Finding('Fig. 15', 'speed fluctuations smear the lines, most at high frequencies',
                 'RMS width of the first three mesh harmonics '
                 + ', '.join(f'{width:.1f}' for width in widths) + ' Hz',
                 agreement(list(widths) == sorted(widths), widths[2] > 2.0 * widths[0]))),
        {'fig15': _figure(frequencies, density)},
        ('As in the caption: 2 s at 93750 Hz, Hann window, 16 averages of 50 % overlap, 1 to '
         f'9 kHz. The simulated bench is that of Figs. 17 to 19: speed wander of '
         f'{100.0 * SPEED_STD:g} %, white noise of {_NOISE} a sample.',))


def _figure(frequencies: Array, density: Array) -> Figure:
    figure, axes = panels(1)
    shown = (frequencies >= _BAND[0]) & (frequencies <= _BAND[1])
    axes[0].semilogy(1e-3 * frequencies[shown], density[shown], color='tab:blue', linewidth=0.8)
    first = 1e-3 * TEETH * PINION_SPEED
    at = int(np.argmin(np.abs(1e-3 * frequencies - first)))
    axes[0].plot(1e-3 * frequencies[at], density[at], 'x', color='black',
                 label='first mesh harmonic')
    axes[0].set_xlabel('frequency / kHz')
    axes[0].set_ylabel('spectral density / 1/Hz (mesh amplitude 1)')
    axes[0].legend(fontsize=8)
    axes[0].grid(alpha=0.3)
    return figure
