"""Synchronous averaging of vibration, honest about what the keyphasor does to it."""

__version__ = '0.1.0'
