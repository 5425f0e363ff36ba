"""Recordings in files: npz, mat, wav, csv, rosbag2, read in blocks."""

from sa_jitter_ros.recordings.bag_writer import write_bag
from sa_jitter_ros.recordings.channel_map import ChannelMap
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.opening import open_recording
from sa_jitter_ros.recordings.recording import ArraySource, Recording, SampleSource

__all__ = ['ArraySource', 'ChannelMap', 'Recording', 'SampleSource', 'open_recording', 'write_bag',
           'write_npz']
