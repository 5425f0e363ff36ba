# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Common base of player and simulator: sends a stream at a given rate, starts and stops."""

from collections.abc import Iterator
from dataclasses import dataclass
import math
import time
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.nodes.base import INPUT_QOS, MonitoringNode
from sa_jitter_ros.nodes.messages import (
    encode_samples, encode_samples_float32, known_type, SAMPLE_TYPES)
from sa_jitter_ros.nodes.parameters import as_ros_parameter
from sa_jitter_ros.nodes.signals import PulseOutput
from sa_jitter_ros.parameters import fixed, Parameter, TACH_TYPE, Values
from sa_jitter_ros.samples import SampleBlock
from std_msgs.msg import Float64MultiArray

TRANSPORT_BYTES_PER_SECOND = 100e6
MAX_LAG = 0.5  # s; a stream that lags more continues from now instead of catching up
PROGRESS_PERIOD = 5.0  # s between log lines on progress

PLAYBACK_PARAMETERS = (
    Parameter('rate', 1.0, 'speed of playing over real time', above=0.0, maximum=1000.0),
    Parameter('playing', True, 'false: pause'),
    fixed('block_seconds', 0.05, 'length of a message; less if above message_bytes', unit='s',
          minimum=0.001, maximum=1.0),
    fixed('message_bytes', 300_000, 'largest message; more only with config/fastdds.xml', unit='B',
          minimum=10_000, maximum=16_000_000),
    fixed('wait_seconds', 3.0, 'longest wait for subscribers before the start', unit='s',
          minimum=0.0, maximum=60.0),
    fixed('vibration_type', 'std_msgs/Float64MultiArray', 'message type of vibration and '
          'tach_waveform; or std_msgs/Float32MultiArray'),
    TACH_TYPE,
    fixed('keyphasor', 'keyphasor', 'name of the keyphasor: source of the pulses'),
)
_WRITTEN_TYPES = {name: SAMPLE_TYPES[name] for name in SAMPLE_TYPES if 'MultiArray' in name}


@dataclass(frozen=True)
class Portion:
    """Part of a stream: what to publish, and how much machine time (s) it contains."""

    seconds: float
    vibration: tuple[SampleBlock, ...]
    waveform: tuple[SampleBlock, ...]
    pulses: FloatArray


class Pacer:
    """Calculates how much machine time should have been sent, with pauses and changing rates."""

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self._due = 0.0
        self._since: float | None = None

    def due(self, now: float) -> float:
        """Return the machine time in s that should have been sent by `now`."""
        return self._due + (0.0 if self._since is None else (now - self._since) * self.rate)

    def run(self, now: float, *, rate: float, running: bool) -> None:
        """Continue at a rate from `now`, or pause."""
        self._due = self.due(now)
        self.rate, self._since = rate, now if running else None

    def skip(self, lag: float) -> None:
        """Reduce the machine time that is due by `lag` seconds."""
        self._due -= lag


