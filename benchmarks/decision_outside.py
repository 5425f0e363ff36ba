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
Recordings from outside: of a simulator that shares nothing with the package, and measured ones.

The simulator is `sim.py` in the folder `SA_JITTER_MACHINES`, the recordings are in
`SA_JITTER_DATA`; both are looked for in `../shared` beside the checkout where these are not set.
`Absent` is raised where one is missing.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
import importlib.util
import math
import os
from pathlib import Path
from typing import Any

from decision_judge import Expected, TICKS
from decision_own import Drawn, parameter_text, traced, UNEXPLAINED
import measured_injections as measured
import numpy as np

_SHARED = Path(__file__).resolve().parents[2] / 'shared'
KINDS = 'heli', 'turbine', 'slow2', 'enc36', 'rlow', 'rhigh', 'sidebands', 'runup'
#: Effects of the foreign simulator, each with the machines that show it.
FOREIGN: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys((
        'excess_jitter', 'jitter_scale', 'speed_fluctuation', 'clock_skew', 'phase_wander',
        'missing_pulses', 'additive_noise', 'amplitude_modulation', 'interfering_tone',
        'interpolation_loss', 'keyphasor_quantisation', 'hum', 'backlash', 'slip', 'own_phase',
        'bursts'), KINDS),
    'correlated_jitter': tuple(kind for kind in KINDS if kind != 'enc36'),
    'target_geometry': ('enc36',),
    'path_delay': ('runup',)}
_MARKS, _PER_TURN = 12, 3  # of the 36 marks of a target, and trigger cycles a revolution
_SLIP = 0.47  # of a recording, behind which the source has slipped
_NO_MODULE = 'hum', 'backlash', 'slip', 'own_phase', 'bursts'


class Absent(Exception):
    """What a row needs is not on this computer."""


def _simulator() -> Any:
    folder = Path(os.environ.get(
        'SA_JITTER_MACHINES', _SHARED / 'reference' / 'foreign_machines'))
    path = folder / 'sim.py'
    if not path.is_file():
        raise Absent(f'no simulator {path}: set SA_JITTER_MACHINES to its folder')
    return _loaded(path)


@cache
def _loaded(path: Path) -> Any:
    found = importlib.util.spec_from_file_location('foreign_sim', path)
    assert found is not None
    assert found.loader is not None
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def foreign(seed: int, effect: str = '', kinds: tuple[str, ...] = KINDS, lost: int = 0) -> Drawn:
    """
    Return a machine of the foreign simulator, of a kind drawn, with an effect or none.

    So many samples are lost unnoticed in its middle third.
    """
    simulator, rng = _simulator(), np.random.default_rng([seed, 5])
    kind = str(rng.choice(kinds))
    size = simulator.sized(kind, effect, rng) if effect else {}
    made = simulator.make(kind, {effect: size} if effect else {}, int(rng.integers(1 << 30)))
    model = dict(made['decl'])
    if effect == 'target_geometry':  # cycles from mark to mark, which would else begin at one
        model.update(pulses_per_trigger=_MARKS, trigger_cycles=_PER_TURN * model['trigger_cycles'])
    fields = {'vibration': made['vib'], 'sample_rate': made['fs'], 'pulse_times': made['pulses'],
              **{key: model[key] for key in (
                  'ratio', 'pulses_per_revolution', 'pulses_per_trigger')}}
    expected = _of_foreign(effect, size)
    if effect == 'slip':  # of the source by an angle, which is at one speed as a step of the clock
        at = _SLIP * made['vib'].shape[1] / made['fs']
        marks, here = model['pulses_per_revolution'], np.searchsorted(made['pulses'], at)
        revolutions = np.ptp(made['pulses'][[here - marks, here + marks]]) / 2.0
        expected = replace(expected, cycle=1.0 / made['trig'], steps=(
            (at, size['size'] * revolutions / model['ratio']),))
    if lost:
        at = int(made['vib'].shape[1] * rng.uniform(0.35, 0.65))
        fields['vibration'] = np.delete(made['vib'], slice(at, at + lost), axis=1)
        expected = replace(UNEXPLAINED, cycle=1.0 / made['trig'], steps=(
            (at / made['fs'], lost / made['fs']),))
    return Drawn((fields,), parameter_text(model), expected)


