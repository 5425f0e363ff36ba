# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Faults of the nodes while they run: kills, stops, and changes of parameters."""

from collections.abc import Callable
from typing import Any

from fault_graph import DECLARED_ORDERS, Graph, ORDERS, ROLES
import numpy as np
from rclpy.task import Future
from sa_jitter_ros.nodes.messages import encode_array
from std_msgs.msg import Float64

VALID: dict[str, list[tuple[str, list[Any]]]] = {
    'direct': [
        ('trigger_cycles', [3, 6, 8, 12]), ('averaging', ['block', 'sliding', 'exponential']),
        ('tach.orders', [ORDERS, [2.5], [1.0, 2.0, 5.0, 12.04]]),
        ('gear.orders', [ORDERS, [5.0, 0.41531]]), ('gear.ratio', [2.40789, 0.41, 1.0, 3.5]),
        ('pulses_per_trigger', [0, 1, 2]), ('missing_pulses', ['break', 'bridge']),
        ('interval_tolerance', [0.0, 0.02, 0.03]), ('gear.samples_per_revolution', [0, 300, 512]),
        ('tach.mesh_orders', [[5.0], [12.0]]), ('keyphasor_rate', [0.0, 6400.0])],
    'averager': [('trigger_cycles', [4, 6, 6]), ('shaft.orders', [DECLARED_ORDERS, [1.0, 5.0]]),
                 ('correct_jitter', [True, False]), ('keyphasor_rate', [0.0, 6400.0])],
    'predictor': [
        ('trigger_cycles', [4, 6, 6]), ('orders', [DECLARED_ORDERS, [1.0, 40.0]]),
        ('ratio', [1.0, 1.0, 2.40789]),
        ('effects.excess_jitter.std', [1e-6, 2e-5]),
        ('effects.excess_jitter.enabled', [True, False]),
        ('jitter_distribution', ['uniform', 'normal', 'triangular'])],
    'detector': [('hysteresis', [0.1, 0.3]), ('minimum_interval', [0.0, 1e-3]),
                 ('learning_time', [0.2, 0.3])],
    'analyser': [('acquisitions', [4, 5, 6]), ('close_loop', [True, False])]}
INVALID: dict[str, list[tuple[str, Any]]] = {
    'direct': [
        ('trigger_cycles', 0), ('trigger_cycles', 'many'), ('averaging', 'median'),
        ('gear.ratio', 0.0), ('gear.ratio', float('nan')), ('tach.orders', [-1.0]),
        ('pulses_per_trigger', 3), ('interval_tolerance', 0.6), ('shafts', ['other']),
        ('buffer_seconds', 1.0), ('angle_law', 'cubic'), ('gear.samples_per_revolution', 2),
        ('no.such', 1)],
    'averager': [('averaging', 'sliding ' * 50), ('keyphasor_rate', -1.0),
                 ('shaft.ratio', float('inf'))],
    'predictor': [('trigger_speed', -1.0), ('noise_std', 1.0), ('ratio', 0.0),
                  ('jitter_distribution', 'cauchy'), ('orders', [0.0])],
    'detector': [('hysteresis', 1.0), ('polarity', 'up'), ('learning_time', 0.0)],
    'analyser': [('acquisitions', 1), ('shaft', 'other')]}
NONSENSE = ('shaft_speed', 'shaft/order_amplitude', 'shaft/pulse_error', 'prediction')


