"""
What is declared about a machine: the parameters of `jitter_predictor`, by name, and their models.

The node and the reader of its parameter files share this table, and so does what they make of it.
With one shaft, the default, `ratio` and `orders` are its; with several, each shaft has
`<shaft>.ratio` and `<shaft>.orders`. One shaft may have its name before them, too. Both forms in
one declaration are an error.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re
from typing import Any

from sa_jitter_ros.effects import Effect, enabled_effects
from sa_jitter_ros.effects.parameters import effect_parameters
from sa_jitter_ros.errors import ModelError, ParameterError, SaJitterError
from sa_jitter_ros.parameter_file import one_line, read_parameters
from sa_jitter_ros.parameters import Parameter, RATIO, require_shaft_names
from sa_jitter_ros.prediction.prediction import DeclaredModel, DISTRIBUTIONS
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS

NODE = 'jitter_predictor'
SHAFTS = Parameter('shafts', ['shaft'], 'names of the shafts to predict for', read_only=True)
#: Parameters of each shaft.
SHAFT_PARAMETERS = (
    RATIO,
    Parameter('orders', [1.0, 2.0, 3.0], 'orders to predict, multiples of the shaft of interest',
              above=0.0),
)
#: Parameters of keyphasor and average, the same for all shafts.
MODEL_PARAMETERS = (
    Parameter('keyphasor_rate', 10000.0, 'rate at which the keyphasor is sampled', unit='Hz',
              above=0.0),
    Parameter('trigger_speed', 25.0, 'speed of the tach shaft', unit='Hz', above=0.0),
    Parameter('pulses_per_revolution', 1, 'pulses per revolution of the tach shaft', minimum=1,
              maximum=100000),
    Parameter('pulses_per_trigger', 0, 'pulses per trigger cycle, 0 for all of a revolution',
              minimum=0, maximum=100000),
    Parameter('trigger_cycles', 40, 'trigger cycles in an average, N_t', minimum=1,
              maximum=1000000),
    Parameter('jitter_distribution', 'uniform', 'distribution of the pulse error',
              choices=DISTRIBUTIONS),
    Parameter('jitter_std', 0.0, 'standard deviation of a normal or triangular pulse error, 0 '
              'for that of the sampled keyphasor', unit='s', minimum=0.0),
    Parameter('jitter_table', [], 'equally likely pulse errors, for the distribution table',
              unit='s'),
    Parameter('noise_std', 0.0, 'standard deviation of white noise per vibration sample, in '
              "units of the component's amplitude", minimum=0.0),
    Parameter('sample_rate', 0.0, 'sampling rate of the vibration, needed with noise_std',
              unit='Hz', minimum=0.0),
    Parameter('angle_law', 'linear', 'how the angle runs between pulses, as in the averager',
              choices=ANGLE_LAWS),
)
#: Parameters of the node that say nothing about the model.
FOLLOWING = (
    Parameter('follow_shaft_speed', False, 'take the speed from shaft_speed'),
    Parameter('speed_tolerance', 1e-3, 'relative change of the speed that makes a new '
              'prediction', minimum=0.0, maximum=1.0),
)
# What rcl takes for a number and YAML 1.1 for a text.
_FLOAT = re.compile(r'[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?')


@dataclass(frozen=True)
class Declaration:
    """
    What is declared: a model for each shaft by its name, and the effects of all of them.

    `unknown` are names in a file that match no parameter.
    """

    models: Mapping[str, DeclaredModel]
    effects: tuple[Effect, ...]
    unknown: tuple[str, ...] = ()

    @property
    def model(self) -> DeclaredModel:
        """Return the model of the only shaft; raise ModelError where there are several."""
        if len(self.models) > 1:
            raise ModelError(f'shafts {", ".join(self.models)} are declared: one shaft is needed '
                             'here, declare each in a file of its own')
        return next(iter(self.models.values()))


def predictor_parameters(
    shafts: Sequence[str] = ('shaft',), given: Collection[str] = (),
) -> tuple[Parameter, ...]:
    """
    Return the parameters of `jitter_predictor` for these shafts.

    `given` are the names that are set, which decide in what form `ratio` and `orders` of one shaft
    stand. Raises ParameterError for shaft names that topics cannot have and for both forms at
    once.
    """
    require_shaft_names(SHAFTS.name, shafts)
    own = [[replace(item, name=f'{shaft}.{item.name}') for item in SHAFT_PARAMETERS]
           for shaft in shafts]
    of_shafts = [item for items in own for item in items]
    common = [item for item in SHAFT_PARAMETERS if item.name in given]
    if len(shafts) == 1 and not any(item.name in given for item in of_shafts):
        of_shafts = list(SHAFT_PARAMETERS)
    elif common:
        name = common[0].name
        raise ParameterError(
            f'{name} is given for shafts {", ".join(shafts)}, which have '
            f'{", ".join(f"{shaft}.{name}" for shaft in shafts)}: leave out {name}')
    return (*MODEL_PARAMETERS, SHAFTS, *of_shafts, *FOLLOWING, *effect_parameters())


def declaration_of(values: Mapping[str, Any]) -> Declaration:
    """
    Return what parameters of `jitter_predictor` declare.

    `values` are converted; what they lack has its default. Raises ModelError for values that make
    no sense together.
    """
    models = {}
    for shaft in values.get(SHAFTS.name, SHAFTS.default):
        arguments: dict[str, Any] = {}
        for item in (*MODEL_PARAMETERS, *SHAFT_PARAMETERS):
            value = values.get(f'{shaft}.{item.name}', values.get(item.name, item.default))
            arguments[item.name] = tuple(value) if item.is_list else value
        models[shaft] = DeclaredModel(**arguments)
    return Declaration(models, enabled_effects(values))


def read_declaration(path: Path, *, sample_rate: float = 0.0) -> Declaration:
    """
    Read what a ROS parameter file of `jitter_predictor` declares, without ROS.

    `sample_rate` (Hz) serves where the file has none. Raises ModelError, in one line, for a file
    that is missing, no parameter file of the node, or holds values that make no sense.
    """
    try:
        values = read_parameters(path, NODE)
    except ParameterError as error:
        raise ModelError(str(error)) from error
    try:
        shafts = SHAFTS.convert(values.get(SHAFTS.name, SHAFTS.default))
        known = {item.name: item for item in predictor_parameters(shafts, values)}
        converted = {name: known[name].convert(_as_rcl_reads(value, known[name]))
                     for name, value in values.items() if name in known}
        if not converted.get('sample_rate'):
            converted['sample_rate'] = sample_rate
        declaration = declaration_of(converted)
    except SaJitterError as error:
        raise ModelError(f'{path}: {one_line(error)}') from error
    unknown = sorted(name for name in values if name not in known and name != 'use_sim_time'
                     and not name.startswith('qos_overrides.'))
    return replace(declaration, unknown=tuple(unknown))


def _as_rcl_reads(value: Any, item: Parameter) -> Any:
    """Return a value of a file with texts that rcl takes for floats as floats."""
    if isinstance(value, list):
        return [_as_rcl_reads(each, item) for each in value]
    if item.kind is float and isinstance(value, str) and _FLOAT.fullmatch(value):
        return float(value)
    return value
