# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Files that are there when they are complete, or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import tempfile
from typing import TextIO

TEMPORARY = '.averages.'  # prefix of folders whose files are not finished


@contextmanager
def finished_together(folder: Path, *, last: str = '') -> Iterator[Path]:
    """
    Yield a temporary folder, whose files get their places in `folder` at the end, or not at all.

    The file `last` comes after all others: where it is, these are. Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(dir=folder, prefix=TEMPORARY) as temporary:
            place = Path(temporary, 'finished')
            place.mkdir()
            yield place
            files = [path for path in place.rglob('*') if path.is_file()]
            for path in sorted(files, key=lambda path: path.name == last):
                target = folder / path.relative_to(place)
                target.parent.mkdir(exist_ok=True)
                os.replace(path, target)
    finally:
        with suppress(OSError):  # it holds something
            folder.rmdir()


@contextmanager
def whole_file(path: Path) -> Iterator[TextIO]:
    """Yield a text file that gets its name when it is complete; raises OSError."""
    with finished_together(path.parent) as folder, (folder / path.name).open(
            'w', encoding='utf-8', newline='') as file:
        yield file
