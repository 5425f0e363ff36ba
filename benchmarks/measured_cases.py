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
The loop on measured machines, whose true effects are unknown: what `close_loop` finds.

Run `python benchmarks/measured_cases.py --data FOLDER` with the recordings that
docs/measured_cases.md names; it prints the tables of that page. `--figures DIR` draws its
figures. Recordings are derived in a temporary folder that is removed at the end.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
import io
import json
from pathlib import Path
import tempfile
from typing import Any, TYPE_CHECKING

import numpy as np
from sa_jitter_ros.commands import close_loop
from sa_jitter_ros.recordings import read
from sa_jitter_ros.recordings.channel_map import with_channels
from sa_jitter_ros.recordings.npz_format import write_npz
from sa_jitter_ros.recordings.recording import Recording
from scipy import stats
from worse_pulses import with_slower_clock
import yaml

if TYPE_CHECKING:  # loaded where something is drawn: matplotlib takes half a second
    from matplotlib.figure import Figure

CLOCKS = (2560.0, 3300.0, 4700.0, 5120.0, 6000.0, 9100.0, 13000.0)
FITTED = 3300.0
GEAR0 = {'trigger_speed': 33.33, 'trigger_cycles': 40, 'orders': [23.0, 46.0, 69.0, 92.0, 115.0]}
_FIRST_HALF, _SECOND_HALF = (0, 1, 2), (3, 4, 5)
_FEW, _SHOWN = 10, 120
_TURBINE = (20130316, 20130326, 20130331, 20130405, 20130415)  # days


@dataclass(frozen=True)
class Case:
    """Recordings of one machine, the declared model, and what came out (`content` or `error`)."""

    title: str
    recordings: Sequence[Callable[[Path], Recording]]
    model: Mapping[str, Any]
    content: Mapping[str, Any] = field(default_factory=dict)
    error: str = ''

    @property
    def effects(self) -> str:
        """Return the names of the effects that were added."""
        return ', '.join(item['name'] for item in self.content['missing_effects']) or '-'

    @property
    def refinements(self) -> str:
        """Return what the recording adds to the declared model."""
        return ', '.join(dict.fromkeys(
            item['name'] for item in self.content['declared_changes']
            if item['declared'] is None)) or '-'

    def value(self, when: str, key: str) -> float:
        """Return a number of the residual, NaN without one; `when` is as_declared or after."""
        value = self.content[f'error_{when}'][key]
        return float('nan' if value is None else value)


def gear0(clock: float, channels: Sequence[int] = ()) -> Callable[[Path], Recording]:
    """Return what opens the gearbox with its keyphasor timed by a slower clock."""
    def made(data: Path) -> Recording:
        recording = with_slower_clock(read(data / 'gear0_gearbox.npz'), clock)
        return with_channels(recording, channels) if channels else recording
    return made


def stored(name: str, acquisition: int = 0) -> Callable[[Path], Recording]:
    """Return what opens a recording as it is."""
    return lambda data: read(data / name, acquisition=acquisition)


def gearbox_cases() -> list[Case]:
    """Return the gearbox at every clock, and one clock with shorter acquisitions."""
    found = [Case(f'gearbox, {clock:.0f} Hz', [gear0(clock)], {**GEAR0, 'keyphasor_rate': clock})
             for clock in CLOCKS]
    return [*found, Case(f'gearbox, 6000 Hz, {_FEW} cycles', [gear0(6000.0)],
                         {**GEAR0, 'keyphasor_rate': 6000.0, 'trigger_cycles': _FEW})]


def other_cases() -> list[Case]:
    """Return the other machines; a tacho's step of 1/100 kHz is its declared jitter."""
    motor = {'keyphasor_rate': 1e5, 'pulses_per_revolution': 8,
             'orders': [12.0, 16.0, 18.0, 36.0, 54.0, 72.0]}
    return [
        Case('motor, 10 V', [stored('motor_10V_100kHz.npz')],
             {**motor, 'trigger_speed': 19.6, 'trigger_cycles': 5}),
        Case('motor, 30 V', [stored('motor_30V_100kHz.npz')],
             {**motor, 'trigger_speed': 94.4, 'trigger_cycles': 8}),
        Case('motor, run-up', [stored('motor_runup_20V_40kHz.npz')],
             {**motor, 'keyphasor_rate': 4e4, 'orders': [12.0, 36.0, 72.0],
              'trigger_speed': 44.0, 'trigger_cycles': 8}),
        Case('bearing rig', [stored('uia_bearing_rig_1.npz')],
             {'keyphasor_rate': 1024.0, 'orders': [1.0, 2.0, 3.0], 'trigger_speed': 4.19,
              'trigger_cycles': 10}),
        Case('small rotor', [stored('rotorbalancer_weight_5.npz', k) for k in range(10)],
             {'keyphasor_rate': 952.0, 'orders': [1.0], 'trigger_speed': 32.0,
              'trigger_cycles': 10}),
        *(Case(f'turbine, {day}', [stored(f'turbine_{day}.npz')],
               {'keyphasor_rate': 3.125e6, 'pulses_per_revolution': 2,
                'orders': [20.0, 40.0, 60.0], 'trigger_speed': 30.0, 'trigger_cycles': 10})
          for day in _TURBINE)]


