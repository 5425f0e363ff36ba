# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The comb-filter response against direct averaging of tones."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.prediction.comb import (
    comb_response, leakage, order_response, order_share, waveform_share)

# Exact to rounding for fewer than about 100 periods.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(400)


def averaged_tone(order, cycles, points=64):
    """Return the mean over whole cycles of exp(j 2 pi order theta), Eq. 6."""
    theta = np.arange(cycles * points).reshape(cycles, points) / points
    return np.exp(2j * np.pi * order * theta).mean(axis=0)


def integrated(signal, order, length):
    """Return (1/length) times the integral of the signal at an order, by Gauss-Legendre."""
    theta = 0.5 * length * (NODES + 1.0)
    return 0.5 * np.sum(WEIGHTS * signal(theta) * np.exp(-2j * np.pi * order * theta))


class TestCombResponse:

    @given(st.floats(-50.0, 50.0), st.integers(1, 60))
    def test_equals_the_average_of_a_tone(self, order, cycles):
        theta = np.arange(64) / 64
        expected = comb_response(order, cycles) * np.exp(2j * np.pi * order * theta)
        assert averaged_tone(order, cycles) == pytest.approx(expected, abs=1e-10)

    def test_equals_the_printed_formula(self, rng):
        orders, cycles = rng.uniform(0.0, 40.0, 200), rng.integers(1, 300, 200)
        expected = (np.sin(np.pi * orders * cycles) / (cycles * np.sin(np.pi * orders))
                    * np.exp(1j * np.pi * orders * (cycles - 1)))
        # The sine of a large argument loses digits, more so near the integers.
        assert comb_response(orders, cycles) == pytest.approx(expected, abs=1e-9)

    def test_integer_orders_pass_unchanged(self):
        assert comb_response(np.arange(-3, 400), 17) == pytest.approx(np.ones(403), abs=1e-13)

    def test_notches_lie_at_the_other_multiples_of_one_over_n(self):
        n = 12
        orders = np.arange(1, 10 * n) / n
        gain = np.abs(comb_response(orders, n))
        assert gain == pytest.approx(np.where(np.arange(1, 10 * n) % n == 0, 1.0, 0.0), abs=1e-12)

    def test_white_noise_is_attenuated_by_the_root_of_n(self):
        # Equally spaced orders integrate a polynomial in exp(j 2 pi order) exactly.
        power = np.mean(np.abs(comb_response(np.arange(64) / 64, 25))**2)
        assert power == pytest.approx(1.0 / 25.0)


class TestOrderResponse:

    @given(st.floats(0.0, 8.0), st.floats(0.0, 8.0), st.floats(0.2, 10.0))
    def test_equals_the_integral_over_the_average(self, tone, order, length):
        expected = integrated(lambda theta: np.exp(2j * np.pi * tone * theta), order, length)
        assert order_response(tone, order, length) == pytest.approx(expected, abs=1e-9)

    @given(st.floats(0.0, 20.0), st.integers(0, 20), st.integers(1, 50))
    def test_for_whole_cycles_the_comb_times_the_response_of_one(self, tone, order, cycles):
        """The integral over N cycles is that of one cycle times Eq. 8."""
        assert order_response(tone, order, cycles) == pytest.approx(
            order_response(tone, order, 1) * comb_response(tone, cycles), abs=1e-10)

    def test_a_folded_average_and_an_order_amplitude_differ(self):
        """3 trigger cycles of 0.4137 hold one whole fundamental cycle, but 1.2411 are taken."""
        amplitude = abs(order_response(2.5, 1.0, 3 * 0.4137))
        assert amplitude == pytest.approx(abs(np.sinc(1.2411 * 1.5)))
        folded = comb_response(2.5, 1) * order_response(2.5, 1.0, 1)
        assert abs(folded) > 2.0 * amplitude

    def test_the_share_of_a_real_tone_is_its_worst_phase(self):
        phases = np.linspace(0.0, 2.0 * np.pi, 721)
        amplitudes = [
            2.0 * abs(integrated(lambda theta, p=phase: np.cos(2 * np.pi * 1.6 * theta + p), 2.0,
                                 2.1))
            for phase in phases]
        assert max(amplitudes) == pytest.approx(order_share(1.6, 2.0, 2.1), rel=1e-4)


class TestWaveformShare:

    def test_a_rational_order_has_exact_notches(self):
        shares = [waveform_share(2.4, n) for n in range(8, 41)]
        assert np.flatnonzero(np.array(shares) < 1e-12).tolist() == [2, 7, 12, 17, 22, 27, 32]
        assert averaged_tone(2.4, 10) == pytest.approx(np.zeros(64), abs=1e-12)

    @given(st.floats(0.51, 0.99), st.integers(1, 90))
    def test_of_whole_cycles_is_that_of_the_mean(self, order, cycles):
        assert waveform_share([order], cycles) == pytest.approx(
            np.abs(averaged_tone(order, cycles, points=1)), abs=1e-10)

    def test_at_a_length_that_is_not_whole_it_may_lose_a_cycle(self):
        """2.5 cycles a trigger: 5 whole ones in two, but 6 or 7 in three."""
        assert waveform_share([0.2], 5.0) == pytest.approx(0.0, abs=1e-12)
        assert waveform_share([0.2], 7.5) == pytest.approx(
            max(abs(comb_response(0.2, n)) for n in (6, 7)))

    def test_an_average_without_a_whole_cycle_has_none(self):
        assert np.isnan(waveform_share([0.5, 0.7], 1.5)).all()


