# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
What the vibration says of the pulses: their errors, and how phases turn with the speed.

The chain that users start averages the vibration with what was found of the keyphasor. Pulse
errors that it recovers contain slow jitter, which pulses alone do not show. A delay of the tach
turns every order by the same time, a resonance does not.
"""

from collections.abc import Sequence
import math
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.averaging.average import Average
from sa_jitter_ros.averaging.averager import Averager
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.keyphasor_check.jitter import Jitter
from sa_jitter_ros.keyphasor_check.result import Checked
from scipy import special

_FEWEST_AVERAGES = 3
_FEWEST_SPEEDS = 6
_SPEED_RANGE = 0.02  # relative, below which phases say nothing of a delay
_AGREE = 0.01  # p value below which orders disagree
_CLEAR = 5.0  # amplitude over its noise
#: the delay that a steady speed tells
UNCHANGED = Checked(None, None, 's', (), 'the speed hardly changes: record a run-up or several '
                    'speeds')


def averages_of(samples: FloatArray, rate: float, pulses: FloatArray, *, correct_jitter: bool,
                **options: Any) -> tuple[Average, ...]:
    """
    Return averages of samples (channel, sample) with corrected jitter; none if it fails.

    Without the correction the angle law is the spline, which follows a changing speed. The other
    `options` are those of `Averager`.
    """
    try:
        averager = Averager(rate, correct_jitter=correct_jitter,
                            angle_law='linear' if correct_jitter else 'spline', **options)
        return averager.update(samples, pulses) + averager.flush()
    except SaJitterError:
        return ()


def recovered_jitter(averages: Sequence[Average]) -> Jitter | None:
    """Return the jitter that averages recovered; None where too few did."""
    good = [item.correction for item in averages
            if item.correction is not None and item.correction.accepted]
    if len(good) < _FEWEST_AVERAGES or 2 * len(good) < len(averages):
        return None
    power, products, count = [], [], 0
    for item in good:
        errors, noise = item.pulse_errors, float(np.mean(item.standard_errors**2))
        n = errors.size
        # The mean of each average is not known.
        power.append((float(np.mean(errors**2)) - noise) * n / (n - 1.0))
        products.append(float(np.mean(errors[1:] * errors[:-1])) + power[-1] / n)
        count += n
    variance = float(np.mean(power))
    noise = float(np.mean([np.mean(item.standard_errors**2) for item in good]))
    if not variance > 0.25 * noise:
        return None
    std = math.sqrt(variance)
    error = float(np.std(power, ddof=1)) / math.sqrt(len(power)) / (2.0 * std)
    correlation = float(np.clip(np.mean(products) / variance, -1.0, 1.0))
    return Jitter(std, max(error, std / math.sqrt(2.0 * count)), correlation,
                  1.0 / math.sqrt(count))


def path_delay(averages: Sequence[Average], ratio: float) -> Checked:
    """
    Return the delay (s) of the tach behind the vibration, from the phases of orders.

    The phase of order g of a shaft that turns at frequency f advances by 2 pi g f times the delay.
    """
    if not averages:
        return _unknown('no averages of the vibration')
    if len(averages) < _FEWEST_SPEEDS:
        return _unknown('too few averages of the vibration: record longer')
    speeds = np.array([item.trigger_speed for item in averages])
    if is_steady(speeds):
        return UNCHANGED
    amplitudes = np.array([item.amplitudes for item in averages])
    noise = np.array([item.noise for item in averages])
    size = np.abs(amplitudes)
    # An order that was refused in one of the averages has no amplitude there: it is not clear.
    clear = np.nan_to_num(np.divide(
        size, noise, out=np.where(size > 0.0, np.inf, 0.0), where=noise != 0.0),
        posinf=np.inf).min(axis=0)
    found, errors, turned = [], [], []
    centred = speeds - speeds.mean()
    for place, order in enumerate(averages[0].orders):
        channel = int(np.argmax(clear[:, place]))
        if not clear[channel, place] > _CLEAR:
            continue
        angle = np.unwrap(np.angle(amplitudes[:, channel, place])) / (
            2.0 * math.pi * order * ratio)
        slope, error, left = _slope(centred, angle)
        if np.abs(left).max() < 0.25 / (order * ratio):
            found.append(slope)
            errors.append(max(error, 1e-15))
            turned.append(angle)
    if len(found) < 2:
        return _unknown('fewer than two orders stand clear of their noise at all speeds')
    weight = 1.0 / np.array(errors) ** 2
    # Pulse errors turn all orders at once: the orders are not independent of each other.
    mean, error, _ = _slope(centred, weight @ np.array(turned) / weight.sum())
    chi2 = float(((np.array(found) - mean) ** 2) @ weight)
    if special.chdtrc(len(found) - 1, chi2) < _AGREE:
        return _unknown('the orders turn differently with the speed, as resonances make them: tap '
                        'the sensor, or compare with a second tach at the vibration input')
    return Checked(mean, error, 's', (), 'phases of the orders turn alike with the speed')


def is_steady(speeds: FloatArray) -> bool:
    """Return whether speeds (n,) in Hz change so little that phases say nothing of a delay."""
    return bool(np.ptp(speeds) < _SPEED_RANGE * speeds.mean())


def _unknown(why: str) -> Checked:
    return Checked(None, None, 's', (), why)


def _slope(centred: FloatArray, values: FloatArray) -> tuple[float, float, FloatArray]:
    """Return the slope of values (n,) over centred places, its error, and what is left."""
    power = float(centred @ centred)
    slope = float(centred @ values) / power
    left = values - values.mean() - slope * centred
    return slope, float(np.sqrt(left @ left / (values.size - 2) / power)), left
