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
Measure everything that docs/performance.md says, and write it there.

    .venv/bin/python benchmarks/performance.py

takes a quarter of an hour. Peers are installed into `benchmarks/.venv` (phonometry needs a
`python3.13` in PATH); what cannot be installed is skipped and named. The tables between the
markers of the page are replaced, the figures drawn again, and all numbers kept in
`out/performance.json`.
"""

import argparse
from collections.abc import Iterable, Mapping, Sequence
import json
import os
from pathlib import Path
import shutil
import subprocess
import sys
from typing import Any

from matplotlib.figure import Figure
from page import fill, table

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
PEERS = (('numpy', 'scipy', 'setuptools'), ('rota-order',), ('acoular',), ('--pre', 'phonometry'))
# What the wheels of ROS 2 leave for child processes, wrong for another environment's Python.
WHEELS = '_ROS_WHEELS_BOOTSTRAP_COMPLETE'
OURS = 'sa_jitter_ros, resampling and mean'


def environment_without_ros() -> dict[str, str]:
    """Return an environment without ROS, with one thread of linear algebra and this tree."""
    environment = {key: value for key, value in os.environ.items()
                   if key not in (WHEELS, 'PYTHONHOME')
                   and not (key == 'LD_LIBRARY_PATH' and WHEELS in os.environ)}
    return {**environment, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': str(ROOT)}


def peer_python() -> str:
    """Return the Python of the environment with the peers, which the first call makes."""
    python = HERE / '.venv' / 'bin' / 'python'
    if not python.exists():
        newest = shutil.which('python3.13')
        usable = newest and not subprocess.run([newest, '-c', ''], capture_output=True).returncode
        subprocess.run([newest if usable else sys.executable, '-m', 'venv', HERE / '.venv'],
                       check=True, env=environment_without_ros())
    for names in PEERS:
        done = subprocess.run(
            [python, '-m', 'pip', 'install', '--quiet', '--disable-pip-version-check', *names],
            env=environment_without_ros(), capture_output=True, text=True, check=False)
        if done.returncode:
            print(f'performance: cannot install {names[-1]}: '
                  f'{done.stderr.strip().splitlines()[-1]}', file=sys.stderr)
    # This Python may be another one than that for which the C code of this tree is compiled.
    subprocess.run([python, 'setup.py', '--quiet', 'build_ext', '--inplace'], cwd=ROOT, check=True)
    return str(python)


def run(python: str, script: str, arguments: Sequence[str], environment: dict[str, str]) -> Any:
    """Run a script of this folder and return the JSON that it prints."""
    done = subprocess.run([python, '-W', 'ignore', HERE / script, *arguments], env=environment,
                          stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def measure(quick: bool) -> dict[str, Any]:
    """Run the three benchmarks."""
    environment = {**os.environ, 'OMP_NUM_THREADS': '1', 'PYTHONPATH': os.pathsep.join(
        filter(None, (str(ROOT), os.environ.get('PYTHONPATH'))))}
    small = ['--scale', '0.1', '--rounds', '2'] if quick else []
    brief = ['--seconds', '6', '--channels', '8', '--large', '8', '--latency-seconds', '0'
             ] if quick else []
    return {'core': run(peer_python(), 'core_speed.py', small, environment_without_ros()),
            'loop': run(sys.executable, 'loop_speed.py', small, environment),
            'graph': run(sys.executable, 'graph_speed.py', brief, environment)}


# --- the page ------------------------------------------------------------------------------------

def sections(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the contents of all sections of the page."""
    core, loop, graph = found['core'], found['loop'], found['graph']
    return {
        'machine': _machine(core, loop, graph), 'core': _comparisons(core['comparisons']),
        'limits': _limits(core), 'loop': _loop(loop),
        'shares': table(('on line', 'CPU share of one core'),
                        [(name, f'{share:.0%}') for name, share in core['shares'].items()]),
        'threads': table(('threads of linear algebra', 'recovery of 100 trigger cycles x 8 '
                          'channels, on the clock'),
                         [(name, f'{value:.0f} ms') for name, value in loop['threads'].items()]),
        'graph': _graph(graph['runs']), 'latency': _latency(graph['latency'])}


def _machine(core: Mapping[str, Any], loop: Mapping[str, Any], graph: Mapping[str, Any]) -> str:
    parts = [f'{name} {value}' for name, value in core['machine'].items() if name != 'load']
    loads = core['machine']['load'], loop['machine']['load'], graph['load']
    return f'{"; ".join(parts)}; load averages {", ".join(map(str, loads))}.'


