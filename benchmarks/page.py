# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Tables and sections of the pages of measured numbers, which commands write."""

from collections.abc import Iterable, Mapping, Sequence
import re

import numpy as np

MEMORY = ('MB half way', 'at the end', 'trend between in MB an hour')
LONG = 240.0  # s that a node must have lived for a trend


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    head, *body = (f'| {" | ".join(line)} |' for line in (header, *rows))
    return '\n'.join((head, '|' + '---|' * len(header), *body))


def fill(page: str, contents: Mapping[str, str]) -> str:
    """Return the page with what is between the markers of each section replaced."""
    for name, content in contents.items():
        pattern = re.compile(f'(<!-- {name} -->\n).*?(<!-- end -->)', re.DOTALL)
        if len(pattern.findall(page)) != 1:
            raise ValueError(f'the page has no section <!-- {name} --> ... <!-- end -->: add it')
        page = pattern.sub(lambda match, text=content: f'{match[1]}{text}\n{match[2]}', page)
    return page


def growth(rss: Sequence[Sequence[float]]) -> tuple[str, str, str]:
    """Return memory (MB) half way and at the end, and the trend between (MB an hour)."""
    times, values = np.array(rss).T
    later = times >= times.mean()
    trend = '-'
    if np.ptp(times) >= LONG:
        trend = f'{3600.0 * np.polyfit(times[later], values[later], 1)[0]:+.1f}'
    return f'{values[later][0]:.1f}', f'{values[-1]:.1f}', trend
