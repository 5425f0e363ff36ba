# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The loops over all samples: those in C where they are compiled, else those in numpy."""

try:
    from sa_jitter_ros.inner_loops._in_c import add_products, add_steps, frames, weighted_sums
except ImportError:  # installed without a C compiler
    from sa_jitter_ros.inner_loops.in_numpy import add_products, add_steps, frames, weighted_sums

__all__ = ['add_products', 'add_steps', 'frames', 'weighted_sums']
