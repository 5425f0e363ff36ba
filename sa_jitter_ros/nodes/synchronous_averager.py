"""Node `synchronous_averager`: vibration and tach pulses in, synchronous averages out."""

from collections.abc import Sequence
from dataclasses import asdict
from math import prod
import re
from typing import Any

import numpy as np
from rclpy.publisher import Publisher
from sa_jitter_ros.angle.laws import LAWS
from sa_jitter_ros.angle.pulses import PulseValidator
from sa_jitter_ros.angle.resampling import METHODS
from sa_jitter_ros.averaging.indicators import RunningIndicators
from sa_jitter_ros.averaging.residual import GearSettings
from sa_jitter_ros.averaging.shaft import AverageSettings, AVERAGING, SynchronousAverage
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import ParameterError, SignalError
from sa_jitter_ros.nodes.base import MonitoringNode, run_node
from sa_jitter_ros.nodes.messages import (AMPLITUDE_FIELDS, AverageHeader, AverageMessage,
                                          decode_pulse_array, decode_pulse_reference,
                                          encode_average, known_type, PULSE_TYPES, SAMPLE_TYPES,
                                          SampleDecoder)
from sa_jitter_ros.nodes.parameters import Parameter, Values
from std_msgs.msg import Float64, Float64MultiArray

PARAMETERS = (
    Parameter('vibration_type', 'std_msgs/Float64MultiArray', 'message type of vibration',
              read_only=True),
    Parameter('tach_type', 'sensor_msgs/TimeReference', 'message type of tach_pulse',
              read_only=True),
    Parameter('sample_rate', 0.0, 'sampling rate where messages carry none, 0 if they do',
              unit='Hz', minimum=0.0, read_only=True),
    Parameter('start_time', 0.0, 'time of sample 0 where messages carry none', unit='s',
              read_only=True),
    Parameter('imu_axis', 'z', 'axes of linear acceleration taken as channels, from x, y, z',
              read_only=True),
    Parameter('keyphasor', '', 'source of the tach pulses to use, empty for the first seen',
              read_only=True),
    Parameter('shafts', ['shaft'], 'names of the shafts to average', read_only=True),
    Parameter('buffer_seconds', 5.0, 'how long samples and pulses wait for each other',
              unit='s', above=0.0, maximum=3600.0, read_only=True),
    Parameter('time_tolerance', 0.01, 'deviation of a header time that starts a new run',
              unit='s', above=0.0, read_only=True),
    Parameter('pulses_per_revolution', 1, 'pulses per revolution of the tach shaft, missing '
              'teeth included', minimum=1, maximum=100000),
    Parameter('pulses_per_trigger', 0, 'pulses per trigger cycle, 0 for all of a revolution',
              minimum=0, maximum=100000),
    Parameter('missing_teeth', 0, 'missing teeth of the target wheel, once a revolution',
              minimum=0, maximum=1000),
    Parameter('missing_pulses', 'break', 'what to do about a missing pulse',
              choices=('break', 'bridge')),
    Parameter('maximum_missing', 3, 'more missing pulses in a row are a standstill',
              minimum=0, maximum=1000),
    Parameter('interval_tolerance', 0.25, 'largest change of a pulse interval that is believed, '
              'as a fraction of it', above=0.0, maximum=0.49),
    Parameter('minimum_interval', 0.0, 'pulses closer than this are double', unit='s',
              minimum=0.0),
    Parameter('trigger_cycles', 40, 'trigger cycles in an average, N_t', minimum=1,
              maximum=1000000),
    Parameter('averaging', 'block', 'kind of average', choices=AVERAGING),
    Parameter('angle_law', 'linear', 'angle between pulses', choices=LAWS),
    Parameter('interpolation', 'band_limited', 'interpolation between samples', choices=METHODS),
)


def shaft_parameters(name: str) -> tuple[Parameter, ...]:
    """Parameters of one shaft."""
    return (
        Parameter(f'{name}.ratio', 1.0, 'speed of the shaft over that of the tach shaft',
                  above=0.0),
        Parameter(f'{name}.ratio_teeth', [], 'tooth counts [driver, driven, ...] that make the '
                  'ratio instead', minimum=1, element=int),
        Parameter(f'{name}.samples_per_revolution', 0, 'points of the waveform, 0 to choose',
                  minimum=0, maximum=1 << 20),
        Parameter(f'{name}.orders', [1.0, 2.0, 3.0], 'orders to publish, multiples of the shaft',
                  above=0.0),
        Parameter(f'{name}.mesh_orders', [], 'tooth counts on the shaft, for the condition '
                  'indicators', above=0.0),
        Parameter(f'{name}.sidebands', 1, 'sideband pairs that belong to a mesh order',
                  minimum=0, maximum=100),
    )


