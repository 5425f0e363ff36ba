"""Options of commands for recordings that do not say which channel is what."""

import argparse
from typing import Any

# Keywords of `sa_jitter_ros.recordings.read`, and parameters of the recording player.
_NAMES = ('sample_rate', 'vibration_channels', 'tach_channel', 'time_column')


def add_recording_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that a `.wav` or `.csv` needs, named as the parameters of the player."""
    group = parser.add_argument_group('channels, where the file does not say them (.wav, .csv)')
    group.add_argument('--tach-channel', default='', metavar='CHANNEL',
                       help='name, or number from 0, of the sampled keyphasor waveform')
    group.add_argument('--vibration-channels', nargs='+', default=(), metavar='CHANNEL',
                       help='names or numbers of the vibration channels (default: all but the '
                       'tach)')
    group.add_argument('--time-column', default='', metavar='COLUMN',
                       help='name or number of the column of a .csv with the times in s')
    group.add_argument('--sample-rate', type=float, metavar='HZ',
                       help='sampling rate of the vibration, where the file does not say it')


def read_options(options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that were given, as keywords of `read` and parameters of the player."""
    return {name: value for name in _NAMES if (value := getattr(options, name))}