def _comparisons(comparisons: Sequence[Mapping[str, Any]]) -> str:
    """Return the time of each method in every comparison, and its gains in the first one."""
    first, lines = comparisons[0], []
    for name, row in first['rows'].items():
        gain = '-' if row['gains'] is None else ' / '.join(f'{item:.4f}' for item in row['gains'])
        lines.append((name + '*' * bool(row['note']), *(
            f'{item["rows"][name]["nanoseconds"]:.1f}' if name in item['rows'] else '-'
            for item in comparisons), gain))
    text = table(('method', *(f'{item["channels"]} channels, ratio {item["ratio"]:g}'
                              for item in comparisons),
                  f'gain error in dB at f/fs = {" / ".join(f"{f:.2f}" for f in first["bands"])}'),
                 lines)
    notes = [f'\\* {name}: {row["note"]}.' for name, row in first['rows'].items() if row['note']]
    notes += [f'Not measured: {", ".join(first["skipped"])}.'] if first['skipped'] else []
    return '\n\n'.join((text, *notes))


def _limits(core: Mapping[str, Any]) -> str:
    limits, texts = core['limits'], []
    for name in (OURS, 'sa_jitter_ros, on line'):
        times = [item['rows'][name]['nanoseconds'] / limits['arithmetic']
                 for item in core['comparisons']]
        texts.append(f'*{name.partition(", ")[2]}* takes {min(times):.0f} to {max(times):.0f} '
                     'times that')
    return (f'One core reads a sample of 8 bytes in {limits["memory"]:.2f} ns '
            f'({limits["bandwidth"] / 1e9:.1f} GB/s) and does the 16 multiply-adds of a resampled '
            f'value in {limits["arithmetic"]:.2f} ns ({limits["multiply_adds"] / 1e9:.1f} 10^9 a '
            f'second). {", ".join(texts)}.')


def _loop(loop: Mapping[str, Any]) -> str:
    rows = [(f'prediction: {name}', f'{value:.1f} ms', '50 ms')
            for name, value in loop['prediction'].items()]
    rows += [(f'recovery: {name}', f'{value:.0f} ms', '250 ms' if ' 8 ' in name else '')
             for name, value in loop['recovery'].items()]
    rows += [_closed(item) for item in loop['close_loop']]
    return table(('', 'time', 'goal: below'), rows)


def _closed(item: Mapping[str, Any]) -> tuple[str, str, str]:
    found = ', '.join(item['missing']) or 'nothing'
    return (f'`close_loop`, recording of {item["megabytes"]:.1f} MB ({item["channels"]} channels, '
            f'{item["seconds"]:.0f} s, gears: {item["gears"]}), found {found}',
            f'{item["wall"]:.1f} s ({item["cpu"]:.1f} s of CPU)',
            '4 s' if item['megabytes'] < 20.0 else '8 s')


def _graph(runs: Iterable[Mapping[str, Any]]) -> str:
    return table(
        ('channels', 'shared memory', 'CPU share of one core', 'peak memory in MB',
         'latency from the last pulse in ms, median / 99 %', 'sustained'),
        [(str(run['channels']), _memory(run), f'{run["cpu_share"]:.1%}',
          f'{run["peak_megabytes"]:.0f}', f'{run["pulse_median"]:.0f} / {run["pulse_99"]:.0f}',
          'yes' if run['sustained'] else f'no, {run["averages"]} of {run["expected"]} averages')
         for run in runs])


def _memory(run: Mapping[str, Any]) -> str:
    return '64 MB' if run['large'] else '0.5 MB'


def _latency(runs: Iterable[Mapping[str, Any]]) -> str:
    return table(
        ('messages of', 'from the last pulse, median', '99 %',
         'from when the last sample was sent, median', '99 %', 'CPU share'),
        [(f'{run["block_milliseconds"]:.3g} ms',
          *(f'{run[key]:.1f} ms' for key in ('pulse_median', 'pulse_99', 'data_median',
                                             'data_99')),
          f'{run["cpu_share"]:.1%}') for run in runs])