class Disturber:
    """
    Disturbs nodes of a graph at random; `killed` is called with each that is killed.

    `settings` are the parameters that each averager may have at present, the newest last; the
    lists stay the same objects.
    """

    def __init__(self, rng: np.random.Generator, graph: Graph,
                 killed: Callable[[str], None]) -> None:
        self.rng, self._graph, self._killed = rng, graph, killed
        self.settings = {role: [dict(ROLES[role].parameters)] for role in ('direct', 'averager')}
        self.faults: list[str] = []
        self.wrong: list[str] = []
        self.rejected = dict.fromkeys(('predictor', 'analyser'), 0)
        self.replaced = 0  # of these at most: a latched topic keeps the newest message only
        self._asked: list[tuple[str, str, Any, bool, Future]] = []

    def plan(self, *, kills: bool) -> list[Callable[[], None]]:
        """Return the disturbances of a scene, which do not interfere with each other."""
        rng = self.rng
        if kills and rng.random() < 0.12:
            role = str(rng.choice(['direct', 'direct', *ROLES]))
            return [lambda: self._kill(role)]
        actions: list[Callable[[], None]] = []
        for _ in range(int(rng.integers(0, 4))):
            actions.append([self._change, self._change_wrongly, self._nonsense][
                int(rng.integers(3))])
        if rng.random() < 0.08:
            actions.append(self._stall)
        return actions

    def set_angle_law(self) -> bool:
        """Choose the angle law of the next scene; return whether pulses may be displaced."""
        law = str(self.rng.choice(['linear', 'linear', 'linear', 'quadratic', 'spline']))
        if law != self.settings['direct'][-1].get('angle_law', 'linear'):
            self._ask('direct', 'angle_law', law, True)
            self.settle()
        return law == 'linear'

    def settle(self) -> None:
        """Wait for all answers; afterwards one set of parameters is in force."""
        for role, name, value, valid, future in self._asked:
            if not self._graph.spin(future.done, 20.0):
                self.wrong.append(f'{role}: no answer to {name} := {value}')
                continue
            answer = future.result().results[0]
            if answer.successful != valid:
                self.wrong.append(f'{role}: {name} := {value} was {"not " * valid}refused: '
                                  f'{answer.reason}')
        self._asked.clear()
        for known in self.settings.values():
            del known[:-1]

    # --- disturbances ---

    def _ask(self, role: str, name: str, value: Any, valid: bool) -> None:
        if valid and role in self.settings:
            self.settings[role].append({**self.settings[role][-1], name: value})
        self._asked.append((role, name, value, valid,
                            self._graph.set_parameter(role, name, value)))

    def _change(self) -> None:
        role = str(self.rng.choice(['direct', *VALID]))
        name, values = VALID[role][int(self.rng.integers(len(VALID[role])))]
        self.faults.append('parameter: valid')
        self._ask(role, name, values[int(self.rng.integers(len(values)))], True)

    def _change_wrongly(self) -> None:
        role = str(self.rng.choice(['direct', *INVALID]))
        name, value = INVALID[role][int(self.rng.integers(len(INVALID[role])))]
        self.faults.append('parameter: invalid')
        self._ask(role, name, value, False)

    def _nonsense(self) -> None:
        """Send a message that the predictor or the analyser must refuse."""
        topic = str(self.rng.choice(NONSENSE))
        self.faults.append(f'{topic}: nonsense')
        if topic == 'shaft_speed':
            value = float(self.rng.choice([np.nan, np.inf, -1.0, 0.0]))
            self._graph.send(topic, Float64(data=value))
            self.rejected['predictor'] += 1
            return
        message = encode_array(self.rng.standard_normal((2, 3, 5)), ('channel', 'order', 'field'),
                               tuple(self.rng.standard_normal(int(self.rng.integers(7)))))
        self._graph.send(topic, message)
        self.rejected['analyser'] += 1
        self.replaced += topic == 'prediction'

    def _stall(self) -> None:
        role = str(self.rng.choice(list(ROLES)))
        self.faults.append('node: stopped for a while')
        self._graph.stall(role, float(self.rng.uniform(0.1, 1.0)))

    def _kill(self, role: str) -> None:
        self.faults.append('node: killed')
        self._graph.kill(role)
        self._killed(role)
        if role in self.settings:
            self.settings[role][:] = [dict(ROLES[role].parameters)]
        self._graph.start([role])
