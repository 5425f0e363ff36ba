# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Node `jitter_predictor`: predicts how jitter changes each order of a synchronous average."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
from sa_jitter_ros.declaration import declaration_of, NODE, predictor_parameters, SHAFTS
from sa_jitter_ros.errors import MessageError, ModelError
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.messages import encode_prediction, PREDICTION_FIELDS, PredictionMessage
from sa_jitter_ros.nodes.parameters import Values
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict, Prediction
from std_msgs.msg import Float64, Float64MultiArray


def check(values: Values) -> None:
    """Raise `SaJitterError` unless the parameters declare models that can be predicted."""
    declaration = declaration_of(values)
    for model in declaration.models.values():
        predict(replace(model, orders=(max(model.orders),)), declaration.effects)


class JitterPredictor(MonitoringNode):
    """
    Publishes the prediction at its start and after each change of a parameter or of the speed.

    The topic is `prediction` for one shaft and `<shaft>/prediction` for each of several.
    """

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__(NODE, (SHAFTS,), **node_kwargs)
        shafts = self.parameters.values()[SHAFTS.name]
        self.parameters.declare([
            item for item in predictor_parameters(shafts, self.parameters.given)
            if item is not SHAFTS])
        self._values = self.parameters.values()
        self._declaration = declaration_of(self._values)
        self._published = 0
        self._predictions = {shaft: self.create_output(
            Float64MultiArray, f'{shaft}/prediction' if len(shafts) > 1 else 'prediction',
            LATCHED_QOS) for shaft in shafts}
        self.create_input(Float64, 'shaft_speed', self._on_speed)
        self.parameters.watch(check=check, apply=self._apply)
        self._predict(self._declaration.models)

    def _apply(self, values: Values) -> None:
        speed = self._trigger_speed
        follows = values['follow_shaft_speed'] and self._values['follow_shaft_speed']
        given = values['trigger_speed'] != self._values['trigger_speed']
        self._values, self._declaration = values, declaration_of(values)
        if follows and not given:
            try:
                self._predict(self._models_at(speed))
                return
            except ModelError as error:
                self.warn(f'at the measured speed of {speed:.6g} Hz: {error}')
        self._predict(self._declaration.models)

    def _on_speed(self, message: Float64) -> None:
        if not self._values['follow_shaft_speed']:
            return
        speed = message.data
        if not (math.isfinite(speed) and speed > 0.0):
            raise MessageError(f'shaft_speed is {speed} Hz: publish a positive number')
        predicted = self._trigger_speed
        if abs(speed - predicted) > self._values['speed_tolerance'] * predicted:
            self._predict(self._models_at(speed))

    def _models_at(self, trigger_speed: float) -> dict[str, DeclaredModel]:
        """Return the declared models at a measured speed; raises ModelError."""
        return {shaft: replace(model, trigger_speed=trigger_speed)
                for shaft, model in self._declaration.models.items()}

    def _predict(self, models: Mapping[str, DeclaredModel]) -> None:
        predictions = {shaft: predict(model, self._declaration.effects)
                       for shaft, model in models.items()}
        self._models = models
        self._published += 1
        for shaft, prediction in predictions.items():
            self._predictions[shaft].publish(encode_prediction(prediction_message(prediction)))

    @property
    def _trigger_speed(self) -> float:
        """Return the speed of the tach shaft in the last prediction, Hz."""
        return next(iter(self._models.values())).trigger_speed

    def summary(self) -> tuple[str, dict[str, str]]:
        """Return what is predicted, the number of predictions and the declared effects."""
        orders = sum(len(model.orders) for model in self._models.values())
        model = next(iter(self._models.values()))
        shafts = f' of {len(self._models)} shafts' if len(self._models) > 1 else ''
        return (f'{orders} orders{shafts} at {model.trigger_speed:.6g} Hz, keyphasor '
                f'{model.keyphasor_rate:.6g} Hz, {model.trigger_cycles} trigger cycles',
                {'predictions': str(self._published),
                 'effects': ', '.join(effect.name for effect in self._declaration.effects)})


def prediction_message(prediction: Prediction) -> PredictionMessage:
    """Return the content of the message of a prediction."""
    table = np.stack([getattr(prediction, name) for name in PREDICTION_FIELDS], axis=1)
    speed, rate, cycles, ratio, pulse_error, noise = prediction.header
    return PredictionMessage(table, speed, rate, int(cycles), ratio, pulse_error, noise)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(JitterPredictor, args)
