# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Figures of the evidence: pulse errors, trigger cycle and amplitudes, expected and observed."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.effects.evidence import Evidence
from sa_jitter_ros.prediction.prediction import predict
from sa_jitter_ros.pulses.angle_law import LINEAR
from sa_jitter_ros.report.expected_errors import cycle_places, lags_of, Version
from sa_jitter_ros.report.plotting import AFTER, BEFORE, MEASURED, panels

Words = Callable[[float], str]  # an order in a sentence

_MICRO = 1e6
_MOST_POINTS = 3000
_STEPS = 16  # positions in a trigger cycle
_FINEST = 1e-6  # half the range of a histogram of relative intervals that are all equal


def pulse_errors(evidence: Evidence, versions: Sequence[Version]) -> Figure:
    """Draw the pulse errors over time, their distribution, autocorrelation, clock and origin."""
    figure, axes = panels(8)
    _over_time(axes[0], evidence, versions[-1])
    _distribution(axes[1], evidence, versions)
    _autocorrelation(axes[2], evidence, versions)
    _return_map(axes[3], evidence)
    _lattice(axes[4], evidence)
    _origin(axes[5], evidence)
    _steadiness(axes[6], evidence, versions)
    _intervals(axes[7], evidence)
    return figure


def trigger_cycle(evidence: Evidence, versions: Sequence[Version], *, words: Words) -> Figure:
    """
    Draw the profile over the trigger cycle, the dependence on N_t, and the pulse index.

    `words` names an order.
    """
    figure, axes = panels(3)
    _profile(axes[0], evidence, versions)
    _dependence_on_cycles(axes[1], evidence, versions, words)
    _folded(axes[2], evidence, versions[-1])
    return figure


def amplitudes(evidence: Evidence, channel_names: Sequence[str], words: Words) -> Figure:
    """Draw how the strongest lines vary: over time, with each other, and their spectrum."""
    lines = evidence.lines
    figure, axes = panels(3)
    strongest = np.argsort(lines.radial_noise)[:4]
    names = [f'{words(lines.order[k])}, {channel_names[lines.channel[k]]}' for k in strongest]
    changes = lines.radial[..., strongest]
    cycles = changes.shape[1]
    for change, name in zip(changes.reshape(-1, len(names)).T, names):
        axes[0].plot(change, linewidth=0.6, alpha=0.8, label=name)
    axes[0].set(title='cycle by cycle', xlabel='trigger cycle of the fitted acquisitions',
                ylabel='relative change of the amplitude')
    for other in range(1, len(names)):
        axes[1].plot(_thinned(changes[..., 0]), _thinned(changes[..., other]), '.', markersize=2,
                     color=f'C{other}', label=names[other])
    axes[1].locator_params(axis='x', nbins=6)  # of many digits
    axes[1].set(title='correlation between lines', xlabel=f'relative change, {names[0]}',
                ylabel='relative change, other lines')
    power = np.mean(np.abs(np.fft.rfft(changes, axis=1)[:, 1:]) ** 2, axis=0) * 2.0 / cycles
    axes[2].semilogy(np.fft.rfftfreq(cycles)[1:], power, linewidth=0.9)
    axes[2].set(title='spectrum', xlabel='frequency / trigger rate',
                ylabel='spectral density')
    return figure


# --- panels of pulse errors ----------------------------------------------------------------------

def _over_time(axes: Axes, evidence: Evidence, version: Version) -> None:
    """Draw the errors over an acquisition; their mean shows a common trend."""
    times = evidence.times - evidence.times[:, :1]
    for row in range(min(len(times), 8)):
        axes.plot(times[row], _MICRO * evidence.errors[row], color='0.7', linewidth=0.6,
                  label='single acquisitions' if row == 0 else None)
    axes.plot(times.mean(axis=0), _MICRO * evidence.errors.mean(axis=0), color=MEASURED,
              label='mean of all')
    if version.patterns.any():
        axes.plot(times[0], _MICRO * version.patterns[0], color=version.colour, linewidth=0.9,
                  label='deterministic part, first acquisition')
    axes.set(title='over an acquisition', xlabel='time since its start [s]',
             ylabel='pulse error [µs]')


def _distribution(axes: Axes, evidence: Evidence, versions: Sequence[Version]) -> None:
    """Draw the histogram of the errors and the expected distributions."""
    errors = _MICRO * evidence.errors.ravel()
    top = max(np.abs(errors).max(), *(_MICRO * np.quantile(np.abs(item.draws), 0.999)
                                      for item in versions))
    edges = np.linspace(-top, top, 41).tolist()
    axes.hist(errors, edges, density=True, histtype='stepfilled', color='0.8',
              label='recovered')
    for item in versions:
        axes.hist(_MICRO * item.draws, edges, density=True, histtype='step', color=item.colour,
                  label=item.label)
    axes.set(title='distribution', xlabel='pulse error [µs]', ylabel='density [1/µs]')