def shaft_settings(values: Values, name: str) -> AverageSettings:
    """Settings of one shaft's average; raises `ParameterError`."""
    teeth = values[f'{name}.ratio_teeth']
    ratio = values[f'{name}.ratio']
    if teeth:
        if ratio != 1.0:
            raise ParameterError(f'{name}.ratio is {ratio} and {name}.ratio_teeth is {teeth}: '
                                 'give one of them')
        if len(teeth) % 2:
            raise ParameterError(f'{name}.ratio_teeth has {len(teeth)} tooth counts: give pairs '
                                 'of driver and driven')
        ratio = prod(teeth[::2]) / prod(teeth[1::2])
    return AverageSettings(
        cycles=ratio * trigger_share(values), trigger_cycles=values['trigger_cycles'],
        orders=tuple(values[f'{name}.orders']),
        samples_per_revolution=values[f'{name}.samples_per_revolution'],
        averaging=values['averaging'], law=values['angle_law'],
        interpolation=values['interpolation'])


def trigger_share(values: Values) -> float:
    """Tach revolutions in a trigger cycle; raises `ParameterError`."""
    revolution, trigger = values['pulses_per_revolution'], values['pulses_per_trigger']
    if trigger > revolution:
        raise ParameterError(f'pulses_per_trigger is {trigger} of {revolution} '
                             'pulses_per_revolution: give at most that many')
    return (trigger or revolution) / revolution


def pulse_validator(values: Values) -> PulseValidator:
    """Validator of the tach pulses; raises `ParameterError`."""
    return PulseValidator(
        pulses_per_revolution=values['pulses_per_revolution'],
        pulses_per_trigger=values['pulses_per_trigger'] or None,
        missing_teeth=values['missing_teeth'], missing_pulses=values['missing_pulses'],
        maximum_missing=values['maximum_missing'],
        interval_tolerance=values['interval_tolerance'],
        minimum_interval=values['minimum_interval'], time_tolerance=values['time_tolerance'])


