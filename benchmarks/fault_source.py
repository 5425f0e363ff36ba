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
A source that misbehaves at random: scenes of messages in their order of arrival.

A scene is a few seconds of vibration, tach pulses and tach waveform. Blocks and pulses are lost,
repeated, swapped, late or corrupt, teeth are missing or displaced, the source restarts, stops or
loses its clock; the last part of a scene is faultless, so that the graph can show that it is well.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from fault_machine import MESH, RATE, Run, TEETH
import numpy as np
from sa_jitter_ros.nodes.messages import encode_pulse_reference, encode_samples
from sa_jitter_ros.samples import SampleBlock

BODY, TAIL = 1.4, 1.4  # s of a scene with faults, and without: 170 pulses fill no queue
SHORTEST = 0.25  # s that a source sends before it changes again: two blocks or more
KEYPHASOR = 'keyphasor'
CHANGES = ('restart', 'clock back', 'clock ahead', 'stop', 'index back', 'other channels')
BLOCKS = {'lost': 3, 'repeated': 2, 'swapped': 2, 'late': 2, 'not finite': 2, 'layout': 2,
          'header': 2, 'channels': 1, 'rate': 1, 'time': 2}
TEETH_FAULTS = ('missing', 'double', 'stray', 'displaced', 'far displaced')
PULSES = ('lost', 'repeated', 'swapped', 'late', 'foreign', 'wild')
SPACING = 8  # teeth between two faults of teeth or pulses
# Of the pitch: nearer to a tooth a stray cannot be told from it, because the errors that all teeth
# have are a percent of the pitch.
BESIDE = 0.03
JITTER = 1.0 / RATE  # s, declared width of the errors that all teeth have
# Teeth at the end of a scene without them. The next scene's angle law may curve between such
# pulses: it reads eight cycles back from averages that wait for their last pulses.
STEADY = 56
REJECTED = ('layout', 'header', 'channels', 'rate')  # messages that are refused as such


@dataclass
class Scene:
    """
    What is sent, (arrival in s, topic, message) in order, and what there is to expect.

    `run` is the one that sends at the end, from tooth `tail` to `last` without faults; `faults`
    counts what was injected, `rejected` are vibration messages that must be refused.
    """

    run: Run
    tail: int = 0
    last: int = 0
    events: list[tuple[float, str, Any]] = field(default_factory=list)
    faults: Counter[str] = field(default_factory=Counter)
    rejected: int = 0


