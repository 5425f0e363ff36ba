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

plays 3000 scenes within four minutes; over DDS they take two hours. Each average is compared with
the truth as in `fault_campaign.py`. One that is wrong has a line, with the faults of its scene;
the last line counts. The exit status is 1 if any was wrong.
"""

import argparse
import sys

from fault_check import ShaftChecker, WrongAverageError
from fault_graph import DIRECT, SHAFTS
from fault_source import FaultySource, KEYPHASOR, Scene
import numpy as np
from sa_jitter_ros.averaging.average import Average, KeyphasorParameters
from sa_jitter_ros.averaging.results import ShaftResults
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import MessageError, SignalError
from sa_jitter_ros.nodes.messages import decode_average, decode_pulse_reference, encode_average
from sa_jitter_ros.recordings.message_layouts import FLOAT64, SampleDecoder

BUFFER_SECONDS = 10.0  # of the node
AGAIN = 100  # scenes after which source and averager begin anew


class Replay:
    """A faulty source, the averager of the campaign's `direct` node, and a checker for a shaft."""

    def __init__(self, seed: int) -> None:
        names = [name for role, name in SHAFTS if role == 'direct']
        keyphasor = KeyphasorParameters(**{
            key: DIRECT[key] for key in ('pulses_per_revolution', 'pulses_per_trigger',
                                         'missing_pulses')})
        self.source = FaultySource(np.random.default_rng(seed))
        self.stream = StreamingAverager(
            {name: keyphasor.average(
                ratio=DIRECT[f'{name}.ratio'], orders=DIRECT[f'{name}.orders'],
                trigger_cycles=DIRECT['trigger_cycles'], averaging=DIRECT['averaging'])
             for name in names},
            validator=keyphasor.validator(), timeline=VibrationTimeline(
                buffer_seconds=BUFFER_SECONDS))
        self.checkers = {name: ShaftChecker(name, self.source.runs, [DIRECT], delivered=True)
                         for name in names}
        self.wrong: list[str] = []
        self._decoder = SampleDecoder(FLOAT64, sample_rate=0.0)

    def play(self) -> None:
        """Play a scene."""
        scene = self.source.scene()
        for _, topic, message in scene.events:
            try:
                if topic == 'vibration':
                    found = self.stream.add_samples(self._decoder.decode(message))
                elif topic == 'tach_pulse' and message.source == KEYPHASOR:
                    found = self.stream.add_pulses(decode_pulse_reference(message)[0])
                else:
                    continue
            except (MessageError, SignalError):
                continue
            for name, average in found:
                self._check(scene, name, average)
        self.stream.take_messages()

    def _check(self, scene: Scene, name: str, average: Average) -> None:
        results = ShaftResults().of(average)
        amplitude, waveform = (
            decode_average(kind, encode_average(kind, results[kind]))
            for kind in ('order_amplitude', 'synchronous_average'))
        try:
            self.checkers[name].check(amplitude, waveform)
        except WrongAverageError as error:
            faults = ', '.join(f'{kind} {count}' for kind, count in scene.faults.items())
            self.wrong.append(f'{error} ({faults})')
            self.checkers[name].start_anew(average.sequence + 1)


def main(arguments: list[str] | None = None) -> int:
    """Play scenes and print what was wrong; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.strip().partition('\n')[0])
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--scenes', type=int, default=3000)
    options = parser.parse_args(arguments)
    averages = wrong = 0
    for number, first in enumerate(range(0, options.scenes, AGAIN)):
        replay = Replay(options.seed + number)
        for _ in range(min(AGAIN, options.scenes - first)):
            replay.play()
        for line in replay.wrong:
            print(f'seed {options.seed + number}: {line}', flush=True)
        wrong += len(replay.wrong)
        averages += sum(checker.checked for checker in replay.checkers.values())
    print(f'{options.scenes} scenes, {averages} averages are true, {wrong} wrong')
    return int(wrong > 0)


if __name__ == '__main__':
    sys.exit(main())
