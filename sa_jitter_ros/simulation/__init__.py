"""Machines whose truth is known."""

from sa_jitter_ros.simulation.components import ChippedTooth, Component, mesh
from sa_jitter_ros.simulation.effect import Effect, Setting
from sa_jitter_ros.simulation.effects import EFFECTS, make_effects
from sa_jitter_ros.simulation.gearbox import Gearbox
from sa_jitter_ros.simulation.keyphasor import Keyphasor, Pulses
from sa_jitter_ros.simulation.motion import Motion, Torsion
from sa_jitter_ros.simulation.pulse_effects import DeclaredJitter
from sa_jitter_ros.simulation.sinusoids import band_limited, SinusoidSum
from sa_jitter_ros.simulation.vibration_effects import AdditiveNoise

__all__ = ['EFFECTS', 'AdditiveNoise', 'ChippedTooth', 'Component', 'DeclaredJitter', 'Effect',
           'Gearbox', 'Keyphasor', 'Motion', 'Pulses', 'Setting', 'SinusoidSum', 'Torsion',
           'band_limited', 'make_effects', 'mesh']
