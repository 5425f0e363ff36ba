# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Numbers as people read them: with the digits that their error leaves, and units."""

from collections.abc import Sequence
import math
from typing import Any

Json = Any

HALF_95 = 1.96  # standard errors from the middle of a 95 % interval to its end
_PREFIXES = (('', 1.0), ('m', 1e-3), ('µ', 1e-6), ('n', 1e-9))
_PREFIXED = ('s', 'rad')
_LARGE = (('T', 1e12), ('G', 1e9), ('M', 1e6))  # prefixes of a frequency
_EXACT = 1e-9  # relative error of a number that only rounding makes uncertain
_DIGITS = 3  # of a number without error
_SMALL = -3  # exponent of a number, below which it is written with it


def measured_text(value: Json, error: Json = None, unit: str = '') -> str:
    """
    Return a value with two digits of its standard error, in a unit that suits its size.

    Lists have an error for each value, or one for all. Without error, or where it is but rounding,
    there are three digits, all of a number that is whole. A text stays as it is.

    >>> measured_text(8.042e-05, 6.92e-06, 's')
    '80.4 ± 6.9 µs'
    >>> measured_text(3300.000000000002, 2.2e-12, 'Hz')
    '3300 Hz'
    >>> measured_text([0.0061, -0.0042], 0.00021, 'rad')
    '6.10 ± 0.21, -4.20 ± 0.21 mrad'
    >>> measured_text(0.01931, 0.00131, '1'), measured_text(None), measured_text([19.0, 38.0])
    ('0.0193 ± 0.0013', '–', '19, 38')
    >>> measured_text(280835514.3, None, 'Hz'), measured_text(5.41e12, None, 'Hz')
    ('281 MHz', '5.41 THz')
    >>> measured_text(163.0596441, 1.2e-6, 'Hz')
    '163.0596441 ± 0.0000012 Hz'
    """
    values = value if isinstance(value, list) else [value]
    errors = error if isinstance(error, list) else [error] * len(values)
    scale, unit = _unit(values, unit)
    texts = [_one(item if item is None or isinstance(item, str) else item / scale,
                  each if each is None else each / scale) for item, each in zip(values, errors)]
    return ' '.join(filter(None, (', '.join(texts), unit if texts != ['–'] else '')))


def percent_text(value: Json, error: Json = None, *, shown: bool = True) -> str:
    """
    Return a share in percent, with two digits of its standard error; `shown` writes the error.

    >>> percent_text(0.8111402, 0.008426), percent_text(0.8016, 0.008426, shown=False)
    ('81.11 ± 0.84 %', '80.16 %')
    >>> percent_text(0.17067)
    '17.1 %'
    """
    if value is None:
        return '–'
    text = measured_text(100.0 * value, None if error is None else 100.0 * error, '%')
    return text if shown else text.partition(' ')[0] + ' %'


def order_text(order: float, name: str = '') -> str:
    """
    Return an order with the digits that tell it from others, behind the name of what makes it.

    >>> order_text(39.047619), order_text(38.0, 'mesh input-output 2x')
    ('39.0476', 'mesh input-output 2x (38)')
    """
    return f'{name} ({order:.6g})' if name else f'{order:.6g}'


def order_words(order: float, name: str = '') -> str:
    """
    Return an order in a sentence.

    >>> order_words(60.0), order_words(38.0, 'mesh input-output 2x')
    ('order 60', 'mesh input-output 2x (38)')
    """
    return order_text(order, name) if name else f'order {order_text(order)}'


def _unit(values: Sequence[Json], unit: str) -> tuple[float, str]:
    """Return the size of a unit that suits the largest value, and its name."""
    unit = '' if unit == '1' else unit.replace('^2', '²')
    largest = max((abs(item) for item in values if isinstance(item, (int, float))), default=0.0)
    if unit == 'Hz':
        return next(((scale, prefix + unit) for prefix, scale in _LARGE if largest >= scale),
                    (1.0, unit))
    if unit not in _PREFIXED or not 0.0 < largest < 1.0:
        return 1.0, unit
    prefix, scale = next((item for item in _PREFIXES if largest >= item[1]), _PREFIXES[-1])
    return scale, prefix + unit


def _one(value: Json, error: Json) -> str:
    if value is None:
        return '–'
    if isinstance(value, str):
        return value
    if error is None or not error > _EXACT * abs(value):
        whole = round(value)
        if abs(value - whole) <= _EXACT * abs(value) and abs(whole) < 10**9:
            return str(whole)
        return _fixed(value, _DIGITS - 1 - _exponent(value))
    places = 1 - _exponent(error)
    small = not value or _exponent(value) < _SMALL
    return f'{_fixed(value, places, small)} ± {_fixed(error, places, small)}'


def _exponent(value: float) -> int:
    """Return the exponent of ten of the first digit of a number that is not 0."""
    return int(f'{value:.1e}'.partition('e')[2])


def _fixed(value: float, places: int, small: bool = True) -> str:
    """Return a number rounded at a decimal place; a small one with an exponent for its zeros."""
    if not value:
        return '0'
    if places > 6 and small:
        return f'{value:.{max(places + _exponent(value), 0)}e}'
    rounded = round(value, places)
    return f'{rounded:.{max(places, 0)}f}' if math.isfinite(rounded) else '–'
