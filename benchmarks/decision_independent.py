# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Recordings of the simulator of `independent_machines`, some damaged, and what must be said."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
import math
from typing import Any

from decision_damages import DAMAGES, Measurement
from decision_judge import Expected, TICKS
from decision_own import Drawn, traced, UNEXPLAINED
from independent_effects import Case, draw_case, UNKNOWN
from independent_machines import declared, Machine, pulses, record
import numpy as np

_PULSE_ERRORS = frozenset(('excess_jitter', 'correlated_jitter'))
_TRIES = 400
_STEP = 1_000_003  # from seed to seed, of machines that a damage does not suit

Fits = Callable[[Machine], bool]


def independent(seed: int, *effects: str, again: bool = False) -> Drawn:
    """Return a machine with effects, each known one of which must be traced to its size."""
    case = draw_case(effects, seed)
    made = _measurement(case, seed)
    expected = Expected() if again else _expected(case)
    return Drawn((made.fields,), made.text, expected, again=again)


def _measurement(case: Case, seed: int) -> Measurement:
    machine = case.machine
    return Measurement(
        record(machine, case.what, np.random.default_rng([seed, 1])), declared(machine),
        pulses(machine, case.what, np.random.default_rng([seed, 1]))[1],
        np.random.default_rng([seed, 2]))


def _expected(case: Case) -> Expected:
    """
    Return what must come out of a machine.

    A declared clock is no missing effect; coloured noise, which no model declares, and errors that
    the sampling of a tach waveform makes may be named beside the others.
    """
    known = {name: values for name, values in case.truth.items()
             if name not in (*UNKNOWN, 'keyphasor_quantisation')}
    expected = traced(known) if known else Expected()
    if set(UNKNOWN) & set(case.truth):
        expected = UNEXPLAINED
    if 'keyphasor_quantisation' in case.truth:
        expected = replace(expected, changes={TICKS: math.nan})
    return replace(expected, optional=_optional(case))


def _optional(case: Case) -> frozenset[str]:
    found: frozenset[str] = frozenset()
    if case.machine.noise_colour:
        found |= {'additive_noise'}
    if case.machine.waveform:
        found |= _PULSE_ERRORS
    return found - set(case.truth)


# --- damages -------------------------------------------------------------------------------------

@dataclass(frozen=True)
class Damage:
    """
    What is done to a recording with `effects`, and what must be said.

    `fits` says of which machines what must be said is certain; `expected` sees machine and truth.
    """

    expected: Callable[[Case], Expected]
    fits: Fits = lambda machine: True
    effects: tuple[str, ...] = ()


def damaged(seed: int, name: str, *, drawn: bool = True) -> Drawn:
    """Return a damaged recording; not `drawn`: of the machine of this seed, whatever it is."""
    damage = DAMAGED[name]
    for attempt in range(_TRIES if drawn else 1):
        number = seed + _STEP * attempt
        case = draw_case(damage.effects, number)
        if not drawn or (_plain(case.machine) and damage.fits(case.machine)):
            break
    else:
        raise RuntimeError(f'no machine for {name}')
    made = _measurement(case, number)
    DAMAGES[name](made)
    recordings = (made.fields, {**made.fields, **made.more})[:1 + bool(made.more)]
    expected = damage.expected(case)
    return Drawn(recordings, made.text, replace(
        expected, optional=expected.optional | _optional(case)))


def _plain(machine: Machine) -> bool:
    """Tell whether a machine shows its pulse errors well, by several orders and acquisitions."""
    power = 0.5 * float(np.mean(np.sum(machine.levels**2, axis=1)))
    return (not machine.waveform and not machine.noise_colour and machine.orders.size >= 3
            and not machine.start_time
            and machine.acquisitions >= 10 and machine.cycle_length >= 1.0
            and machine.noise_std < 0.4 * math.sqrt(power))


def _says(words: str) -> Callable[[Case], Expected]:
    return lambda case: Expected(error=words)


def _always(expected: Expected) -> Callable[[Case], Expected]:
    return lambda case: expected


def _true(case: Case) -> Expected:
    return traced(case.truth) if case.truth else Expected()


def _perhaps(effects: Mapping[str, Mapping[str, Any]]) -> Callable[[Case], Expected]:
    """Return an effect that must be named with its size, or have a limit that covers it."""
    def expected(case: Case) -> Expected:
        found = traced(effects)
        return replace(found, verdicts=('none', 'traced'), effects=(*found.effects, frozenset()),
                       covered=found.sizes, sizes={})
    return expected


