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
The declared model of a machine, from the parameters of `jitter_predictor`.

The node, the reader of its parameter files and the library share these parameters. With one shaft,
which is the default, `ratio` and `orders` belong to it; with several, each has `<shaft>.ratio` and
`<shaft>.orders`. The second form is allowed for one shaft, too, but not both forms at once.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
from typing import Any

from sa_jitter_ros.effects import Effect, enabled_effects
from sa_jitter_ros.effects.parameters import effect_parameters
from sa_jitter_ros.errors import ModelError, ParameterError, quoted, SaJitterError
from sa_jitter_ros.machine import following, Machine, PREFIX, UNKNOWN
from sa_jitter_ros.parameter_file import read_parameters
from sa_jitter_ros.parameters import (
    converted, fixed, Parameter, PULSES_PER_REVOLUTION, PULSES_PER_TRIGGER, RATIO,
    require_shaft_names, TRIGGER_CYCLES, unknown_names)
from sa_jitter_ros.prediction.model import DeclaredModel, DISTRIBUTIONS
from sa_jitter_ros.pulses.angle_law import ANGLE_LAWS

NODE = 'jitter_predictor'
SHAFTS = fixed('shafts', ['shaft'], 'names of the shafts')
#: Parameters of each shaft.
SHAFT_PARAMETERS = (
    RATIO,
    Parameter('orders', [1.0, 2.0, 3.0], 'orders to predict, of the shaft of interest', above=0.0),
)
#: Parameters of keyphasor and average, the same for all shafts.
MODEL_PARAMETERS = (
    Parameter('keyphasor_rate', 10000.0, 'sampling rate of the keyphasor', unit='Hz', above=0.0),
    Parameter('trigger_speed', 25.0, 'speed of the tach shaft', unit='Hz', above=0.0),
    PULSES_PER_REVOLUTION,
    PULSES_PER_TRIGGER,
    TRIGGER_CYCLES,
    Parameter('jitter_distribution', 'uniform', 'distribution of the pulse error',
              choices=DISTRIBUTIONS),
    Parameter('jitter_std', 0.0, 'standard deviation of a normal or triangular pulse error; 0: '
              '1/(sqrt(12) keyphasor_rate)', unit='s', minimum=0.0),
    Parameter('jitter_table', [], 'equally likely pulse errors, for jitter_distribution table',
              unit='s'),
    Parameter('noise_std', math.nan, 'standard deviation of white noise per sample, of '
              'components of amplitude 1; NaN: not declared (close_loop estimates it)',
              minimum=0.0),
    Parameter('sample_rate', 0.0, 'sampling rate of the vibration, needed with noise_std',
              unit='Hz', minimum=0.0),
    Parameter('angle_law', 'linear', 'how the angle runs between pulses, the same in averager '
              'and predictor', choices=ANGLE_LAWS),
)
#: Parameters of the node that are not part of the model.
FOLLOWING = (
    Parameter('follow_shaft_speed', False, 'predict at the measured speed (topic '
              'shaft_speed)'),
    Parameter('speed_tolerance', 1e-3, 'relative change of the speed that starts a new prediction',
              minimum=0.0, maximum=1.0),
)


@dataclass(frozen=True)
class Declaration:
    """
    A declared model for each shaft by its name, and the effects that all of them share.

    `unknown` are the names in a parameter file that match no parameter; the `machine` names the
    orders.
    """

    models: Mapping[str, DeclaredModel]
    effects: tuple[Effect, ...]
    unknown: tuple[str, ...] = ()
    machine: Machine = UNKNOWN

    @property
    def model(self) -> DeclaredModel:
        """Return the model of the only shaft; raise ModelError where there are several."""
        if len(self.models) > 1:
            raise ModelError(f'shafts {", ".join(self.models)} are declared: one shaft is needed '
                             'here; use one parameter file for each shaft')
        return next(iter(self.models.values()))


def predictor_parameters(shafts: Sequence[str] = ('shaft',), given: Collection[str] = ()
                         ) -> tuple[Parameter, ...]:
    """
    Return the parameters of `jitter_predictor` for these shafts.

    `given` are the names that the user set: they decide whether one shaft has `ratio` and `orders`
    or `<shaft>.ratio` and `<shaft>.orders`. Raises ParameterError for both forms at once and for
    names that cannot be part of a topic's name.
    """
    require_shaft_names(SHAFTS.name, shafts)
    of_shafts = [replace(item, name=f'{shaft}.{item.name}')
                 for shaft in shafts for item in SHAFT_PARAMETERS]
    common = [item for item in SHAFT_PARAMETERS if item.name in given]
    if len(shafts) == 1 and not any(item.name in given for item in of_shafts):
        of_shafts = list(SHAFT_PARAMETERS)
    elif common:
        name = common[0].name
        raise ParameterError(
            f'{name} is given together with the shafts {", ".join(shafts)}: give '
            f'{", ".join(f"{shaft}.{name}" for shaft in shafts)} and leave out {name}')
    return (*MODEL_PARAMETERS, SHAFTS, *of_shafts, *FOLLOWING, *effect_parameters())


def declaration_of(values: Mapping[str, Any]) -> Declaration:
    """
    Return the models and effects that parameters of `jitter_predictor` declare.

    `values` are converted values by name; a parameter that is not among them has its default.
    Raises ModelError for values that contradict each other.
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
    Read the models and effects that a ROS parameter file of `jitter_predictor` declares.

    ROS is not needed. `sample_rate` (Hz) is used if the file contains none. Raises ModelError, in
    one line, for a file that is missing, is no parameter file of the node, or has unusable values.
    """
    try:
        values = read_parameters(path, NODE)
    except ParameterError as error:
        raise ModelError(str(error)) from error
    try:
        found, machine = following(values), Machine.among(values)
        values = {name: value for name, value in values.items() if not name.startswith(PREFIX)}
        shafts = SHAFTS.convert((found | values).get(SHAFTS.name, SHAFTS.default))
        known = {item.name: item for item in predictor_parameters(shafts, values)}
        if values and not known.keys() & (found | values).keys():
            raise ModelError(f'none of {", ".join(values)} is a parameter of {NODE}: give the '
                             f'parameter file of {NODE}')
        taken = converted(found | values, known)
        taken['sample_rate'] = taken.get('sample_rate') or sample_rate
        declaration = declaration_of(taken)
    except SaJitterError as error:
        raise ModelError(f'{path}: {quoted(error)}') from error
    return replace(declaration, unknown=unknown_names(values, known), machine=machine)
