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

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
from sa_jitter_ros.declaration import declaration_of, NODE, predictor_parameters, SHAFTS
from sa_jitter_ros.errors import MessageError, ModelError
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.health import Flow
from sa_jitter_ros.nodes.messages import encode_prediction, PREDICTION_FIELDS, PredictionMessage
from sa_jitter_ros.parameters import Values
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.prediction.prediction import predict, Prediction
from std_msgs.msg import Float64, Float64MultiArray

STEP = 0.05  # relative change of the speed from one cycle to the next that no jitter makes


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
            item for item in predictor_parameters(shafts, self.parameters.given_values)
            if item is not SHAFTS])
        self._values = self.parameters.values()
        self._declaration = declaration_of(self._values)
        self._published = 0
        self._predictions = {shaft: self.create_output(
            Float64MultiArray, f'{shaft}/prediction' if len(shafts) > 1 else 'prediction',
            LATCHED_QOS) for shaft in shafts}
        self._speeds: deque[float] = deque(maxlen=self._values['trigger_cycles'])
        self.create_input(Float64, 'shaft_speed', self._on_speed)
        self._speed_flow = self.watch_input(
            'speed', 'shaft_speed', 'has the averager vibration and pulses? (see its status)',
            judged=self._values['follow_shaft_speed'])
        self._prediction_flow = self.health.add(Flow('prediction', 'prediction', judged=False))
        self.parameters.watch(check=check, apply=self._apply)
        self._predict(self._declaration.models)
        self.get_logger().info(f'started: {self.summary()[0]}')

    def _apply(self, values: Values) -> None:
        follows = values['follow_shaft_speed'] and self._values['follow_shaft_speed']
        given = values['trigger_speed'] != self._values['trigger_speed']
        if values['trigger_cycles'] != self._values['trigger_cycles']:
            self._speeds = deque(self._speeds, maxlen=values['trigger_cycles'])
        self._values, self._declaration = values, declaration_of(values)
        self._speed_flow.judged = values['follow_shaft_speed']
        if not (follows and not given and self._predict_at(self._trigger_speed)):
            self._speeds.clear()
            self._predict(self._declaration.models)

    def _on_speed(self, message: Float64) -> None:
        if not self._values['follow_shaft_speed']:
            return
        speed = message.data
        if not (math.isfinite(speed) and speed > 0.0):
            raise MessageError(f'shaft_speed is {speed} Hz: publish a positive number')
        self._speed_flow.came()
        if self._speeds and abs(speed - self._speeds[-1]) > STEP * self._speeds[-1]:
            self._speeds.clear()
        self._speeds.append(speed)
        # Jitter moves the speed of one cycle, but hardly that of an average of trigger_cycles.
        mean = len(self._speeds) / sum(1.0 / item for item in self._speeds)
        predicted = self._trigger_speed
        if abs(mean - predicted) > self._values['speed_tolerance'] * predicted:
            self._predict_at(mean)

    def _predict_at(self, speed: float) -> bool:
        """Predict at a measured speed (Hz); return whether it is possible."""
        try:
            self._predict({shaft: replace(model, trigger_speed=speed)
                           for shaft, model in self._declaration.models.items()})
        except ModelError as error:
            self.set_missing('prediction', f'impossible at the measured {speed:.6g} Hz, {error}')
            return False
        return True

    def _predict(self, models: Mapping[str, DeclaredModel]) -> None:
        predictions = {shaft: predict(model, self._declaration.effects)
                       for shaft, model in models.items()}
        self.set_missing('prediction', '')
        self._models = models
        self._published += 1
        self._prediction_flow.came()
        for shaft, prediction in predictions.items():
            self._predictions[shaft].publish(encode_prediction(prediction_message(prediction)))

    @property
    def _trigger_speed(self) -> float:
        """Return the speed of the tach shaft in the last prediction, Hz."""
        return next(iter(self._models.values())).trigger_speed

    def summary(self) -> tuple[str, dict[str, object]]:
        """Return what is predicted, the number of predictions and the declared effects."""
        orders = sum(len(model.orders) for model in self._models.values())
        model = next(iter(self._models.values()))
        shafts = f' of {len(self._models)} shafts' if len(self._models) > 1 else ''
        return (f'{orders} orders{shafts} at {model.trigger_speed:.6g} Hz, keyphasor '
                f'{model.keyphasor_rate:.6g} Hz, {model.trigger_cycles} trigger cycles',
                {'predictions': self._published,
                 'effects': ', '.join(effect.name for effect in self._declaration.effects)})


def prediction_message(prediction: Prediction) -> PredictionMessage:
    """Return the content of the message of a prediction."""
    table = np.stack([getattr(prediction, name) for name in PREDICTION_FIELDS], axis=1)
    speed, rate, cycles, ratio, pulse_error, noise = prediction.header
    return PredictionMessage(table, speed, rate, int(cycles), ratio, pulse_error, noise)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(JitterPredictor, args)


if __name__ == '__main__':
    raise SystemExit(main())
