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
The loop on machines of another simulator: what it finds, and how wrong its numbers are.

`python benchmarks/independent_confusion.py` draws machines (`independent_machines`) with effects
that their declared model lacks (`independent_effects`), closes the loop on recording and
parameter file as a user does, and judges the report. Beside it stands the oracle: the same
recording with the true effects and parameters declared, scored on the same held-out acquisitions.
It writes one line of JSON a run to the standard error and prints tables at the end.
"""

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
import contextlib
from dataclasses import asdict, astuple, dataclass, field, replace
import io
import json
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

from independent_effects import draw_case, KNOWN, UNKNOWN
from independent_machines import declared, record
import numpy as np
from sa_jitter_ros.commands import close_loop, loop_run
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.effects import declared_effects
from sa_jitter_ros.errors import SaJitterError
from sa_jitter_ros.inference.residual import Residual, UNDEFINED
from sa_jitter_ros.inference.scoring import make_bench
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.recordings import read, Recording

PAIRS = (('keyphasor_quantisation', 'clock_skew'), ('excess_jitter', 'amplitude_modulation'),
         ('speed_fluctuation', 'additive_noise'), ('phase_wander', 'interfering_tone'))
_OF_PULSES, _SAMPLED = ('excess_jitter', 'correlated_jitter'), 0.5  # sample periods, 12^-0.5 RMS
_STATED = (0.0, 0.01), (0.01, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.1)
_ON_LINES = {'interpolation_loss', 'additive_noise', 'amplitude_modulation', 'interfering_tone'}


@dataclass(frozen=True)
class Score:
    """
    How well the held-out acquisitions of a machine were predicted.

    `rms` is that of the mean residual of the attenuation over the lines, `chi2` (per degree of
    freedom) and `coverage` (of the 95 % band) are those of the raw amplitudes.
    """

    rms: float = float('nan')
    chi2: float = float('nan')
    coverage: float = float('nan')


@dataclass(frozen=True)
class Run:
    """
    What the loop reported of one machine.

    `noisy` machines have coloured noise, which no declared model holds, so that naming it is
    right. `sampling` are errors of the pulses, among those `found`, that the sampling of a tach
    waveform makes. Effects that are `present` change no average. `oracle` knows the true effects
    and parameters, NaN where no effect of the package describes them; `errors` are those of the
    parameters in stated standard errors, `probabilities` those of all effects.
    """

    effects: tuple[str, ...]
    seed: int
    machine: str
    cycle_length: float
    seconds: float
    status: int
    message: str
    verdict: str = ''
    noisy: bool = False
    found: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    rivals: tuple[str, ...] = ()
    sampling: tuple[str, ...] = ()
    before: Score = Score()
    after: Score = Score()
    oracle: Score = Score()
    errors: Mapping[str, float] = field(default_factory=dict)
    probabilities: Mapping[str, float] = field(default_factory=dict)

    @property
    def right(self) -> bool:
        """Tell whether the loop named what happened, or said that it knows none of it."""
        if set(self.effects) & set(UNKNOWN):
            return self.verdict == 'unexplained' and not self.found
        found = set(self.found) - set(self.sampling) - (
            {'additive_noise'} if self.noisy else set())
        if 'jitter_scale' in self.effects and 'jitter_scale' in self.rivals:
            found = {'jitter_scale' if name == 'excess_jitter' else name for name in found}
        return self.status == 0 and found <= set(self.effects) <= found | set(self.present) and (
            self.verdict == ('traced' if self.found else 'none'))

    @property
    def near(self) -> bool:
        """Tell whether the mean residual fell five-fold, or to less than twice the oracle's."""
        return self.after.rms <= max(0.2 * self.before.rms, 2.0 * self.oracle.rms)


