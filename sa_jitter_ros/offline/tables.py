# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The files of a run: rows of all recordings, a row for each, and what has changed in them."""

from collections.abc import Sequence
import json
from pathlib import Path

from sa_jitter_ros.offline.average_recording import Row
from sa_jitter_ros.offline.changes import CHANGES, Changes, FIGURE
from sa_jitter_ros.offline.files import join_tables, TABLE, write_lines, write_rows

RECORDINGS = 'recordings.csv'


def write_tables(output: Path, rows: Sequence[Row]) -> None:
    """
    Write `averages.csv` and `recordings.csv` beside the folders of the recordings.

    A recording that ended early, or could not be averaged, has a row with the reason in both.
    Raises OSError.
    """
    ordered = write_rows(output / RECORDINGS, rows)
    join_tables(output / TABLE, [output / row.recording for row in ordered if row.averages],
                [(row.recording, row.error) for row in ordered if row.error])


def write_changes(output: Path, changes: Changes, *, figure: bool) -> None:
    """Write `changes.json`, and `changes.png` with a `figure`; raises OSError."""
    text = json.dumps(changes.report(), indent=1, allow_nan=False)
    write_lines(output / CHANGES, lambda file: file.writelines((text, '\n')))
    if figure:
        from sa_jitter_ros.offline.change_figure import changes_figure
        changes_figure(changes).savefig(output / FIGURE, dpi=110)
