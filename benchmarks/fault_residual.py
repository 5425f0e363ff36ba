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
Check residuals against the published averages and predictions, and reports for completeness.

All channels of the machine carry the same vibration, each times a factor. They have the same
attenuation with the same relative error, so the first channel suffices to recompute a residual.
"""

from collections.abc import Iterator
import json
from typing import Any

from fault_check import WrongAverageError
import numpy as np
from sa_jitter_ros.inference.expectation import RESOLUTION
from sa_jitter_ros.nodes.messages import AverageMessage, PredictionMessage, ResidualMessage

KEPT = 300  # averages and predictions that a residual may be of
ROUNDING = 1e-6
VERDICTS = ('traced', 'none', 'unexplained')
KEYS = ('declared', 'acquisitions', 'orders', 'missing_effects', 'candidates', 'error_before',
        'error_after', 'verdict')


class WrongResidualError(WrongAverageError):
    """A residual or report that is not what it should be."""


class ResidualChecker:
    """Checks residuals against the corrected averages and predictions that were received."""

    def __init__(self) -> None:
        self._averages: list[AverageMessage] = []
        self._predictions: list[PredictionMessage] = []
        self.checked = 0

    def add_average(self, average: AverageMessage) -> None:
        """Take a corrected average."""
        self._averages.append(average)
        del self._averages[:-KEPT]

    def add_prediction(self, prediction: PredictionMessage) -> None:
        """Take a prediction."""
        self._predictions.append(prediction)
        del self._predictions[:-KEPT]

    def check(self, message: ResidualMessage) -> None:
        """Raise `WrongResidualError` unless some batch and prediction give this residual."""
        table = message.values
        if not (table.size and np.isfinite(table).all() and 0.0 <= message.p_value <= 1.0):
            raise WrongResidualError(f'residual: {message}')
        order, observed, _, difference, _, z = table.T
        close = {'rtol': ROUNDING, 'atol': ROUNDING}
        if not (np.allclose(message.rms, np.sqrt(np.mean(difference**2)), **close)
                and np.allclose(z, difference / table[:, 4], **close)):
            raise WrongResidualError(f'residual does not agree with itself: {message}')
        for prediction in self._predictions:
            predicted, deviation = self._predicted(prediction, order)
            if not np.allclose(predicted, table[:, 2], **close):
                continue
            for batch in self._batches(message.acquisitions, prediction.trigger_cycles):
                attenuation, error = self._measured(batch, order)
                if not np.allclose(attenuation.mean(axis=0), observed, **close):
                    continue
                variance = error**2 + deviation**2 + RESOLUTION**2
                expected = np.stack((
                    order, attenuation.mean(axis=0), predicted, observed - predicted,
                    np.sqrt(variance.mean(axis=0) / len(batch)), z), axis=1)
                chi2 = np.mean((attenuation - predicted) ** 2 / variance)
                if np.allclose(table, expected, **close) and np.isclose(
                        message.chi2_per_dof, chi2, **close):
                    self.checked += 1
                    return
        raise WrongResidualError(f'residual is of no averages and prediction: {message}')

    def _predicted(self, prediction: PredictionMessage, order: Any) -> tuple[Any, Any]:
        """Return mean and standard deviation (order,), NaN where the order is not predicted."""
        found = np.full((2, len(order)), np.nan)
        for place, value in enumerate(order):
            row = np.flatnonzero(np.isclose(prediction.values[:, 0], value))
            if row.size:
                found[:, place] = prediction.values[row[0], [1, 3]]
        return found[0], found[1]

    def _measured(self, batch: list[AverageMessage], order: Any) -> tuple[Any, Any]:
        """Return attenuation and its standard error (average, order), the mean of channels."""
        tables = np.array([average.values for average in batch])
        column = [int(np.argmin(np.abs(tables[0, 0, :, 0] - value))) for value in order]
        return tables[:, 0, column, 5], tables[:, 0, column, 6] / np.sqrt(tables.shape[1])

    def _batches(self, count: int, cycles: int) -> Iterator[list[AverageMessage]]:
        """Iterate over what a batch may be: averages of one layout, later and later."""
        for first in range(len(self._averages) - count, -1, -1):
            batch: list[AverageMessage] = []
            for average in self._averages[first:]:
                header = average.header
                if header.trigger_cycles != cycles:
                    break
                if batch:
                    last = batch[-1]
                    if (header.start_time <= last.header.start_time
                            or not np.array_equal(average.values[..., 0], last.values[..., 0])):
                        break
                    if header.start_time < last.header.end_time - 1e-6:
                        continue  # overlaps
                batch.append(average)
                if len(batch) == count:
                    yield batch
                    break


def check_report(text: str) -> str:
    """Return the verdict of a report; raises `WrongResidualError` for one that is not whole."""
    def refuse(name: str) -> None:
        raise WrongResidualError(f'missing_effect holds {name}')

    content = json.loads(text, parse_constant=refuse)
    absent = [key for key in KEYS if key not in content]
    verdict, effects = content.get('verdict'), content.get('missing_effects', ())
    if absent or verdict not in VERDICTS or not content['acquisitions']['held_out']:
        raise WrongResidualError(f'missing_effect with verdict {verdict!r} lacks {absent}')
    if (verdict == 'none') != (not effects) and verdict != 'unexplained':
        raise WrongResidualError(f'verdict {verdict!r} with the effects {effects}')
    for effect in effects:
        if not (effect['name'] and effect['evidence'] and effect['p_value'] is None and all(
                item['value'] is not None for item in effect['parameters'].values())):
            raise WrongResidualError(f'missing_effect names {effect}')
    return str(verdict)
