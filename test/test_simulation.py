# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The simulated gearbox: exact at the true angle, whatever the block size."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.simulation import (
    AdditiveNoise, band_limited, ChippedTooth, Component, DeclaredJitter, Gearbox, Keyphasor,
    make_effects, mesh, Motion, Torsion)
from sa_jitter_ros.simulation.random_streams import RandomStream

RATE = 20_000.0


def machine(**options):
    """Return a machine with two shafts, sidebands, fluctuation and torsion."""
    defaults = {
        'sample_rate': RATE, 'shafts': {'input': 1.0, 'output': 23 / 47},
        'components': (*mesh('input', 23, channel_gains=(1.0, 0.4), sidebands={1.0: 0.2}),
                       Component('output', 3.5, (0.3, 0.1), (0.1, -2.0))),
        'speed': ((0.0, 20.0), (3.0, 35.0)), 'torsion': (Torsion(2.0, 0.01, 0.3),),
        'fluctuation': band_limited(std=2e-3, band=(0.5, 10.0), seed=4, name='speed'),
        'keyphasor': Keyphasor(pulses_per_revolution=3, rate=30_000.0)}
    return Gearbox(**{**defaults, **options})


EVERYTHING = make_effects({
    'excess_jitter': {'std': 2e-6}, 'correlated_jitter': {'std': 2e-6, 'correlation': 0.5},
    'target_geometry': {'pulse_angles': (0.0, 0.001, -0.002)}, 'clock_skew': {'skew': 1e-4},
    'keyphasor_quantisation': {'clock_rate': 1e5, 'period_std': 1e-5},
    'missing_pulses': {'probability': 0.1}, 'speed_fluctuation': {'acceleration_std': 0.5},
    'phase_wander': {'std': 0.01}, 'amplitude_modulation': {'std': 0.1},
    'interpolation_loss': {'method': 'spline'}, 'additive_noise': {'std': 0.3},
    'interfering_tone': {'frequency': 123.4, 'amplitude': 0.2}})


# --- motion -------------------------------------------------------------------------------------

MOTIONS = {
    'constant': Motion(((0.0, 25.0),), start_angle=-0.25),
    'ramps': Motion(((0.0, 10.0), (1.0, 40.0), (2.5, 5.0))),
    'from rest': Motion(((0.0, 0.0), (2.0, 50.0))),
    'stop and go': Motion(((0.0, 30.0), (1.0, 0.0), (2.0, 0.0), (3.0, 30.0))),
    'torsion': Motion(((0.0, 25.0),), torsion=(Torsion(2, 0.15, 1.0), Torsion(5.5, 0.03))),
    'all': Motion(((0.0, 10.0), (1.0, 40.0)), torsion=(Torsion(3, 0.15),), start_angle=-0.25,
                  fluctuation=band_limited(std=0.04, band=(0.5, 40.0), seed=1, name='x')),
}


@pytest.mark.parametrize('name', MOTIONS)
def test_time_and_angle_are_inverse(name):
    motion = MOTIONS[name]
    times = np.linspace(1e-3, 5.0, 9973)
    if name == 'stop and go':
        times = times[(times < 0.99) | (times > 2.01)]
    np.testing.assert_allclose(motion.time_at(motion.angle(times)), times, rtol=0, atol=3e-13)


@pytest.mark.parametrize('name', MOTIONS)
def test_speed_is_the_derivative_of_the_angle(name):
    motion, step = MOTIONS[name], 3e-7
    times = np.linspace(0.0017, 4.0, 1009)
    slope = (motion.angle(times + step) - motion.angle(times - step)) / (2 * step)
    np.testing.assert_allclose(motion.speed(times), slope, rtol=0, atol=1e-6)


def test_fluctuation_has_its_standard_deviation_and_band():
    fluctuation = band_limited(std=0.7, band=(2.0, 8.0), seed=3, name='x')
    # The lines of a sum beat: over T the variance is known to about 1/(T x line spacing).
    values = fluctuation.value(np.arange(0, 4000.0, 0.05))
    assert np.std(values) == pytest.approx(0.7, rel=0.01)
    power = np.abs(np.fft.rfft(values * np.hanning(values.size)))**2
    frequencies = np.fft.rfftfreq(values.size, 0.05)
    outside = (frequencies < 1.99) | (frequencies > 8.01)
    assert power[outside].sum() < 1e-6 * power.sum()


