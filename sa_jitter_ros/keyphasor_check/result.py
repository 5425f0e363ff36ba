# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The result of a check: findings, warnings with their cost, and a summary."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sa_jitter_ros.keyphasor_check.lines import ToothLines
from sa_jitter_ros.keyphasor_check.marks import FittedPulses

_SHOWN = 4  # numbers, orders, or alternatives in a line of the summary


@dataclass(frozen=True)
class Checked:
    """
    A value (None: unknown) with its standard error, and what decided it or would decide it.

    `alternatives` are other values that fit, each with its probability.
    """

    value: Any
    standard_error: Any = None
    unit: str = '1'
    alternatives: tuple[tuple[Any, float], ...] = ()
    decided_by: str = ''


@dataclass(frozen=True)
class Warn:
    """A warning: its code, a text, and the loss in percent at each of some orders."""

    code: str
    text: str
    cost: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class KeyphasorCheck:
    """
    Result of `check_keyphasor`; `str` makes a summary.

    `fitted` are the pulses on their target, `lines` those of the vibration in orders of the tach
    shaft (None without vibration), `sample_rate` (Hz) that of the vibration without mistakes of
    units. `from_waveform`: the pulses are those of a sampled waveform. `by_marks`: trigger cycles
    from mark to mark are proposed.
    """

    findings: Mapping[str, Checked]
    warnings: tuple[Warn, ...]
    fitted: FittedPulses
    lines: ToothLines | None
    sample_rate: float
    from_waveform: bool = False
    by_marks: bool = False

    @property
    def report(self) -> dict[str, Any]:
        """Return the content of `keyphasor.json`."""
        found: dict[str, Any] = {name: {**vars(item), 'alternatives': [
            {'value': value, 'probability': probability}
            for value, probability in item.alternatives]} for name, item in self.findings.items()}
        found['warnings'] = [{**vars(item), 'cost': [
            {'order': order, 'percent': percent} for order, percent in item.cost]}
            for item in self.warnings]
        return found

    def __str__(self) -> str:
        """Return the findings and warnings, a line each."""
        lines = [f'{name:>22}  {_shown(item)}' for name, item in self.findings.items()]
        for item in self.warnings:
            worst = sorted(item.cost, key=lambda pair: -pair[1])[:_SHOWN]
            cost = ', '.join(f'order {g:g}: {percent:.2g} %' for g, percent in sorted(worst))
            lines.append(f'! {item.code}: {item.text}' + (f' (loss at {cost})' if cost else ''))
        return '\n'.join(lines)


def _shown(item: Checked) -> str:
    """Return a finding in one line."""
    value = item.value
    if value is None:
        text = 'unknown'
    elif isinstance(value, Mapping):
        text = ', '.join(f'{key} {number:.6g}' if isinstance(number, float) else f'{key} {number}'
                         for key, number in value.items() if not isinstance(number, list))
    elif isinstance(value, list):
        text = ', '.join(f'{number:.4g}' for number in value[:8]) + (
            ', ...' if len(value) > 8 else '')
    else:
        text = f'{value:.6g}'
    if isinstance(item.standard_error, float):
        text += f' ± {item.standard_error:.2g}'
    if item.unit not in ('1', '') and value is not None:
        text += f' {item.unit}'
    if item.alternatives:
        text += '; or ' + ', '.join(f'{other:.6g} ({probability:.0%})' for other, probability
                                    in item.alternatives[:_SHOWN])
    return text + (f'  [{item.decided_by}]' if item.decided_by else '')
