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

_ILLUSTRATION = 'an illustration without numbers'
_DRAWING = 'a drawing or photograph of a machine'
_BENCH = 'simulated bench: the recordings are not public'
_FLEET = 'simulated flights: the recordings are not public'
_SETTINGS = 'as printed'


@dataclass(frozen=True)
class Item:
    """
    One table or figure of the paper and what it shows.

    `module` of this package reproduces it, '' for none; `basis` says on what, or why not.
    """

    name: str
    shows: str
    module: str
    basis: str


ITEMS = (
    Item('Fig. 1', 'synchronous averaging', '', _ILLUSTRATION),
    Item('Fig. 2', 'pulse error of a sampled keyphasor', '', _ILLUSTRATION),
    Item('Table 1', 'settings of the full simulation', 'single_harmonic', 'see its settings'),
    Item('Table 2', 'settings of the numerical model', 'single_harmonic', 'see its settings'),
    Item('Table 3', 'twelve cases', 'single_harmonic', _SETTINGS),
    Item('Table 3', 'the same through `average`', 'pulse_acceptance', _SETTINGS),
    Item('Fig. 3', 'moments of one cycle', 'analytic_approximation', 'closed forms'),
    Item('Fig. 4', 'amplitude over N_t', 'single_harmonic', 'simulation'),
    Item('Fig. 5', 'amplitude over D', 'single_harmonic', 'simulation'),
    Item('Fig. 6', 'amplitude over r', 'single_harmonic', 'simulation'),
    Item('Fig. 7', 'two harmonics', 'multi_harmonic', 'simulation'),
    Item('Fig. 8', 'analytic and simulated distributions', 'analytic_approximation',
         'simulation'),
    Item('Fig. 9', 'cumulants over N_t and D', 'parametric_study', 'closed forms, Monte Carlo'),
    Item('Fig. 10', 'cumulants over N_t and noise', 'parametric_study',
         'closed forms, Monte Carlo'),
    Item('Fig. 11', 'cumulants over D and noise', 'parametric_study',
         'closed forms, Monte Carlo'),
    Item('Figs. 12-14', 'gearbox, test stand, chipped tooth', '', _DRAWING),
    Item('Table 4', 'settings of the bench test', 'angle_laws', _SETTINGS),
    Item('Fig. 15', 'spectrum of the bench', 'bench_spectrum', _BENCH),
    Item('Fig. 16', 'amplitude ratio of two keyphasors, three angle laws', 'angle_laws', _BENCH),
    Item('Fig. 17', 'residual signals', 'residual_kurtosis', _BENCH),
    Item('Fig. 18', 'kurtosis, band with one mesh harmonic', 'residual_kurtosis', _BENCH),
    Item('Fig. 19', 'kurtosis, band with two mesh harmonics', 'residual_kurtosis', _BENCH),
    Item('Fig. 20', 'gearboxes and sensors of the fleet', '', _DRAWING),
    Item('Table 5', 'settings of the fleet data', 'fleet', _FLEET),
    Item('Fig. 21', 'amplitude ratio under added pulse errors', 'fleet', _FLEET))
