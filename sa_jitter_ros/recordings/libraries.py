# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Libraries that read one format of recordings and are optional dependencies."""

from collections.abc import Iterator
from contextlib import contextmanager

from sa_jitter_ros.errors import RecordingError


@contextmanager
def library(reads: str, name: str, extra: str, otherwise: str = '') -> Iterator[None]:
    """
    Raise RecordingError that says how to install a library if an import within it fails.

    `reads` is what it reads, `extra` the one of this package that installs it.

    >>> with library('bags are', 'rosbags', 'bags'):  # doctest: +ELLIPSIS
    ...     import no_such
    Traceback (most recent call last):
    ...
    sa_jitter_ros.errors.RecordingError: bags are read with rosbags, which is not installed: ...
    """
    try:
        yield
    except ImportError:
        raise RecordingError(f'{reads} read with {name}, which is not installed: pip install '
                             f"'sa_jitter_ros[{extra}]' or {name}{otherwise}") from None
