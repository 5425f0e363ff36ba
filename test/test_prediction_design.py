# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The design: limits kept with the least, interfering components in notches, changes detected."""

from dataclasses import fields, replace
import doctest

import numpy as np
import pytest
from sa_jitter_ros.errors import ModelError, ParameterError
from sa_jitter_ros.prediction import design as module
from sa_jitter_ros.prediction.comb import order_share
from sa_jitter_ros.prediction.design import (
    design, design_grid, detection_probability, loss_and_variation, required_keyphasor_rate,
    required_trigger_cycles)
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict
from validation.monte_carlo import AveragedSignal, monte_carlo

MODEL = DeclaredModel(keyphasor_rate=5000.0, trigger_speed=20.0, trigger_cycles=41,
                      orders=(1.0, 19.0, 38.0), ratio=2.40789)
BENCH = {'orders': [19, 38], 'trigger_speed': 41.5, 'ratio': 2.40789}


def loss(model):
    """Return the loss of each order."""
    return loss_and_variation(model)[0]


def variation(model, **changes):
    """Return the coefficient of variation of the highest order of a changed model."""
    return loss_and_variation(replace(model, **changes))[1][-1]


# --- the library ---


def test_the_example_of_the_docstring():
    assert doctest.testmod(module).failed == 0


def test_chosen_settings_are_the_smallest_that_keep_both_limits():
    found = design(**BENCH, maximum_loss=0.03, maximum_variation=0.01, noise_std=0.5,
                   sample_rate=5e4)
    assert found.loss.max() <= 0.03 < loss(replace(found.model, keyphasor_rate=0.999
                                                   * found.keyphasor_rate)).max()
    assert found.variation.max() <= 0.01 < variation(
        found.model, trigger_cycles=found.trigger_cycles - 1)
    assert found.orders.tolist() == [19.0, 38.0]
    assert found.leakage is None
    assert found.detection is None
    assert float(f'{found.keyphasor_rate:.4g}') == found.keyphasor_rate


def test_given_settings_are_assessed():
    found = design(**BENCH, keyphasor_rate=5000.0, trigger_cycles=41, pulses_per_revolution=6)
    assert (found.keyphasor_rate, found.trigger_cycles) == (5000.0, 41)
    expected = loss_and_variation(replace(
        MODEL, trigger_speed=41.5, orders=(19.0, 38.0), pulses_per_revolution=6))
    np.testing.assert_array_equal([found.loss, found.variation], expected)


def test_results_are_frozen():
    found = design(**BENCH)
    for item in fields(found):
        with pytest.raises(AttributeError):
            setattr(found, item.name, None)


def test_interfering_components_move_the_number_of_cycles_and_never_below_the_limits():
    limits = {'maximum_loss': 0.03, 'maximum_variation': 0.01, 'noise_std': 0.5,
              'sample_rate': 5e4}
    needed = design(**BENCH, **limits).trigger_cycles
    found = design(**BENCH, **limits, others=[45 / 2.40789], tones=[50.0, 1880.0])
    leakage = found.leakage
    assert needed < found.trigger_cycles == leakage.trigger_cycles <= 2 * needed + 20
    assert leakage.candidates[0] == needed
    speed = 41.5 * 2.40789
    np.testing.assert_allclose(leakage.orders, [45 / 2.40789, 50.0 / speed, 1880.0 / speed])
    np.testing.assert_array_equal(leakage.share, order_share(
        leakage.orders[:, None], [19.0, 38.0], found.trigger_cycles * 2.40789))
    at_needed = leakage.largest_share[0]
    assert leakage.share.max() < 0.3 * at_needed
    assert found.variation.max() <= 0.01


def test_given_cycles_stay_and_the_better_ones_around_them_are_named():
    found = design(**BENCH, trigger_cycles=33, others=[45 / 2.40789])
    assert found.trigger_cycles == found.leakage.trigger_cycles == 33
    assert (found.leakage.candidates[0], found.leakage.candidates[-1]) == (1, 66)
    assert set(found.leakage.best(9) % 4) == {0}  # 4 x 19 x 2.40789 and 4 x 45 are nearly whole


def test_a_change_is_detected_with_the_probability_of_one_average():
    found = design(**BENCH, change=-0.05, false_alarm_rate=0.02)
    np.testing.assert_array_equal(
        found.detection, detection_probability(found.model, -0.05, 0.02)[:, 0])
    assert found.detection[0] > found.detection[1]  # jitter hides more of the higher order


@pytest.mark.parametrize(('changes', 'error', 'message'), [
    ({'maximum_loss': 0.0}, ParameterError, 'maximum_loss is 0.0: give a fraction'),
    ({'maximum_variation': 1.0}, ParameterError, 'maximum_variation is 1.0'),
    ({'maximum_loss': float('nan')}, ParameterError, 'maximum_loss is nan'),
    ({'orders': []}, ModelError, 'orders'),
    ({'keyphasor_rate': 30.0}, ModelError, 'pulses could swap'),
    ({'trigger_cycles': 3.7}, ModelError, 'trigger_cycles is 3.7'),
    ({'jitter_distribution': 'table'}, ParameterError, 'choose one of uniform, normal, triang'),
    ({'noise_std': 5e4, 'sample_rate': 5e4}, ModelError, 'more than 1000000 trigger cycles'),
    ({'change': 0.1}, ParameterError, 'change is given without false_alarm_rate'),
    ({'false_alarm_rate': 0.1}, ParameterError, 'false_alarm_rate is given without change'),
    ({'change': 0.0, 'false_alarm_rate': 0.1}, ParameterError, 'change is 0'),
    ({'change': -2.0, 'false_alarm_rate': 0.1}, ParameterError, 'change is -2: give'),
    ({'change': float('nan'), 'false_alarm_rate': 0.1}, ParameterError, 'change is nan'),
    ({'change': 0.1, 'false_alarm_rate': 1.0}, ParameterError, 'false_alarm_rate is 1.0'),
    ({'others': [38.0]}, ParameterError, 'order 38 is synchronous with a monitored order'),
    ({'tones': [19 * 41.5 * 2.40789]}, ParameterError, 'order 19 is synchronous'),
    ({'tones': [0.0]}, ParameterError, 'tones hold 0 Hz'),
    ({'others': [-1.0]}, ParameterError, 'others hold -1: give finite'),
    ({'tones': [3000.0], 'orders': [19], 'sample_rate': 5000.0}, ParameterError,
     'of 3000 Hz is above half the sample_rate of 5000 Hz'),
])
def test_bad_questions_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        design(**{**BENCH, **changes})


