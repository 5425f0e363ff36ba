# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

def weighted_sums(samples: FloatArray, origin: NDArray[np.int32], begin: FloatArray,
                  length: FloatArray, u: FloatArray, polynomials: FloatArray, values: FloatArray, /
                  ) -> None: ...

def frames(samples: FloatArray, values: FloatArray, /) -> bool: ...

def add_steps(values: FloatArray, first: FloatArray, total: FloatArray, squares: FloatArray, /
              ) -> None: ...

def add_products(table: FloatArray, values: FloatArray, sums: FloatArray, /) -> None: ...

def take_lanes(most: int, /) -> int: ...
