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
The machines on which the decisions of `close_loop` are judged: the one list of them.

Each `Group` draws any number of recordings of one class. Those with an even index are open; those
with an odd index are reserved: no number, threshold or rule is ever chosen on them. The seeds of
the two are disjoint.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product, zip_longest

from decision_independent import DAMAGED, damaged, independent
from decision_outside import FOREIGN, foreign, INJECTED, put_in
from decision_own import (
    channel_step, confusion, Drawn, fading_path, load_step, loop_example, lose_samples, no_noise,
    nothing_shown, plain, second_shaft, skew, ticks, tutorial)
from trace_confusion import EFFECTS, PAIRS, UNKNOWN

OWN, INDEPENDENT, FOREIGN_SOURCE, BROKEN, MEASURED, LOOP = (
    'own simulator', 'independent machines', 'foreign machines', 'broken by campaigns',
    'measured recordings', 'loop')
_OPEN, _RESERVED = 500_000, 1_000_000  # first seeds
_STEADY = 1e-4  # relative speed: by less than a tick from pulse to pulse

Draw = Callable[[int], Drawn]


@dataclass(frozen=True)
class Row:
    """A recording of the table; `draw` makes it, the same whenever it is called."""

    name: str
    group: str
    source: str
    reserved: bool
    seed: int
    draw: Callable[[], Drawn]


@dataclass(frozen=True)
class Group:
    """
    A class of recordings: `draw` makes one of a seed, `count` of them are in the table.

    `seeds` are those of the first open ones, `first` draws a recording of these.
    """

    name: str
    source: str
    draw: Draw
    count: int = 2
    seeds: tuple[int, ...] = ()
    first: Draw | None = None

    def row(self, index: int) -> Row:
        """Return a recording by its number; an odd one is reserved."""
        reserved, place = bool(index % 2), index // 2
        draw, seed = self.draw, (_RESERVED if reserved else _OPEN) + index
        if not reserved and place < len(self.seeds):
            draw, seed = self.first or self.draw, self.seeds[place]
        return Row(f'{self.name} {index}', self.name, self.source, reserved, seed,
                   partial(draw, seed))


def _tutorial() -> list[Group]:
    lengths = {20.0: (3e-4, 1e-3, 3e-3, 1e-2), 60.0: (3e-4, 1e-2), 100.0: (1e-3, 3e-3)}
    return [
        *(Group(f'tutorial {seconds:g} s {fluctuation:g}', OWN, partial(
            tutorial, seconds=seconds, fluctuation=fluctuation))
          for seconds, some in lengths.items() for fluctuation in some),
        Group('tutorial as in section 4', OWN, partial(
            tutorial, seconds=20.0, fluctuation=2e-3, declared=False), 4, (1,)),
        Group('example of the loop', OWN, loop_example, 2, (3,))]


def _own() -> list[Group]:
    cases = [*((name,) for name in EFFECTS), *((name,) for name in UNKNOWN), *PAIRS[:3]]
    return [
        Group('own none', OWN, partial(confusion, names=()), 4),
        *(Group(f'own {"+".join(names)}', OWN, partial(confusion, names=names))
          for names in cases),
        Group('own undeclared clock', OWN, partial(
            confusion, names=('keyphasor_quantisation',), declare_clock=False))]


_DRAWN = {  # effects, and open seeds
    '': (1009, 52619), 'excess_jitter': (1007, 12103, 70001),
    'keyphasor_quantisation': (1005, 5307), 'correlated_jitter': (1002,),
    'target_geometry': (1002, 2003), 'speed_fluctuation': (1011,), 'clock_skew': (1000,),
    'phase_wander': (1004,), 'missing_pulses': (3000,), 'interpolation_loss': (1005,),
    'additive_noise': (1007, 3001), 'amplitude_modulation': (1006,),
    'interfering_tone': (1005, 3001), 'two_paths': (1001, 56002), 'following_level': (3000,),
    'late_recovery': (2012, 3001), 'resonance': (1010, 41009),
    'correlated_jitter+additive_noise': (3000,), 'phase_wander+interfering_tone': (3000,),
    'keyphasor_quantisation+clock_skew': (3003,), 'missing_pulses+clock_skew': (3001,),
    'excess_jitter+amplitude_modulation': (3000,)}
_AGAIN = {'interfering_tone': (1005,), 'interpolation_loss': (1005,), 'excess_jitter': (1007,),
          'clock_skew': (1000,)}


