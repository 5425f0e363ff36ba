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
Inject thousands of random faults into the running graph and check every average against the truth.

    .venv/bin/python benchmarks/fault_campaign.py

takes a quarter of an hour. A source that misbehaves feeds the nodes, each a process of its own
over DDS; nodes are killed, stopped and reconfigured; all averages are compared with the known
vibration of the cycles they claim. Numbers go to `out/faults.json`, figures and tables to
docs/reliability.md. The exit status is 1 if anything was wrong.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Mapping
import json
from pathlib import Path
import sys
import time
from typing import Any

from fault_check import check_correction, ShaftChecker, WrongAverageError
from fault_disturb import Disturber
from fault_graph import Graph, ROLES, SHAFTS
from fault_residual import check_report, ResidualChecker
from fault_source import FaultySource, KEYPHASOR, Scene
from matplotlib.figure import Figure
import numpy as np
from page import fill

ROOT = Path(__file__).resolve().parents[1]
PULSES = ('accepted', 'doubles', 'early', 'out_of_order', 'non_finite', 'unlocked')
ENOUGH = 50  # scenes that have to give a residual
EXTRA = 5  # faultless scenes within which every average must have come back
HELD = 4  # pulses that may be waiting to be judged
SLACK = 24  # teeth behind an average until it is published: a spline reads eight cycles ahead