class FaultySource:
    """
    Sends scene after scene; `runs` is the truth, `displace` allows errors of pulses.

    `jitter` is the width of the errors that all teeth have, in declared ones.
    """

    def __init__(self, rng: np.random.Generator, *, jitter: float = 1.0) -> None:
        self.rng, self._jitter = rng, jitter * JITTER
        self.runs: list[Run] = []
        self.displace = True
        self._sample = 0  # of the run, that comes next
        self._arrival = 0.0  # of the run's sample 0
        self._lags = (0.0, 0.0)
        self._start(clock=float(rng.choice([0.0, -50.3, 1e5])), index=0, channels=2)

    # --- runs ---

    def _start(self, *, clock: float, index: int, channels: int, keep: bool = False) -> None:
        """Begin a run: another machine, or with `keep` the same teeth, in other vibration."""
        rng, now = self.rng, self._sample / RATE
        speed, first = float(rng.uniform(22.0, 28.0)), float(rng.uniform(0.001, 0.015))
        if keep:
            last = self.runs[-1]
            speed, pitch = last.speed, 1.0 / (TEETH * last.speed)
            first = float((last.first_tooth - now) % pitch)
        size = rng.uniform(1.0, 4.0)
        components = tuple(
            (order, float(size * rng.uniform(0.3, 1.0)), float(rng.uniform(-np.pi, np.pi)))
            for order in (1.0, 5.0, 5.0 * 2.40789, MESH))
        self._arrival += now
        self._sample = 0
        self.runs.append(Run(len(self.runs), speed, clock, index, first, channels, components))

    def _change(self, scene: Scene, kind: str) -> None:
        """Let the source do what `kind` says at its next sample."""
        rng, run = self.rng, self.runs[-1]
        time = run.clock + self._sample / RATE
        index = run.index + self._sample
        if kind == 'restart':
            self._start(clock=time - float(rng.uniform(0.5, 60.0)) - self._sample / RATE, index=0,
                        channels=run.channels)
        elif kind == 'clock back':
            self._start(clock=time - float(rng.uniform(0.05, 60.0)), index=index,
                        channels=run.channels)
        elif kind == 'clock ahead':
            self._start(clock=time + float(10.0 ** rng.uniform(-1.3, 3.0)), index=index,
                        channels=run.channels)
        elif kind == 'stop':
            stop = self._sample
            self._sample += round(10.0 ** rng.uniform(-1.0, 1.3) * RATE)
            span = stop / RATE, self._sample / RATE
            run.missing.update(run.teeth(*span).tolist())
            run.lost.append(span)
        elif kind == 'index back':
            self._start(clock=time, index=0, channels=run.channels, keep=True)
        else:
            channels = int(rng.choice([n for n in (1, 2, 3) if n != run.channels]))
            self._start(clock=time, index=index, channels=channels, keep=True)
            scene.rejected += 1  # only the second block shows that it is not a fault

    # --- scenes ---

    def scene(self, *, changes: bool = True, faults: bool = True) -> Scene:
        """Return the next scene; the last change of the source is well before its tail."""
        rng = self.rng
        self._lags = tuple(rng.uniform(-0.4, 0.4, 2))
        scene = Scene(self.runs[-1])
        count = int(rng.integers(1, 4))
        pieces = SHORTEST + rng.dirichlet(np.ones(count)) * (BODY - count * SHORTEST)
        for number, piece in enumerate(pieces):
            if changes and self._arrival + self._sample > 0.0 and (
                    number or rng.random() < 0.5 or self._sample > 60.0 * RATE):
                kind = str(rng.choice(CHANGES))
                scene.faults[f'source: {kind}'] += 1
                self._change(scene, kind)
            self._send(scene, piece, faults=faults)
        scene.run = self.runs[-1]
        tau = self._sample / RATE
        scene.tail, *_, scene.last = scene.run.teeth(tau, tau + TAIL).tolist()
        self._send(scene, TAIL, faults=False)
        scene.events.sort(key=lambda event: event[0])
        return scene

    def _send(self, scene: Scene, seconds: float, *, faults: bool) -> None:
        """Add a piece of the present run to a scene."""
        run, first = self.runs[-1], self._sample
        end = first + round(seconds * RATE)
        span = first / RATE, end / RATE
        if self.displace:
            # none whose edge the waveform shows before or behind, too
            teeth = run.teeth(*span).tolist()[2:-2 if faults else -STEADY]
            errors = self.rng.uniform(-0.5, 0.5, len(teeth)) * self._jitter
            run.jitter.update(zip(teeth, errors.tolist()))
        if faults:
            self._spoil_teeth(scene, run, span)
        for topic, make in (('vibration', run.block), ('tach_waveform', run.waveform)):
            lag = 0.0 if topic == 'vibration' else self._lags[1]
            for index, message in self._blocks(scene, topic, make, first, end, faults):
                self._add(scene, (index - run.index) / RATE + lag, topic, message)
        for arrival, message in self._pulses(scene, run, span, faults):
            self._add(scene, arrival + self._lags[0], 'tach_pulse', message)
        self._sample = end

    def _add(self, scene: Scene, tau: float, topic: str, message: Any) -> None:
        scene.events.append((self._arrival + tau, topic, message))

    # --- blocks ---

    def _blocks(self, scene: Scene, topic: str, make: Callable[[int, int], SampleBlock],
                first: int, end: int, faults: bool) -> Iterator[tuple[float, Any]]:
        """Iterate over (index of the sample with which it arrives, message)."""
        rng, blocks = self.rng, []
        while first < end:
            size = int(rng.integers(1, 20) if rng.random() < 0.1 else rng.integers(40, 700))
            blocks.append(make(first, min(size, end - first)))
            first += len(blocks[-1].samples[0])
        kinds, weights = list(BLOCKS), np.array(list(BLOCKS.values()), dtype=float)
        number, calm = 0, 2  # the first two tell that it is another run
        while number < len(blocks):
            block = blocks[number]
            if (not faults or number < calm or number > len(blocks) - 5 or rng.random() > 0.4):
                yield block.end_index, encode_samples(block)
                number += 1
                continue
            kind = str(rng.choice(kinds, p=weights / weights.sum()))
            scene.faults[f'{topic}: {kind}'] += 1
            if topic == 'vibration':
                scene.rejected += kind in REJECTED
                if kind not in ('repeated', 'layout', 'header'):
                    self._lose(block)
            if kind == 'swapped':
                number += 1
                yield block.end_index, encode_samples(blocks[number])
                yield block.end_index, encode_samples(block)
            else:
                late = blocks[number + int(rng.integers(1, 4))].end_index + 0.5
                yield from ((late if kind == 'late' else block.end_index, message)
                            for message in self._messages(block, kind))
            number += 1
            calm = number + 2

    def _lose(self, block: SampleBlock) -> None:
        run = self.runs[-1]
        run.lost.append(((block.index - run.index) / RATE, (block.end_index - run.index) / RATE))

    def _messages(self, block: SampleBlock, kind: str) -> list[Any]:
        """Return the messages that carry a block with this fault."""
        rng, good = self.rng, encode_samples(block)
        bad = encode_samples(block)
        if kind == 'lost':
            return []
        if kind == 'repeated':
            return [good, good]
        if kind == 'late':
            return [good]
        if kind == 'layout':  # beside a good one
            change = int(rng.integers(4))
            if change == 0:
                bad.layout.dim[int(rng.integers(2))].size += int(rng.integers(1, 5))
            elif change == 1:
                bad.layout.data_offset = int(rng.choice([1, 2, 4, 2**32 - 1]))
            elif change == 2:
                bad.layout.dim[int(rng.integers(2))].label = 'time'
            else:
                bad.data = bad.data[:int(rng.integers(0, 3))]
            return [bad, good]
        if kind == 'header':  # beside a good one
            place = int(rng.integers(3))
            wrong = {0: (np.nan, np.inf), 1: (0.0, -RATE, np.nan, np.inf),
                     2: (-1.0, 0.5, np.nan, np.inf, 2.0**60)}[place]
            bad.data[place] = float(rng.choice(wrong))
            return [bad, good]
        if kind == 'not finite':
            samples = np.full_like(block.samples, rng.choice([np.nan, np.inf, -np.inf]))
            return [encode_samples(replace(block, samples=samples))]
        if kind == 'channels':
            return [encode_samples(replace(block, samples=np.vstack((
                block.samples, block.samples))))]
        if kind == 'rate':
            return [encode_samples(replace(block, sample_rate=RATE * rng.choice([0.5, 1.001])))]
        wrong = block.start_time + rng.choice([-1.0, 1.0]) * rng.choice([0.05, 1.0, 1e6])
        return [encode_samples(replace(block, start_time=float(wrong)))]

    # --- pulses ---

    def _spoil_teeth(self, scene: Scene, run: Run, span: tuple[float, float]) -> None:
        """Let teeth be missing or displaced and pulses come that no tooth made."""
        rng, pitch = self.rng, 1.0 / (TEETH * run.speed)
        for tooth in self._some(run, span):
            kind = str(rng.choice(TEETH_FAULTS))
            if kind == 'displaced' and not self.displace:
                continue
            scene.faults[f'tach: {kind}'] += 1
            time = run.first_tooth + tooth * pitch
            if kind == 'missing':
                run.missing.add(tooth)
            elif kind == 'double':
                run.strays.append(time + float(rng.uniform(BESIDE, 0.5)) * pitch)
            elif kind == 'stray':
                run.strays.append(time - float(rng.uniform(BESIDE, 1.0 - BESIDE)) * pitch)
            elif kind == 'displaced':
                run.displaced[tooth] = float(rng.choice([-1, 1]) * rng.uniform(0.05, 0.1)) * pitch
            else:
                run.displaced[tooth] = float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.5)) * pitch

    def _some(self, run: Run, span: tuple[float, float]) -> Iterator[int]:
        """Iterate over teeth of a span that are not near its ends, nor near each other."""
        teeth = run.teeth(*span)
        at = 8 + int(self.rng.integers(SPACING))
        while at < len(teeth) - 8:
            yield int(teeth[at])
            at += SPACING + int(self.rng.integers(2 * SPACING))

    def _pulses(self, scene: Scene, run: Run, span: tuple[float, float], faults: bool
                ) -> list[tuple[float, Any]]:
        """Return (arrival, message) of the pulses in a span."""
        teeth = run.teeth(*span)
        arrival = dict(zip(teeth.tolist(), run.times(teeth).tolist()))
        sent = [(tau, run.clock + tau, KEYPHASOR) for tau in (
            *arrival.values(), *(item for item in run.strays if span[0] <= item < span[1]))]
        pitch = 1.0 / (TEETH * run.speed)
        spoilt = run.missing.union(run.displaced)
        for tooth in self._some(run, span) if faults else ():
            near = range(tooth - 5, tooth + 6)
            tau = arrival[tooth]
            if spoilt.intersection(near) or any(abs(item - tau) < 5 * pitch
                                                for item in run.strays):
                continue
            kind = str(self.rng.choice(PULSES))
            scene.faults[f'tach_pulse: {kind}'] += 1
            time, at = run.clock + tau, sent.index((tau, run.clock + tau, KEYPHASOR))
            if kind in ('lost', 'late', 'swapped'):
                run.undelivered.add(tooth)
                del sent[at]
            if kind == 'late':
                late = float(self.rng.uniform(2.2, 4.5))
                run.behind[tooth] = int(late)
                sent.append((tau + late * pitch, time, KEYPHASOR))
            elif kind == 'swapped':
                run.behind[tooth] = 1
                sent.append((tau + 1.01 * pitch, time, KEYPHASOR))
            elif kind == 'repeated':
                sent.append((tau + 1e-6, time, KEYPHASOR))
            elif kind == 'foreign':
                sent.append((tau + 1e-6, time, 'another'))
            elif kind == 'wild':
                wild = float(self.rng.choice([-1.0, 1.0]) * 10.0 ** self.rng.uniform(0.0, 8.0))
                sent.append((tau + 0.1 * pitch, time + wild, KEYPHASOR))
        return [(tau, encode_pulse_reference(time, source)) for tau, time, source in sent]