@pytest.mark.parametrize(('make', 'message'), [
    (lambda: Motion(((0.0, -1.0),)), 'must not be negative'),
    (lambda: Motion(((0.0, 1.0), (1.0, 0.0))), 'nor the last one 0'),
    (lambda: Motion(((1.0, 1.0),)), 'must increase from 0'),
    (lambda: Motion(((0.0, 1.0), (0.0, 2.0))), 'must increase from 0'),
    (lambda: Motion(((0.0, np.nan),)), 'pairs of time'),
    (lambda: Motion((0.0, 25.0)), 'pairs of time'),
    (lambda: Motion(((0.0, 9.0),), torsion=(Torsion(4, 0.2),)), 'changes the speed by up to 0.8'),
    (lambda: machine(fluctuation=band_limited(std=0.2, band=(1, 2), seed=0, name='x')),
     'fluctuation may reach'),
    (lambda: band_limited(std=1.0, band=(2.0, 1.0), seed=0, name='x'), '0 <= low < high'),
    (lambda: band_limited(std=-1.0, band=(1.0, 2.0), seed=0, name='x'), 'at least 0'),
    (lambda: machine(sample_rate=0.0), 'sample_rate 0.0: must be finite and above 0'),
    (lambda: machine(shafts={'input': 1.0}), "no shaft 'output'"),
    (lambda: machine(shafts={'input': 1.0, 'output': 0.0}), 'ratio of shaft output 0.0'),
    (lambda: machine(components=(Component('input', 1.0, (1.0,), (0.0, 0.0)),)), '1, 2. channels'),
    (lambda: machine(components=()), 'channels'),
    (lambda: ChippedTooth('a', 2.5, (1.0,)), 'whole number'),
    (lambda: ChippedTooth('a', 2, (1.0,), width=0.5), 'at most 0.15'),
    (lambda: Keyphasor(pulses_per_revolution=0), 'pulses_per_revolution 0'),
    (lambda: Keyphasor(waveform='square'), "'square'"),
    (lambda: Keyphasor(duty=0.7), 'below 0.6'),
    (lambda: machine().vibration(-1, 5), 'samples -1 to 5'),
])
def test_what_cannot_be_is_refused(make, message):
    with pytest.raises(ParameterError, match=message):
        make()


# --- block independence -------------------------------------------------------------------------

@pytest.fixture(scope='module')
def everything():
    """Return a machine with all effects, and its signals read at once."""
    options = {'effects': (DeclaredJitter('normal', 1e-6), *EVERYTHING), 'seed': 7}
    whole = machine(**options)
    return (machine(**options), whole.vibration(0, 9000), whole.tach_waveform(0, 9000),
            whole.pulses(0.0, 9000 / RATE))


@pytest.mark.machines
@settings(max_examples=9)
@given(cuts=st.lists(st.integers(0, 9000), max_size=6))
def test_signals_do_not_depend_on_the_cuts(everything, cuts):
    cut, vibration, waveform, wanted = everything
    edges = [0, *sorted(cuts), 9000]
    pairs = list(pairwise(edges))
    for read, whole in ((cut.vibration, vibration), (cut.tach_waveform, waveform)):
        pieces = [read(*pair) for pair in pairs]
        np.testing.assert_array_equal(np.concatenate(pieces, axis=-1), whole)
    pieces = [cut.pulses(start / RATE, stop / RATE) for start, stop in pairs]
    for name in ('index', 'times', 'true_times'):
        np.testing.assert_array_equal(np.concatenate([getattr(piece, name) for piece in pieces]),
                                      getattr(wanted, name))


def test_blocks_cover_the_machine():
    blocks = list(machine(seed=1).blocks(10_000, 777))
    assert {block.shape for block in blocks[:-1]} == {(2, 777)}
    np.testing.assert_array_equal(np.concatenate(blocks, axis=1), machine().vibration(0, 10_000))


def test_seeds_repeat_and_differ():
    noisy = [machine(effects=(AdditiveNoise(1.0),), seed=seed).vibration(0, 100)
             for seed in (1, 1, 2)]
    np.testing.assert_array_equal(noisy[0], noisy[1])
    assert np.abs(noisy[0] - noisy[2]).min() > 0


def test_streams_are_independent_of_each_other_and_white():
    first, second = (RandomStream(1, name).normal(-50_000, 50_000)[0] for name in 'ab')
    limit = 4 / np.sqrt(first.size)
    assert abs(np.mean(first * second)) < limit
    assert max(abs(np.mean(first[k:] * first[:-k])) for k in (1, 2, 1023, 1024, 1025)) < limit


# --- truth --------------------------------------------------------------------------------------

def projected(values, cycles):
    """Return the complex peak amplitude of a component by least squares on its true phase."""
    basis = np.stack([np.cos(2 * np.pi * cycles), -np.sin(2 * np.pi * cycles)])
    return np.linalg.lstsq(basis.T, values, rcond=None)[0] @ [1, 1j]


def test_amplitudes_are_the_true_ones_at_the_true_angle():
    tooth = ChippedTooth('input', 23, (-0.5, -0.2), width=0.03, place=0.3)
    gearbox = machine(components=(*mesh('input', 23, channel_gains=(1.0, 0.4), seed=2),),
                      faults=(tooth,))
    # Even steps of the angle over whole revolutions make all orders orthogonal.
    angles = np.arange(40 * 512) / 512
    signal = gearbox._signal(gearbox.setting.motion.time_at(angles))
    for order in (0, 1, 20, 23, 24, 46, 69):
        twin = 1 if order == 0 else 2
        got = twin * np.mean(signal * np.exp(-2j * np.pi * order * angles), axis=1)
        np.testing.assert_allclose(got, gearbox.amplitude(order, 'input'), rtol=0, atol=1e-9)
    np.testing.assert_allclose(gearbox.amplitude(47, 'output'), gearbox.amplitude(23, 'input'))


