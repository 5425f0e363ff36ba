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
The machine by its parts: ratios and orders from numbers of teeth and geometry of bearings.

`Machine` is read from the machine file, `following` gives the parameters that follow from it.
"""

from sa_jitter_ros.machine.parts import LEVELS, Limit
from sa_jitter_ros.machine.train import following, Machine, PREFIX, UNKNOWN

__all__ = ['LEVELS', 'PREFIX', 'UNKNOWN', 'Limit', 'Machine', 'following']