def _independent() -> list[Group]:
    return [
        *(Group(f'independent {effects or "none"}', INDEPENDENT, partial(_effects, effects),
                max(2 * len(seeds), 8 if not effects else 2), seeds)
          for effects, seeds in _DRAWN.items()),
        *(Group(f'again {effects}', INDEPENDENT, partial(_effects, effects, again=True), 2, seeds)
          for effects, seeds in _AGAIN.items())]


def _effects(names: str, seed: int, again: bool = False) -> Drawn:
    return independent(seed, *(name for name in names.split('+') if name), again=again)


#: Seeds of the first recording, where it is not 1009.
_SEEDS = {'fast_at_times': 1007, 'coarse_clock': 52619, 'two_clocks': 52619, 'dithered': 52619,
          'interrupted': 1000, 'lost': 1000, 'short': 1000, 'late': 1013, 'late_run_up': 52619,
          'slow_torsion': 1011, 'drifting': 1003, 'one_order': 1011, 'slow_beat': 1011}


def _damaged() -> list[Group]:
    return [Group(f'damaged {name}', BROKEN, partial(damaged, name=name), 2,
                  (_SEEDS.get(name, 1009),), partial(damaged, name=name, drawn=False))
            for name in DAMAGED]


def _outside() -> list[Group]:
    return [
        *(Group(f'foreign none {kind}', FOREIGN_SOURCE, partial(foreign, kinds=(kind,)))
          for kind in FOREIGN['excess_jitter']),
        *(Group(f'foreign {effect}', FOREIGN_SOURCE, partial(
            foreign, effect=effect, kinds=kinds)) for effect, kinds in FOREIGN.items()),
        *(Group(f'foreign lost {lost} samples', FOREIGN_SOURCE, partial(foreign, lost=lost))
          for lost in (5, 7)),
        *(Group(f'measured {machine}: none', MEASURED, partial(put_in, machine=machine))
          for machine in INJECTED),
        Group('measured gearbox: noise left out', MEASURED, partial(
            put_in, machine='gearbox', declare_noise=False)),
        *(Group(f'measured {machine}: {effect}', MEASURED, partial(
            put_in, machine=machine, effect=effect))
          for machine, effects in INJECTED.items() for effect in effects)]


def _loop() -> list[Group]:
    """Return what the loop met last: steps and lines that vary, ticks, noise, other shafts."""
    broken = {'load step': load_step, 'step of one channel': channel_step,
              'fading path': fading_path}
    return [
        Group('correct', LOOP, _plain(), 16),
        Group('correct, quiet pulses', LOOP, _plain(quiet=True)),
        *(Group(f'{name}{", quiet pulses" * quiet}', LOOP, _plain(change, quiet=quiet))
          for (name, change), quiet in product(broken.items(), (False, True))),
        *(Group(f'lost {count} samples{", quiet pulses" * quiet}', LOOP,
                _plain(lose_samples(count), quiet=quiet))
          for count, quiet in product((3, 5, 7, 11), (False, True))),
        Group('ticks of the declared clock', LOOP, _plain(ticks, wander=_STEADY), 4),
        Group('noise left out', LOOP, _plain(no_noise), 4),
        Group('ticks and noise left out', LOOP, _plain(ticks, no_noise, wander=_STEADY), 4),
        Group("another shaft's mesh", LOOP, _plain(second_shaft, wander=5e-4), 6),
        Group('skew of 1e-4', LOOP, _plain(skew(1e-4)), 4),
        Group('nothing but noise', LOOP, _plain(nothing_shown), 2)]


def _plain(*changes: Callable[..., None], quiet: bool = False, wander: float | None = None
           ) -> Draw:
    return lambda seed: plain(seed, *changes, quiet=quiet, wander=wander)


def groups() -> Sequence[Group]:
    """Return all classes."""
    return [*_loop(), *_tutorial(), *_own(), *_independent(), *_damaged(), *_outside()]


def rows(count: int | None = None) -> list[Row]:
    """
    Return the rows of the table, the first of every class, then the second and so on.

    With `count` there are so many of every class, even of one that has fewer in the table.
    """
    turns = zip_longest(*([group.row(index) for index in range(
        group.count if count is None else count)] for group in groups()))
    return [row for turn in turns for row in turn if row is not None]
