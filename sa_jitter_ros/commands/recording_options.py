"""What a command must be told of files that do not say which channel is what."""

import argparse
from collections.abc import Mapping
from pathlib import Path

from sa_jitter_ros.recordings import ChannelMap, open_recording, Recording


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that a `.wav` or `.csv` needs, named as the parameters of the player."""
    group = parser.add_argument_group('channels, where the file does not say them (.wav, .csv)')
    group.add_argument('--tach-channel', default='', metavar='CHANNEL',
                       help='name, or number from 0, of the sampled keyphasor waveform')
    group.add_argument('--vibration-channels', nargs='+', default=[], metavar='CHANNEL',
                       help='names or numbers of the vibration; all but the tach without')
    group.add_argument('--time-column', default='', metavar='COLUMN',
                       help='column of a .csv with the times in s')
    group.add_argument('--sample-rate', type=float, default=0.0, metavar='HZ',
                       help='sampling rate, where the file does not say it')


def open_with(options: argparse.Namespace, path: Path) -> Recording:
    """Open a recording with these options; raises RecordingError."""
    return open_recording(
        path, sample_rate=options.sample_rate or None, channel_map=ChannelMap(
            tuple(options.vibration_channels), options.tach_channel, options.time_column))


def player_parameters(options: argparse.Namespace) -> Mapping[str, object]:
    """Return the parameters with which `recording_player` opens the same."""
    given: dict[str, object] = {
        'tach_channel': options.tach_channel,
        'vibration_channels': tuple(options.vibration_channels),
        'time_column': options.time_column, 'sample_rate': options.sample_rate}
    return {name: value for name, value in given.items() if value}