def _jitter(scale: float) -> Callable[[Case], Expected]:
    """Return that the true jitter is `scale` times the declared."""
    def expected(case: Case) -> Expected:
        more = 1.0 / case.machine.keyphasor_rate / math.sqrt(12.0)
        sizes = {'jitter_scale.scale': scale}
        names = [frozenset({'jitter_scale'})]
        if scale > 1.0:
            sizes['excess_jitter.std'] = more * math.sqrt(1.0 - scale**-2)
            names.append(frozenset({'excess_jitter'}))
        return Expected(('traced',), tuple(names), sizes=sizes)
    return expected


def _lost(case: Case) -> Expected:
    """Return that a skew is found, and perhaps the lost pulses that change no trigger."""
    found = traced(case.truth)
    return replace(found, effects=(*found.effects, found.effects[0] | {'missing_pulses'}))


_SKEW = ('clock_skew',)
_STEADY: Fits = lambda machine: machine.relative_drift < 1e-3  # noqa: E731
_LOW: Fits = lambda machine: machine.top < 0.1 * machine.sample_rate  # noqa: E731
_HIGH: Fits = lambda machine: machine.top > 0.15 * machine.sample_rate  # noqa: E731
_FREE: Fits = lambda machine: not machine.reference  # noqa: E731
_FEW: Fits = lambda machine: machine.acquisitions < 24  # noqa: E731
_TICKS = Expected(changes={TICKS: math.nan})
#: By the name of the damage, which is that in `DAMAGES`.
DAMAGED: Mapping[str, Damage] = {
    'faster': Damage(_says('trigger_speed is declared as')),
    'fast_at_times': Damage(_true, lambda machine: machine.relative_drift > 3e-3,
                            ('additive_noise',)),
    'other_ratio': Damage(_says('ratio is declared as')),
    'much_jitter': Damage(_jitter(0.1)),
    'little_jitter': Damage(_jitter(10.0)),
    'strays': Damage(_says('pulses are spurious')),
    'no_shaft': Damage(_says('no interval that a shaft could have')),
    'two_pulses': Damage(_says('2 keyphasor pulses')),
    'swaying': Damage(_always(UNEXPLAINED), _FREE),
    'interrupted': Damage(_true, effects=_SKEW),
    'gap': Damage(_true),
    'slow_clock': Damage(_perhaps({'clock_skew': {'skew': 2e-5}})),
    'late': Damage(_perhaps({'path_delay': {'delay': 0.012}})),
    'foreign_shaft': Damage(_always(Expected(
        ('none', 'traced'), (frozenset(), frozenset({'interfering_tone'}))))),
    'fast_clock': Damage(_always(traced({'clock_skew': {'skew': -3e-3}}))),
    'displaced': Damage(_always(UNEXPLAINED), _FREE),
    'lost': Damage(_lost, effects=_SKEW),
    'torsion': Damage(_always(Expected(('none', 'unexplained')))),
    'slow_torsion': Damage(_always(UNEXPLAINED), _LOW),
    'drifting': Damage(_always(UNEXPLAINED)),
    'one_order': Damage(_always(UNEXPLAINED)),
    'slow_beat': Damage(_always(traced({'interpolation_loss': {'method': 'linear'}})), _HIGH),
    'run_up': Damage(_true, _LOW),
    'late_run_up': Damage(lambda case: traced({'path_delay': {
        'delay': 0.3 / case.machine.speed / case.machine.pulses_per_revolution}}), _LOW),
    'twisting': Damage(_always(UNEXPLAINED), _LOW),
    'fading': Damage(_always(UNEXPLAINED)),
    'weak_order': Damage(_true),
    'coarse_clock': Damage(_always(_TICKS), _STEADY),
    'two_clocks': Damage(_says('one declared model holds for one clock'), _STEADY),
    'dithered': Damage(_true, _STEADY),
    'late_reference': Damage(_always(Expected(against='reference keyphasor'))),
    'short_reference': Damage(_says('reference_pulse_times cover 30% of the pulses')),
    'poor_reference': Damage(_always(Expected(
        against='vibration', said=('they give less amplitude than pulse_times',)))),
    'short': Damage(_always(Expected(untested=True)), _FEW, _SKEW),
    'louder': Damage(_says('different machines or loads'))}
