"""What the demo does with a recording: how to average it, and what to declare for it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sa_jitter_ros.averaging.average import KeyphasorParameters
from sa_jitter_ros.averaging.averager import Averager
from sa_jitter_ros.errors import RecordingError
from sa_jitter_ros.recordings import Recording

FloatArray = NDArray[np.float64]

LOOK = 10.0  # s of a recording that are looked at before it is played
ORDERS = 6
AVERAGES = 8  # that a recording should give


@dataclass(frozen=True)
class Plan:
    """
    How a source is played, averaged and predicted.

    `source` is the node that plays it, with `source_parameters`; `seconds` it lasts, `speed` of
    the tach shaft and `keyphasor_rate` in Hz; `pulses_per_trigger` is 0 for all of a revolution;
    `waveform` tells that pulses come from a tach waveform; `note` is a remark for the user.
    """

    source: str
    source_parameters: Mapping[str, object]
    title: str
    seconds: float
    channels: tuple[str, ...]
    unit: str
    speed: float
    keyphasor_rate: float
    pulses_per_revolution: int
    ratio: float
    trigger_cycles: int
    orders: tuple[float, ...]
    waveform: bool = False
    pulses_per_trigger: int = 0
    note: str = ''


_SPEED, _RATIO, _CLOCK, _SECONDS = 16.6, 2.40789, 3000.0, 20.0
SIMULATED = Plan(
    source='machine_simulator',
    source_parameters={
        'speed': _SPEED, 'shaft.ratio': _RATIO, 'shaft.teeth': 19,
        'shaft.harmonics': (1.0, 0.5, 0.25), 'shaft.sidebands': 0.1,
        'speed_fluctuation_std': 2e-4, 'channel_gains': (1.0, 0.6), 'noise_std': 0.3,
        'sample_rate': 20000.0, 'keyphasor_rate': _CLOCK, 'duration': _SECONDS, 'seed': 1},
    title='simulated gearbox, gear of 19 teeth', seconds=_SECONDS,
    channels=('channel 0', 'channel 1'), unit='m/s^2', speed=_SPEED, keyphasor_rate=_CLOCK,
    pulses_per_revolution=1, ratio=_RATIO, trigger_cycles=30,
    orders=(18.0, 19.0, 20.0, 37.0, 38.0, 39.0, 57.0))


def plan_recording(path: Path, recording: Recording, *, keyphasor_rate: float = 0.0,
                   parameters: Mapping[str, object] | None = None) -> Plan:
    """
    Look at the first seconds of a recording.

    `parameters` are those with which `recording_player` opens its file, at `path`, as it is opened
    here. With `keyphasor_rate` (Hz) its pulse times are rounded up to a clock of that rate, as if
    the keyphasor had been sampled so. Raises `RecordingError` if the recording cannot be used.
    """
    first, pulses = _first_seconds(recording)
    triggers = _keyphasor(recording).validator().update(pulses)
    cycles = np.diff(triggers.times)[~triggers.starts_run[1:]]
    if len(cycles) < 4:
        raise RecordingError(f'{len(pulses)} pulses give {len(cycles)} trigger cycles in '
                             f'the first {LOOK:g} s: at least 4 are needed')
    period = float(np.median(cycles))
    trigger_cycles = int(np.clip(recording.duration / period // AVERAGES, 2, 100))
    waveform = recording.pulse_times is None and recording.tach is not None
    if keyphasor_rate and waveform:
        raise RecordingError('a tach waveform has the rate at which it was sampled: leave '
                             '--keyphasor-rate out')
    rate = keyphasor_rate or recording.tach_rate or recording.sample_rate
    note = '' if keyphasor_rate or recording.tach_rate else (
        'the recording does not say at which rate the keyphasor was sampled: that of the '
        'vibration is assumed')
    return Plan(
        source='recording_player',
        source_parameters={'recording': str(path), 'keyphasor_rate': keyphasor_rate,
                           **(parameters or {})},
        title=path.name, seconds=recording.duration,
        channels=recording.channel_names, unit=recording.units[0] if recording.units else '',
        speed=_keyphasor(recording).revolutions_per_trigger / period, keyphasor_rate=rate,
        pulses_per_revolution=recording.pulses_per_revolution, ratio=recording.ratio,
        trigger_cycles=trigger_cycles,
        orders=recording.orders or _strongest_orders(recording, first, pulses, trigger_cycles),
        waveform=waveform, pulses_per_trigger=recording.pulses_per_trigger or 0, note=note)


def _keyphasor(recording: Recording) -> KeyphasorParameters:
    return KeyphasorParameters(pulses_per_revolution=recording.pulses_per_revolution,
                               pulses_per_trigger=recording.pulses_per_trigger)


def _first_seconds(recording: Recording) -> tuple[FloatArray, FloatArray]:
    """Vibration and pulse times of the first seconds."""
    samples = next(recording.blocks(round(LOOK * recording.sample_rate)))
    return samples, recording.keyphasor_pulses(duration=samples.shape[1] / recording.sample_rate)


def _strongest_orders(recording: Recording, samples: FloatArray, pulses: FloatArray,
                      trigger_cycles: int) -> tuple[float, ...]:
    """Orders that stand out most in the first average."""
    averages = Averager(
        recording.sample_rate, start_time=recording.start_time, ratio=recording.ratio,
        pulses_per_revolution=recording.pulses_per_revolution,
        pulses_per_trigger=recording.pulses_per_trigger, trigger_cycles=trigger_cycles,
    ).update(samples, pulses)
    if not averages:
        return (1.0, 2.0, 3.0)
    waveform = averages[0].waveform
    amplitude = np.abs(np.fft.rfft(waveform, axis=1)).max(axis=0)[1:waveform.shape[1] // 3]
    strongest = np.sort(np.argsort(amplitude)[-ORDERS:]) + 1
    return tuple(float(order) for order in strongest)