def _of_foreign(effect: str, size: Mapping[str, Any]) -> Expected:
    if effect == 'keyphasor_quantisation':  # by the declared clock
        return Expected(changes={TICKS: math.nan})
    if not effect:
        return Expected()
    if effect in _NO_MODULE:
        return UNEXPLAINED
    names = {'angles': 'pulse_angles', 'size': 'amplitude'}
    parameters = {names.get(key, key): value for key, value in size.items()}
    return traced({effect: parameters or {'method': 'linear'}})


# --- measured machines ---------------------------------------------------------------------------

#: White noise of each recording, which its lines show, and the trigger speed in Hz.
_NOISE: Mapping[str, float] = {
    'gearbox': 3.887, 'motor, 30 V': 6.641e-4, 'bearing rig': 0.1077}
#: Sizes with which the worst line changes by about a tenth, by machine and effect.
INJECTED: Mapping[str, Mapping[str, float]] = {
    'gearbox': {
        'excess_jitter': 2.7e-5, 'clock_skew': 2.2e-4, 'missing_pulses': 0.03,
        'phase_wander': 4.9e-3, 'amplitude_modulation': 0.116, 'hum': 3.3e-5},
    'motor, 30 V': {'excess_jitter': 1.7e-5, 'phase_wander': 8.7e-3, 'hum': 2.5e-5},
    'bearing rig': {'excess_jitter': 8.3e-3}}


def _folder() -> Path:
    found = Path(os.environ.get('SA_JITTER_DATA', _SHARED / 'data'))
    if not found.is_dir():
        raise Absent(f'no measured recordings in {found}: set SA_JITTER_DATA to their folder')
    return found


def _bench(machine: str, rng: np.random.Generator) -> measured.Bench:
    """Return a measured recording with the declared errors of its pulses, drawn anew."""
    bench, = measured.opened(machine, _folder())
    jitter = measured.JITTER.get(machine, 0.0)
    return replace(bench, times=bench.true_times + jitter * rng.uniform(
        -0.5, 0.5, bench.true_times.size))


def put_in(seed: int, machine: str, effect: str = '', *, declare_noise: bool = True) -> Drawn:
    """Return a measured recording with an effect put in, and what it has without declared."""
    rng = np.random.default_rng([seed, 11])
    bench = _bench(machine, rng)
    expected, level = Expected(), bench.level
    if effect:
        size = INJECTED[machine][effect]
        make: Callable[..., measured.Bench] = measured.UNKNOWN.get(
            effect) or measured.KNOWN[effect][0]
        expected = UNEXPLAINED
        if effect in measured.KNOWN:
            parameters = dict(measured.KNOWN[effect][1](bench, size))
            for key in measured.IN_UNITS.get(effect, ()):
                parameters[key] *= level
            expected = traced({effect: {key: value for key, value in parameters.items()
                                        if key not in measured.UNSURE}})
        count, bench = bench.times.size, make(bench, rng, size)
        if effect == 'missing_pulses':  # few enough that their share is another than was drawn
            expected = traced({effect: {'probability': 1.0 - bench.times.size / count}})
    model = {**bench.model, 'noise_std': _NOISE[machine]}
    if not declare_noise:
        del model['noise_std']
        expected = Expected(changes={'noise.noise_std': math.nan})
    fields = {
        'vibration': bench.samples.astype(np.float32), 'sample_rate': bench.rate,
        'start_time': bench.start, 'pulse_times': bench.times,
        'pulses_per_revolution': model.get('pulses_per_revolution', 1)}
    return Drawn((fields,), parameter_text(model), expected)
