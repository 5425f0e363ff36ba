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
Slips: pulse errors that the steps of the record fit have led astray.

Lines fit the vibration at several errors nearly alike, of which steps find the nearest: errors of
half a turn of the highest order or more may miss the right one, as a phase that is unwrapped to
the wrong turn. Around cycles that the lines do not fit, errors are chosen anew, all together.
"""

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.averaging.neighbour_equations import shortest_path
from sa_jitter_ros.inference.cycle_states import States
from sa_jitter_ros.inference.line_search import fit_lines
from scipy.special import gammainccinv

# Errors that are tried, in parts of a turn of the highest declared order, to either side; the size
# of errors, in turns, from which one of some hundreds is half a turn or more.
_PLACES, _SLIPPING = 6, 0.125


def mend_slips(states: States) -> bool:
    """
    Choose errors anew where the lines do not fit; return whether some have changed.

    They are the likeliest ones together among some on either side, with bends and gains free.
    """
    turn = 1.0 / (states.orders[:states.declared].max() * states.frequency)
    period = float(np.diff(states.times).mean())
    reach = min(_PLACES, int(0.25 * _PLACES * period / turn))
    if states.size[0] < _SLIPPING * turn or reach < 1:
        return False
    tried = turn / _PLACES * np.arange(-reach, reach + 1)
    power = np.einsum('c,ckp->k', states.weight, states.residual() ** 2)
    freedom = 0.5 * states.vibration.shape[0] * states.u.size
    limit = gammainccinv(freedom, 1.0 / power.size) / freedom  # one cycle by chance
    bad = power > limit * np.median(power[states.whole])
    loose = np.append(bad, False) | np.append(False, bad)
    edges = np.flatnonzero(np.diff(np.pad(loose.astype(int), 1)))
    expected = states.states.copy()
    expected[:, 0] -= states.no_jitter
    before = 0.5 * np.sum((expected / states.size) ** 2, axis=1)
    of_orders = np.arange(states.amplitudes.shape[1]) < states.orders.size
    signals, rate = states.signals(of_orders * states.amplitudes), states.rate()
    mended = False
    for first, end in edges.reshape(-1, 2).tolist():
        chosen = np.arange(max(first - 1, 0), min(end + 1, states.times.size))
        offsets = [tried if loose[k] else np.zeros(1) for k in chosen.tolist()]
        costs = [0.5 * ((expected[k, 0] + row) / states.size[0]) ** 2
                 for k, row in zip(chosen.tolist(), offsets)]
        cells = [_misfits(states, k, offsets[i], offsets[i + 1], signals[:, k], rate[:, k])
                 for i, k in enumerate(chosen[:-1].tolist())]
        path, cost = shortest_path(costs, cells)
        change = np.array([row[i] for row, i in zip(offsets, path)])
        if change.any() and cost < before[chosen].sum() + 0.5 * power[chosen[:-1]].sum():
            states.states[chosen, 0] += change
            states.states[chosen[:-1], 1:] = 0.0
            mended = True
    if mended:
        states.read()
        fit_lines(states)
    return mended


def _misfits(states: States, cycle: int, one: Array, other: Array, signals: Array, rate: Array
             ) -> Array:
    """
    Return minus the log likelihood of a cycle for changes of its two errors (one, other).

    Its bends and gain are then the likeliest ones. `signals` (channel, point) are its orders,
    `rate` their derivative by the pulse errors.
    """
    if not states.whole[cycle]:
        return np.zeros((one.size, other.size))
    begin = states.times[cycle] - states.states[cycle, 0] - one[:, None, None]
    end = states.times[cycle + 1] - states.states[cycle + 1, 0] - other[:, None]
    place = begin + (end - begin) * states.u
    left = states.band.at(place) - signals.T
    if states.tones.size:
        left -= _tones(states, begin[:, 0, 0], end[:, 0])
    left *= np.sqrt(states.weight)
    left = left.reshape(one.size, other.size, -1)
    columns = np.concatenate([states.shapes[1:-2, :, None] * rate.T, signals.T[None]])
    columns = (columns * np.sqrt(states.weight)).reshape(len(columns), -1)
    known = np.linalg.inv(columns @ columns.T + np.diag(states.size[1:] ** -2.0))
    along = left @ columns.T
    return np.asarray(0.5 * (np.sum(left**2, axis=2)
                             - np.einsum('ijk,kl,ijl->ij', along, known, along)))


def _tones(states: States, begin: Array, end: Array) -> Array:
    """
    Return the tones (one, other, point, channel) in cycles from `begin` (one,) to `end` (other,).

    A place in a cycle is a sum of a part of either, and so the wave there is a product of two.
    """
    u, turn = states.u[:, None, None], 2j * np.pi * states.tones
    first = np.exp((1.0 - u) * (begin[:, None] - states.band.start) * turn)
    second = np.exp(u * turn[:, None] * (end - states.band.start))
    found = (states.amplitudes[:, None, states.orders.size:] * first[:, None]) @ second[:, None]
    return np.moveaxis(found.real, (0, 1), (2, 3))
