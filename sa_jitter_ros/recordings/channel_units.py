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
Names, units and sensitivities of vibration channels: `machine.channels` of a machine file.

Volts become units once, where vibration enters: in the averager, and when a recording is read.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
import re
from typing import Any

import numpy as np
from sa_jitter_ros.arrays import FloatArray
from sa_jitter_ros.errors import ParameterError
from sa_jitter_ros.parameters import fixed, Parameter
from sa_jitter_ros.recordings.recording import changed, Recording

#: Channels by name, each with `unit` and `sensitivity`, in the order of the machine file.
Channels = Mapping[str, Mapping[str, Any]]

PREFIX = 'machine.channels.'
_FIELDS = {item.name: item for item in (
    fixed('unit', '', 'unit of this vibration channel'),
    fixed('sensitivity', math.nan, 'of its sensor with amplifier, by which the vibration is '
          'divided; NaN: it comes in the unit', unit='V per unit'))}
_VOLTS = {'': 1.0, '1': 1.0, 'v': 1.0, 'mv': 1e-3, 'uv': 1e-6, 'µv': 1e-6}


@dataclass(frozen=True)
class ChannelScale:
    """Names and units of the channels of a signal, and what it is divided by (channel, 1)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    divisor: FloatArray

    def apply(self, samples: FloatArray) -> FloatArray:
        """Return samples (channel, sample) in the units."""
        return samples if np.all(self.divisor == 1.0) else samples / self.divisor

    @property
    def labels(self) -> list[tuple[str, str]]:
        """Return what a machine file may call each channel: its number or its name."""
        return [(str(place), name) for place, name in enumerate(self.names)]


def channel_parameters(values: Mapping[str, Any]) -> list[Parameter]:
    """Return the parameters of the channels that names of parameters tell; raises as below."""
    found: dict[str, None] = {}
    for key in values:
        if key.startswith(PREFIX):
            name, _, field = key.removeprefix(PREFIX).rpartition('.')
            if not name or field not in _FIELDS:
                raise ParameterError(f'{key}: give {PREFIX}NAME.unit or {PREFIX}NAME.sensitivity')
            found[name] = None
    return [replace(item, name=f'{PREFIX}{name}.{field}')
            for name in found for field, item in _FIELDS.items()]


def channels_of(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """
    Return the channels in parameters by their full names; raises ParameterError.

    >>> channels_of({'machine.channels.bearing.sensitivity': 0.1, 'trigger_cycles': 3})
    {'bearing': {'unit': '', 'sensitivity': 0.1}}
    """
    channels: dict[str, dict[str, Any]] = {}
    for item in channel_parameters(values):
        name, _, field = item.name.removeprefix(PREFIX).rpartition('.')
        value = item.convert(values.get(item.name, item.default))
        if value == 0.0:
            raise ParameterError(f'{item.name} is 0: give the volts of one unit')
        channels.setdefault(name, {})[field] = value
    return channels


def scale_of(channels: Channels, names: Sequence[str] | int, units: Sequence[str] = ()
             ) -> ChannelScale:
    """
    Return names, units and divisors of a signal with a number of channels, or these names.

    A channel is found by its name or its number, from 0. Where none is, they are meant in their
    order. Raises ParameterError where it is open which channel has which sensitivity, and for a
    sensitivity of a channel that is not in volts.

    >>> scale_of({'drive end': {'unit': 'g', 'sensitivity': 0.5}}, ['Drive_End', 'other'])
    ChannelScale(names=('drive end', 'other'), units=('g', ''), divisor=array([[0.5],
           [1. ]]))
    """
    if isinstance(names, int):
        names = [f'channel {place}' for place in range(names)]
    places = {_plain(name): place for place, name in enumerate(names)}
    found = {places.get(_plain(name), int(name) if name.isdecimal() else -1): name
             for name in channels}
    if set(found) == {-1} and len(channels) == len(names):
        found = dict(enumerate(channels))
    missing = len(channels) - sum(0 <= place < len(names) for place in found)
    at_stake = any(math.isfinite(_sensitivity(item)) for item in channels.values())
    if missing and at_stake and len(channels) - missing < len(names):
        raise ParameterError(
            f'machine.channels has {", ".join(channels)}, the vibration {len(names)} channels '
            f'({", ".join(names[:6])}): name all, or give numbers from 0')
    shown, labels, divisor = list(names), [*units] or [''] * len(names), np.ones((len(names), 1))
    for place, name in found.items():
        if not 0 <= place < len(names):
            continue
        sensitivity = _sensitivity(channels[name])
        if math.isfinite(sensitivity):
            if labels[place].lower() not in _VOLTS:
                raise ParameterError(f'{PREFIX}{name}.sensitivity: the channel comes in '
                                     f'{labels[place]}, not in V: leave it out')
            divisor[place] = sensitivity / _VOLTS[labels[place].lower()]
        labels[place] = channels[name].get('unit') or (
            '' if math.isfinite(sensitivity) else labels[place])
        shown[place] = shown[place] if name.isdecimal() else name
    return ChannelScale(tuple(shown), tuple(labels), divisor)


def _sensitivity(channel: Mapping[str, Any]) -> float:
    return float(channel.get('sensitivity') or math.nan)


def _plain(name: str) -> str:
    return re.sub(r'\W+', '_', name).lower()


def in_units(recording: Recording, channels: Channels) -> Recording:
    """Return a recording with the names and in the units of a machine; raises ParameterError."""
    if not channels:
        return recording
    scale = scale_of(channels, recording.channel_names, recording.units)
    remarks = tuple(
        f'{name} is in {before} by the file, in {after} by machine.channels: check which is true'
        for name, before, after, divisor in zip(scale.names, recording.units, scale.units,
                                                scale.divisor)
        if divisor == 1.0 and before not in ('', '1') and before != after)
    vibration = changed(recording.vibration, recording.channels, scale.apply)
    return replace(recording, vibration=vibration,
                   channel_names=scale.names, units=scale.units,
                   remarks=(*recording.remarks, *remarks))
