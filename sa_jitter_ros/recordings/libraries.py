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

from sa_jitter_ros.errors import RecordingError


def missing_library(reads: str, name: str, extra: str, otherwise: str = '') -> RecordingError:
    """
    Return the error for a library that is not installed, but by an `extra` of this package.

    >>> print(missing_library('bags are', 'rosbags', 'bags'))  # doctest: +ELLIPSIS
    bags are read with rosbags, which is not installed: ... 'sa_jitter_ros[bags]' or rosbags
    """
    return RecordingError(f'{reads} read with {name}, which is not installed: pip install '
                          f"'sa_jitter_ros[{extra}]' or {name}{otherwise}")
