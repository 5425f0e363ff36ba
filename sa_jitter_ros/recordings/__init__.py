"""Recordings in files: npz, mat, wav, csv, rosbag2, read in blocks."""

from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.reading import read
from sa_jitter_ros.recordings.recording import ArraySource, Recording, SampleSource

__all__ = ['ArraySource', 'Recording', 'SampleSource', 'read', 'write_npz']
