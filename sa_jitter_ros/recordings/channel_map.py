# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Channel maps: which channels of a file are vibration, and which one is the tach waveform."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.recording import changed, Recording, SampleSource


def rows_of(source: SampleSource, rows: Sequence[int]) -> SampleSource:
    """Return some channels of a source, in the order of `rows`."""
    return changed(source, len(rows), itemgetter(list(rows)))


def with_channels(recording: Recording, rows: Sequence[int]) -> Recording:
    """Return a recording with some of its channels, in the order of `rows`."""
    if list(rows) == list(range(recording.channels)):
        return recording
    return replace(recording, vibration=rows_of(recording.vibration, rows),
                   channel_names=tuple(recording.channel_names[row] for row in rows),
                   units=tuple(recording.units[row] for row in rows))


@dataclass(frozen=True)
class ChannelMap:
    """
    Roles of a file's channels, each given by name or by number from 0.

    Parameters
    ----------
    vibration
        Channels that are vibration; empty for all that have no other role.
    tach
        Channel that is the sampled keyphasor waveform; '' for none.
    time
        Column of a `.csv` with the sample times in s; '' for one named `time` or `t`.

    Examples
    --------
    >>> ChannelMap(tach='2').roles(['x', 'y', 'speed'])
    ((0, 1), 2)

    """

    vibration: tuple[str, ...] = ()
    tach: str = ''
    time: str = ''

    def roles(self, names: Sequence[str]) -> tuple[tuple[int, ...], int | None]:
        """Return the rows of the vibration and that of the tach among `names`."""
        tach = find_channel(names, self.tach) if self.tach else None
        rows = tuple(find_channel(names, entry) for entry in self.vibration)
        if not rows:
            rows = tuple(row for row in range(len(names)) if row != tach)
        if not rows:
            raise RecordingError(f'the only channel, {self.tach}, is the tach: name a channel of '
                                 'vibration')
        return rows, tach

    def named(self, names: Sequence[str]) -> 'ChannelMap':
        """Return this map with the names of channels in place of their numbers."""
        def name(entry: str) -> str:
            return names[find_channel(names, entry)] if entry else ''
        return ChannelMap(tuple(map(name, self.vibration)), name(self.tach), name(self.time))

    def select(self, recording: Recording) -> Recording:
        """Return the recording with its channels in their roles."""
        rows, tach = self.roles(recording.channel_names)
        if tach is not None:
            recording = replace(recording, tach=rows_of(recording.vibration, [tach]),
                                tach_rate=recording.sample_rate)
        return with_channels(recording, rows)


def find_channel(names: Sequence[str], entry: str) -> int:
    """
    Return the number of the channel with the name `entry`, else with that number.

    A unit in brackets at the end of a name may be left out if one channel has the rest.

    >>> find_channel(['Drehzahl [V]', 'ax (g)'], 'ax')
    1
    """
    if entry in names:
        return list(names).index(entry)
    if entry.isdecimal() and int(entry) < len(names):
        return int(entry)
    found = [place for place, name in enumerate(names) if name.endswith((']', ')'))
             and name[:max(map(name.rfind, '[('))].rstrip() == entry]
    if len(found) == 1:
        return found[0]
    raise RecordingError(f'no channel {entry!r}: choose from {", ".join(names)}')
