# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The simulated fleet: its prediction against moments, its noise, one flight against the model."""

import numpy as np
import pytest
from sa_jitter_ros.prediction.angle_error import IndependentPulseJitter
from sa_jitter_ros.prediction.distributions import Uniform
from sa_jitter_ros.prediction.moments import cycle_moments
from validation import fleet


def ignore(done):
    """Take progress and do nothing."""


def test_the_numbers_are_those_of_table_5():
    assert (fleet.TRIGGER_CYCLES, fleet.RATIO, fleet.TEETH, fleet.HELICOPTERS) == (
        21, 5.8154, 23, 14)
    assert fleet.WIDTHS[0] == 0.4


def test_the_prediction_without_noise_has_the_mean_of_the_moments():
    ratios = fleet.predicted_ratios(4000, 0.0, seed=3)
    tick = IndependentPulseJitter(Uniform(fleet.RATIO * 20.0 / 20480.0))
    for w, width in enumerate(fleet.WIDTHS):
        added = IndependentPulseJitter(Uniform(width / fleet.TEETH))
        sizes = []
        for processes in ([tick], [tick, added]):
            moments = cycle_moments([float(fleet.TEETH)], processes).averaged(
                fleet.TRIGGER_CYCLES)
            # the modulus regains half of the variance across the mean
            sizes.append(abs(moments.mean[0])
                         + 0.5 * moments.imag_variance[0] / abs(moments.mean[0]))
        error = ratios[:, w, 0].std() / np.sqrt(len(ratios))
        assert ratios[:, w, 0].mean() == pytest.approx(sizes[1] / sizes[0], abs=4 * error + 1e-3)


def test_both_averages_read_the_same_noise(monkeypatch):
    plain, noisy = (fleet.predicted_ratios(2000, noise, seed=4)[:, 0, 0] for noise in (0.0, 8.0))
    assert noisy.std() > 1.2 * plain.std()
    monkeypatch.setattr(fleet, 'WIDTHS', (1e-6,))
    assert np.abs(fleet.predicted_ratios(100, 8.0, seed=4) - 1.0).max() < 1e-4


def test_a_flight_without_noise_is_that_of_the_model_but_for_the_wander_of_the_speed(monkeypatch):
    measured, modelled = fleet.acquisition(1, 0.0)
    assert measured == pytest.approx(modelled, abs=0.02)
    assert np.all(measured < 1.0)
    assert np.all(measured[0] < measured[1])
    monkeypatch.setattr(fleet, '_SPEED_STD', 1e-9)
    measured, modelled = fleet.acquisition(1, 0.0)
    assert measured == pytest.approx(modelled, abs=1e-3)  # what leaks from sidebands


@pytest.mark.machines
def test_flights_are_shared_out_among_all_helicopters():
    flights = fleet.fly(16, ignore)
    assert [len(item.ratios) for item in flights] == [2, 2] + 12 * [1]
    assert np.unique(np.concatenate([item.ratios[:, 0, 0] for item in flights])).size == 16
