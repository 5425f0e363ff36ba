# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The library's synchronous average of arrays: at once (`average`) or block by block (`Averager`).

Both use the stream of the node `synchronous_averager` and take its parameters under the same
names. Three defaults differ: `trigger_cycles` None averages all cycles, `keyphasor_rate` None is
the sampling rate of the vibration, and `buffer_seconds` is unlimited.
"""

from dataclasses import fields
from typing import TYPE_CHECKING
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sa_jitter_ros.averaging.average import Average, KeyphasorParameters
from sa_jitter_ros.averaging.envelope import EnvelopeSettings
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.averaging.interpolator_gain import without_amplitude
from sa_jitter_ros.averaging.options import (
    AverageOptions, AveragerOptions, completed, with_keywords)
from sa_jitter_ros.averaging.shaft_indicators import ShaftIndicators
from sa_jitter_ros.averaging.standing_orders import without_lines
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.averaging.uneven_revolution import lost_inside_revolutions
from sa_jitter_ros.errors import DataWarning, ParameterError, SignalError
from sa_jitter_ros.parameters import number, numbers
from sa_jitter_ros.pulses.target_geometry import MarkOffsets
from sa_jitter_ros.pulses.unit_check import is_waveform, likely_mistake, other_rate
from sa_jitter_ros.samples import check_samples, SampleBlock

if TYPE_CHECKING:
    from typing_extensions import Unpack

_PIECE = 1 << 18  # samples of a channel that are handed on at once, so that memory stays small
_ALL_CYCLES = 1 << 60  # more trigger cycles than a stream has
_SHAFT = 'shaft'


class Averager:
    """
    Synchronous averages of one shaft from vibration and pulses in blocks.

    `sample_rate` (Hz) and `start_time` (s) of the first sample put the vibration on the clock of
    the pulses; `ratio` is the speed of the shaft over that of the tach shaft, `trigger_cycles` N_t
    (None: all of an uninterrupted run, returned where it ends), `orders` are multiples of the
    shaft speed (None: 1, 2, 3). With a `machine` (`sa.Machine`) ratio, orders, mesh and bearing
    orders of its `shaft`, by default the one that turns with `ratio`, follow where they are not
    given. The other keywords are the parameters of the node
    `synchronous_averager`.

    The averages depend on the data only: not on the sizes of the blocks, and not on whether pulses
    come before or after their samples. An average contains consecutive trigger cycles only, unless
    `maximum_discarded` (0 to 1) lets up to this share of N_t discarded ones lie between them.
    Samples that are NaN or infinite in all channels are a gap, in one of them they cost this
    channel alone, which is NaN; stray pulses are dropped; cycles with displaced, late or missing
    pulses are discarded. `messages` describes what was discarded, `counts` counts it.
    Samples wait for their pulses, and pulses for their samples, up to `buffer_seconds`: set a
    limit if one of the two may fail. Raises `ParameterError` for parameters that cannot be used.

    A shaft at 25 Hz whose 8th order has an amplitude of 2 m/s^2, in blocks of a second:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> averager = sa.Averager(5000.0, trigger_cycles=20, orders=[8.0])
    >>> for start in 0.0, 1.0:
    ...     time = start + np.arange(5000) / 5000.0
    ...     pulses = start + 0.02 + np.arange(25) / 25.0
    ...     for average in averager.update(2.0 * np.cos(2.0 * np.pi * 200.0 * time), pulses):
    ...         print(average.sequence, round(average.start_time, 2), average.trigger_cycles,
    ...               abs(average.amplitudes).round(3))
    0 0.02 20 [[2.]]
    1 0.82 20 [[2.]]
    >>> averager.flush(), averager.counts['trigger_cycles']
    ((), 49)
    """

    @with_keywords(AveragerOptions)
    def __init__(self, sample_rate: float, **options: 'Unpack[AveragerOptions]') -> None:
        values = completed(options, AveragerOptions)
        sample_rate = number('sample_rate', sample_rate)
        start_time = number('start_time', values.pop('start_time'))
        buffer_seconds = number('buffer_seconds', values.pop('buffer_seconds'))
        endless = values['trigger_cycles'] is None
        if not (np.isfinite(sample_rate) and sample_rate > 0.0):
            raise ParameterError(f'sample_rate is {sample_rate} Hz: give a positive rate')
        if not np.isfinite(start_time):
            raise ParameterError(f'start_time is {start_time} s: give the time of the first '
                                 'sample on the clock of the pulses')
        if not buffer_seconds > 0.0:
            raise ParameterError(f'buffer_seconds is {buffer_seconds} s: give a positive time')
        if endless and values['averaging'] != 'block':
            raise ParameterError(f'averaging is {values["averaging"]!r} without trigger_cycles: '
                                 'set the number of trigger cycles in the window')
        if endless:
            values['trigger_cycles'] = _ALL_CYCLES
        values['keyphasor_rate'] = values['keyphasor_rate'] or 0.0
        keyphasor = KeyphasorParameters(**{
            item.name: values.pop(item.name) for item in fields(KeyphasorParameters)})
        self._indicators = ShaftIndicators(GearSettings(
            numbers('mesh_orders', values.pop('mesh_orders')), values.pop('sidebands')))
        envelope = EnvelopeSettings(numbers('bearing_orders', values.pop('bearing_orders')),
                                    numbers('envelope_band', values.pop('envelope_band')))
        self._stream = StreamingAverager(
            {_SHAFT: keyphasor.average(envelope=envelope, **values)},
            validator=keyphasor.validator(), timeline=VibrationTimeline(
                time_tolerance=keyphasor.time_tolerance, buffer_seconds=buffer_seconds),
            keep_unfinished=endless)
        self._rate, self._start_time = sample_rate, start_time
        self._index = 0
        self._channels: int | None = None
        self._ended = False
        self.messages: list[str] = []

    @property
    def counts(self) -> dict[str, int]:
        """
        Return how much data was used and discarded, by the keys of the node's diagnostics.

        `trigger_cycles` were averaged; `pulses_missing_broken`, `pulses_doubles`, ... count the
        pulses by kind (`sa_jitter_ros.pulses.validation.PulseCounts`).
        """
        stream = self._stream
        return {
            'trigger_cycles': stream.counts.cycles, **stream.totals,
            'samples_non_finite': stream.timeline.counts.non_finite,
            **{f'pulses_{name}': count for name, count in vars(stream.pulse_counts).items()}}

    @property
    def problem(self) -> str:
        """Return why the latest average has no condition indicators, '' if it has."""
        return self._indicators.problem

    @property
    def geometry(self) -> MarkOffsets | None:
        """Return what `target_geometry` takes from the pulses of each mark, None for nothing."""
        return self._stream.geometry

    def update(self, vibration: ArrayLike | None = None, pulse_times: ArrayLike | None = None,
               ) -> tuple[Average, ...]:
        """
        Take the next samples and pulses, either or both, and return the averages that are due.

        `vibration` (channel, sample), or (sample,) for one channel, continues the samples before;
        `pulse_times` (pulse,) in s, in order of arrival. Raises `SignalError`, and takes nothing,
        for arrays that are not real numbers or have another shape or number of channels.
        """
        if self._ended:
            raise SignalError('update after flush, which ends the stream: make another Averager')
        samples = None if vibration is None else self._checked(vibration)
        self._indicators.catch_up()  # a stream must not keep all its averages
        found = []
        if pulse_times is not None:
            times = np.atleast_1d(np.asarray(pulse_times))
            if samples is not None and is_waveform(times, samples.shape[1]):
                raise SignalError(
                    f'pulse_times are {times.size} values that do not rise, as those of a sampled '
                    'tach: give its pulse times, detect_pulses(tach, tach_rate)')
            found += self._stream.add_pulses(times)
        if samples is not None and samples.size:
            self._channels = len(samples)
            for first in range(0, samples.shape[1], _PIECE):
                piece = samples[:, first:first + _PIECE].astype(np.float64)
                found += self._stream.add_samples(SampleBlock(
                    piece, self._start_time + self._index / self._rate, self._rate, self._index))
                self._index += piece.shape[1]
        return self._taken(found)

    def flush(self) -> tuple[Average, ...]:
        """Return the averages that are due because the stream ends here."""
        self._ended = True
        return self._taken(self._stream.finish())

    def _checked(self, vibration: ArrayLike) -> NDArray[np.generic]:
        samples = _array(vibration)
        if samples.ndim == 1:
            samples = samples[None]
        if samples.ndim != 2 or samples.dtype.kind not in 'fiu':
            raise SignalError(f'vibration has type {samples.dtype} and shape {samples.shape}: '
                              'give real numbers, (channel, sample) or (sample,)')
        if self._channels not in (None, len(samples)) and samples.size:
            raise SignalError(f'vibration has {len(samples)} channels and had {self._channels} '
                              'before: give (channel, sample) with the same channels')
        check_samples(samples, SignalError)
        return samples

    def _taken(self, found: list[tuple[str, Average]]) -> tuple[Average, ...]:
        self.messages += self._stream.take_messages()
        return tuple(self._indicators.added(average) for _, average in found)


@with_keywords(AverageOptions)
def average(vibration: ArrayLike, sample_rate: float, pulse_times: ArrayLike,
            **options: 'Unpack[AverageOptions]') -> tuple[Average, ...]:
    """
    Return the synchronous averages of a recording of vibration (channel, sample) or (sample,).

    `pulse_times` (pulse,) in s are on the clock on which the first sample is at `start_time`. The
    keywords are those of `Averager`: without `trigger_cycles` all cycles make one average, or one
    for every uninterrupted run of them. A `DataWarning` says what is discarded. Raises
    `ParameterError` for parameters and `SignalError` for arrays that cannot be used, also if they
    contain fewer trigger cycles than an average needs.

    A gear mesh of 19 teeth on a shaft at 16.6 Hz whose keyphasor is sampled at 1 kHz. The average
    shows less than the true amplitude of 2 m/s^2. The correction recovers the pulse errors from
    the vibration, and with them the true amplitude:

    >>> import numpy as np
    >>> import sa_jitter_ros as sa
    >>> time = np.arange(60_000) / 20e3
    >>> angle = 16.6 * time  # revolutions
    >>> rng = np.random.default_rng(1)
    >>> vibration = 2.0 * np.cos(2.0 * np.pi * 19.0 * angle) + rng.normal(0.0, 0.3, time.size)
    >>> pulses = np.ceil(np.arange(48) / 16.6 * 1e3) / 1e3
    >>> result, = sa.average(vibration, 20e3, pulses, orders=[19.0], correct_jitter=True,
    ...                      keyphasor_rate=1e3)
    >>> abs(result.amplitudes).round(2), abs(result.correction.amplitudes).round(2)
    (array([[1.8]]), array([[2.]]))
    >>> result.trigger_cycles, round(result.trigger_speed, 2), result.waveform.shape
    (47, 16.6, (1, 1296))
    >>> bool(np.ptp(result.correction.pulse_errors) < 1.05 / 1e3)  # a sample of the keyphasor
    True
    """
    values = completed(options, AverageOptions)
    averager = Averager(sample_rate, **options)
    samples, pulses = _array(vibration), np.asarray(pulse_times)
    if pulse_times is None:
        raise SignalError('pulse_times is None: give the pulse times in s; those of a recording '
                          'are recording.keyphasor_pulses()')
    if samples.ndim == 2 and samples.shape[0] > samples.shape[1] > 0:
        raise SignalError(f'vibration has {samples.shape[0]} channels of {samples.shape[1]} '
                          'samples: give (channel, sample), transpose it')
    found = averager.update(samples, pulses) + averager.flush()
    discarded = _discarded(averager)
    start = float(values['start_time'])
    end = start + float(samples.shape[-1] / sample_rate)
    likely = likely_mistake(pulses, start, end, float(sample_rate))
    if not found:
        counts = averager.counts
        wanted = values['trigger_cycles']
        of_average = '' if wanted is None else f' of the {wanted} of an average'
        raise SignalError(
            f'{pulses.size} pulses and vibration from {start:g} s to {end:g} s make '
            f'{counts["trigger_cycles"]} whole trigger cycles{of_average}: '
            + (likely or discarded or 'lower trigger_cycles, or give more pulses'))
    doubt = likely or other_rate(pulses, start, end, float(sample_rate))
    lines = ['; '.join(filter(None, (doubt, discarded)))]
    if not lines[0] and values['target_geometry'] == 'none':
        lines[0] = lost_inside_revolutions(
            pulses, averager._stream.shafts[_SHAFT].settings, values['pulses_per_revolution'],
            values['missing_teeth'])
    if averager.problem:
        lines.append(f'no condition indicators: {averager.problem}')
    lines.append(without_amplitude(max(found, key=lambda item: len(item.refused)).refused))
    envelopes = [item.envelope.problem for item in found if item.envelope is not None]
    lines.append(max(envelopes, default='', key=len))
    if values['orders'] is not None:
        lines.append(without_lines(found))
    for line in filter(None, lines):
        warnings.warn(line, DataWarning, stacklevel=2)
    return found


def _array(vibration: ArrayLike) -> NDArray[np.generic]:
    """Return vibration as an array; raise SignalError for a `Recording` or a source of one."""
    if hasattr(vibration, 'blocks'):
        raise SignalError(f'vibration is of type {type(vibration).__name__}, which reads samples '
                          'block by block: give all of them as an array, recording.read()')
    return np.asarray(vibration)


_CAUSES = {
    'samples_non_finite': 'samples that are NaN or infinite',
    'pulses_non_finite': 'pulse times that are NaN or infinite',
    'pulses_doubles': 'double pulses', 'pulses_early': 'early pulses',
    'pulses_late': 'late pulses', 'pulses_missing_broken': 'missing pulses',
    'pulses_missing_bridged': 'missing pulses that were interpolated',
    'pulses_out_of_order': 'pulses out of order',
    'pulses_restarts': 'steps back of the pulse times',
    'pulses_unlocked': 'pulses without a steady interval',
    'pulses_relearnt': 'changes of the pulse interval within one or two pulses'}


def _discarded(averager: Averager) -> str:
    """Return what an averager could not use, and why; '' if it used everything."""
    counts = averager.counts
    causes = [f'{counts[key]} {text}' for key, text in _CAUSES.items() if counts[key]]
    if not (causes or averager.messages or counts['cycles_dropped']):
        return ''
    return '; '.join([
        f'{counts["cycles_dropped"]} trigger cycles were discarded and '
        f'{counts["trigger_cycles"]} averaged', *causes, *averager.messages[:3],
        *(['...'] if len(averager.messages) > 3 else [])])
