"""The comb-filter response against direct averaging of tones."""

from hypothesis import given, strategies as st
import numpy as np
import pytest

from sa_jitter_ros.averaging.comb import (
    choose_cycles, comb_response, order_response, tone_gain)
from sa_jitter_ros.errors import ParameterError

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

    @given(st.floats(0.0, 8.0), st.floats(0.0, 8.0), st.integers(1, 5), st.floats(0.2, 2.0))
    def test_equals_the_integral_over_whole_trigger_cycles(self, tone, order, cycles, ratio):
        found = order_response(tone, order, trigger_cycles=cycles, ratio=ratio)
        expected = integrated(lambda theta: np.exp(2j * np.pi * tone * theta), order,
                              cycles * ratio)
        assert found == pytest.approx(expected, abs=1e-9)

    @given(st.floats(0.0, 20.0), st.integers(0, 20), st.integers(1, 50))
    def test_for_whole_cycles_the_comb_times_the_response_of_one(self, tone, order, cycles):
        """The integral over N cycles is that of one cycle times Eq. 8."""
        one = order_response(tone, order, trigger_cycles=1)
        assert order_response(tone, order, trigger_cycles=cycles) == pytest.approx(
            one * comb_response(tone, cycles), abs=1e-10)

    def test_a_folded_average_and_an_order_amplitude_differ(self):
        """3 trigger cycles of 0.4137 hold one whole fundamental cycle, but 1.2411 are taken."""
        amplitude = abs(order_response(2.5, 1.0, trigger_cycles=3, ratio=0.4137))
        assert amplitude == pytest.approx(abs(np.sinc(1.2411 * 1.5)))
        folded = comb_response(2.5, 1) * order_response(2.5, 1.0, trigger_cycles=1)
        assert abs(folded) > 2.0 * amplitude

    def test_the_gain_of_a_real_tone_is_its_worst_phase(self):
        arguments = {'trigger_cycles': 3, 'ratio': 0.7}
        phases = np.linspace(0.0, 2.0 * np.pi, 721)
        amplitudes = [
            2.0 * abs(integrated(lambda theta, p=phase: np.cos(2 * np.pi * 1.6 * theta + p), 2.0,
                                 2.1))
            for phase in phases]
        assert max(amplitudes) == pytest.approx(tone_gain(1.6, 2.0, **arguments), rel=1e-4)


class TestChooseCycles:

    def test_a_rational_order_gets_its_exact_notch(self):
        choice = choose_cycles(2.4, minimum=8, maximum=40)
        assert choice.trigger_cycles == 10
        assert choice.gain == pytest.approx(0.0, abs=1e-12)
        assert averaged_tone(2.4, 10) == pytest.approx(np.zeros(64), abs=1e-12)
        assert choice.candidates.tolist() == list(range(8, 41))
        assert np.flatnonzero(choice.gains < 1e-12).tolist() == [2, 7, 12, 17, 22, 27, 32]

    @given(st.floats(0.51, 0.99), st.integers(1, 30), st.integers(0, 60))
    def test_no_other_number_within_the_bounds_is_better(self, order, minimum, span):
        choice = choose_cycles(order, minimum=minimum, maximum=minimum + span)
        direct = [abs(averaged_tone(order, n, points=1)[0])
                  for n in range(minimum, minimum + span + 1)]
        assert choice.gains == pytest.approx(np.array(direct), abs=1e-10)
        assert choice.gain == pytest.approx(min(direct), abs=1e-8)

    def test_the_worst_of_several_orders_counts(self):
        choice = choose_cycles([0.5, 1.0 / 3.0], minimum=1, maximum=10)
        assert choice.trigger_cycles == 6
        assert choice.gain == pytest.approx(0.0, abs=1e-12)

    def test_a_roughly_known_order_is_a_range(self):
        choice = choose_cycles([2.38, 2.42], minimum=2, maximum=30)
        assert choice.gain == pytest.approx(max(
            np.abs(averaged_tone(tone, choice.trigger_cycles)).max() for tone in (2.38, 2.42)))
        assert choice.gain > 0.01

    def test_order_amplitudes_of_a_real_tone_at_a_non_integer_ratio(self, rng):
        """The notch of the amplitudes depends on the trigger cycles times the ratio."""
        tone, ratio, orders = 5.37, 2.40789, [19.0, 38.0]
        choice = choose_cycles(tone, minimum=20, maximum=60, ratio=ratio, orders=orders)
        gains = []
        for cycles in (choice.trigger_cycles, 20):
            length = cycles * ratio
            phase = rng.uniform(0.0, 2.0 * np.pi)
            theta = (np.arange(400_000) + 0.5) / 400_000 * length
            wave = np.cos(2.0 * np.pi * tone * theta + phase)
            found = [2.0 * abs(np.mean(wave * np.exp(-2j * np.pi * g * theta))) for g in orders]
            gains.append(max(found))
        assert gains[0] <= choice.gain + 1e-6
        assert choice.gain < 0.3 * choice.gains[0]

    def test_the_waveform_at_a_non_integer_ratio_may_lose_a_cycle(self):
        """2.5 cycles a trigger: 5 whole ones in two, but 6 or 7 in three."""
        choice = choose_cycles(0.2, minimum=2, maximum=3, ratio=2.5)
        seven, six = (abs(comb_response(0.2, n)) for n in (7, 6))
        assert choice.trigger_cycles == 2
        assert choice.gains == pytest.approx([0.0, max(six, seven)], abs=1e-12)

    def test_averages_without_a_whole_cycle_are_no_candidates(self):
        choice = choose_cycles(0.5, minimum=1, maximum=8, ratio=0.5)
        assert np.isnan(choice.gains[0])
        assert choice.trigger_cycles == 4
        assert choice.gain == pytest.approx(0.0, abs=1e-12)