def _autocorrelation(axes: Axes, evidence: Evidence, versions: Sequence[Version]) -> None:
    """Draw the autocorrelation of the errors with its standard error."""
    errors = evidence.errors
    lags = np.arange(lags_of(evidence))
    rows = np.array([[np.mean(row[:row.size - k] * row[k:]) for k in lags] for row in errors])
    scale = rows[:, 0].mean()
    for item in versions:
        axes.plot(lags, item.autocovariance / item.autocovariance[0], color=item.colour,
                  marker='_', label=item.label)
    if scale > 0.0:  # all errors are 0 where the pulses are those of the reference keyphasor
        error = rows.std(axis=0, ddof=1) / np.sqrt(len(rows)) / scale
        axes.errorbar(lags[1:], rows.mean(axis=0)[1:] / scale, yerr=error[1:], fmt='o',
                      markersize=3, capsize=2, color=MEASURED, label='recovered')
    axes.set(title='autocorrelation', xlabel='lag [trigger pulses]', ylabel='correlation')


def _return_map(axes: Axes, evidence: Evidence) -> None:
    """Draw each error over the one before, which shows correlation and quantisation."""
    errors = _MICRO * evidence.errors
    axes.plot(_thinned(errors[:, :-1]), _thinned(errors[:, 1:]), '.', color=MEASURED, markersize=2)
    axes.set(title='successive pulses', xlabel='pulse error [µs]',
             ylabel='error of the next pulse [µs]')


def _lattice(axes: Axes, evidence: Evidence) -> None:
    """Draw the errors over the ticks of the clock of the pulse times, else of the declared one."""
    errors = _MICRO * evidence.errors
    imposed = [pulses.errors for pulses in evidence.pulses if pulses.errors is not None]
    if len(imposed) == len(errors):
        grid = np.array(imposed)
        grid = _MICRO * (grid - grid.mean(axis=1, keepdims=True))
        axes.plot(_thinned(grid), _thinned(errors), '.', color=MEASURED, markersize=2)
        axes.plot(*2 * [[grid.min(), grid.max()]], color=AFTER, linewidth=0.9, label='slope 1')
        axes.set(title=f'clock of the pulse times, {evidence.clock.rate:.6g} Hz',
                 xlabel='error due to its ticks [µs]', ylabel='recovered pulse error [µs]')
        return
    rate = evidence.model.keyphasor_rate
    ticks = ((evidence.times - evidence.errors) * rate) % 1.0
    axes.plot(_thinned(ticks), _thinned(errors), '.', color=MEASURED, markersize=2)
    axes.set(title=f'declared clock, {rate:.6g} Hz', xlabel='pulse time × clock rate, modulo 1',
             ylabel='pulse error [µs]')


def _origin(axes: Axes, evidence: Evidence) -> None:
    """Draw pulse times over recovered errors: only errors of the tach are in both."""
    x = _MICRO * np.diff(evidence.errors, 2, axis=1)
    y = np.diff(evidence.times, 2, axis=1)
    half = 0.5 * evidence.period
    y = _MICRO * ((y + half) % (2.0 * half) - half)
    axes.plot(_thinned(x), _thinned(y), '.', color=MEASURED, markersize=2)
    ends = np.array([x.min(), x.max()])
    axes.plot(ends, ends, color=AFTER, linewidth=0.9, label='expected: error of the tach')
    axes.plot(ends, 0.0 * ends, color=BEFORE, linewidth=0.9, label='expected: motion of the shaft')
    axes.set(title='origin of the errors',
             xlabel='second difference of the pulse errors [µs]',
             ylabel='second difference of\nthe pulse times [µs]')


def _steadiness(axes: Axes, evidence: Evidence, versions: Sequence[Version]) -> None:
    """Draw the RMS of the errors over the record."""
    size = np.sqrt(np.mean(evidence.errors**2, axis=1))
    axes.plot(evidence.times.mean(axis=1), _MICRO * size, 'o', markersize=3, color=MEASURED,
              label='acquisitions')
    for item in versions:
        axes.axhline(_MICRO * item.std, color=item.colour, linewidth=0.9, label=item.label)
    axes.set(title='over the record', xlabel='time [s]', ylabel='RMS pulse error [µs]')
    axes.set_ylim(bottom=0.0)


def _intervals(axes: Axes, evidence: Evidence) -> None:
    """Draw the histogram of the pulse intervals."""
    intervals = np.diff(evidence.record_times)
    relative = intervals / np.median(intervals)
    # Very steady intervals differ by rounding only: too little to be divided into bins.
    ends = min(relative.min(), 1.0 - _FINEST), max(relative.max(), 1.0 + _FINEST)
    axes.hist(relative, 60, range=ends, histtype='stepfilled', color='0.6')
    axes.set_yscale('log')
    axes.set_ylim(bottom=0.5)
    axes.set(title='pulse intervals', xlabel='interval / median interval', ylabel='number')


