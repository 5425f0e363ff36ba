# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `recording_player`: publishes a recording as if it were measured now."""

import argparse
from collections.abc import Iterator, Sequence
import json
import sys
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.keyphasor_check.machine_file import on_target
from sa_jitter_ros.keyphasor_check.plausibility import doubts
from sa_jitter_ros.nodes.base import run_node
from sa_jitter_ros.nodes.parameters import parameter_files
from sa_jitter_ros.nodes.playback import PlaybackNode, Portion
from sa_jitter_ros.parameters import fixed, Parameter, Values
from sa_jitter_ros.pulses.validation import PulseValidator
from sa_jitter_ros.recordings import read, Recording
from sa_jitter_ros.recordings.channel_check import usable_channels
from sa_jitter_ros.recordings.channel_units import in_units, scale_of
from sa_jitter_ros.recordings.fields import fields_of
from sa_jitter_ros.recordings.reading import READ_PARAMETERS
from sa_jitter_ros.samples import SampleBlock

PARAMETERS = (
    fixed('recording', '', 'file or rosbag2 folder to play'),
    Parameter('loop', False, 'start again at the end; times and indices continue'),
    fixed('tach', 'auto', 'keyphasor to play; both: pulses and waveform; auto: the first of '
          'pulses, waveform, reference',
          choices=('auto', 'pulses', 'waveform', 'reference', 'both', 'none')),
    fixed('keyphasor_rate', 0.0, 'round pulse times up to a clock of this rate; 0: as recorded',
          unit='Hz', minimum=0.0),
    fixed('recorded_keyphasor', '', 'keyphasor to play, of several in a bag; empty: the first'),
    *READ_PARAMETERS,
    fixed('fields', [], 'NAME=KEY: the key that the file has for a field; or NAME=VALUE',
          element=str),
)