class TestBadInput:

    @pytest.mark.parametrize('order', [np.nan, np.inf])
    def test_orders_are_finite(self, order):
        for call in (lambda: comb_response(order, 3),
                     lambda: order_response(order, 1.0, trigger_cycles=3),
                     lambda: tone_gain(1.0, order, trigger_cycles=3),
                     lambda: choose_cycles(order, minimum=1, maximum=3)):
            with pytest.raises(ParameterError, match='finite'):
                call()

    @pytest.mark.parametrize('cycles', [0, -1, 2.5, [1, 0]])
    def test_the_comb_averages_whole_cycles(self, cycles):
        with pytest.raises(ParameterError, match='whole'):
            comb_response(0.3, cycles)

    @pytest.mark.parametrize(('cycles', 'ratio'), [(0, 1.0), (3, 0.0), (-3, -1.0), (3, -1.0)])
    def test_lengths_are_positive(self, cycles, ratio):
        with pytest.raises(ParameterError, match='positive'):
            order_response(0.3, 1.0, trigger_cycles=cycles, ratio=ratio)

    @pytest.mark.parametrize(('minimum', 'maximum'), [
        (0, 3), (4, 3), (1.5, 3), (1, np.inf), (1, np.nan), (np.nan, 3)])
    def test_bounds_are_whole_and_ordered(self, minimum, maximum):
        with pytest.raises(ParameterError, match='minimum'):
            choose_cycles(0.3, minimum=minimum, maximum=maximum)

    @pytest.mark.parametrize('arguments', [
        {'interfering_orders': []}, {'interfering_orders': [0.3, -1.2]},
        {'interfering_orders': 0.3, 'orders': [0.0]}])
    def test_orders_to_choose_for_are_positive(self, arguments):
        with pytest.raises(ParameterError, match='positive'):
            choose_cycles(minimum=1, maximum=3, **arguments)

    def test_synchronous_orders_cannot_be_removed(self):
        with pytest.raises(ParameterError, match='order 3 is synchronous'):
            choose_cycles([0.3, 3.0], minimum=1, maximum=9)
        with pytest.raises(ParameterError, match=r'order 2\.5 is synchronous'):
            choose_cycles(2.5, minimum=1, maximum=9, orders=[1.0, 2.5])
        assert choose_cycles(3.0, minimum=1, maximum=9, orders=[1.0]).gain < 1e-12

    def test_a_waveform_needs_a_whole_cycle(self):
        with pytest.raises(ParameterError, match='no whole one'):
            choose_cycles(0.3, minimum=1, maximum=3, ratio=0.3)
