# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Results as values that JSON has."""

from collections.abc import Mapping
import json
import math
from typing import Any

import numpy as np


def json_values(value: Any) -> Any:
    """
    Return arrays and tuples as lists, and numbers that are not finite as None.

    >>> json_values({'mean': np.array([[0.5, np.nan]]), 'orders': (19, 38)})
    {'mean': [[0.5, None]], 'orders': [19, 38]}
    """
    if isinstance(value, Mapping):
        return {str(key): json_values(item) for key, item in value.items()}
    if isinstance(value, np.ndarray) and value.dtype.kind == 'f':
        content = value.astype(object)
        content[~np.isfinite(value)] = None
        return content.tolist()
    if isinstance(value, (list, tuple, np.ndarray)):
        return [json_values(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return value


def json_text(value: Any) -> str:
    """Return results as the text of a file in JSON."""
    return json.dumps(json_values(value), indent=1, allow_nan=False) + '\n'