class SynchronousAverager(MonitoringNode):
    """Averages `vibration` synchronously with `tach_pulse`, for every shaft."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('synchronous_averager', PARAMETERS, **node_kwargs)
        names = self.parameters.values()['shafts']
        wrong = [name for name in names if not re.fullmatch('[a-z][a-z0-9_]*', name)]
        if wrong or not names or len(set(names)) < len(names):
            raise ParameterError(f'shafts is {names}: give different names of small letters, '
                                 'digits and underscores')
        for name in names:
            self.parameters.declare(shaft_parameters(name))
        values = self.parameters.values()
        self._shafts = {name: _ShaftOutput(self, name) for name in names}
        self._averager = self._build(values)
        self._check(values)
        self._apply_indicators(values)
        self._values = values
        self._keyphasor = values['keyphasor']
        self._other_keyphasors = 0
        vibration_type = known_type('vibration_type', values['vibration_type'], SAMPLE_TYPES)
        tach_type = known_type('tach_type', values['tach_type'], PULSE_TYPES)
        self._decoder = SampleDecoder(vibration_type, sample_rate=values['sample_rate'],
                                      start_time=values['start_time'],
                                      imu_axis=values['imu_axis'])
        self._speed = self.create_output(Float64, 'shaft_speed')
        self.create_input(SAMPLE_TYPES[vibration_type], 'vibration', self._on_vibration)
        self.create_input(PULSE_TYPES[tach_type], 'tach_pulse',
                          self._on_pulse_array if PULSE_TYPES[tach_type] is Float64MultiArray
                          else self._on_pulse_reference)
        self.parameters.watch(check=self._check, apply=self._apply)

    # --- parameters ---

    def _build(self, values: Values) -> StreamingAverager:
        return StreamingAverager(
            {name: shaft_settings(values, name) for name in self._shafts},
            validator=pulse_validator(values),
            timeline=VibrationTimeline(time_tolerance=values['time_tolerance'],
                                       buffer_seconds=values['buffer_seconds']))

    def _check(self, values: Values) -> None:
        pulse_validator(values)
        for name in self._shafts:
            shaft_settings(values, name)
            _gear_settings(values, name)

    def _apply(self, values: Values) -> None:
        before, self._values = self._values, values
        if any(values[key] != before[key] for key in (
                'pulses_per_revolution', 'pulses_per_trigger', 'missing_teeth', 'missing_pulses',
                'maximum_missing', 'interval_tolerance', 'minimum_interval')):
            self._averager.change_pulses(pulse_validator(values))
        changed = {name: shaft_settings(values, name) for name in self._shafts}
        if changed != {name: shaft_settings(before, name) for name in self._shafts}:
            self._averager.change(changed)
        self._apply_indicators(values)

    def _apply_indicators(self, values: Values) -> None:
        for name, shaft in self._shafts.items():
            shaft.use(_gear_settings(values, name))

    # --- messages ---

    def _on_vibration(self, message: Any) -> None:
        block = self._decoder.decode(message)
        try:
            averages = self._averager.add_samples(block)
        except SignalError:
            self.counts['messages_rejected'] += 1
            raise
        self._publish(averages)

    def _on_pulse_reference(self, message: Any) -> None:
        times, source = decode_pulse_reference(message)
        self._keyphasor = self._keyphasor or source
        if source != self._keyphasor:
            self._other_keyphasors += 1
            self.warn(f'tach_pulse: pulse of keyphasor {source!r} while {self._keyphasor!r} is '
                      'used: set the parameter keyphasor')
            return
        self._publish(self._averager.add_pulses(times))

    def _on_pulse_array(self, message: Float64MultiArray) -> None:
        self._publish(self._averager.add_pulses(decode_pulse_array(message)))

    def _publish(self, averages: Sequence[tuple[str, SynchronousAverage]]) -> None:
        share = trigger_share(self._values)
        for name, average in averages:
            self._shafts[name].publish(average, share)
        speed = self._averager.take_speed() * share
        if np.isfinite(speed):
            self._speed.publish(Float64(data=float(speed)))
        for line in self._averager.take_messages():
            self.warn(line)

    # --- diagnostics ---

    def update_counts(self) -> None:
        """Gather the counts of the core."""
        averager = self._averager
        samples, pulses = averager.timeline.counts, averager.validator.counts
        self.counts.update(
            samples_dropped=samples.samples_dropped,
            pulses_dropped=(averager.counts.pulses_dropped + self._other_keyphasors
                            + pulses.doubles + pulses.early + pulses.out_of_order
                            + pulses.non_finite + pulses.unlocked),
            cycles_dropped=averager.counts.cycles_dropped + pulses.cycles_discarded,
            gaps=samples.gaps, restarts=max(samples.restarts, pulses.restarts),
            clock_deviation=samples.clock_deviation,
            averages_dropped=averager.counts.averages_dropped, repeats=samples.repeats)

    def summary(self) -> tuple[str, dict[str, str]]:
        """Say how far the averages are and what the pulses look like."""
        averager = self._averager
        layout = averager.timeline.layout
        published = sum(shaft.published for shaft in self._shafts.values())
        values = {'trigger_cycles': str(averager.counts.cycles), 'averages': str(published),
                  'keyphasor': self._keyphasor,
                  **{f'pulses_{key}': str(count)
                     for key, count in asdict(averager.validator.counts).items()}}
        if layout is None:
            return 'no vibration received yet', values
        values.update(channels=str(layout[0]), sample_rate=f'{layout[1]:.10g}')
        if not averager.counts.cycles:
            return 'no trigger cycle completed yet', values
        if self._decoder.counted:
            return ('vibration without header: samples are counted from start_time, a loss '
                    'would not be seen'), values
        return f'{published} averages of {averager.counts.cycles} trigger cycles', values


def _gear_settings(values: Values, name: str) -> GearSettings:
    return GearSettings(mesh_orders=values[f'{name}.mesh_orders'],
                        sidebands=values[f'{name}.sidebands'])


class _ShaftOutput:
    """Publishers of one shaft, and its condition indicators, which have a history."""

    def __init__(self, node: MonitoringNode, name: str) -> None:
        self._node, self._name = node, name
        self._publishers: dict[str, Publisher] = {
            kind: node.create_output(Float64MultiArray, f'{name}/{kind}')
            for kind in ('synchronous_average', 'standard_error', 'order_amplitude',
                         'condition_indicator', 'corrected_average', 'pulse_error')}
        self._gear = GearSettings()
        self._indicators = RunningIndicators(self._gear)
        self.published = 0

    def use(self, gear: GearSettings) -> None:
        """Take other mesh orders; the indicators' history starts anew."""
        if gear != self._gear:
            self._gear, self._indicators = gear, RunningIndicators(gear)

    def publish(self, average: SynchronousAverage, share: float) -> None:
        """Publish one average; `share` is the tach revolutions in a trigger cycle."""
        header = AverageHeader(
            average.start_time, average.end_time, average.sequence, average.trigger_cycles,
            average.fundamental_cycles,
            average.trigger_cycles * share / (average.end_time - average.start_time))
        self._send('synchronous_average', header, average.waveform)
        self._send('standard_error', header, average.standard_error)
        self._send('order_amplitude', header, amplitude_table(average), AMPLITUDE_FIELDS)
        if np.isfinite(average.waveform).all():
            try:
                self._indicators.update(average.waveform)
            except SignalError:  # the source came back with other channels
                self._indicators = RunningIndicators(self._gear)
                self._indicators.update(average.waveform)
            latest = self._indicators.get()
            self._send('condition_indicator', header, latest.values, latest.names)
        self.published += 1

    def _send(self, kind: str, header: AverageHeader, values: Any,
              names: tuple[str, ...] = ()) -> None:
        self._publishers[kind].publish(encode_average(kind, AverageMessage(header, values, names)))


def amplitude_table(average: SynchronousAverage) -> np.ndarray:
    """Channel x order x `AMPLITUDE_FIELDS` of an average without corrected pulses."""
    table = np.full((*average.amplitudes.shape, len(AMPLITUDE_FIELDS)), np.nan)
    table[..., 0] = average.orders
    table[..., 1] = np.abs(average.amplitudes)
    table[..., 2] = np.angle(average.amplitudes)
    table[..., 7] = average.noise
    return table


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(SynchronousAverager, args)
