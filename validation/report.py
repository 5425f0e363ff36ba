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
from validation.results import Effort, Results

_INTRODUCTION = """# Validation against the paper

V. Camerini, G. Coppotelli, S. Bendisch, D. Kiehn, "Impact of pulse time uncertainty on
synchronous average: Statistical analysis and relevance to rotating machinery diagnosis" (2019):
every numerical result of the paper, compared with that of this package. One command writes this
page, its figures and `validation.json`, with every number in them:

    {command}

D is the width of the uniform pulse error in cycles of the analysed order, N_t the number of
averaged trigger cycles, r the cycle length: fundamental cycles in a trigger cycle.

The command decides the agreement: *yes* if all its conditions hold, *partly* if some do. Samples
are compared by two-sample Kolmogorov-Smirnov tests with their own sizes, at 1 % for each family of
comparisons (Bonferroni). Full simulation and model are also compared draw by draw under the same
pulse errors, which is stricter than any test of distributions.

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
            figure.savefig(figures / f'validation-{stem}.png', metadata={'Software': None})
    document = {'command': command, 'effort': asdict(effort),
                'groups': {group.title: group.numbers for group in groups},
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
             f'{count["partly"]} partly, {count["no"]} not.\n',
             '\n## Tables and figures of the paper\n', _items(results)]
    for group in groups:
        lines.append(f'\n## {group.title}\n')
        lines.append(_table(
            (('', 'what the paper finds', 'what we find', 'agreement', 'why'),
             *((item.item, item.paper, item.ours, item.agreement, item.why)
               for item in group.findings))))
        lines += [_table(rows) for rows in group.tables]
        if group.choices:
            lines.append('Settings that differ from the paper or are not in its text:\n')
            lines += [f'* {choice}' for choice in group.choices]
            lines.append('')
        lines += [f'![{stem} of: {group.title}](figures/validation-{stem}.png)\n'
                  for stem in group.figures]
    return '\n'.join(lines)


def _items(results: Mapping[str, Results]) -> str:
    """Return the table of what the paper shows, and in which part of the page it is."""
    titles = {name: group.title for name, group in results.items()}
    return _table((('', 'what it shows', 'part of this page', 'on what'),
                   *((item.name, item.shows, titles.get(item.module, 'none'), item.basis)
                     for item in ITEMS)))


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table whose first row is the header."""
    escaped = [[cell.replace('|', '\\|') for cell in row] for row in rows]
    body = [escaped[0], ['---'] * len(escaped[0]), *escaped[1:]]
    return '\n'.join('| ' + ' | '.join(row) + ' |' for row in body) + '\n'


def _as_json(value: Any) -> Any:
    """Return a value with five significant digits and null for what is no number."""
    if isinstance(value, dict):
        return {str(key): _as_json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_as_json(item) for item in value]
    if isinstance(value, float):
        return float(f'{value:.5g}') if math.isfinite(value) else None
    return value
