# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The validation report: figures, a file of numbers, and the page that compares with the paper."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
import json
import math
from pathlib import Path
from typing import Any

from validation.paper import ITEMS
from validation.plots import save
from validation.results import Effort, Results

_INTRODUCTION = """# Validation against the paper

How far this package reproduces V. Camerini, G. Coppotelli, S. Bendisch, D. Kiehn, "Impact of pulse
time uncertainty on synchronous average: Statistical analysis and relevance to rotating machinery
diagnosis" (2019), for whoever relies on it. One command compares every numerical result of the
paper with ours:

    {command}

The settings that differ from the paper, and the numbers of each case, are in `validation.json`.

D is the width of the uniform pulse error in cycles of the analysed order, N_t the number of
trigger cycles in an average, r that of fundamental cycles in a trigger cycle. The exact model
splits fundamental cycles that straddle a pulse, the approximate one (Eq. 26) does not. *Same
errors*: two models with the same pulse errors. KS: two-sample Kolmogorov-Smirnov test, at 1 % for
each family of tests (Bonferroni). For the kurtosis, *separation* is the difference of the means
over the standard deviation, *detection* the share of faults found at 5 % false alarms, *area* that
under the ROC curve. A finding agrees (*yes*) if all its conditions hold, *partly* if some do.

"""


def write(results: Mapping[str, Results], effort: Effort, command: str, folder: Path) -> None:
    """
    Write `validation.md`, `validation.json` and `figures/validation-*.png` into a folder.

    `results` are by the name of their module.
    """
    figures, groups = folder / 'figures', results.values()
    figures.mkdir(parents=True, exist_ok=True)
    for group in groups:
        for stem, figure in group.figures.items():
            save(figure, figures / f'validation-{stem}.png')
    document = {'command': command, 'effort': asdict(effort),
                'groups': {group.title: group.numbers for group in groups},
                'settings': {group.title: group.choices for group in groups if group.choices},
                'findings': [asdict(finding) for group in groups for finding in group.findings]}
    (folder / 'validation.json').write_text(
        json.dumps(_as_json(document), indent=1, allow_nan=False) + '\n', encoding='utf-8')
    (folder / 'validation.md').write_text(page(results, command), encoding='utf-8')


def page(results: Mapping[str, Results], command: str) -> str:
    """Return the page in Markdown."""
    groups = results.values()
    count = Counter(finding.agreement for group in groups for finding in group.findings)
    lines = [_INTRODUCTION.format(command=command)
             + f'Of {sum(count.values())} findings {count["yes"]} are reproduced, '
             f'{count["partly"]} partly, {count["no"]} not.\n', _items()]
    for group in groups:
        lines.append(f'\n## {group.title}\n')
        rows = [('', 'the paper', 'here', 'agrees'),
                *((item.item, item.paper, item.ours,
                   ': '.join(filter(None, (item.agreement, item.why))))
                  for item in group.findings)]
        lines.append(_table(rows))
        lines += [f'![{stem}](figures/validation-{stem}.png)\n' for stem in group.figures]
    return '\n'.join(lines)


def _items() -> str:
    """Return what stands for tables and figures of the paper that have no numbers, or no data."""
    names: dict[str, list[str]] = {}
    for item in ITEMS:
        if item.instead:
            names.setdefault(item.instead, []).append(item.name)
    return _table((('of the paper', 'here'),
                   *((', '.join(group), instead) for instead, group in names.items())))


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose first row is the header."""
    escaped = [[cell.replace('|', '\\|') for cell in row] for row in rows]
    head, *body = ('| ' + ' | '.join(row) + ' |' for row in escaped)
    return '\n'.join((head, '|' + '---|' * len(escaped[0]), *body)) + '\n'


def _as_json(value: Any) -> Any:
    """Return a value with five significant digits and null for what is no number."""
    if isinstance(value, dict):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    if isinstance(value, float):
        return float(f'{value:.5g}') if math.isfinite(value) else None
    return value
