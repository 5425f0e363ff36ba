# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loops over all samples, in numpy and in C with each width of vectors, against plain sums."""

from importlib import import_module, util

from hypothesis import given, strategies as st
import numpy as np
import pytest

COMPILED = 'sa_jitter_ros.inner_loops._in_c'
needs_c = pytest.mark.skipif(util.find_spec(COMPILED) is None, reason='no C compiler')
WIDTHS = [lanes for lanes in (2, 4, 8) if util.find_spec(COMPILED)
          and import_module(COMPILED).take_lanes(lanes) == lanes]
ALL = pytest.mark.parametrize('lanes', [pytest.param(0, id='numpy'), *WIDTHS])


@pytest.fixture(autouse=True)
def widest_vectors():
    """Leave the loops as they are taken at the start."""
    yield
    if WIDTHS:
        import_module(COMPILED).take_lanes(8)


def loops(lanes):
    """Return the loops in C with vectors of so many numbers, those in numpy for 0."""
    if not lanes:
        return import_module('sa_jitter_ros.inner_loops.in_numpy')
    compiled = import_module(COMPILED)
    compiled.take_lanes(lanes)
    return compiled


def arrays(rng, *, rows, points, channels, half, order=8, samples=300):
    """Return what `weighted_sums` takes: rows of places up to 90 samples long, with their sums."""
    return (rng.standard_normal((samples, channels)),
            rng.integers(0, samples - 2 * half - 90, rows).astype(np.int32),
            rng.uniform(0.0, 2.0, rows), rng.uniform(0.0, 88.0, rows),
            rng.uniform(0.0, 1.0, points), rng.standard_normal((order, half)),
            np.full((rows * points, channels), np.nan))


def change(arrays_, which, value):
    """Return the arrays with another one in one place."""
    return (*arrays_[:which], value, *arrays_[which + 1:])


# --- weighted sums -------------------------------------------------------------------------------

@ALL
@given(channels=st.integers(1, 70), half=st.integers(1, 60), order=st.integers(2, 9),
       rows=st.integers(1, 5), points=st.integers(1, 9), seed=st.integers(0, 1000))
def test_sums_are_those_of_the_definition(lanes, channels, half, order, rows, points, seed):
    given_ = arrays(np.random.default_rng(seed), rows=rows, points=points, channels=channels,
                    half=half, order=order)
    samples, origin, begin, length, u, polynomials, values = given_
    loops(lanes).weighted_sums(*given_)
    places = (begin[:, None] + length[:, None] * u).ravel()
    first = np.repeat(origin, points) + places.astype(int)
    x = 2.0 * (places % 1.0) - 1.0
    weights = np.concatenate((
        np.vander(x, order, increasing=True) @ polynomials,
        (np.vander(-x, order, increasing=True) @ polynomials)[:, ::-1]), axis=1)
    for at, row, found in zip(first, weights, values):
        np.testing.assert_allclose(found, row @ samples[at:at + 2 * half],
                                   atol=1e-11 * order * half)


@ALL
@pytest.mark.parametrize('channels', [1, 3, 64])
def test_sums_are_the_same_however_many_are_made_together(lanes, channels, rng):
    given_ = arrays(rng, rows=50, points=100, channels=channels, half=8)
    samples, *rows, u, polynomials, values = given_
    weighted_sums = loops(lanes).weighted_sums
    weighted_sums(*given_)
    alone = np.empty((1, channels))
    for k in (0, 1, 2047, 2048, 4999):
        row, point = divmod(k, 100)
        weighted_sums(samples, *(item[row:row + 1] for item in rows), u[point:point + 1],
                      polynomials, alone)
        np.testing.assert_allclose(alone[0], values[k], rtol=0.0, atol=1e-12)


@needs_c
def test_sums_in_c_are_within_the_arrays(rng):
    good = arrays(rng, rows=4, points=5, channels=3, half=8)
    compiled = import_module(COMPILED).weighted_sums
    late, early = good[1].copy(), good[1].copy()
    late[2], early[2] = 300 - 16 + 1, -200
    for which, value in (
            (0, good[0][:15]), (0, good[0].astype(np.float32)), (0, good[0][:, :2].copy()),
            (0, good[0].ravel()), (1, late), (1, early), (1, good[1][:-1]),
            (1, good[1].astype(np.int64)), (2, good[2][:-1]), (2, good[2].astype('>f8')),
            (2, good[2] - 200.0), (2, np.full(4, np.nan)), (2, np.full(4, 1e300)),
            (3, good[3][:-1]), (4, good[4][:-1]), (4, good[4] * 1e4), (5, good[5][0]),
            (5, np.empty((0, 8))), (5, np.empty((8, 0))), (6, good[6][:-1]),
            (6, good[6][:, :2].copy())):
        with pytest.raises(ValueError, match='do not fit'):
            compiled(*change(good, which, value))
    with pytest.raises(ValueError, match='contiguous'):
        compiled(*change(good, 0, np.asfortranarray(good[0])))
    with pytest.raises(TypeError, match='7 arrays'):
        compiled(*good[:-1])