def transferred(clock: float, period_std: float) -> tuple[Case, Case]:
    """Return channels outside the fit, without the effect and with it declared."""
    model = {**GEAR0, 'keyphasor_rate': clock}
    effect = {'enabled': True, 'clock_rate': clock, 'period_std': period_std}
    recordings = [gear0(clock, _SECOND_HALF)]
    return (Case(f'{clock:.0f} Hz', recordings, model),
            Case(f'{clock:.0f} Hz', recordings,
                 {**model, 'effects': {'keyphasor_quantisation': effect}}))


def run(case: Case, data: Path) -> Case:
    """Write the case's recordings and model, and close the loop on them as a user does."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        paths = [folder / f'{k}.npz' for k in range(len(case.recordings))]
        for path, opened in zip(paths, case.recordings):
            write_npz(path, opened(data))
        declared = folder / 'model.yaml'
        declared.write_text(yaml.safe_dump({
            'jitter_predictor': {'ros__parameters': dict(case.model)}}), encoding='utf-8')
        said = io.StringIO()
        with redirect_stdout(said), redirect_stderr(said):
            status = close_loop.main([*map(str, paths), '--declared', str(declared), '--output',
                                      str(folder / 'report'), '--quiet'])
        if status:
            return replace(case, error=said.getvalue().replace(f'{folder}/', '').strip())
        return replace(case, content=json.loads(
            (folder / 'report' / 'report.json').read_text(encoding='utf-8')))


def transfer_table(period_std: float, data: Path) -> str:
    """Return the RMS without and with the effect, at clocks and channels outside the fit."""
    lines = ['| clock | RMS without the effect | RMS with it |', '|---|---|---|']
    for clock in CLOCKS:
        if clock != FITTED:
            without, fitted = (run(case, data) for case in transferred(clock, period_std))
            lines.append(f'| {without.title} | {without.value("as_declared", "rms"):.4f} | '
                         f'{fitted.value("as_declared", "rms"):.4f} |')
    return '\n'.join(lines)


def table(cases: Sequence[Case], first: str) -> str:
    """Return the outcomes in Markdown."""
    lines = [f'| {first} | held out | verdict | effects | refined by | unsteadiness '
             '| RMS as declared | after | chi2/dof as declared | after |', f'|{"---|" * 10}']
    for case in cases:
        if case.error:
            lines.append(f'| {case.title} | - | not used {"| " * 7}|')
            continue
        if not case.content['lines']:
            lines.append(f'| {case.title} | {case.content["acquisitions"]["held_out"]} | '
                         f'{case.content["verdict"]} | {case.effects} | {case.refinements} '
                         f'{"| - " * 5}|')
            continue
        numbers = [f'{case.value(when, key):.{digits}}'
                   for key, digits in (('rms', '4f'), ('chi2_per_dof', '3g'))
                   for when in ('as_declared', 'after')]
        lines.append(f'| {case.title} | {case.content["acquisitions"]["held_out"]} | '
                     f'{case.content["verdict"]} | {case.effects} | {case.refinements} | '
                     f'{case.content["unsteadiness"]:.1%} | {" | ".join(numbers)} |')
    return '\n'.join(lines)


def clock_errors(clock: float, data: Path) -> tuple[Any, Any]:
    """Return the pulse errors in periods of the clock, and the true times of the pulses in s."""
    recording = gear0(clock)(data)
    pulses, truth = recording.pulse_times, recording.reference_pulse_times
    assert pulses is not None
    assert truth is not None
    return clock * (pulses - truth), truth


def clock_table(data: Path) -> str:
    """Return what the clocks do to the pulses of the gearbox."""
    lines = ['| clock | ticks a revolution | correlation of neighbouring errors '
             '| KS distance from uniform |', '|---|---|---|---|']
    for clock in CLOCKS:
        errors, truth = clock_errors(clock, data)
        lines.append(f'| {clock:.0f} Hz | {clock * np.diff(truth).mean():.2f} | '
                     f'{np.corrcoef(errors[1:], errors[:-1])[0, 1]:.2f} | '
                     f'{stats.kstest(errors, "uniform").statistic:.2f} |')
    return '\n'.join(lines)


def grid_figure(cases: Sequence[Case], data: Path) -> 'Figure':
    """Draw what the clock does to the pulses, and the lines before and after it is known."""
    from matplotlib.figure import Figure
    from sa_jitter_ros.report.plotting import AFTER, BEFORE
    figure = Figure(figsize=(10.0, 3.6), layout='constrained')
    left, right = figure.subplots(1, 2)
    for clock, colour in ((FITTED, 'tab:orange'), (6000.0, 'tab:purple')):
        errors, _ = clock_errors(clock, data)
        left.plot(errors[:_SHOWN], '.-', color=colour, linewidth=0.6,
                  markersize=4, label=f'clock of {clock:.0f} Hz')
    left.set(xlabel='revolution', ylabel='pulse error in periods of the clock', ylim=(-0.05, 1.25),
             title='Errors of a steady machine repeat')
    left.legend(fontsize='small', loc='upper right', ncols=2)
    lines = [line for case in cases for line in case.content['lines']]
    for when, colour, label in (('as_declared', BEFORE, 'declared: independent errors'),
                                ('after', AFTER, 'with the ticks of the clock')):
        right.plot([line[f'predicted_{when}'] for line in lines],
                   [line['observed'] for line in lines], 'o', color=colour, markersize=4,
                   label=label)
    right.axline((0.5, 0.5), slope=1.0, color='0.4', linewidth=0.8)
    right.set(xlabel='predicted attenuation', ylabel='observed, held-out acquisitions',
              title='All lines, without and with the ticks')
    right.legend(fontsize='small')
    return figure


def error_figure(cases: Sequence[Case]) -> 'Figure':
    """Draw the held-out error of every case that could be used, as declared and after."""
    from matplotlib.figure import Figure
    from sa_jitter_ros.report.plotting import AFTER, BEFORE
    used = [case for case in cases if case.content.get('lines')]
    place = np.arange(len(used))
    figure = Figure(figsize=(10.0, 3.4), layout='constrained')
    axes = figure.subplots()
    for when, colour, shift in (('as_declared', BEFORE, -0.2), ('after', AFTER, 0.2)):
        axes.bar(place + shift, [case.value(when, 'rms') for case in used], 0.38, color=colour,
                 label=when.replace('_', ' ') + ' the loop' * (when == 'after'))
    axes.set_xticks(place, [case.title.replace(', ', ',\n') for case in used], fontsize='small')
    axes.set(ylabel='RMS of observed minus\npredicted attenuation', yscale='log', ylim=(1e-4, 1.0))
    axes.grid(axis='y', alpha=0.3)
    axes.legend(fontsize='small')
    return figure


def main() -> None:
    """Print the tables and draw the figures."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--data', type=Path, required=True, help='folder of the recordings')
    parser.add_argument('--figures', type=Path, help='folder for the figures')
    options = parser.parse_args()
    print(f'{clock_table(options.data)}\n', flush=True)
    gearbox = [run(case, options.data) for case in gearbox_cases()]
    print(table(gearbox, 'gearbox, clock'), flush=True)
    source = run(Case('', [gear0(FITTED, _FIRST_HALF)], {**GEAR0, 'keyphasor_rate': FITTED}),
                 options.data)
    period_std, = (item['value'] for item in source.content['declared_changes']
                   if item['parameter'] == 'period_std')
    print(f'\nperiod_std = {period_std:.3g} s, fitted at {FITTED:.0f} Hz on channels 0 to 2, then '
          'declared; channels 3 to 5:\n')
    print(transfer_table(period_std, options.data), flush=True)
    others = [run(case, options.data) for case in other_cases()]
    print(f'\n{table(others, "machine")}')
    for case in others:
        if case.error:
            print(f'\n{case.title}: {case.error}')
        for item in case.content.get('missing_effects', ()):
            print(f'\n{case.title}: {item["name"]}: {item["evidence"]}')
        if case.content and not case.content['lines']:
            print(f'\n{case.title}: {case.content["remarks"][-1]}')
    if options.figures:
        options.figures.mkdir(parents=True, exist_ok=True)
        for name, figure in (('measured-gearbox', grid_figure(gearbox, options.data)),
                             ('measured-errors', error_figure([*gearbox, *others]))):
            figure.savefig(options.figures / f'{name}.png', dpi=90)


if __name__ == '__main__':
    main()
