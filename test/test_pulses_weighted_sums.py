# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The weighted sums of resampling: in C and in numpy, against sums in plain terms."""

from importlib import import_module, util

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.pulses import weighted_sums as in_numpy

COMPILED = 'sa_jitter_ros.pulses._weighted_sums'
needs_c = pytest.mark.skipif(util.find_spec(COMPILED) is None, reason='no C compiler')
BOTH = pytest.mark.parametrize('name', [
    'sa_jitter_ros.pulses.weighted_sums', pytest.param(COMPILED, marks=needs_c)])


def arrays(rng, *, count, channels, taps, order=8, samples=300):
    """Return what the function takes, with room for the sums."""
    return (rng.standard_normal((samples, channels)),
            rng.integers(0, samples - taps + 1, count).astype(np.int32),
            rng.uniform(0.0, 1.0, count), rng.standard_normal((order, taps)),
            np.full((count, channels), np.nan))


@BOTH
@given(channels=st.integers(1, 70), taps=st.integers(1, 120), order=st.integers(2, 9),
       count=st.integers(1, 40), seed=st.integers(0, 1000))
def test_sums_are_those_of_the_definition(name, channels, taps, order, count, seed):
    given_ = arrays(np.random.default_rng(seed), count=count, channels=channels, taps=taps,
                    order=order)
    samples, begin, fraction, polynomials, values = given_
    import_module(name).weighted_sums(*given_)
    weights = np.vander(2.0 * fraction - 1.0, order, increasing=True) @ polynomials
    for at, row, found in zip(begin, weights, values):
        np.testing.assert_allclose(found, row @ samples[at:at + taps], atol=1e-12 * order * taps)


@BOTH
@pytest.mark.parametrize('channels', [1, 3, 64])
def test_sums_are_the_same_however_many_are_made_together(name, channels, rng):
    given_ = arrays(rng, count=5000, channels=channels, taps=16)
    samples, begin, fraction, polynomials, values = given_
    weighted_sums = import_module(name).weighted_sums
    weighted_sums(*given_)
    alone = np.empty((1, channels))
    for k in (0, 1, 2047, 2048, 4999):
        weighted_sums(samples, begin[k:k + 1], fraction[k:k + 1], polynomials, alone)
        np.testing.assert_allclose(alone[0], values[k], rtol=0.0, atol=1e-13)


@needs_c
def test_c_writes_what_numpy_writes(rng):
    for channels in (1, 2, 7, 8, 13, 40):
        given_ = arrays(rng, count=3000, channels=channels, taps=16)
        expected = np.empty_like(given_[-1])
        in_numpy.weighted_sums(*given_[:-1], expected)
        import_module(COMPILED).weighted_sums(*given_)
        np.testing.assert_allclose(given_[-1], expected, rtol=0.0, atol=1e-12)


def change(arrays_, which, value):
    """Return the arrays with another one in one place."""
    return (*arrays_[:which], value, *arrays_[which + 1:])


@needs_c
def test_c_reads_and_writes_nothing_beyond_the_arrays(rng):
    good = arrays(rng, count=20, channels=3, taps=16)
    compiled = import_module(COMPILED).weighted_sums
    late, early = good[1].copy(), good[1].copy()
    late[7], early[7] = 300 - 16 + 1, -1
    for which, value in (
            (0, good[0][:15]), (0, good[0].astype(np.float32)), (0, good[0][:, :2].copy()),
            (0, good[0].ravel()), (1, late), (1, early), (1, good[1][:-1]),
            (1, good[1].astype(np.int64)), (2, good[2][:-1]), (2, good[2].astype('>f8')),
            (3, good[3][0]), (3, np.empty((0, 16))), (4, good[4][:-1]),
            (4, good[4][:, :2].copy())):
        with pytest.raises(ValueError, match='do not fit'):
            compiled(*change(good, which, value))
    with pytest.raises(ValueError, match='contiguous'):
        compiled(*change(good, 0, np.asfortranarray(good[0])))
    read_only = good[4].copy()
    read_only.flags.writeable = False
    with pytest.raises(ValueError, match='read-only'):
        compiled(*change(good, 4, read_only))
    with pytest.raises(TypeError, match='five'):
        compiled(*good[:4])
    with pytest.raises(TypeError):
        compiled(*good[:4], None)
    assert np.isnan(good[4]).all()
    compiled(*good)
    assert np.isfinite(good[4]).all()