def test_components_of_several_shafts_are_found_in_the_samples():
    gearbox = machine()
    samples = gearbox.vibration(0, 60_000)
    times = np.arange(60_000) / RATE
    orders = [(item.order, item.shaft) for item in gearbox.components]
    cycles = np.array([order * gearbox.angle(times, shaft) for order, shaft in orders])
    basis = np.concatenate([np.cos(2 * np.pi * cycles), -np.sin(2 * np.pi * cycles)])
    solution, residual, *_ = np.linalg.lstsq(basis.T, samples.T, rcond=None)
    count = len(orders)
    np.testing.assert_allclose(residual, 0, atol=1e-12)
    for k, (order, shaft) in enumerate(orders):
        np.testing.assert_allclose(solution[k] + 1j * solution[count + k],
                                   gearbox.amplitude(order, shaft), atol=1e-8)


def test_ideal_pulses_are_the_true_ones():
    gearbox = machine()
    pulses = gearbox.pulses(0.0, 2.0)
    np.testing.assert_array_equal(pulses.errors, 0)
    np.testing.assert_array_equal(pulses.index, np.arange(pulses.index.size))
    np.testing.assert_allclose(3 * gearbox.angle(pulses.times), pulses.index, rtol=0, atol=1e-10)
    assert 3 * gearbox.angle(np.array([2.0]))[0] == pytest.approx(pulses.index[-1] + 0.5, abs=0.5)
    np.testing.assert_allclose(gearbox.shaft_speed(pulses.times, 'output'),
                               23 / 47 * gearbox.shaft_speed(pulses.times))


# --- keyphasor waveform -------------------------------------------------------------------------

def crossings(waveform, rate, level):
    """Return the times at which a waveform rises through a level, by linear interpolation."""
    at = np.flatnonzero((waveform[:-1] < level) & (waveform[1:] >= level))
    return (at + (level - waveform[at]) / (waveform[at + 1] - waveform[at])) / rate


@pytest.mark.parametrize('effects', [(), EVERYTHING], ids=['ideal', 'everything'])
def test_ttl_edges_lie_at_the_measured_pulses(effects):
    # The edge spans six samples; its slope follows the speed, which moves by less than 1e-4 in it.
    keyphasor = Keyphasor(pulses_per_revolution=3, rate=30_000.0, rise_time=2e-4, low=-1.0)
    gearbox = machine(keyphasor=keyphasor, effects=effects, seed=3)
    times = crossings(gearbox.tach_waveform(0, 60_000), 30_000.0, 2.0)
    wanted = gearbox.pulses(0.0, times[-1] + 1e-3).times
    assert (times.size < gearbox.pulses(0.0, 2.0).index[-1] + 1) == bool(effects)
    np.testing.assert_allclose(times, wanted, rtol=0, atol=1e-7)


def test_ttl_without_rise_time_is_the_sampled_keyphasor():
    gearbox = machine()
    waveform = gearbox.tach_waveform(0, 60_000)
    assert set(waveform) == {0.0, 5.0}
    high = np.flatnonzero(np.diff(waveform) > 0) + 1
    pulses = gearbox.pulses(0.0, 2.0).times
    np.testing.assert_array_equal(high, np.ceil(pulses * 30_000.0))
    assert np.mean(waveform > 2.5) == pytest.approx(0.2, abs=0.01)


def test_sine_rises_through_its_middle_at_the_pulses():
    keyphasor = Keyphasor(pulses_per_revolution=8, rate=100_000.0, waveform='sine', low=-1, high=1)
    gearbox = machine(keyphasor=keyphasor, effects=(DeclaredJitter('normal', 1e-5),))
    times = crossings(gearbox.tach_waveform(0, 100_000), 100_000.0, 0.0)
    # At a pulse the line between the errors bends, by at most 16 std over a period of 5.6 ms; a
    # chord of 10 us across the bend is off by a quarter of that.
    np.testing.assert_allclose(times, gearbox.pulses(0.0, times[-1] + 1e-3).times, rtol=0,
                               atol=1e-5 * 16e-5 / 5.6e-3 / 4)


def test_waveform_noise_is_white_with_its_standard_deviation():
    quiet, noisy = (machine(keyphasor=Keyphasor(rate=RATE, noise_std=std)) for std in (0.0, 0.2))
    noise = noisy.tach_waveform(0, 40_000) - quiet.tach_waveform(0, 40_000)
    assert np.std(noise) == pytest.approx(0.2, rel=4 / np.sqrt(2 * noise.size))
    assert abs(np.mean(noise[1:] * noise[:-1])) < 4 * 0.04 / np.sqrt(noise.size)