class PlaybackNode(MonitoringNode):
    """Publishes a stream at a given rate; a subclass yields its parts in `portions`."""

    takes_data = False

    def __init__(self, name: str, parameters: tuple[Parameter, ...], **node_kwargs: Any) -> None:
        super().__init__(name, PLAYBACK_PARAMETERS + parameters, **node_kwargs)
        values = self.parameters.values()
        kind = known_type('vibration_type', values['vibration_type'], _WRITTEN_TYPES)
        self._encode = (encode_samples if SAMPLE_TYPES[kind] is Float64MultiArray
                        else encode_samples_float32)
        self._sample_type = SAMPLE_TYPES[kind]
        self._vibration = self.create_output(self._sample_type, 'vibration', INPUT_QOS)
        self._keyphasor, self._tach_type = values['keyphasor'], values['tach_type']
        self._tach_pulse: PulseOutput | None = None  # where there is something to publish
        self._waveform: Any = None
        self._pacer = Pacer(values['rate'])
        self._playing, self._started, self._heard = values['playing'], False, False
        self._asked, self._wait = time.monotonic(), values['wait_seconds']
        self._idle_until = self._sent = 0.0
        self._progress_time = -math.inf
        self._stream: Iterator[Portion] | None = None

    # --- methods of a subclass ---

    def portions(self) -> Iterator[Portion]:
        """Return the next pass through the stream; times and indices continue."""
        raise NotImplementedError

    def again(self) -> bool:
        """Return whether another pass follows."""
        return False

    def progress(self, sent: float) -> str:
        """Return the progress after `sent` seconds of machine time, as a text."""
        return f'{sent:.1f} s sent'

    # --- starting ---

    def begin(self, sample_rate: float, channels: int, *, pulses: bool, waveform: bool) -> None:
        """Create the publishers of the keyphasor and start; call it at the end of `__init__`."""
        values = self.parameters.values()
        seconds, most = float(values['block_seconds']), int(values['message_bytes']) - 4096
        self._block = max(1, min(round(seconds * sample_rate), most // (8 * channels)))
        self._portion_seconds, self._portion_bytes = (
            self._block / sample_rate, 8 * self._block * channels)
        if pulses:
            self._tach_pulse = PulseOutput(self, self._tach_type)
        if waveform:
            self._waveform = self.create_output(self._sample_type, 'tach_waveform', INPUT_QOS)
        self._stream = self.portions()
        self._timer = self.create_steady_timer(self._period(self._pacer.rate), self._tick)
        self.parameters.watch(check=self.check, apply=self.apply)

    def check(self, values: Values) -> None:
        """Raise SaJitterError for values with which the node cannot run."""

    def apply(self, values: Values) -> None:
        """Apply changed values."""
        if values['playing'] and not self._playing:
            self._asked = time.monotonic()
            if self._stream is None:
                self._stream = self.portions()  # the stream has ended: play it again
                self.set_fault('stream', '')
        self._playing = values['playing']
        self._timer.timer_period_ns = round(self._period(values['rate']) * 1e9)
        self._pacer.run(time.monotonic(), rate=values['rate'],
                        running=self._playing and self._started)

    def _period(self, rate: float) -> float:
        return float(np.clip(self._portion_seconds / rate, 0.002, 0.05))

    # --- sending ---

    def _tick(self) -> None:
        now = time.monotonic()
        if not self._playing or now < self._idle_until or not (self._started or self._may_start()):
            return
        due, period = self._pacer.due(now), self._period(self._pacer.rate)
        most = math.ceil(period * self._pacer.rate / self._portion_seconds) + 1
        most = min(most, max(1, int(period * TRANSPORT_BYTES_PER_SECOND / self._portion_bytes)))
        try:
            for _ in range(most):
                if self._sent >= due or not self._send_next():
                    break
        except SaJitterError as error:
            self.set_fault('stream', f'ended early: {error}')
            self.get_logger().error(self.faults['stream'])
            self._end()
            return
        lag = due - self._sent
        if self._playing and lag > MAX_LAG * self._pacer.rate + 2 * self._portion_seconds:
            self._pacer.skip(lag)
            self.warn(f'this computer cannot send at {self._pacer.rate:g} x real time: the '
                      'signals are sent more slowly')
        # Other nodes in this executor get at least half of its time.
        ended = time.monotonic()
        self._idle_until = ended + (ended - now)
        self._log_progress()

    def _may_start(self) -> bool:
        """Start when vibration and keyphasor have subscribers, or have had `wait_seconds` to."""
        tach = [] if self._tach_pulse is None else [self._tach_pulse.subscribers]
        tach += [] if self._waveform is None else [self._waveform.get_subscription_count()]
        subscribed = self._vibration.get_subscription_count() > 0 and (not tach or any(tach))
        now = time.monotonic()
        self._started = subscribed or now - self._asked >= self._wait
        if self._started:
            self._pacer.run(now, rate=self._pacer.rate, running=True)
        return self._started

    def _send_next(self) -> bool:
        if self._stream is None:
            return False
        portion = next(self._stream, None)
        if portion is None and self.again():
            self._stream = self.portions()
            portion = next(self._stream, None)
        if portion is None:
            self.get_logger().info(
                f'end: {self.progress(self._sent)}, {self._pulses_sent()} pulses')
            if not self._heard:
                self.warn('nobody took the vibration: start its subscribers first, and compare '
                          'topics and namespaces (ros2 topic list)')
            self._end()
            return False
        self._heard = self._heard or self._vibration.get_subscription_count() > 0
        for block in portion.vibration:
            self._vibration.publish(self._encode(block))
        for block in portion.waveform:
            self._waveform.publish(self._encode(block))
        if self._tach_pulse is not None:
            self.counts['pulses_dropped'] += self._tach_pulse.publish(
                portion.pulses, self._keyphasor)
        self._sent += portion.seconds
        return True

    def _pulses_sent(self) -> int:
        return 0 if self._tach_pulse is None else self._tach_pulse.published

    def _end(self) -> None:
        self._stream = None
        self.set_parameters([as_ros_parameter('playing', False)])

    def _log_progress(self) -> None:
        if time.monotonic() - self._progress_time >= PROGRESS_PERIOD:
            self._progress_time = time.monotonic()
            self.get_logger().info(self.progress(self._sent))

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return state and progress, and how much was sent."""
        state = ('ended' if self._stream is None else 'paused' if not self._playing
                 else 'playing' if self._started else 'waiting for subscribers')
        return f'{state}, {self.progress(self._sent)}', {
            'seconds_sent': f'{self._sent:.3f}', 'pulses_sent': self._pulses_sent()}
