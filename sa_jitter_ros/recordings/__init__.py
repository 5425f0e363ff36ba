"""Recordings in files: npz, mat, wav, csv, rosbag2, read in blocks."""