class TestLeakage:

    def test_the_fewest_cycles_that_put_all_into_notches_are_chosen(self):
        found = leakage([2.5, 1.0 / 3.0], [4.0], cycle_length=1.0, minimum=7, maximum=40)
        assert found.trigger_cycles == 12
        assert found.share == pytest.approx(np.zeros((2, 1)), abs=1e-12)
        assert found.candidates.tolist() == list(range(7, 41))
        assert found.candidates[found.largest_share < 1e-12].tolist() == [12, 18, 24, 30, 36]
        assert found.best(3).tolist() == [12, 18, 24]

    def test_without_a_notch_the_least_counts_and_a_tenth_more_is_as_good(self):
        found = leakage([18.6893, 0.5], [19.0, 38.0], cycle_length=2.40789, minimum=13, maximum=34)
        least = found.largest_share.min()
        assert least > 1e-3
        assert found.largest_share.argmin() > 16 - 13
        assert found.trigger_cycles == 16
        assert found.share.max() == found.largest_share[16 - 13] <= 1.1 * least
        assert np.all(found.largest_share[:16 - 13] > 1.1 * least)
        assert 16 in found.best(2)

    def test_a_roughly_known_order_is_a_range(self):
        both = leakage([2.38, 2.42], [3.0], cycle_length=1.0, minimum=2, maximum=30)
        each = [leakage(tone, [3.0], cycle_length=1.0, minimum=2, maximum=30)
                for tone in (2.38, 2.42)]
        np.testing.assert_array_equal(
            both.largest_share, np.maximum(*(found.largest_share for found in each)))

    def test_given_cycles_are_assessed(self):
        found = leakage([5.37], [19.0, 38.0], cycle_length=2.40789, minimum=20, maximum=60,
                        trigger_cycles=33)
        assert found.trigger_cycles == 33
        np.testing.assert_array_equal(
            found.share, order_share([[5.37]], [19.0, 38.0], 33 * 2.40789))
        assert found.waveform_share == waveform_share([5.37], 33 * 2.40789)

    def test_order_amplitudes_of_a_real_tone_at_a_non_integer_ratio(self, rng):
        """The notch of the amplitudes depends on the trigger cycles times their length."""
        tone, ratio, orders = 18.3, 2.40789, [19.0, 38.0]
        found = leakage(tone, orders, cycle_length=ratio, minimum=20, maximum=60)
        measured = []
        for cycles in (found.trigger_cycles, 20):
            length = cycles * ratio
            phase = rng.uniform(0.0, 2.0 * np.pi)
            theta = (np.arange(400_000) + 0.5) / 400_000 * length
            wave = np.cos(2.0 * np.pi * tone * theta + phase)
            shown = [2.0 * abs(np.mean(wave * np.exp(-2j * np.pi * g * theta))) for g in orders]
            measured.append(max(shown))
        assert measured[0] <= found.share.max() + 1e-6
        assert found.share.max() < 0.1 * measured[1]


class TestBadInput:

    @pytest.mark.parametrize('order', [np.nan, np.inf])
    def test_orders_are_finite(self, order):
        for call in (lambda: comb_response(order, 3),
                     lambda: order_response(order, 1.0, 3),
                     lambda: order_share(1.0, order, 3),
                     lambda: leakage(order, 1.0, cycle_length=1.0, minimum=1, maximum=3)):
            with pytest.raises(ParameterError, match='finite'):
                call()

    @pytest.mark.parametrize('cycles', [0, -1, 2.5, [1, 0]])
    def test_the_comb_averages_whole_cycles(self, cycles):
        with pytest.raises(ParameterError, match='whole'):
            comb_response(0.3, cycles)

    @pytest.mark.parametrize('length', [0.0, -3.0, [1.0, 0.0]])
    def test_lengths_are_positive(self, length):
        with pytest.raises(ParameterError, match='positive'):
            order_response(0.3, 1.0, length)

    @pytest.mark.parametrize(('minimum', 'maximum'), [
        (0, 3), (4, 3), (1.5, 3), (1, np.inf), (1, np.nan), (np.nan, 3)])
    def test_bounds_are_whole_and_ordered(self, minimum, maximum):
        with pytest.raises(ParameterError, match='minimum'):
            leakage(0.3, 1.0, cycle_length=1.0, minimum=minimum, maximum=maximum)

    @pytest.mark.parametrize(('tones', 'orders'), [
        ([], [1.0]), ([0.3, -1.2], [1.0]), ([0.3], [0.0]), ([0.3], [])])
    def test_orders_are_positive_and_there_are_some(self, tones, orders):
        with pytest.raises(ParameterError, match='give orders above 0'):
            leakage(tones, orders, cycle_length=1.0, minimum=1, maximum=3)

    def test_synchronous_orders_cannot_be_removed(self):
        with pytest.raises(ParameterError, match=r'order 2\.5 is synchronous'):
            leakage([0.3, 2.5], [1.0, 2.5], cycle_length=1.0, minimum=1, maximum=9)
        found = leakage(3.0, 1.0, cycle_length=1.0, minimum=1, maximum=9)
        assert found.share.max() < 1e-12
        assert found.waveform_share[0] == pytest.approx(1.0)  # synchronous with the waveform