def judge(effects: tuple[str, ...], seed: int, folder: Path, *, only_declared: bool = False,
          pictures: bool = False, scale: float = 1.0, share: float = 1.0) -> Run:
    """
    Draw a case, run `close_loop` on it in `folder` and read its report.

    The true jitter is `scale` times the declared one, which adds `jitter_scale` to the effects,
    which are `share` times as large as drawn.
    Without `pictures`, which take most of its time, the command stops short of drawing them.
    """
    case = draw_case(effects, seed, only_declared=only_declared, share=share)
    declaration, truth = case.machine, dict(case.truth)
    if scale != 1.0:
        declaration = replace(declaration, keyphasor_rate=scale * declaration.keyphasor_rate)
        effects, truth['jitter_scale'] = (*effects, 'jitter_scale'), {'scale': scale}
    if case.machine.noise_colour:
        truth['additive_noise'] = {'std': case.machine.noise_at_orders}
    fields = record(case.machine, case.what, np.random.default_rng([seed, 1]))
    np.savez(folder / 'machine.npz', **fields)
    (folder / 'model.yaml').write_text(declared(declaration))
    options = close_loop.make_parser().parse_args([
        str(folder / 'machine.npz'), '--declared', str(folder / 'model.yaml'),
        '--output', str(folder / 'report'), '--quiet'])
    item, error = case.machine, io.StringIO()
    start = time.perf_counter()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
            loop = loop_run.run(options, Progress('close_loop', quiet=True))
            if pictures:
                loop.write(options.output)
        status = 0
    except Exception as failure:  # a crash is a finding, too
        status = 2 if isinstance(failure, SaJitterError) else 1
        error.write(repr(failure))
    seconds = time.perf_counter() - start
    text = (f'fs {item.sample_rate:g}, {item.speed:.1f} Hz, r {item.cycle_length:.3g} '
            f'({item.pulses_per_trigger}/{item.pulses_per_revolution}), '
            f'{item.trigger_cycles}x{item.acquisitions}, {len(item.peaks)} ch, '
            f'orders {np.round(item.orders, 1).tolist()}, gD '
            f'{item.top / item.keyphasor_rate:.2f}, top {item.top / item.sample_rate:.2f}, '
            f'noise {item.noise_std:.2g}/{item.noise_colour:.1f}'
            f'{", reference" * item.reference}{", waveform" * item.waveform}')
    run = Run(effects, seed, text, item.cycle_length, seconds, status, error.getvalue().strip())
    if status:
        return run
    report, (trace,) = loop.report, loop.traces.values()
    found = report['missing_effects']
    oracle = UNDEFINED if set(effects) & set(UNKNOWN) else _oracle(
        trace, read(folder / 'machine.npz'), truth)
    return replace(
        run, verdict=report['verdict'], noisy=item.noise_colour > 0.0,
        found=tuple(one['name'] for one in found),
        present=tuple(one['name'] for one in report['present']),
        rivals=tuple(sorted({name for one in found for name in one['indistinguishable_from']})),
        sampling=tuple(one['name'] for one in found if item.waveform and one['name'] in _OF_PULSES
                       and one['parameters']['std']['value'] < _SAMPLED / item.sample_rate),
        before=_score(trace.before), after=_score(trace.after), oracle=_score(oracle),
        errors={f'{one["name"]}.{name}': _standard_errors(value, truth[one['name']][name])
                for one in found for name, value in one['parameters'].items()
                if name in truth.get(one['name'], {}) and value['standard_error'] is not None},
        probabilities=trace.probabilities)


def _oracle(trace: Trace, recording: Recording, truth: Mapping[str, Mapping[str, Any]]
            ) -> Residual:
    """Return the residual of the same held-out acquisitions with the true effects declared."""
    if not trace.lines.count:
        return UNDEFINED
    bench = make_bench(trace.observation, [trace.observation], [recording],
                       declared_effects(truth))
    return bench.score((), unsteadiness=bench.unsteadiness(()))


def _score(item: Residual) -> Score:
    return Score(item.rms, item.chi2_per_dof, item.coverage)


def _standard_errors(stated: Mapping[str, Any], truth: Any) -> float:
    """Return the error of a parameter in standard errors, of a list its root mean square."""
    value, error = np.array(stated['value']), np.array(stated['standard_error'], float)
    if value.shape != np.shape(truth):
        return float('nan')
    off = value - truth
    off = off - off[np.isfinite(error)].mean() if off.ndim else off  # None: a mark without pulses
    with np.errstate(divide='ignore', invalid='ignore'):
        z = off / error
    return float(np.sqrt(np.nanmean(z**2))) if z.ndim else float(z)


def table(runs: Sequence[Run]) -> str:
    """Return the confusion matrix and what became of the parameters, in Markdown."""
    lines = ['| undeclared | runs | right | found | parameters within 3 standard errors |',
             '|---|---|---|---|---|']
    for effects, rows in _by_effects(runs).items():
        found = Counter(f'exit {run.status}' if run.status else (
            '+'.join(run.found) or '-') + {'unexplained': ' *unexplained*'}.get(run.verdict, '')
            for run in rows)
        errors = [z for run in rows for z in run.errors.values() if np.isfinite(z)]
        lines.append(
            f'| {effects} | {len(rows)} | {sum(run.right for run in rows)} | '
            f'{", ".join(f"{count} {name}" for name, count in found.most_common())} | '
            f'{f"{sum(abs(z) < 3 for z in errors)} of {len(errors)}" if errors else "-"} |')
    return '\n'.join(lines)


def scores(runs: Sequence[Run]) -> str:
    """
    Return how well held-out acquisitions were predicted, in Markdown.

    Only machines of which a line is compared count: medians of RMS, and of those that are not
    unexplained, of which nothing is corrected, means of chi2, with the standard error of that of
    the loop, and of coverage.
    """
    lines = ['| undeclared | machines (not unexplained) | RMS before, after, oracle | near | chi2 '
             'per degree of freedom before, after, oracle | coverage of 95 % before, after, '
             'oracle |',
             '|---|---|---|---|---|---|']
    for effects, rows in _by_effects(runs).items():
        rows = [run for run in rows if np.isfinite(run.oracle.rms)]
        if not rows:
            continue
        found = np.array([[astuple(score) for score in (run.before, run.after, run.oracle)]
                          for run in rows])
        rms, told = np.median(found[..., 0], axis=0), found[[
            run.verdict != 'unexplained' for run in rows], :, 1:]
        (before, after, oracle), coverage = (
            told.mean(axis=0) if len(told) else np.full((3, 2), np.nan)).T
        error = told[:, 1, 0].std(ddof=1) / np.sqrt(len(told)) if len(told) > 1 else np.nan
        lines.append(
            f'| {effects} | {len(rows)} ({len(told)}) | '
            f'{", ".join(f"{value:.4f}" for value in rms)} | {sum(run.near for run in rows)} | '
            f'{before:.3g}, {after:.3g} +- {error:.2g}, {oracle:.3g} | '
            f'{", ".join(f"{value:.1%}" for value in coverage)} |')
    return '\n'.join(lines)