# --- panels of the trigger cycle -----------------------------------------------------------------

def _profile(axes: Axes, evidence: Evidence, versions: Sequence[Version]) -> None:
    """Draw the RMS angle error over the trigger cycle."""
    u = cycle_places()
    for item in versions:
        axes.plot(u, _MICRO * item.profile, color=item.colour, label=item.label)
    size = np.sqrt(np.mean(_angle_errors(evidence, u) ** 2, axis=(0, 1)))
    axes.plot(u, _MICRO * size, color=MEASURED, linewidth=0.0, marker='.', label='recovered')
    axes.set(title='over the trigger cycle', xlabel='position in the trigger cycle, u',
             ylabel='RMS angle error [µs]')
    axes.set_ylim(bottom=0.0)


def _angle_errors(evidence: Evidence, u: Array) -> Array:
    """
    Return the angle error (acquisition, cycle, u) in s, from pulse errors and speed ripple.

    The ripple is relative to the linear angle law; the other laws follow part of it.
    """
    cycles = evidence.errors.shape[1] - 1
    late = evidence.times - evidence.times[:, :1] - evidence.period * np.arange(cycles + 1)
    read = (evidence.model.weights.path(late, u, cycles)
            - LINEAR.path(late - evidence.errors, u, cycles))
    ripple = np.where(np.isfinite(evidence.ripple), evidence.ripple, 0.0)[:, :, None]
    return np.asarray(read + ripple * u * (1.0 - u))


def _dependence_on_cycles(axes: Axes, evidence: Evidence, versions: Sequence[Version],
                          words: Words) -> None:
    """Draw the attenuation by the pulse errors in averages of fewer cycles."""
    model = evidence.model
    counts = np.unique(np.geomspace(1, model.trigger_cycles, 7).astype(int))
    path = _angle_errors(evidence, np.arange(_STEPS) / _STEPS + 0.5 / _STEPS)
    turns = 2j * np.pi * model.fundamental_frequency * path
    single = np.array([np.abs(np.exp(g * turns).mean()) for g in model.orders])
    g = model.orders[int(np.argmin(np.abs(single - 0.7)))]
    gain = np.exp(g * turns).mean(axis=2)
    means, spreads = [], []
    for n in counts:
        whole = gain.shape[1] // n
        each = np.abs(gain[:, :whole * n].reshape(len(gain), whole, n).mean(axis=2)).mean(axis=1)
        means.append(each.mean())
        spreads.append(each.std(ddof=1) / np.sqrt(len(each)))
    axes.errorbar(counts, means, yerr=spreads, fmt='o', color=MEASURED, markersize=4, capsize=2,
                  label='by the recovered errors')
    for item in versions:
        curve = [predict(replace(model, trigger_cycles=int(n), noise_std=0.0, orders=(g,)),
                         item.effects).mean_attenuation[0] for n in counts]
        axes.plot(counts, curve, color=item.colour, label=item.label)
    axes.set_xscale('log')
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.set_xticks([], minor=True)
    axes.set(title=words(g), xlabel='trigger cycles in an average',
             ylabel='attenuation')


def _folded(axes: Axes, evidence: Evidence, version: Version) -> None:
    """Draw the mean error of each mark of the target, or of each of a few pulses."""
    model = evidence.model
    step = model.pulses_in_trigger_cycle
    angles = [effect.values['pulse_angles'] for effect in version.effects
              if effect.name == 'target_geometry']
    marks = len(angles[0]) if angles else 1
    period = marks // int(np.gcd(marks, step)) if marks > 1 else 12
    period = min(period, evidence.errors.shape[1])
    index = np.array([pulses.index for pulses in evidence.pulses]) % period
    positions = np.unique(index)
    mean = np.array([evidence.errors[index == k].mean() for k in positions])
    error = np.array([evidence.errors[index == k].std() / np.sqrt((index == k).sum())
                      for k in positions])
    axes.errorbar(positions, _MICRO * mean, yerr=_MICRO * error, fmt='o', color=MEASURED,
                  capsize=2, markersize=4, label='recovered, mean')
    if angles:
        expected = np.array([version.patterns[index == k].mean() for k in positions])
        axes.plot(positions, _MICRO * expected, color=version.colour, marker='_',
                  label=version.label)
    axes.axhline(0.0, color='0.4', linewidth=0.8)
    axes.set(title=f'folded by {period} pulses', xlabel=f'trigger pulse, modulo {period}',
             ylabel='pulse error [µs]')


def _thinned(values: Array) -> Array:
    flat = values.ravel()
    return np.asarray(flat[::max(1, flat.size // _MOST_POINTS)])
