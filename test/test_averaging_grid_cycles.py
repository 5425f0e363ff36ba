# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Trigger cycles at equal steps of angle: what is kept of them."""

import numpy as np
import pytest
from sa_jitter_ros.averaging.grid_cycles import GridCycles
from sa_jitter_ros.averaging.synchronous_orders import LineSearch


@pytest.mark.parametrize(('samples', 'orders', 'fewer'), [
    (5000, (3.0, 19.0, 38.4), True), (5000, (40.0,), True), (512, (19.0, 38.0), False)])
def test_compact_cycles_keep_what_their_orders_tell(rng, samples, orders, fewer):
    u = np.arange(samples) / samples
    grid = GridCycles(rng.standard_normal((6, samples, 2)))
    waves = np.exp(2j * np.pi * np.outer(u, orders)) * (1.0 + u - 0.5 * u**3)[:, None]
    rows = np.concatenate((waves.real, waves.imag), axis=1)
    columns, flat = grid.compact(rows, max(orders))
    assert (len(columns) < 0.8 * samples) == fewer
    whole = grid.samples.reshape(samples, -1)
    np.testing.assert_allclose(columns.T @ columns, rows.T @ rows, atol=1e-9 * samples)
    np.testing.assert_allclose(columns.T @ flat, rows.T @ whole, atol=1e-9 * samples)
    assert grid.compact(rows, max(orders))[1] is flat or not fewer  # not computed again


def test_cycles_are_not_compact_where_that_leaves_less_than_their_columns(rng):
    grid = GridCycles(rng.standard_normal((6, 864, 1)))
    assert [len(grid.compact(rng.standard_normal((864, columns)), 6.0)[0]) == 864
            for columns in (10, 119)] == [False, True]


@pytest.mark.parametrize('order', [10.0, 10.4])
def test_what_an_order_shows_of_a_line_is_known(order):
    angle = np.arange(12)[:, None] + np.arange(128) / 128
    grid = GridCycles(np.cos(2.0 * np.pi * order * angle)[..., None])
    search, none = LineSearch.of(grid, 1.0), np.zeros(grid.pulses)
    orders = np.array([order, 8.0, 9.0, 11.0, 12.0, 13.0])
    lines = search._series(none, orders).sum(axis=1)[:, 0]
    np.testing.assert_allclose(search._shown(none, orders)[:, 0], lines / lines[0], atol=1e-4)
