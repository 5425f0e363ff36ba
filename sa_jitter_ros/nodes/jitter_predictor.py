"""Node `jitter_predictor`: what the declared keyphasor does to each order of the average."""

from collections.abc import Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
from sa_jitter_ros.effects import enabled_effects, predict_with
from sa_jitter_ros.errors import MessageError, ModelError
from sa_jitter_ros.nodes.base import LATCHED_QOS, MonitoringNode, run_node
from sa_jitter_ros.nodes.effect_parameters import effect_parameters
from sa_jitter_ros.nodes.messages import (encode_prediction, PREDICTION_FIELDS,
                                          PredictionMessage)
from sa_jitter_ros.nodes.parameters import Parameter, Values
from sa_jitter_ros.statistics.prediction import DeclaredModel, DISTRIBUTIONS, Prediction
from sa_jitter_ros.statistics.pulse_weights import ANGLE_LAWS
from std_msgs.msg import Float64, Float64MultiArray

PARAMETERS = (
    Parameter('keyphasor_rate', 10000.0, 'rate at which the keyphasor is sampled', unit='Hz',
              above=0.0),
    Parameter('trigger_speed', 25.0, 'speed of the tach shaft', unit='Hz', above=0.0),
    Parameter('pulses_per_revolution', 1, 'pulses per revolution of the tach shaft', minimum=1,
              maximum=100000),
    Parameter('pulses_per_trigger', 0, 'pulses per trigger cycle, 0 for all of a revolution',
              minimum=0, maximum=100000),
    Parameter('trigger_cycles', 40, 'trigger cycles in an average, N_t', minimum=1,
              maximum=1000000),
    Parameter('ratio', 1.0, 'speed of the shaft of interest over that of the tach shaft',
              above=0.0),
    Parameter('orders', [1.0, 2.0, 3.0], 'orders to predict, multiples of the shaft of interest',
              above=0.0),
    Parameter('jitter_distribution', 'uniform', 'law of the pulse error', choices=DISTRIBUTIONS),
    Parameter('jitter_std', 0.0, 'standard deviation of a normal or triangular pulse error, 0 '
              'for that of the sampled keyphasor', unit='s', minimum=0.0),
    Parameter('jitter_table', [], 'equally likely pulse errors, for the distribution table',
              unit='s'),
    Parameter('noise_std', 0.0, 'standard deviation of white noise per vibration sample, in '
              "units of the component's amplitude", minimum=0.0),
    Parameter('sample_rate', 0.0, 'sampling rate of the vibration, needed with noise_std',
              unit='Hz', minimum=0.0),
    Parameter('angle_law', 'linear', 'angle between pulses, as the averager has it',
              choices=ANGLE_LAWS),
    Parameter('follow_shaft_speed', False, 'take the speed from shaft_speed'),
    Parameter('speed_tolerance', 1e-3, 'relative change of the speed that is worth another '
              'prediction', minimum=0.0, maximum=1.0),
)
_MODEL = ('keyphasor_rate', 'trigger_speed', 'trigger_cycles', 'orders', 'ratio',
          'pulses_per_revolution', 'pulses_per_trigger', 'jitter_distribution', 'jitter_std',
          'jitter_table', 'noise_std', 'sample_rate', 'angle_law')


def declared_model(values: Values) -> DeclaredModel:
    """Model that the parameters declare; raises `ModelError`."""
    arguments: dict[str, Any] = {
        name: tuple(values[name]) if isinstance(values[name], list) else values[name]
        for name in _MODEL}
    return DeclaredModel(**arguments)


def check(values: Values) -> None:
    """Raise `SaJitterError` unless the parameters make a model with effects."""
    model = declared_model(values)
    predict_with(replace(model, orders=(max(model.orders),)), enabled_effects(values))


class JitterPredictor(MonitoringNode):
    """Publishes `prediction`, and again whenever a parameter or the speed changes."""

    def __init__(self, **node_kwargs: Any) -> None:
        super().__init__('jitter_predictor', (*PARAMETERS, *effect_parameters()), **node_kwargs)
        self._values = self.parameters.values()
        self._effects = enabled_effects(self._values)
        self._published = 0
        self._model = declared_model(self._values)
        self._prediction = self.create_output(Float64MultiArray, 'prediction', LATCHED_QOS)
        self.create_input(Float64, 'shaft_speed', self._on_speed)
        self.parameters.watch(check=check, apply=self._apply)
        self._predict(self._model)

    def _apply(self, values: Values) -> None:
        speed = self._model.trigger_speed
        follows = values['follow_shaft_speed'] and self._values['follow_shaft_speed']
        given = values['trigger_speed'] != self._values['trigger_speed']
        self._values, self._effects = values, enabled_effects(values)
        model = declared_model(values)
        if follows and not given:
            try:
                model = replace(model, trigger_speed=speed)
            except ModelError as error:
                self.warn(f'at the measured {speed:.6g} Hz: {error}')
        self._predict(model)

    def _on_speed(self, message: Float64) -> None:
        if not self._values['follow_shaft_speed']:
            return
        speed = message.data
        if not (math.isfinite(speed) and speed > 0.0):
            raise MessageError(f'speed is {speed} Hz: publish a positive number')
        known = self._model.trigger_speed
        if abs(speed - known) > self._values['speed_tolerance'] * known:
            self._predict(replace(self._model, trigger_speed=speed))

    def _predict(self, model: DeclaredModel) -> None:
        prediction = predict_with(model, self._effects)
        self._model = model
        self._published += 1
        self._prediction.publish(encode_prediction(prediction_message(prediction)))

    def summary(self) -> tuple[str, dict[str, str]]:
        """Say what is predicted for which model."""
        model = self._model
        return (f'{len(model.orders)} orders at {model.trigger_speed:.6g} Hz, keyphasor '
                f'{model.keyphasor_rate:.6g} Hz, {model.trigger_cycles} trigger cycles',
                {'predictions': str(self._published),
                 'effects': ', '.join(effect.name for effect in self._effects)})


def prediction_message(prediction: Prediction) -> PredictionMessage:
    """Message content of a prediction."""
    table = np.stack([getattr(prediction, name) for name in PREDICTION_FIELDS], axis=1)
    speed, rate, cycles, ratio, pulse_error, noise = prediction.header
    return PredictionMessage(table, speed, rate, int(cycles), ratio, pulse_error, noise)


def main(args: Sequence[str] | None = None) -> int:
    """Run the node."""
    return run_node(JitterPredictor, args)
