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
Simulated gearboxes whose angle, pulses and amplitudes are known exactly.

>>> from sa_jitter_ros.simulation import ExcessJitter, Gearbox, mesh
>>> gearbox = Gearbox(mesh('output', teeth=19, harmonics=(1.0, 0.5)), sample_rate=20e3,
...                   shafts={'output': 2.5}, speed=[(0.0, 25.0)], seed=1,
...                   effects=[ExcessJitter(std=2e-5)])
>>> vibration = gearbox.vibration(0, 20_000)
>>> vibration.shape
(1, 20000)
>>> pulses = gearbox.pulses(0.0, 1.0)
>>> bool(abs(pulses.errors).max() < 2e-4)
True
>>> abs(gearbox.amplitude(38.0, 'output'))
array([0.5])
"""

from sa_jitter_ros.simulation.components import ChippedTooth, Component, mesh
from sa_jitter_ros.simulation.effect import Effect, Setting
from sa_jitter_ros.simulation.effects import (
    AdditiveNoise, AmplitudeModulation, ClockSkew, CorrelatedJitter, DeclaredJitter, EFFECTS,
    ExcessJitter, InterferingTone, InterpolationLoss, JitterScale, KeyphasorQuantisation,
    make_effects, MissingPulses, PathDelay, PhaseWander, SpeedFluctuation, TargetGeometry)
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.keyphasor import Keyphasor, Pulses
from sa_jitter_ros.simulation.motion import Motion, Torsion
from sa_jitter_ros.simulation.random_streams import band_limited, SinusoidSum

__all__ = ['EFFECTS', 'AdditiveNoise', 'AmplitudeModulation', 'ChippedTooth', 'ClockSkew',
           'Component', 'CorrelatedJitter', 'DeclaredJitter', 'Effect', 'ExcessJitter', 'Gearbox',
           'InterferingTone', 'InterpolationLoss', 'JitterScale', 'Keyphasor',
           'KeyphasorQuantisation', 'MissingPulses', 'Motion', 'PathDelay', 'PhaseWander',
           'Pulses', 'Setting', 'SinusoidSum', 'SpeedFluctuation', 'TargetGeometry', 'Torsion',
           'band_limited', 'make_effects', 'mesh']