def draw(found: Mapping[str, Any], folder: Path) -> None:
    """Draw the figures of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    _draw_core(found['core']['comparisons'][0]).savefig(folder / 'performance-core.png', dpi=110)
    _draw_growth(found['core']).savefig(folder / 'performance-growth.png', dpi=110)
    _draw_graph(found['graph']['runs']).savefig(folder / 'performance-graph.png', dpi=110)


def _draw_core(comparison: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(7.5, 4.2), layout='constrained')
    axes = figure.subplots()
    for name, row in comparison['rows'].items():
        if row['gains'] is None:
            continue
        ours = name.startswith('sa_jitter')
        below = name in (OURS, 'tsa linear')  # their labels would meet another
        error = abs(row['gains'][-1])
        axes.loglog(row['nanoseconds'], error, 'o', color='tab:blue' if ours else 'tab:gray')
        axes.annotate(name.replace('sa_jitter_ros, ', ''), (row['nanoseconds'], error),
                      xytext=(5, -12 if below else 4), textcoords='offset points',
                      fontsize='small',
                      color='tab:blue' if ours else 'black')
    axes.set_xlabel('CPU time per sample and channel [ns]')
    axes.set_ylabel('gain error at 0.30 of the sampling rate [dB]')
    axes.set_title(f'{comparison["channels"]} channels x {comparison["seconds"]:g} s at 93.75 kHz;'
                   ' blue: this package', fontsize='medium')
    axes.margins(x=0.2, y=0.1)
    axes.grid(which='both', alpha=0.2)
    return figure


def _draw_growth(core: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(9.5, 5.4), layout='constrained')
    growth = [(name, values) for name, values in core['growth'].items() if name != 'averaging']
    panels = figure.subplots(2, 3).ravel()
    for axes, (name, values) in zip(panels, growth):
        axes.semilogx([float(key) for key in values], list(values.values()), 'o-')
        axes.set_xticks([float(key) for key in values], list(values), fontsize='small')
        axes.minorticks_off()
        limit = max(core['limits']['memory'], core['limits']['arithmetic'])
        axes.axhline(limit, color='tab:red', linewidth=1.0, label='limit of the machine')
        axes.set_xlabel(name)
        axes.set_ylim(bottom=0.0)
    memory = core['memory']
    panels[4].plot([float(key) for key in memory], list(memory.values()), 'o-')
    panels[4].set_xlabel('record length in s')
    panels[4].set_ylabel('peak memory [MB]')
    panels[4].set_ylim(0.0, 1.3 * max(memory.values()))
    averaging = core['growth']['averaging']
    panels[5].bar(list(averaging), list(averaging.values()))
    panels[5].set_xlabel('averaging')
    for axes in (panels[0], panels[3], panels[5]):
        axes.set_ylabel('ns per sample and channel')
    panels[0].legend(fontsize='small')
    for axes in panels:
        axes.grid(alpha=0.3)
    return figure


def _draw_graph(runs: Sequence[Mapping[str, Any]]) -> Figure:
    figure = Figure(figsize=(8.5, 3.4), layout='constrained')
    share, latency = figure.subplots(1, 2)
    for run in runs:
        marker = {'markerfacecolor': 'none' if not run['large'] else None,
                  'color': 'tab:blue' if run['sustained'] else 'tab:red'}
        share.plot(run['channels'], 100.0 * run['cpu_share'], 'o', **marker)
        latency.semilogy(run['channels'], run['pulse_median'], 'o', **marker)
        latency.semilogy(run['channels'], run['pulse_99'], '^', **marker)
    share.set_ylabel('CPU share of one core [%]')
    share.set_ylim(0.0, 105.0)
    share.set_title('filled: 64 MB of shared memory, open: 0.5 MB; red: not sustained',
                    fontsize='small')
    latency.set_ylabel('latency [ms]: o median, ^ 99 %')
    for axes in (share, latency):
        axes.set_xlabel('channels at 93.75 kHz')
        axes.grid(alpha=0.3)
    return figure


def main() -> int:
    """Measure, keep the numbers, and write the page."""
    parser = argparse.ArgumentParser(description='Measure what docs/performance.md says.')
    parser.add_argument('--quick', action='store_true', help='small sizes: a check, not a result')
    parser.add_argument('--only-write', action='store_true', help='from the numbers of last time')
    parser.add_argument('--numbers', type=Path, default=ROOT / 'out' / 'performance.json')
    parser.add_argument('--page', type=Path, default=ROOT / 'docs' / 'performance.md')
    parser.add_argument('--figures', type=Path, default=ROOT / 'docs' / 'figures')
    options = parser.parse_args()
    if not options.only_write:
        found = measure(options.quick)
        options.numbers.parent.mkdir(parents=True, exist_ok=True)
        options.numbers.write_text(json.dumps(found, indent=1) + '\n')
    found = json.loads(options.numbers.read_text())
    draw(found, options.figures)
    options.page.write_text(fill(options.page.read_text(), sections(found)))
    print(f'numbers: {options.numbers}\npage: {options.page}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