def _by_effects(runs: Sequence[Run]) -> dict[str, list[Run]]:
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(' + '.join(run.effects) or 'declared model', []).append(run)
    return found


def reliability(runs: Sequence[Run]) -> str:
    """
    Return how often what has a stated probability is there, in Markdown; effects on lines apart.

    The score is Brier's: the mean square of probability less truth, and that of a probability that
    is always the share of those that are there. What no module describes is left out, and so is
    noise where it is coloured.
    """
    lines = ['| effects | stated | cases | mean probability | there | Brier score, of the share |',
             '|---|---|---|---|---|---|']
    runs = [run for run in runs if not run.status and not set(run.effects) & set(UNKNOWN)]
    for title, names in (('on the lines', _ON_LINES), ('on the timing', set(KNOWN) - _ON_LINES)):
        pairs = np.array([(value, name in run.effects) for run in runs
                          for name, value in run.probabilities.items() if name in names
                          and not (run.noisy and name == 'additive_noise')], float).reshape(-1, 2)
        share = pairs[:, 1].mean()
        score = f'{np.mean(np.diff(pairs) ** 2):.4f}, {share * (1.0 - share):.4f}'
        for low, high in _STATED:
            some = pairs[(pairs[:, 0] >= low) & (pairs[:, 0] < high)]
            if len(some):
                lines.append(f'| {title} | {low:g} to {min(high, 1.0):g} | {len(some)} | '
                             f'{some[:, 0].mean():.3f} | {some[:, 1].sum():.0f} | {score} |')
    return '\n'.join(lines)


def summary(runs: Sequence[Run]) -> str:
    """Return how many runs of each kind are right, and how many parameters."""
    kinds = {'as declared': [run for run in runs if not run.effects],
             'with effects': [run for run in runs if run.effects],
             'with effects in no module': [run for run in runs if set(run.effects) & set(UNKNOWN)],
             'with known effects, trigger cycles of a fundamental cycle or more': [
                 run for run in runs if run.effects and not set(run.effects) & set(UNKNOWN)
                 and run.cycle_length >= 1.0]}
    errors = [z for run in runs for z in run.errors.values() if np.isfinite(z)]
    return '\n'.join([
        *(f'{sum(run.right for run in rows)} of {len(rows)} machines {kind} are right'
          for kind, rows in kinds.items() if rows),
        f'{sum(abs(z) < 3 for z in errors)} of {len(errors)} parameters are within 3 standard '
        'errors'])


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=6, help='machines an effect')
    parser.add_argument('--null', type=int, default=40, help='machines that are as declared')
    parser.add_argument('--unknown', type=int, default=6, help='machines an effect in no module')
    parser.add_argument('--pairs', type=int, default=3, help='machines a pair of effects')
    parser.add_argument('--scales', type=float, nargs='*', default=(),
                        help='true jitter over the declared one, each for so many --seeds')
    parser.add_argument('--share', type=float, default=1.0,
                        help='size of the effects over the drawn one')
    parser.add_argument('--first', type=int, default=0, help='first seed')
    parser.add_argument('--only', help='one case, effects joined by +')
    parser.add_argument('--only-declared', action='store_true', help='no undeclared orders')
    parser.add_argument('--pictures', action='store_true', help='run the whole command')
    parser.add_argument('--keep', type=Path, help='folder for all files of the runs')
    options = parser.parse_args(arguments)
    plan = [((), options.null, 1.0), *(((name,), options.seeds, 1.0) for name in KNOWN),
            *(((name,), options.unknown, 1.0) for name in UNKNOWN),
            *((pair, options.pairs, 1.0) for pair in PAIRS)]
    if options.only is not None:
        plan = [(tuple(name for name in options.only.split('+') if name), options.seeds, 1.0)]
    if options.scales:
        plan = [((), options.seeds, scale) for scale in options.scales]
    runs = []
    for effects, count, scale in plan:
        for seed in range(options.first, options.first + count):
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary)
                if options.keep:
                    folder = options.keep / f'{"+".join(effects) or "none"}_{seed}'
                    folder.mkdir(parents=True, exist_ok=True)
                run = judge(effects, seed, folder, only_declared=options.only_declared,
                            pictures=options.pictures, scale=scale, share=options.share)
            runs.append(run)
            print(json.dumps({**asdict(run), 'right': run.right}), file=sys.stderr, flush=True)
    print(table(runs), scores(runs), summary(runs), reliability(runs), sep='\n\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