class Campaign:
    """Plays scenes into a graph and keeps account."""

    def __init__(self, seed: int, graph: Graph, *, jitter: float) -> None:
        rng = np.random.default_rng(seed)
        self.graph, self.source = graph, FaultySource(rng, jitter=jitter)
        self.disturber = Disturber(rng, graph, self._killed)
        self.checkers = {
            key: ShaftChecker(key[1], self.source.runs, self.disturber.settings[key[0]],
                              delivered=key[0] == 'direct') for key in SHAFTS}
        self.faults: Counter[str] = Counter()
        self.checked: Counter[str] = Counter()  # averages of scenes with a fault, by its kind
        self.corrected = Counter(corrected=0, refused=0)  # averages with `correct_jitter`
        self.residuals, self.verdicts = ResidualChecker(), Counter[str]()
        self.wrong = self.disturber.wrong  # to which both add
        self._scene = Scene(self.source.runs[-1])
        self.recovery: list[int] = []  # faultless scenes that were needed, scene by scene
        self._expected: Counter[str] = Counter()  # of `direct` since `_base`
        self._base: dict[str, str] = {}
        self._refused = dict.fromkeys(self.disturber.rejected, (0, 0))  # counted, sent

    def play(self, *, kills: bool) -> None:
        """Play a scene and wait until all averages are well again."""
        self.source.displace = self.disturber.set_angle_law()
        scene = self.source.scene()
        self.disturber.faults.clear()
        before = self.averages
        self._feed(scene, self.disturber.plan(kills=kills))
        faults = scene.faults + Counter(self.disturber.faults)
        waiting = self._wait(scene)
        extra = 0
        while waiting and extra < EXTRA:
            extra += 1
            for role in ('direct', 'averager'):
                self.graph.quiet_status(role)  # so that no queue is ever full
            scene = self.source.scene(changes=False, faults=False)
            self._feed(scene, [])
            waiting = self._wait(scene)
        self.recovery.append(extra)
        self.wrong += [f'{key}: no average after {EXTRA} faultless scenes' for key in waiting]
        self.disturber.settle()
        self._check_residuals()
        self.graph.watch()
        self.faults += faults
        for kind in faults:
            self.checked[kind] += self.averages - before

    @property
    def averages(self) -> int:
        """Averages that were checked so far and found true."""
        return sum(checker.checked for checker in self.checkers.values())

    def _feed(self, scene: Scene, actions: list[Any]) -> None:
        """Send a scene, and act somewhere in the first half of it."""
        self._scene = scene
        places = sorted(self.disturber.rng.integers(0, len(scene.events) // 2, len(actions)))
        for number, (_, topic, message) in enumerate(scene.events):
            while places and number >= places[0]:
                places.pop(0)
                actions.pop(0)()
            self.graph.send(topic, message)
            if number % 20 == 0:
                self._check(scene)
        self._expected['pulses'] += sum(
            topic == 'tach_pulse' and message.source == KEYPHASOR
            for _, topic, message in scene.events)
        self._expected['messages_rejected'] += scene.rejected

    def _killed(self, role: str) -> None:
        """Begin anew in all accounts of a node, once what it had published is checked."""
        self._check(self._scene)
        for key, checker in self.checkers.items():
            if key[0] == role:
                checker.start_anew()
                self.graph.inboxes[key].forget()
        self._refused.pop(role, None)
        if role == 'direct':
            self._base = {}  # counts again from the next look on

    def _check(self, scene: Scene) -> set[Any]:
        """Check what has come; return which averages have reached the scene's end."""
        well = set()
        for key, checker in self.checkers.items():
            settings = self.disturber.settings[key[0]]
            for received in self.graph.inboxes[key].take():
                if received.pulse_error is not None:
                    self.residuals.add_average(received.amplitude)
                try:
                    place = checker.check(received.amplitude, received.waveform)
                    corrected = check_correction(key[1], received, place, settings)
                except WrongAverageError as error:
                    self.wrong.append(f'{key[0]}: {error}')
                    checker.start_anew(received.amplitude.header.sequence + 1)
                    continue
                if settings[-1].get('correct_jitter'):
                    self.corrected['corrected' if corrected else 'refused'] += 1
                # the last whole average of the scene: hardly anything waits in a queue
                if place.run is scene.run and scene.tail <= place.first and (
                        2 * place.last - place.first + SLACK >= scene.last):
                    well.add(key)
        return well

    def _wait(self, scene: Scene) -> set[Any]:
        """Wait for the last averages of the scene; return which have not come."""
        waiting = set(self.checkers)
        waiting -= self._check(scene)

        def come() -> bool:
            nonlocal waiting
            waiting -= self._check(scene)
            return not waiting
        self.graph.spin(come, 4.0)
        return waiting

    def _check_residuals(self) -> None:
        """Check what predictor and analyser have published."""
        graph = self.graph
        residuals, graph.residuals = graph.residuals, []
        reports, graph.reports = graph.reports, []
        graph.spin(lambda: False, 0.1)  # what they are of was sent before and has come by then
        self._check(self._scene)
        for prediction in graph.predictions:
            self.residuals.add_prediction(prediction)
        graph.predictions.clear()
        for residual in residuals:
            self._try(lambda residual=residual: self.residuals.check(residual))
        for text in reports:
            self._try(lambda text=text: self.verdicts.update([check_report(text)]))

    def _try(self, check: Callable[[], None]) -> None:
        try:
            check()
        except WrongAverageError as error:
            self.wrong.append(str(error))

    def account(self) -> None:
        """Compare what `direct` and the others have counted with what was sent."""
        status = self.graph.quiet_status('direct')
        inboxes = self.graph.inboxes

        def complete() -> bool:
            self._check(self._scene)
            return not any(inbox.incomplete for inbox in inboxes.values())
        if not self.graph.spin(complete, 2.0):
            self.wrong += [f'{key[0]}: {inbox.incomplete} messages of no average of {key[1]}'
                           for key, inbox in inboxes.items() if inbox.incomplete]
        if self._base:
            grown = {key: int(value) - int(self._base[key]) for key, value in status.items()
                     if value.isdecimal() and self._base.get(key, '').isdecimal()}
            judged = sum(grown[f'pulses_{key}'] for key in PULSES)
            self._compare('pulses judged', judged, self._expected['pulses'], HELD)
            self._compare('messages_rejected', grown['messages_rejected'],
                          self._expected['messages_rejected'], 0)
        self._base, self._expected = status, Counter()
        for role in ('predictor', 'analyser'):
            counted = int(self.graph.quiet_status(role)['messages_rejected'])
            sent = self.disturber.rejected[role]
            if role in self._refused:
                self._compare(f'{role}: messages_rejected', counted - self._refused[role][0],
                              sent - self._refused[role][1],
                              self.disturber.replaced if role == 'analyser' else 0)
            self._refused[role] = counted, sent
        self.disturber.replaced = 0

    def _compare(self, what: str, counted: int, expected: int, slack: int) -> None:
        if abs(counted - expected) > slack:
            self.wrong.append(f'{what}: {counted} counted, {expected} sent')


def run(seed: int, scenes: int, report: Callable[[str], None], *, jitter: float = 1.0
        ) -> dict[str, Any]:
    """Run a campaign; nodes are killed in the first half, memory is watched in the second."""
    graph, reported = Graph(), 0
    try:
        graph.start(list(ROLES))
        campaign = Campaign(seed, graph, jitter=jitter)
        for number in range(scenes):
            campaign.play(kills=number < scenes // 2)
            if number % 5 == 4:
                campaign.account()
            if number % 10 == 9 or campaign.wrong[reported:]:
                report('\n'.join([
                    f'{number + 1} of {scenes} scenes, {sum(campaign.faults.values())} faults, '
                    f'{campaign.averages} averages, {len(campaign.wrong)} wrong',
                    *campaign.wrong[reported:]]))
            reported = len(campaign.wrong)
            if reported > 20 or graph.died:
                break
        if scenes >= ENOUGH and not campaign.residuals.checked:
            campaign.wrong.append('analyser: no residual')
    finally:
        statuses = graph.close()
    lives = [*graph.past, *graph.lives.items()]
    return {
        'seed': seed, 'scenes': len(campaign.recovery), 'seconds': time.monotonic() - graph.begin,
        'faults': dict(sorted(campaign.faults.items())), 'checked': dict(campaign.checked),
        'averages': {f'{role} {shaft}': checker.checked
                     for (role, shaft), checker in campaign.checkers.items()},
        'wrong': campaign.wrong, 'died': graph.died, 'statuses': statuses,
        'recovery': campaign.recovery, 'corrected': dict(campaign.corrected),
        'residuals': campaign.residuals.checked, 'verdicts': dict(campaign.verdicts),
        'rss': [(role, life.rss) for role, life in lives]}


# --- the page ------------------------------------------------------------------------------------

def fault_sections(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the contents of the campaign's sections."""
    averages, extra = found['averages'], found['recovery']
    corrected, verdicts = found['corrected'], found['verdicts']
    again = [scenes for scenes in extra if scenes]
    later = f'; {len(again)} needed up to {max(again)} more' if again else ''
    return {'campaign': (
        f'{sum(found["faults"].values()):,} faults in {found["scenes"]} scenes (seed '
        f'{found["seed"]}): {sum(averages.values()):,} averages were checked, **failed checks: '
        f'{len(found["wrong"])}**, nodes that ended by themselves: {len(found["died"])}. '
        f'{corrected["corrected"]:,} averages were corrected, {corrected["refused"]:,} '
        f'corrections refused, {found["residuals"]:,} residuals and {sum(verdicts.values()):,} '
        f'traces checked. In {len(extra) - len(again)} of {len(extra)} scenes all averages were '
        f'back within the faultless 1.4 s at its end{later}.')}


def draw_faults(found: Mapping[str, Any], folder: Path) -> None:
    """Draw faults by kind, and the memory of every process over time."""
    kinds = list(found['faults'])[::-1]
    figure = Figure(figsize=(10.0, 0.16 * len(kinds) + 3.6), layout='constrained')
    bars, memory = figure.subplots(2, 1, height_ratios=(0.16 * len(kinds), 2.6))
    place = np.arange(len(kinds))
    bars.barh(place + 0.2, [found['checked'][kind] for kind in kinds], 0.4, color='tab:blue',
              label='averages checked in scenes with it, all true' if not found['wrong']
              else 'averages checked in scenes with it')
    bars.barh(place - 0.2, [found['faults'][kind] for kind in kinds], 0.4, color='tab:orange',
              label='injected')
    bars.set_yticks(place, kinds, fontsize=7)
    bars.set_ylim(-0.6, len(kinds) - 0.4)
    bars.set_xscale('log')
    bars.set_xlabel('number')
    bars.legend(loc='upper center', bbox_to_anchor=(0.5, 1.07), ncols=2, fontsize=8)
    bars.grid(axis='x', alpha=0.3)
    roles = list(dict.fromkeys(role for role, _ in found['rss']))
    for role, rss in found['rss']:
        if rss:
            times, values = np.array(rss).T
            first = role in roles
            memory.plot(times, values, '.-', markersize=2, linewidth=0.8,
                        color=f'C{list(dict.fromkeys(r for r, _ in found["rss"])).index(role)}',
                        label=role if first else None)
            if first:
                roles.remove(role)
    memory.set_xlabel('time [s]; a line ends where its process was killed')
    memory.set_ylabel('resident memory [MB]')
    memory.set_ylim(bottom=0.0)
    memory.legend(fontsize=8, ncols=5)
    memory.grid(alpha=0.3)
    figure.savefig(folder / 'reliability-faults.png', dpi=110)


def main() -> int:
    """Run, keep the numbers, and write the page."""
    parser = argparse.ArgumentParser(description='Inject faults into the running graph.')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--scenes', type=int, default=300, help='of some fifteen faults each')
    parser.add_argument('--jitter', type=float, default=1.0,
                        help='width of the errors of the pulses over the declared one')
    parser.add_argument('--numbers', type=Path, default=ROOT / 'out' / 'faults.json')
    parser.add_argument('--page', type=Path, default=ROOT / 'docs' / 'reliability.md')
    parser.add_argument('--figures', type=Path, default=ROOT / 'docs' / 'figures')
    parser.add_argument('--only-write', action='store_true', help='from the numbers of last time')
    options = parser.parse_args()
    if not options.only_write:
        found = run(options.seed, options.scenes,
                    lambda text: print(text, file=sys.stderr, flush=True),
                    jitter=options.jitter)
        options.numbers.parent.mkdir(parents=True, exist_ok=True)
        options.numbers.write_text(json.dumps(found) + '\n')
    found = json.loads(options.numbers.read_text())
    print(f'{sum(found["faults"].values())} faults, {sum(found["averages"].values())} averages, '
          f'{len(found["wrong"])} wrong, {len(found["died"])} nodes died')
    print('\n'.join(found['wrong'] + found['died']))
    draw_faults(found, options.figures)
    options.page.write_text(fill(options.page.read_text(), fault_sections(found)))
    return int(bool(found['wrong'] or found['died'] or any(found['statuses'].values())))


if __name__ == '__main__':
    sys.exit(main())
