"""One door for all recordings: `open_recording`."""

from dataclasses import replace
import os
from pathlib import Path

from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings.bag_format import open_bag
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.csv_format import open_csv
from sa_jitter_ros.recordings.mat_format import open_mat
from sa_jitter_ros.recordings.npz_format import open_npz
from sa_jitter_ros.recordings.recording import Recording, recording_errors
from sa_jitter_ros.recordings.wav_format import open_wav

SUFFIXES = ('.npz', '.mat', '.wav', '.csv', '.mcap', '.db3')


def open_recording(path: str | os.PathLike[str], *, channel_map: ChannelMap | None = None,
                   sample_rate: float | None = None, acquisition: int = 0,
                   keyphasor: str = '') -> Recording:
    """
    Open a recording of any format; its vibration is read later, in blocks.

    Parameters
    ----------
    path
        `.npz`, `.mat`, `.wav`, `.csv`, `.mcap` or `.db3` file, or a rosbag2 folder.
    channel_map
        Which channels are vibration and which one is the tach.
    sample_rate
        Hz, where the file does not say it (`.csv` without times, bags of
        Float32MultiArray or Imu).
    acquisition
        Which one, of a file that holds several (`Recording.acquisitions`).
    keyphasor
        Which one, of a bag that holds several; '' for the first seen.

    Raises
    ------
    RecordingError
        If the file is missing, broken, unsafe or lacks what a recording needs, in one line that
        starts with the path.

    """
    path = Path(path)
    chosen = channel_map or ChannelMap()
    with recording_errors(path):
        if not path.exists():
            raise RecordingError('no such file or folder')
        suffix = 'bag' if path.is_dir() else path.suffix.lower()
        if suffix not in ('bag', *SUFFIXES):
            raise RecordingError(f'cannot be read: {suffix or "no suffix"} is not one of '
                                 f'{", ".join(SUFFIXES)} or a rosbag2 folder')
        if suffix in ('bag', '.mcap', '.db3'):
            recording = open_bag(path, channel_map=chosen, sample_rate=sample_rate,
                                 keyphasor=keyphasor)
        elif suffix == '.csv':
            recording = open_csv(path, channel_map=chosen, sample_rate=sample_rate)
        elif suffix == '.wav':
            recording = chosen.select(open_wav(path))
        else:
            opened = open_npz if suffix == '.npz' else open_mat
            recording = chosen.select(opened(path, acquisition=acquisition))
        if acquisition >= recording.acquisitions or acquisition < 0:
            raise RecordingError(f'acquisition {acquisition}: the file holds '
                                 f'{recording.acquisitions}, numbered from 0')
        if sample_rate is not None and abs(recording.sample_rate / sample_rate - 1) > 1e-6:
            raise RecordingError(f'sample_rate {sample_rate} Hz given, but the file says '
                                 f'{recording.sample_rate} Hz')
        return replace(recording, description=recording.description or path.name)
