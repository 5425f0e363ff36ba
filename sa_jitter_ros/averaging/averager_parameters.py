# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters of `synchronous_averager`, and the settings that they make."""

from dataclasses import fields, replace
from math import prod

from sa_jitter_ros.averaging.average import AverageSettings, AVERAGING, KeyphasorParameters
from sa_jitter_ros.averaging.envelope import EnvelopeSettings
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.averaging.streaming import StreamingAverager
from sa_jitter_ros.averaging.timeline import VibrationTimeline
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import (
    Parameter, PULSES_PER_REVOLUTION, PULSES_PER_TRIGGER, RATIO, sample_parameters, TACH_TYPE,
    TRIGGER_CYCLES, Values)
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS
from sa_jitter_ros.pulses.resampling import METHODS
from sa_jitter_ros.pulses.validation import GEOMETRY_MODES

PARAMETERS = (
    *sample_parameters('vibration'),
    TACH_TYPE,
    Parameter('imu_axis', 'z', 'axes of linear acceleration: one or more of x, y, z',
              read_only=True),
    Parameter('keyphasor', '', 'source of the pulses to use; empty: that of the first pulse',
              read_only=True),
    Parameter('shafts', ['shaft'], 'names of the shafts', read_only=True),
    Parameter('buffer_seconds', 5.0, 'how long samples and pulses wait for each other',
              unit='s', above=0.0, maximum=3600.0, read_only=True),
    PULSES_PER_REVOLUTION,
    PULSES_PER_TRIGGER,
    Parameter('missing_teeth', 0, 'teeth missing at one place of the target', minimum=0,
              maximum=1000),
    Parameter('missing_pulses', 'break', 'break: a missing pulse ends the average; bridge: it is '
              'interpolated', choices=('break', 'bridge')),
    Parameter('maximum_missing', 3, 'most consecutive missing pulses; more are a standstill',
              minimum=0, maximum=1000),
    Parameter('interval_tolerance', 0.0, 'largest relative change from one pulse interval to the '
              'next, below 0.5; 0: learnt; 1: accept every pulse', minimum=0.0, maximum=1.0),
    Parameter('minimum_interval', 0.0, 'a pulse this soon after another is dropped',
              unit='s', minimum=0.0),
    Parameter('path_delay', 0.0, 'delay of the pulses behind the vibration, which is '
              'subtracted', unit='s'),
    Parameter('target_geometry', 'none', 'correction of uneven marks: learn (measured), given '
              '(target_angles)', choices=GEOMETRY_MODES),
    Parameter('target_angles', [], 'how late each mark is, without missing teeth, for '
              'target_geometry given', unit='rad'),
    TRIGGER_CYCLES,
    Parameter('maximum_discarded', 0.0, 'most discarded cycles in an average, as a share of '
              'trigger_cycles; 0: the first ends it', minimum=0.0, maximum=1.0),
    Parameter('averaging', 'block', 'block: an average of every trigger_cycles cycles; sliding, '
              'exponential: one after each cycle', choices=AVERAGING),
    Parameter('angle_law', 'linear', 'how the angle runs between pulses, the same in averager '
              'and predictor', choices=ANGLE_LAWS),
    Parameter('correct_jitter', False, 'recover the pulse errors from the vibration, publish '
              'corrected averages'),
    Parameter('keyphasor_rate', 0.0, 'sampling rate of the keyphasor, which limits the pulse '
              'errors; 0: that of the vibration', unit='Hz', minimum=0.0),
    Parameter('interpolation', 'band_limited', 'how samples are interpolated', choices=METHODS),
)


def shaft_parameters(name: str) -> tuple[Parameter, ...]:
    """Return the parameters of one shaft."""
    return (
        replace(RATIO, name=f'{name}.ratio'),
        Parameter(f'{name}.ratio_teeth', [], 'teeth [driver, driven, ...] that give the ratio',
                  minimum=1, element=int),
        Parameter(f'{name}.samples_per_revolution', 0, 'points of the waveform; 0: automatic',
                  minimum=0, maximum=1 << 20),
        Parameter(f'{name}.orders', [1.0, 2.0, 3.0], 'orders to publish, of this shaft',
                  above=0.0),
        Parameter(f'{name}.mesh_orders', [], 'numbers of teeth on this shaft, for the condition '
                  'indicators', above=0.0),
        Parameter(f'{name}.sidebands', 1, 'pairs of sidebands of each mesh order', minimum=0,
                  maximum=100),
        Parameter(f'{name}.bearing_orders', [], 'bearing orders of this shaft (cage, balls, '
                  'rings), for the squared envelope', above=0.0),
        Parameter(f'{name}.envelope_band', [], 'lowest and highest frequency of the envelope '
                  'band; empty: all', unit='Hz', minimum=0.0),
    )


def shaft_settings(values: Values, name: str) -> AverageSettings:
    """Return the settings of one shaft's average; raises `ParameterError`."""
    teeth = values[f'{name}.ratio_teeth']
    ratio = values[f'{name}.ratio']
    if teeth:
        if ratio != 1.0:
            raise one_ratio(values, name)
        if len(teeth) % 2:
            raise ParameterError(f'{name}.ratio_teeth has {len(teeth)} numbers of teeth: give '
                                 'pairs of driver and driven')
        ratio = prod(teeth[::2]) / prod(teeth[1::2])
    try:
        return keyphasor_parameters(values).average(
            ratio=ratio, orders=values[f'{name}.orders'],
            samples_per_revolution=values[f'{name}.samples_per_revolution'],
            envelope=EnvelopeSettings(tuple(values[f'{name}.bearing_orders']),
                                      tuple(values[f'{name}.envelope_band'])),
            **{key: values[key] for key in (
                'trigger_cycles', 'averaging', 'angle_law', 'interpolation', 'correct_jitter',
                'keyphasor_rate', 'maximum_discarded')})
    except ParameterError as error:
        raise ParameterError(f'{name}: {error}') from None


def one_ratio(values: Values, name: str) -> ParameterError:
    """Return the error for a shaft with both `ratio` and `ratio_teeth`."""
    return ParameterError(f'{name}.ratio is {values[f"{name}.ratio"]} and {name}.ratio_teeth is '
                          f'{values[f"{name}.ratio_teeth"]}: give one of them')


def keyphasor_parameters(values: Values) -> KeyphasorParameters:
    """Return the parameters of the keyphasor; raises `ParameterError`."""
    return KeyphasorParameters(**{
        item.name: values[item.name] for item in fields(KeyphasorParameters)})


def streaming_averager(values: Values, *, buffer_seconds: float) -> StreamingAverager:
    """Return the averager of all shafts; raises `ParameterError`."""
    return StreamingAverager(
        {name: shaft_settings(values, name) for name in values['shafts']},
        validator=keyphasor_parameters(values).validator(),
        timeline=VibrationTimeline(time_tolerance=values['time_tolerance'],
                                   buffer_seconds=buffer_seconds))


def gear_settings(values: Values, name: str) -> GearSettings:
    """Return the mesh orders and sidebands of a shaft; raises `ParameterError`."""
    return GearSettings(mesh_orders=values[f'{name}.mesh_orders'],
                        sidebands=values[f'{name}.sidebands'])
