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
Play the scenes of the fault campaign into the averager itself, without nodes and without DDS.

    .venv/bin/python benchmarks/fault_replay.py

plays 400 scenes, with the parameters that the campaign sets, within some minutes; it gives four
times as many averages as over DDS. Each is compared with the truth as in `fault_campaign.py`. One
that is wrong has a line, with the faults of its scene and the parameters. One line counts those
that are fed with pulses (`direct`), one those behind the detector. The exit status is 1 if any was
wrong.
"""

import argparse
from collections.abc import Iterator
import sys
from typing import Any

from fault_check import ShaftChecker, WrongAverageError
from fault_disturb import VALID
from fault_graph import DETECTED, DETECTOR, DIRECT, SHAFTS
from fault_source import FaultySource, KEYPHASOR, Scene
import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import Average, KeyphasorParameters
from sa_jitter_ros.averaging.results import ShaftResults
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import MessageError, SignalError
from sa_jitter_ros.nodes.messages import decode_average, decode_pulse_reference, encode_average
from sa_jitter_ros.pulses.detection import detector_of
from sa_jitter_ros.pulses.detector_parameters import DETECTOR_PARAMETERS
from sa_jitter_ros.recordings.message_layouts import FLOAT64, SampleDecoder

FloatArray = NDArray[np.float64]

BUFFER_SECONDS = 10.0  # of the node
AGAIN = 20  # scenes after which source and averager begin anew


class Replay:
    """
    A faulty source, the averager of a role of the campaign, and a checker for each shaft.

    The parameters are those that the campaign sets, chosen at random.
    """

    role, defaults = 'direct', DIRECT

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.changed = {name: values[rng.integers(len(values))]
                        for name, values in VALID[self.role]}
        values = {'interval_tolerance': 0.0, **self.defaults, **self.changed}
        names = [name for role, name in SHAFTS if role == self.role]
        keyphasor = KeyphasorParameters(**{
            key: values[key] for key in ('pulses_per_revolution', 'pulses_per_trigger',
                                         'missing_pulses', 'interval_tolerance')})
        self.source = FaultySource(rng)
        self.stream = StreamingAverager(
            {name: keyphasor.average(
                ratio=values[f'{name}.ratio'], orders=values[f'{name}.orders'],
                trigger_cycles=values['trigger_cycles'], averaging=values['averaging'],
                samples_per_revolution=values.get(f'{name}.samples_per_revolution', 0))
             for name in names},
            validator=keyphasor.validator(), timeline=VibrationTimeline(
                buffer_seconds=BUFFER_SECONDS))
        self.checkers = {name: ShaftChecker(name, self.source.runs, [values],
                                            delivered=self.role == 'direct') for name in names}
        self.wrong: list[str] = []
        self._decoder = SampleDecoder(FLOAT64, sample_rate=0.0)

    def play(self) -> None:
        """Play a scene."""
        scene = self.source.scene()
        for _, topic, message in scene.events:
            try:
                if topic == 'vibration':
                    found = self.stream.add_samples(self._decoder.decode(message))
                else:
                    found = [average for times in self.pulses(topic, message)
                             for average in self.stream.add_pulses(times)]
            except (MessageError, SignalError):
                continue
            for name, average in found:
                self._check(scene, name, average)
        self.stream.take_messages()

    def pulses(self, topic: str, message: Any) -> Iterator[FloatArray]:
        """Yield the pulse times (n,) of a message; raises `MessageError`."""
        if topic == 'tach_pulse' and message.source == KEYPHASOR:
            yield decode_pulse_reference(message)[0]

    def _check(self, scene: Scene, name: str, average: Average) -> None:
        results = ShaftResults().of(average)
        amplitude, waveform = (
            decode_average(kind, encode_average(kind, results[kind]))
            for kind in ('order_amplitude', 'synchronous_average'))
        try:
            self.checkers[name].check(amplitude, waveform)
        except WrongAverageError as error:
            self.wrong.append(f'{error} {dict(scene.faults)} {self.changed}')
            self.checkers[name].start_anew(average.sequence + 1)


class DetectedReplay(Replay):
    """The same behind the detector, which finds the pulses in the waveform of the tach."""

    role, defaults = 'averager', DETECTED

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self._waveform = SampleDecoder(FLOAT64, sample_rate=0.0)
        self._timeline = VibrationTimeline()
        self._begin(0, 0.0)

    def _begin(self, epoch: int, rate: float) -> None:
        """Begin with another detector, as the node does for another run."""
        self._run = epoch, rate
        self._detector = detector_of({
            **{item.name: item.default for item in DETECTOR_PARAMETERS}, **DETECTOR})

    def pulses(self, topic: str, message: Any) -> Iterator[FloatArray]:
        """Yield the pulse times (n,) that a message shows; raises what the node refuses it for."""
        if topic != 'tach_waveform':
            return
        self._timeline.add(self._waveform.decode(message))
        for epoch, block in self._timeline.take():
            if (epoch, block.sample_rate) != self._run:
                self._begin(epoch, block.sample_rate)
            times = self._detector.update(block.samples[0], block.start_time, block.sample_rate)
            for time in times.round(9):  # as messages carry them
                yield np.array([time])


def main(arguments: list[str] | None = None) -> int:
    """Play scenes and print what was wrong; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.strip().partition('\n')[0])
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--scenes', type=int, default=400)
    options = parser.parse_args(arguments)
    failed = 0
    for kind in (Replay, DetectedReplay):
        averages = wrong = 0
        for number, first in enumerate(range(0, options.scenes, AGAIN)):
            replay = kind(options.seed + number)
            for _ in range(min(AGAIN, options.scenes - first)):
                replay.play()
            for line in replay.wrong:
                print(f'seed {options.seed + number}: {line}', flush=True)
            wrong += len(replay.wrong)
            averages += sum(checker.checked for checker in replay.checkers.values())
        print(f'{kind.role}: {options.scenes} scenes, {averages} averages are true, {wrong} wrong')
        failed += wrong
    return int(failed > 0)


if __name__ == '__main__':
    sys.exit(main())
