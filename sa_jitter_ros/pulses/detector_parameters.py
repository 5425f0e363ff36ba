# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Parameters of a detector of pulses."""

from sa_jitter_ros.parameters import Parameter

DETECTOR_PARAMETERS = (
    Parameter('automatic_threshold', True, 'learn the threshold from the low and high level of '
              'the waveform'),
    Parameter('threshold', 0.0, 'threshold without automatic_threshold [unit of the waveform]'),
    Parameter('hysteresis', 0.1, 'band around the threshold, as a fraction of high minus low '
              'level; wider in noise, unless 0', minimum=0.0, maximum=0.99),
    Parameter('polarity', 'positive', 'positive: pulses are above the threshold; negative: below; '
              'auto: pulses have the rarer level',
              choices=('positive', 'negative', 'auto')),
    Parameter('edge', 'rising', 'edge of the pulse that gives its time',
              choices=('rising', 'falling', 'centre')),
    Parameter('interpolate', True, 'interpolate the time between samples; false: first sample '
              'past the threshold'),
    Parameter('minimum_interval', 0.0, 'a pulse this soon after another is dropped',
              unit='s', minimum=0.0),
    Parameter('learning_time', 0.5, 'shortest window from which the levels are learnt',
              unit='s', above=0.0, maximum=60.0),
    Parameter('minimum_difference', 0.0, 'levels closer than this are noise [unit of the '
              'waveform]', minimum=0.0),
)

# All decide which pulses a detector finds; those behind the threshold are its options.
DECISIVE = tuple(item.name for item in DETECTOR_PARAMETERS)
OPTIONS = DECISIVE[2:]
