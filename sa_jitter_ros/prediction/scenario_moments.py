# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Exact moments of averages whose pulse errors are known but for random ones on top."""

from collections.abc import Sequence

import numpy as np
from sa_jitter_ros.arrays import Array
from sa_jitter_ros.prediction.angle_error import (
    AngleErrorProcess, joint_characteristic, pair_characteristic, unit_nodes)
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.moments import AverageMoments, correlation_length

_COARSE, _FINE = unit_nodes(16), unit_nodes(32)
_CLEAR = 0.05  # mean phasor down to which the coarse rule is exact to 1e-6
_STEEP = 0.5  # fundamental cycles within a cycle: there a pulse is missing
_BLOCK = 1_000_000  # phasors held at once


def scenario_moments(model: DeclaredModel, processes: Sequence[AngleErrorProcess], errors: Array
                     ) -> AverageMoments:
    """
    Return the moments (scenario, order) of averages with known pulse `errors` (scenario, n).

    `errors` are in s, of the N_t + 1 pulses of the average or of all that its angle law reads (see
    `PulseWeights.path`); `processes` are random and independent of them. Exact but for cycles that
    hold a missing pulse, where the random errors count as if they did not vary inside the cycle.
    """
    g = np.asarray(model.orders)
    first = joint_characteristic(processes, [g[:, None]], [_FINE[0]], [0])
    cycles = model.weights.padded(np.asarray(errors) * model.fundamental_frequency,
                                  model.trigger_cycles)
    step = np.abs(np.diff(cycles, axis=1))
    turns = g.max() * np.max(step, initial=0.0, where=step < _STEEP)
    u, w = _COARSE if np.min(np.abs(first)) > _CLEAR and turns < 1.0 else _FINE
    first = joint_characteristic(processes, [g[:, None]], [u], [0]) * np.ones((g.size, 1))
    count = model.trigger_cycles
    reach = min(correlation_length(processes) + 1, count) if processes else 0
    alone = first[:, :, None] * np.stack((first.conj(), first))[:, :, None]
    joint = [pair_characteristic(processes, g, u, lag) - alone for lag in range(reach)]
    shape = (len(cycles), g.size)
    mean, variance, pseudo = (np.zeros(shape, complex) for _ in range(3))
    rows = max(1, _BLOCK // (u.size * (min(count, _BLOCK // u.size) + reach)))
    length = max(1, _BLOCK // (u.size * rows))
    for row in range(0, len(cycles), rows):
        part = slice(row, row + rows)
        for begin in range(0, count, length):
            size = min(length, count - begin)
            held = min(size + max(reach - 1, 0), count - begin)
            pulses = cycles[part, begin:begin + held + model.weights.pulses - 1]
            path = model.weights.path(pulses, u, held)
            for i, order in enumerate(g):
                phasor = _phasors(model, order, pulses, path) * w
                mean[part, i] += (phasor[:, :size] @ first[i]).sum(axis=1) / count
                for lag, pairs in enumerate(joint):
                    here = min(size, held - lag)
                    scale = (1.0 if lag == 0 else 2.0) / count**2
                    early = phasor[:, :here].transpose(0, 2, 1)
                    late = phasor[:, lag:lag + here]
                    variance[part, i] += scale * np.einsum(
                        'suv,uv->s', early @ late.conj(), pairs[0][i])
                    pseudo[part, i] += scale * np.einsum('suv,uv->s', early @ late, pairs[1][i])
    return AverageMoments(mean, np.maximum(variance.real, 0.0), pseudo)


def _phasors(model: DeclaredModel, order: float, pulses: Array, path: Array) -> Array:
    """Return exp(2 pi j g path), or its mean over a cycle of the linear law that turns far."""
    angle = 2.0 * np.pi * order * path
    phasor = np.empty(angle.shape, complex)
    np.cos(angle, out=phasor.real)
    np.sin(angle, out=phasor.imag)
    if model.angle_law == 'linear':
        step = np.diff(pulses, axis=1)
        steep = np.abs(step) > _STEEP
        if steep.any():
            turns = order * step[steep]
            closed = np.exp(2j * np.pi * order * pulses[:, :-1][steep] + 1j * np.pi * turns)
            phasor[steep] = (closed * np.sinc(turns))[:, None]
    return phasor