# --- its parts ---


@pytest.mark.parametrize('name', ['uniform', 'normal', 'triangular'])
def test_required_keyphasor_rate_meets_the_limit_and_no_lower_one_does(name):
    model = replace(MODEL, jitter_distribution=name)
    for limit in (1e-4, 0.02, 0.5):
        rate = required_keyphasor_rate(model, limit)
        assert loss(replace(model, keyphasor_rate=rate)).max() == pytest.approx(limit, rel=1e-6)
        assert loss(replace(model, keyphasor_rate=0.9 * rate)).max() > limit
    rates = [required_keyphasor_rate(replace(model, orders=(g,)), 0.02) for g in (10.0, 20.0)]
    assert rates[1] == pytest.approx(2.0 * rates[0], rel=1e-6)


def test_required_rate_never_lets_pulses_swap():
    model = replace(MODEL, ratio=0.01, orders=(1.0,))
    rate = required_keyphasor_rate(model, 0.5)
    assert rate == pytest.approx(20.0, rel=1e-3)
    assert loss(replace(model, keyphasor_rate=rate))[0] < 0.5


@pytest.mark.machines
@pytest.mark.parametrize('changes', [{}, {'noise_std': 1.0, 'sample_rate': 5e4}])
def test_required_cycles_are_the_fewest_from_which_on_the_limit_holds(changes):
    model = replace(MODEL, orders=(38.0,), **changes)
    for limit in (0.06, 0.05, 0.02):
        cycles = required_trigger_cycles(model, limit)
        assert variation(model, trigger_cycles=cycles) <= limit
        assert variation(model, trigger_cycles=cycles + 1) <= limit
        assert cycles == 1 or variation(model, trigger_cycles=cycles - 1) > limit


def test_design_grid_holds_the_worst_order():
    grid = design_grid(MODEL, [10.0, 3000.0, 9000.0], [5, 50])
    assert grid.loss.shape == (3, 2)
    assert np.all(np.isnan(grid.loss[0]))
    at = replace(MODEL, keyphasor_rate=9000.0, trigger_cycles=50)
    assert grid.loss[2, 1] == pytest.approx(loss(at)[-1])
    assert grid.variation[2, 1] == pytest.approx(variation(at), rel=1e-6)
    assert np.all(np.diff(grid.loss[1:], axis=0) < 0.0)
    assert np.all(np.diff(grid.variation[1:], axis=1) < 0.0)


# --- detection ---


def simulate(model, order, iterations, seed):
    """Return amplitudes of one order of whole trigger cycles, noise included."""
    averaged = AveragedSignal(model.trigger_cycles, model.cycle_length, order)
    noise = 4.0 * model.noise_std**2 / (model.sample_rate * model.duration)

    class Scaled:
        """The declared distribution in fundamental cycles."""

        def draw(self, rng, shape):
            return model.fundamental_frequency * model.distribution.draw(rng, shape)

    return np.abs(monte_carlo(averaged.whole_trigger_cycles, Scaled(), model.trigger_cycles,
                              iterations, seed=seed, line_variance=noise))


@pytest.mark.parametrize('change', [0.06, -0.1])
def test_detection_agrees_with_simulated_averages(change):
    model = replace(MODEL, orders=(38.0,), noise_std=3.0, sample_rate=5e4)
    healthy = simulate(model, 38.0, 20_000, seed=31)
    ratio = 1.0 + change
    faulty = ratio * simulate(replace(model, noise_std=3.0 / ratio), 38.0, 20_000, seed=32)
    for rate in (0.01, 0.1, 0.5):
        threshold = predict(model).ppf([1.0 - rate if change > 0.0 else rate])[0, 0]
        detected = detection_probability(model, change, rate)[0, 0]
        for draws, expected in ((healthy, rate), (faulty, detected)):
            beyond = np.mean(np.sign(change) * (draws - threshold) > 0.0)
            tolerance = 4.5 * np.sqrt(expected * (1.0 - expected) / draws.size) + 0.004
            assert beyond == pytest.approx(expected, abs=tolerance)


def test_no_change_is_detected_at_the_false_alarm_rate_and_jitter_hides_faults():
    np.testing.assert_allclose(detection_probability(MODEL, 0.0, 0.05), 0.05, atol=1e-6)
    fine, coarse = (detection_probability(replace(MODEL, keyphasor_rate=rate), [0.02, 0.05], 0.05)
                    for rate in (5000.0, 2500.0))
    assert fine.shape == (3, 2)
    assert np.all(np.diff(coarse, axis=0) <= 0.0)
    assert np.all(np.diff(coarse, axis=1) >= 0.0)
    assert np.all(coarse[-1] < fine[-1])
