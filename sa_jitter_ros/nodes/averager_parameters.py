"""Parameters of the averager, and what they mean to the core."""

from dataclasses import fields, replace
from math import prod

from sa_jitter_ros.averaging.average import AverageSettings, AVERAGING, KeyphasorParameters
from sa_jitter_ros.averaging.indicators import GearSettings
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.nodes.parameters import Values
from sa_jitter_ros.parameters import Parameter, RATIO
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS
from sa_jitter_ros.pulses.resampling import METHODS

PARAMETERS = (
    Parameter('vibration_type', 'std_msgs/Float64MultiArray', 'message type of vibration',
              read_only=True),
    Parameter('tach_type', 'sensor_msgs/TimeReference', 'message type of tach_pulse',
              read_only=True),
    Parameter('sample_rate', 0.0, 'sampling rate where messages carry none, 0 if they do',
              unit='Hz', minimum=0.0, maximum=1e9, read_only=True),
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
    Parameter('angle_law', 'linear', 'angle between pulses', choices=ANGLE_LAWS),
    Parameter('correct_jitter', False, 'recover the pulse errors from the vibration'),
    Parameter('keyphasor_rate', 0.0, 'rate at which the keyphasor is sampled: how large pulse '
              'errors may be; 0 for that of the vibration', unit='Hz', minimum=0.0),
    Parameter('interpolation', 'band_limited', 'interpolation between samples', choices=METHODS),
)


def shaft_parameters(name: str) -> tuple[Parameter, ...]:
    """Parameters of one shaft."""
    return (
        replace(RATIO, name=f'{name}.ratio'),
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
    """Return the settings of one shaft's average; raises `ParameterError`."""
    teeth = values[f'{name}.ratio_teeth']
    ratio = values[f'{name}.ratio']
    if teeth:
        if ratio != 1.0:
            raise one_ratio(values, name)
        if len(teeth) % 2:
            raise ParameterError(f'{name}.ratio_teeth has {len(teeth)} tooth counts: give pairs '
                                 'of driver and driven')
        ratio = prod(teeth[::2]) / prod(teeth[1::2])
    try:
        return keyphasor_parameters(values).average(
            ratio=ratio, orders=values[f'{name}.orders'],
            samples_per_revolution=values[f'{name}.samples_per_revolution'],
            **{key: values[key] for key in (
                'trigger_cycles', 'averaging', 'angle_law', 'interpolation', 'correct_jitter',
                'keyphasor_rate')})
    except ParameterError as error:
        raise ParameterError(f'{name}: {error}') from None


def one_ratio(values: Values, name: str) -> ParameterError:
    """Return the error that both ways to give a ratio were used."""
    return ParameterError(f'{name}.ratio is {values[f"{name}.ratio"]} and {name}.ratio_teeth is '
                          f'{values[f"{name}.ratio_teeth"]}: give one of them')


def keyphasor_parameters(values: Values) -> KeyphasorParameters:
    """Return what is known of the keyphasor; raises `ParameterError`."""
    return KeyphasorParameters(**{
        item.name: values[item.name] for item in fields(KeyphasorParameters)})


def gear_settings(values: Values, name: str) -> GearSettings:
    """Which orders of a shaft are regular; raises `ParameterError`."""
    return GearSettings(mesh_orders=values[f'{name}.mesh_orders'],
                        sidebands=values[f'{name}.sidebands'])