class RecordingPlayer(PlaybackNode):
    """
    Publishes the vibration and the keyphasor of a recording.

    The option `--field NAME=VALUE` sets its parameter `fields`; it may be repeated.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('recording_player', PARAMETERS, **node_kwargs)
        values = self.parameters.values()
        if not values['recording']:
            raise ParameterError('no recording is given: set the parameter recording to a file, '
                                 'as in --ros-args -p recording:=rig.npz')
        given = {item.name: values[item.name] for item in READ_PARAMETERS if values[item.name]}
        recording = read(values['recording'], keyphasor=values['recorded_keyphasor'],
                         **{**given, **fields_of(values['fields'])})
        channels = self.parameters.declare_channels()
        # It is played as it is; who takes it brings it into units, by the order of the channels.
        units, count = recording.units, recording.channels
        if channels and np.any(scale_of(channels, recording.channel_names, units).divisor
                               != scale_of(channels, count, units).divisor):
            raise ParameterError('machine.channels has another order than the recording '
                                 f'({", ".join(recording.channel_names)}): messages carry no '
                                 'names, list the channels in its order')
        for remark in in_units(recording, channels).remarks:
            self.warn(remark)
        recording, remarks = usable_channels(recording)
        for path in parameter_files(node_kwargs.get('cli_args') or sys.argv):
            recording = on_target(recording, path)
        # A target that no averager takes is not played.
        PulseValidator(pulses_per_revolution=recording.pulses_per_revolution, **recording.target)
        self._recording = recording
        self._pulse_times, self._with_waveform = keyphasor_of(recording, values['tach'])
        for remark in (*remarks, *doubts(
                recording, self._pulse_times, orders=recording.orders, ratio=recording.ratio,
                pulses_per_revolution=recording.pulses_per_revolution,
                pulses_per_trigger=recording.pulses_per_trigger, **recording.target)):
            self.warn(remark)
        if self._pulse_times is not None and values['keyphasor_rate'] > 0.0:
            self._pulse_times = (np.ceil(self._pulse_times * values['keyphasor_rate'])
                                 / values['keyphasor_rate'])
        if self._pulse_times is None and not self._with_waveform:
            self.get_logger().warning('only vibration is played: the recording has no keyphasor, '
                                      'or tach is none')
        self._passes = 0
        self.begin(recording.sample_rate, recording.channels,
                   pulses=self._pulse_times is not None, waveform=self._with_waveform)
        self.get_logger().info(
            f'started: {values["recording"]}, {recording.channels} channels at '
            f'{recording.sample_rate:g} Hz, {recording.duration:.3f} s')

    def check(self, values: Values) -> None:
        """Raise ParameterError for a loop that begins after the end."""
        if self._stream is None and values['loop'] > self.again() and not values['playing']:
            raise ParameterError('loop is true after the end: set playing: true with it')

    def portions(self) -> Iterator[Portion]:
        """Return one pass through the recording; times and indices continue those of the last."""
        number, self._passes = self._passes, self._passes + 1
        return passage(self._recording, self._pulse_times, self._with_waveform, self._block,
                       number, self.counts)

    def again(self) -> bool:
        """Return whether the recording is looped."""
        return bool(self.parameters.values()['loop'])

    def progress(self, sent: float) -> str:
        """Return how much of the recording was sent."""
        total = self._recording.duration
        passed = sent - (self._passes - 1) * total
        loops = f', pass {self._passes}' if self._passes > 1 else ''
        return f'{passed:.1f} of {total:.1f} s ({passed / total:.0%}){loops}'


def keyphasor_of(recording: Recording, tach: str) -> tuple[FloatArray | None, bool]:
    """Return the pulse times to play (None for none) and whether to play the waveform."""
    offers = {'pulses': recording.pulse_times is not None, 'waveform': recording.tach is not None,
              'reference': recording.reference_pulse_times is not None}
    wanted = {'auto': next(([name] for name in offers if offers[name]), []), 'none': [],
              'both': ['pulses', 'waveform']}.get(tach, [tach])
    for name in wanted:
        if not offers[name]:
            found = ', '.join(item for item in offers if offers[item]) or 'no keyphasor'
            raise ParameterError(f'tach is {tach!r}, but the recording contains {found}: set '
                                 'tach to auto')
    pulses = (recording.reference_pulse_times if 'reference' in wanted
              else recording.pulse_times if 'pulses' in wanted else None)
    return pulses, 'waveform' in wanted


def passage(recording: Recording, pulse_times: FloatArray | None, with_waveform: bool,
            block_samples: int, number: int, counts: dict[str, int]) -> Iterator[Portion]:
    """
    Iterate over pass `number` of a recording.

    `counts` counts what is not played: samples that are NaN, and pulses after the last sample.
    """
    rate, origin = recording.sample_rate, recording.start_time
    first = number * recording.samples
    shift = first / rate
    pulses = np.empty(0) if pulse_times is None else pulse_times
    # The first pass also sends the pulses before the first sample.
    start_time = -np.inf if number == 0 else origin
    tach_rate = (recording.tach_rate or rate) if with_waveform else rate
    waveform = _SampleQueue(recording.tach_blocks() if with_waveform else iter(()))
    tach_first = round(shift * tach_rate)
    done = 0
    for block in recording.blocks(block_samples):
        start, done = done, done + block.shape[1]
        stop_time = origin + done / rate
        low, high = np.searchsorted(pulses, [start_time, stop_time])
        start_time = stop_time
        vibration = SampleBlock(
            block, origin + (first + start) / rate, rate, first + start).finite_parts()
        counts['samples_dropped'] += block.shape[1] - sum(
            item.samples.shape[1] for item in vibration)
        tach_index = round(start / rate * tach_rate)
        samples = waveform.take(round(done / rate * tach_rate) - tach_index)
        index = tach_first + tach_index
        tach = SampleBlock(samples, origin + index / tach_rate, tach_rate, index).finite_parts()
        yield Portion(block.shape[1] / rate, vibration, tach, pulses[low:high] + shift)
    counts['pulses_dropped'] += int(np.count_nonzero(pulses >= start_time))


class _SampleQueue:
    """Samples of successive blocks, taken in parts of any length."""

    def __init__(self, blocks: Iterator[FloatArray]) -> None:
        self._blocks = blocks
        self._held = np.empty((1, 0))

    def take(self, count: int) -> FloatArray:
        """Return the next `count` samples, fewer at the end."""
        while self._held.shape[1] < count:
            block = next(self._blocks, None)
            if block is None:
                break
            self._held = np.concatenate([self._held, block], axis=1)
        taken, self._held = self._held[:, :count], self._held[:, count:]
        return taken


def with_fields(args: Sequence[str]) -> list[str]:
    """
    Return a command line in which the parameter `fields` holds the options `--field`.

    >>> with_fields(['player', '--field', 'ratio=2.5', '--ros-args', '-p', 'rate:=2.0'])
    ['player', '--ros-args', '-p', 'rate:=2.0', '--ros-args', '-p', 'fields:=["ratio=2.5"]']
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument('--field', action='append')
    try:
        found, others = parser.parse_known_args(args)
    except argparse.ArgumentError:  # an option without its value, which rcl leaves alone
        return list(args)
    if found.field:
        others += ['--ros-args', '-p', f'fields:={json.dumps(found.field)}']
    return others


def main(args: Sequence[str] | None = None) -> int:
    """Run the node; `--field NAME=VALUE` sets its parameter `fields`."""
    return run_node(RecordingPlayer, with_fields(sys.argv if args is None else args))


if __name__ == '__main__':
    raise SystemExit(main())
