# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Gear signals and condition indicators against hand-computed values and known statistics."""

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.averaging.average import AverageSettings
from sa_jitter_ros.averaging.indicators import (
    condition_indicators, gear_lines, GearSettings, INDICATORS, RunningIndicators, separate)
from sa_jitter_ros.averaging.jackknife import WaveformParts
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.samples import SampleBlock


def cosines(points, amplitudes):
    """Return the sum of a cos(g theta + g) over {order g: a}, one revolution of so many points."""
    theta = 2.0 * np.pi * np.arange(points) / points
    return sum(a * np.cos(g * theta + g) for g, a in amplitudes.items())


def gaussian_moment(order, degrees):
    """
    Return E m_order / s^order of Gaussian noise that fills so many real dimensions evenly.

    The direction of such noise is uniform on a sphere and independent of its length, so the
    expectation of the ratio is the ratio of expectations.
    """
    half = order // 2
    steps = np.arange(half)
    return np.prod(2 * steps + 1.0) * degrees**half / np.prod(degrees + 2.0 * steps)


class TestLines:

    def test_mesh_shaft_and_sidebands_are_separated(self):
        lines = gear_lines(GearSettings([10], sidebands=2, shaft_harmonics=2), 64)
        assert np.flatnonzero(lines.mesh).tolist() == [10, 20, 30]
        assert np.flatnonzero(lines.shaft).tolist() == [0, 1, 2]
        assert np.flatnonzero(lines.sidebands).tolist() == [8, 9, 11, 12, 18, 19, 21, 22,
                                                            28, 29, 31, 32]
        assert np.flatnonzero(lines.fundamental_sidebands).tolist() == [8, 9, 11, 12]
        assert np.flatnonzero(lines.first_sidebands).tolist() == [9, 11]

    def test_a_mesh_or_shaft_line_is_no_sideband(self):
        lines = gear_lines(GearSettings([3, 19, 20]), 50)
        assert np.flatnonzero(lines.first_sidebands).tolist() == [4]
        assert not (lines.mesh & lines.sidebands).any()
        assert not (lines.shaft & lines.sidebands).any()

    def test_without_mesh_orders_only_the_shaft_is_regular(self):
        lines = gear_lines(GearSettings(), 40)
        assert not lines.mesh.any()
        assert not lines.sidebands.any()
        assert np.flatnonzero(lines.shaft).tolist() == [0, 1, 2]