# --- frames --------------------------------------------------------------------------------------

LAYOUTS = {
    'channels': lambda x: x, 'frames': np.asfortranarray,
    'part': lambda x: np.concatenate([x, x], axis=1)[:, :x.shape[1]],
    'turned': lambda x: np.ascontiguousarray(x[::-1, ::-1])[::-1, ::-1],
    'each second': lambda x: np.repeat(np.repeat(x, 2, axis=0), 2, axis=1)[::2, ::2]}


@ALL
@pytest.mark.parametrize('layout', LAYOUTS)
@given(channels=st.integers(1, 20), count=st.integers(1, 150), seed=st.integers(0, 99))
def test_frames_are_the_samples_in_the_other_order(lanes, layout, channels, count, seed):
    samples = np.random.default_rng(seed).standard_normal((channels, count))
    values = np.full((count, channels), np.nan)
    assert loops(lanes).frames(LAYOUTS[layout](samples), values) is True
    np.testing.assert_array_equal(values, samples.T)


@ALL
@pytest.mark.parametrize('layout', LAYOUTS)
@pytest.mark.parametrize('bad', [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize('shape', [(1, 77), (3, 77), (8, 64), (19, 77)])
def test_a_number_that_is_not_finite_is_seen_everywhere(lanes, layout, bad, shape, rng):
    frames = loops(lanes).frames
    for place in [(0, 0), (shape[0] - 1, shape[1] - 1),
                  *zip(rng.integers(0, shape[0], 20), rng.integers(0, shape[1], 20))]:
        samples = np.full(shape, 1e308)
        samples[place] = bad
        assert frames(LAYOUTS[layout](samples), np.empty(shape[::-1])) is False


@needs_c
def test_frames_in_c_are_within_the_arrays(rng):
    frames, samples, values = import_module(COMPILED).frames, np.ones((3, 9)), np.empty((9, 3))
    for pair in ((samples[:2], values), (samples[:, :8], values), (samples[0], values),
                 (samples.astype(np.float32), values), (samples, values.astype(np.float32)),
                 (samples, np.empty((9, 6))[:, ::2]), (samples, np.empty((18, 3))[::2])):
        with pytest.raises(ValueError, match='do not fit'):
            frames(*pair)


# --- steps and products --------------------------------------------------------------------------

@ALL
@given(shape=st.lists(st.integers(1, 21), min_size=2, max_size=3), seed=st.integers(0, 99))
def test_steps_and_their_squares_are_added(lanes, shape, seed):
    rng = np.random.default_rng(seed)
    every = rng.standard_normal((shape[0], *shape[1:]))
    wide = np.concatenate([every, every], axis=1)
    first, total, squares = rng.standard_normal((3, *shape[1:]))
    expected = total + (every - first).sum(axis=0), squares + ((every - first)**2).sum(axis=0)
    for values in (every, wide[:, :shape[1]]):
        found = total.copy(), squares.copy()
        loops(lanes).add_steps(values, first, *found)
        np.testing.assert_allclose(found, expected, atol=1e-12)


@ALL
@given(lines=st.integers(1, 15), rows=st.integers(1, 9), size=st.integers(1, 70),
       count=st.integers(1, 3), seed=st.integers(0, 99))
def test_products_are_added(lanes, lines, rows, size, count, seed):
    rng = np.random.default_rng(seed)
    wide, values = rng.standard_normal((lines, rows + 3)), rng.standard_normal((count, rows, size))
    sums = rng.standard_normal((count, lines, size))
    table = wide[:, 2:2 + rows]
    expected = sums + np.einsum('lr,krn->kln', table, values)
    loops(lanes).add_products(table, values, sums)
    np.testing.assert_allclose(sums, expected, atol=1e-12)


@needs_c
def test_steps_and_products_in_c_are_within_the_arrays():
    compiled, values, item = import_module(COMPILED), np.ones((4, 5, 6)), np.ones((5, 6))
    for given_ in ((values, item[:4], item, item), (values, item, item[:, :5], item),
                   (values, item, item, item.ravel()[:29]), (values[:, :, ::2], item, item, item),
                   (values, np.asfortranarray(item), item, item),
                   (values.astype(complex), item, item, item)):
        with pytest.raises(ValueError, match='do not fit'):
            compiled.add_steps(*given_)
    table, sums = np.ones((2, 5)), np.ones((4, 2, 6))
    for given_ in ((table[:, :4], values, sums), (table, values[:3], sums),
                   (table, values, sums[:, :1]), (table, values, sums[:, :, :5]),
                   (table[0], values, sums), (table, values[0], sums),
                   (table.astype(np.float32), values, sums)):
        with pytest.raises(ValueError, match='do not fit'):
            compiled.add_products(*given_)
    with pytest.raises(ValueError, match='read-only'):
        compiled.add_products(table, values, np.broadcast_to(sums, sums.shape))
