# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Every table and figure of the paper, and what this package does about each."""

from dataclasses import dataclass

_NO_NUMBERS = 'nothing: illustrations, drawings and photographs'
_BENCH = 'a simulated bench: the recordings are not public'
_FLEET = 'simulated flights: the recordings are not public'


@dataclass(frozen=True)
class Item:
    """
    A table or figure of the paper.

    `module` of this package reproduces it, '' for none; `instead` says what stands for it where
    it has no numbers, or where its recordings are not public.
    """

    name: str
    module: str
    instead: str = ''


ITEMS = (
    Item('Fig. 1', '', _NO_NUMBERS),
    Item('Fig. 2', '', _NO_NUMBERS),
    Item('Table 1', 'single_harmonic'),
    Item('Table 2', 'single_harmonic'),
    Item('Table 3', 'single_harmonic'),
    Item('Table 3', 'pulse_acceptance'),
    Item('Fig. 3', 'analytic_approximation'),
    Item('Fig. 4', 'single_harmonic'),
    Item('Fig. 5', 'single_harmonic'),
    Item('Fig. 6', 'single_harmonic'),
    Item('Fig. 7', 'multi_harmonic'),
    Item('Fig. 8', 'analytic_approximation'),
    Item('Fig. 9', 'parametric_study'),
    Item('Fig. 10', 'parametric_study'),
    Item('Fig. 11', 'parametric_study'),
    Item('Figs. 12-14', '', _NO_NUMBERS),
    Item('Table 4', 'angle_laws'),
    Item('Fig. 15', 'bench_spectrum', _BENCH),
    Item('Fig. 16', 'angle_laws', _BENCH),
    Item('Fig. 17', 'residual_kurtosis', _BENCH),
    Item('Fig. 18', 'residual_kurtosis', _BENCH),
    Item('Fig. 19', 'residual_kurtosis', _BENCH),
    Item('Fig. 20', '', _NO_NUMBERS),
    Item('Table 5', 'fleet', _FLEET),
    Item('Fig. 21', 'fleet', _FLEET))