class TestSeparate:

    @pytest.mark.parametrize('points', [120, 121])
    def test_every_line_goes_where_the_definition_says(self, points):
        parts = {'mean': {0: 0.7}, 'shaft': {1: 0.5, 2: 0.4}, 'mesh': {19: 3.0, 38: 2.0},
                 'sideband': {18: 0.3, 39: 0.2}, 'other': {3: 0.11, 25: 0.12, 60 - 5: 0.13}}
        part = {name: cosines(points, lines) for name, lines in parts.items()}
        signals = separate(sum(part.values()), GearSettings([19]))
        assert signals.difference == pytest.approx(part['other'], abs=1e-12)
        assert signals.residual == pytest.approx(part['other'] + part['sideband'], abs=1e-12)
        assert signals.regular == pytest.approx(
            part['mean'] + part['shaft'] + part['mesh'] + part['sideband'], abs=1e-12)
        for lines in parts.values():
            for order, amplitude in lines.items():
                assert signals.amplitudes[order] == pytest.approx(amplitude, abs=1e-12)

    def test_the_nyquist_line_has_its_full_amplitude(self):
        signals = separate((-1.0)**np.arange(76), GearSettings([19]))
        assert signals.amplitudes[38] == pytest.approx(1.0)
        assert signals.residual == pytest.approx(np.zeros(76), abs=1e-14)

    @given(st.integers(4, 60), st.integers(0, 3), st.integers(0, 4), st.integers(0, 2**32 - 1))
    def test_regular_and_difference_add_up(self, points, sidebands, shaft_harmonics, seed):
        rng = np.random.default_rng(seed)
        average = rng.normal(size=(2, points))
        mesh_orders = rng.integers(1, (points - 1) // 2 + 1, 2)
        signals = separate(average, GearSettings(mesh_orders, sidebands, shaft_harmonics))
        assert signals.regular + signals.difference == pytest.approx(average, abs=1e-12)
        # Lines are orthogonal, so the powers add too.
        sideband = signals.residual - signals.difference
        powers = (signals.difference**2).sum() + (sideband**2).sum()
        assert (signals.residual**2).sum() == pytest.approx(powers, abs=1e-10)


class TestValues:

    def test_values_computed_by_hand(self):
        average = np.array([[1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -3.0]])
        found = condition_indicators(average)
        # Mean -1/4: deviations 5/4 four times, -3/4 three times, -11/4 once.
        rms = np.sqrt(248.0 / 16.0 / 8.0)
        assert found['rms'][0] == pytest.approx(rms)
        assert found['peak'][0] == pytest.approx(2.75)
        assert found['crest_factor'][0] == pytest.approx(2.75 / rms)
        second = (4 * 25 + 3 * 9 + 121) / 16.0 / 8.0
        fourth = (4 * 625 + 3 * 81 + 14641) / 256.0 / 8.0
        assert found['kurtosis'][0] == pytest.approx(fourth / second**2)

    def test_gear_indicators_of_known_lines(self):
        """Orders 5, 11 and 18 stay in d; no sums of four of them vanish but the trivial ones."""
        lines = {1: 0.5, 20: 3.0, 40: 1.0, 19: 0.3, 21: 0.2, 18: 0.1, 5: 0.8, 11: 0.6}
        average = cosines(4096, lines)
        found = condition_indicators(average[None], GearSettings([20]))
        values = {name: found[name][0] for name in INDICATORS}
        a, b, c = 0.8, 0.6, 0.1
        second = (a**2 + b**2 + c**2) / 2.0
        fourth = 3.0 / 8.0 * (a**4 + b**4 + c**4) + 1.5 * (
            a**2 * b**2 + b**2 * c**2 + a**2 * c**2)
        assert values['fm4'] == pytest.approx(fourth / second**2, rel=1e-9)
        assert values['fm0'] == pytest.approx(np.ptp(average) / 4.0, rel=1e-9)
        regular = np.sqrt((0.5**2 + 3.0**2 + 1.0 + 0.3**2 + 0.2**2) / 2.0)
        assert values['energy_ratio'] == pytest.approx(np.sqrt(second) / regular, rel=1e-9)
        assert values['sideband_ratio'] == pytest.approx(0.5 / 3.0, rel=1e-9)
        deviation = np.sqrt(sum(p**2 for p in lines.values()) / 2.0)
        assert values['sideband_level_factor'] == pytest.approx(0.5 / deviation, rel=1e-9)
        wider = condition_indicators(average[None], GearSettings([20], sidebands=2))
        assert wider['sideband_ratio'][0] == pytest.approx(0.6 / 3.0, rel=1e-9)
        assert wider['sideband_level_factor'][0] == pytest.approx(0.5 / deviation, rel=1e-9)

    def test_a_single_remaining_line_has_the_moments_of_a_cosine(self):
        """m4, m6, m8 of a cosine are 3/8, 5/16, 35/128; over powers of 1/2: 1.5, 2.5, 4.375."""
        average = cosines(512, {20: 1.0, 33: 1e-3})[None]
        found = condition_indicators(average, GearSettings([20]))
        assert found['fm4'][0] == pytest.approx(1.5, rel=1e-6)
        assert found['m6a'][0] == pytest.approx(2.5, rel=1e-6)
        assert found['m8a'][0] == pytest.approx(4.375, rel=1e-6)
        assert found['na4'][0] == pytest.approx(1.5, rel=1e-6)

    def test_gaussian_noise_has_the_known_moments(self, rng):
        """The scatter over 600 channels is the standard error; the expectation is exact."""
        points, channels = 1000, 600
        settings = GearSettings([50])
        found = condition_indicators(rng.normal(size=(channels, points)), settings)
        lines = gear_lines(settings, points)
        # Every order has two dimensions but the mean and the Nyquist line.
        sidebands = 2 * np.count_nonzero(lines.sidebands)
        residual = points - (2 * np.count_nonzero(lines.mesh | lines.shaft) - 2)
        cases = {'kurtosis': (4, points - 1), 'fm4': (4, residual - sidebands),
                 'm6a': (6, residual - sidebands), 'm8a': (8, residual - sidebands),
                 'na4': (4, residual)}
        for name, (order, degrees) in cases.items():
            expected = gaussian_moment(order, degrees)
            error = found[name].std(ddof=1) / np.sqrt(channels)
            assert found[name].mean() == pytest.approx(expected, abs=4.0 * error), name
            assert error < 0.05 * expected, name
            assert expected == pytest.approx({4: 3.0, 6: 15.0, 8: 105.0}[order], rel=0.02)

    def test_a_chipped_tooth_raises_fm4_as_computed(self):
        """A burst exp(-t^2/2w^2) cos(90 t) has the kurtosis 1.5 sqrt(2 pi) / w."""
        width = 0.1
        theta = 2.0 * np.pi * (np.arange(4096) / 4096 - 0.5)
        burst = 0.2 * np.exp(-0.5 * (theta / width)**2) * np.cos(90 * theta)
        healthy = cosines(4096, {1: 0.1, 60: 1.0, 120: 0.4, 7: 1e-3})
        found = condition_indicators(
            np.stack([healthy, healthy + burst]), GearSettings([60]))
        # The burst's spectrum, of standard deviation 10 orders, barely touches 60 and 120.
        assert found['fm4'][0] == pytest.approx(1.5, rel=1e-6)
        assert found['fm4'][1] == pytest.approx(1.5 * np.sqrt(2.0 * np.pi) / width, rel=0.02)
        for name in ('m6a', 'm8a', 'na4', 'energy_ratio'):
            assert found[name][1] > found[name][0], name

    def test_scale_invariance_and_independent_channels(self, rng):
        average = rng.normal(size=(3, 128)) + cosines(128, {19: 2.0})
        settings = GearSettings([19.0])
        found = condition_indicators(average, settings)
        scaled = condition_indicators(1e-9 * average, settings)
        alone = condition_indicators(average[1:2], settings)
        assert found.values.shape == (3, len(INDICATORS))
        assert found.names == INDICATORS
        assert scaled.values[:, 2:] == pytest.approx(found.values[:, 2:], rel=1e-9)
        assert scaled.values[:, :2] == pytest.approx(1e-9 * found.values[:, :2], rel=1e-9)
        assert alone.values[0] == pytest.approx(found.values[1], rel=1e-12)


class TestUndefined:

    def test_constants_and_pure_mesh_give_nan_where_nothing_remains(self):
        flat = condition_indicators(np.full((1, 64), 0.1), GearSettings([19]))
        assert np.isnan(flat.values[0, 3:]).all()
        assert flat.values[0, :2] == pytest.approx([0.0, 0.0], abs=1e-15)
        assert np.isnan(flat.values[0, 2])
        silent = condition_indicators(np.zeros((1, 64)), GearSettings([19]))
        assert silent.values[0, :2].tolist() == [0.0, 0.0]
        assert np.isnan(silent.values[0, 2:]).all()
        pure = condition_indicators(cosines(64, {19: 1e3})[None], GearSettings([19]))
        for name in ('fm4', 'm6a', 'm8a', 'na4'):
            assert np.isnan(pure[name][0]), name
        assert pure['energy_ratio'][0] == pytest.approx(0.0, abs=1e-12)

    def test_without_mesh_orders_gear_indicators_are_nan(self, rng):
        found = condition_indicators(rng.normal(size=(2, 64)))
        assert np.isfinite(found.values[:, :4]).all()
        assert np.isnan(found.values[:, 4:]).all()

    def test_without_sidebands_their_ratio_is_nan(self, rng):
        found = condition_indicators(rng.normal(size=(1, 64)), GearSettings([19], sidebands=0))
        assert np.isnan(found['sideband_ratio'][0])
        assert np.isfinite(found['sideband_level_factor'][0])


class TestHistory:

    settings = GearSettings([19])

    def test_na4_divides_by_the_mean_variance_of_all_averages(self, rng):
        history = rng.normal(size=(5, 2, 256)) * np.arange(1.0, 6.0)[:, None, None]
        found = condition_indicators(history, self.settings)
        for last in range(5):
            residual = separate(history[:last + 1], self.settings).residual
            centred = residual - residual.mean(axis=-1, keepdims=True)
            fourth = (centred[-1]**4).mean(axis=-1)
            variance = (centred**2).mean(axis=(0, 2))
            assert found['na4'][last] == pytest.approx(fourth / variance**2, rel=1e-12)

    def test_starred_indicators_divide_by_the_nominal_variance(self, rng):
        """Damage makes na4 rise and then fall; na4_star goes on, and comes back with it."""
        history = rng.normal(size=(34, 2, 256))
        history[20:30] *= 3.0
        found = condition_indicators(history, self.settings)
        signals = separate(history, self.settings)
        nominal = np.r_[0:20, 30:34]
        for last in (19, 25, 33):
            before = nominal[nominal <= last]
            residual = signals.residual[before].var(axis=-1).mean(axis=0)
            difference = signals.difference[before].var(axis=-1).mean(axis=0)
            r, d = signals.residual[last], signals.difference[last]
            assert found['na4_star'][last] == pytest.approx((r**4).mean(axis=-1) / residual**2)
            assert found['m6a_star'][last] == pytest.approx((d**6).mean(axis=-1) / difference**3)
            assert found['m8a_star'][last] == pytest.approx((d**8).mean(axis=-1) / difference**4)
        assert np.all(found['na4'][29] < 0.5 * found['na4'][20])
        assert np.all(found['na4_star'][29] > 0.5 * found['na4_star'][20])

    def test_nb4_is_that_of_the_envelope_of_the_mesh(self):
        """A cosine modulated by m cos(theta): its envelope 1 + m cos has the kurtosis 1.5."""
        healthy = cosines(512, {20: 1.0, 3: 0.5})
        angle = 2.0 * np.pi * np.arange(512) / 512
        tone = np.cos(20 * angle) * (1.0 + 0.3 * np.cos(angle)) + healthy - cosines(512, {20: 1.0})
        deeper = np.cos(20 * angle) * (1.0 + 0.6 * np.cos(angle))
        found = condition_indicators(
            np.stack((tone, deeper))[:, None], GearSettings([20, 40], sidebands=1))['nb4'][:, 0]
        assert found[0] == pytest.approx(1.5, rel=1e-9)
        assert found[1] == pytest.approx(1.5 * 0.6**4 / (0.5 * (0.3**2 + 0.6**2))**2, rel=1e-9)

    def test_an_average_that_is_nothing_beside_earlier_ones_has_no_na4(self, rng):
        history = rng.normal(size=(5, 2, 256)) * np.array([1e60, 1e60, 1e60, 1e60, 1e-60])[
            :, None, None]
        assert np.all(condition_indicators(history, self.settings)['na4'][-1] == 0.0)

    def test_na4_follows_the_level_where_kurtosis_does_not(self, rng):
        average = rng.normal(size=(1, 256))
        found = condition_indicators(np.stack([average, average, 3.0 * average]), self.settings)
        assert found['na4'][1, 0] == pytest.approx(found['na4'][0, 0])
        assert found['na4'][2, 0] == pytest.approx(found['na4'][0, 0] * 81 / (11 / 3)**2)
        assert found['fm4'][2, 0] == pytest.approx(found['fm4'][0, 0])

    def test_running_equals_batch(self, rng):
        history = rng.normal(size=(7, 3, 100))
        batch = condition_indicators(history, self.settings)
        running = RunningIndicators(self.settings)
        for count, average in enumerate(history, start=1):
            running.update(average)
            assert running.get().averages == count
            assert running.get().values == pytest.approx(batch.values[count - 1], rel=1e-13)
        assert batch.averages == 7

    @pytest.mark.parametrize('value', [np.nan, np.inf])
    def test_channel_without_samples_costs_the_others_nothing(self, rng, value):
        history = rng.normal(size=(12, 3, 100))
        running, clean, other = (RunningIndicators(self.settings) for _ in range(3))
        for number, average in enumerate(history):
            lost = number % 4 == 1
            clean.update(average[:2])
            if not lost:
                other.update(average[2:])
            running.update(np.where([[False], [False], [lost]], value, average))
            values = running.get().values
            assert values[:2] == pytest.approx(clean.get().values, rel=1e-12)
            assert np.isnan(values[2]).all() if lost else values[2:] == pytest.approx(
                other.get().values, rel=1e-12)

    def test_before_the_first_average_there_is_no_channel(self):
        latest = RunningIndicators().get()
        assert latest.values.shape == (0, len(INDICATORS))
        assert latest.averages == 0

    def test_a_refused_average_leaves_the_history_alone(self, rng):
        running = RunningIndicators(self.settings)
        running.update(rng.normal(size=(2, 64)))
        before = running.get()
        for bad in (np.ones((3, 64)), np.ones(64), np.full((2, 64), np.nan)):
            with pytest.raises(SignalError):
                running.update(bad)
        assert running.get() is before
        average = rng.normal(size=(2, 64))
        running.update(average)
        assert running.get().averages == 2


class TestOffset:

    def test_an_offset_changes_nothing(self, rng):
        """As that of gravity in the channel of an Imu."""
        average = rng.normal(size=(2, 128)) + cosines(128, {19: 2.0})
        found = condition_indicators(average, GearSettings([19]))
        with_gravity = condition_indicators(average + 9.81, GearSettings([19]))
        assert with_gravity.values == pytest.approx(found.values, rel=1e-9)


class TestStandardErrors:

    @pytest.mark.machines
    @pytest.mark.parametrize(('noise', 'damage'), [
        (0.1, 0.0), (1.0, 0.0), (0.1, 0.5), (0.02, 0.5)])
    def test_they_hold(self, rng, noise, damage):
        """Of averages of parts of different size, from the ninth average on, with an offset."""
        points, channels = 512, 250
        counts = np.array([13.0, 14.0, 13.0])
        wave = 3.0 + cosines(points, {19: 1.0, 38: 0.5, 18: 0.1, 20: 0.05, 1: 0.2})
        theta = 2.0 * np.pi * np.arange(points) / points
        wave = wave + damage * np.exp(-0.5 * ((theta - 3.0) / 0.1) ** 2) * np.cos(60.0 * theta)
        running = RunningIndicators(GearSettings([19]))
        z = []
        for count in range(1, 12):
            parts = wave + noise * rng.standard_normal((3, channels, points)) / np.sqrt(
                counts[:, None, None])
            running.update(np.tensordot(counts / counts.sum(), parts, axes=1),
                           WaveformParts(counts, parts))
            latest = running.get()
            if count >= 9:
                z.append((latest.values - latest.values.mean(axis=0)) / latest.standard_errors)
        for width, wanted in ((1.0, 0.683), (1.96, 0.95)):
            found = dict(zip(INDICATORS, np.mean(np.abs(z) < width, axis=(0, 1))))
            limit = 0.03 + 3.0 * np.sqrt(wanted * (1.0 - wanted) / (3 * channels))
            for name in INDICATORS:
                assert found[name] == pytest.approx(wanted, abs=limit), name

    def test_a_change_has_an_error_of_its_own_size(self, rng):
        """The value before it makes the relative error of a value by chance, not of a change."""
        running, points = RunningIndicators(), 512
        wave = cosines(points, {19: 1.0})
        for size in (*[1.0] * 8, 10.0):
            parts = size * (wave + 0.1 * rng.standard_normal((3, 40, points)))
            running.update(parts.mean(axis=0), WaveformParts(np.ones(3), parts))
            if size == 1.0:
                before = running.get()
        relative = [np.median(item.standard_errors[:, 0] / item['rms'])
                    for item in (before, running.get())]
        assert relative[1] == pytest.approx(relative[0], rel=0.2)

    def test_a_channel_of_zeros_has_none_and_warns_of_nothing(self, recwarn):
        running, parts = RunningIndicators(GearSettings([19])), np.zeros((3, 1, 64))
        for _ in range(2):
            running.update(parts[0], WaveformParts(np.ones(3), parts))
        assert np.isnan(running.get().standard_errors).all()
        assert not list(recwarn)

    def test_without_parts_there_are_none(self, rng):
        running = RunningIndicators()
        running.update(rng.normal(size=(1, 64)))
        assert np.isnan(running.get().standard_errors).all()

    @pytest.mark.parametrize('cycles', [7, 40, 1 << 60])
    def test_an_average_has_parts_of_its_cycles(self, rng, cycles):
        """Their mean is that of all; without a number of cycles they are of any size."""
        settings = AverageSettings(trigger_cycles=cycles)
        averager = StreamingAverager(
            {'shaft': settings}, validator=PulseValidator(), keep_unfinished=True,
            timeline=VibrationTimeline(buffer_seconds=100.0))
        averager.add_pulses(np.arange(60) / 10.0)
        found = averager.add_samples(SampleBlock(rng.normal(size=(2, 6000)), 0.0, 1000.0, 0))
        found += averager.finish()
        assert found
        for _, average in found:
            if average.trigger_cycles < min(cycles, 59):  # an unfinished block
                continue
            parts = average.parts
            assert parts.counts.sum() == average.fundamental_cycles
            assert parts.counts.max() <= 2 * parts.counts.min()
            mean = np.tensordot(parts.counts / parts.counts.sum(), parts.waveforms, axes=1)
            assert mean == pytest.approx(average.waveform, abs=1e-12)
            assert parts.without_one(average.waveform)[0] == pytest.approx(np.average(
                parts.waveforms[1:], axis=0, weights=parts.counts[1:]), abs=1e-12)


class TestBadInput:

    @pytest.mark.parametrize('order', [0, -19, 19.5, np.nan, np.inf])
    def test_mesh_orders_are_positive_integers(self, order):
        with pytest.raises(ParameterError, match='positive integer'):
            GearSettings([order])

    @pytest.mark.parametrize('count', [-1, 1.5, np.nan])
    @pytest.mark.parametrize('name', ['sidebands', 'shaft_harmonics'])
    def test_counts_are_whole_numbers(self, name, count):
        with pytest.raises(ParameterError, match=name):
            GearSettings([19], **{name: count})

    @pytest.mark.parametrize('order', [32, 33, 100])
    def test_mesh_orders_lie_below_the_nyquist_order(self, order):
        with pytest.raises(ParameterError, match='Nyquist order 32'):
            condition_indicators(np.ones((1, 64)), GearSettings([order]))

    @pytest.mark.parametrize('shape', [(), (64,), (2, 1), (2, 0), (0, 2, 64), (1, 2, 3, 4)])
    def test_wrong_shapes_are_refused(self, shape):
        with pytest.raises(SignalError, match='shape'):
            condition_indicators(np.ones(shape))

    @pytest.mark.parametrize('value', [np.nan, np.inf, 1e120])
    def test_samples_are_finite_and_of_this_world(self, value):
        average = np.ones((2, 64))
        average[1, 5] = value
        with pytest.raises(SignalError, match='finite'):
            condition_indicators(average, GearSettings([19]))
