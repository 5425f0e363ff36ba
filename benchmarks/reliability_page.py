"""Tables and figures of docs/reliability.md from what the fault campaign and the soak found."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from performance_page import table

MEMORY = ('MB half way', 'at the end', 'trend between in MB an hour')
LONG = 240.0  # s that a node must have lived for a trend


def growth(rss: Sequence[Sequence[float]]) -> tuple[str, str, str]:
    """Return memory (MB) half way and at the end, and the trend between (MB an hour)."""
    times, values = np.array(rss).T
    later = times >= times.mean()
    trend = '-'
    if np.ptp(times) >= LONG:
        trend = f'{3600.0 * np.polyfit(times[later], values[later], 1)[0]:+.1f}'
    return f'{values[later][0]:.1f}', f'{values[-1]:.1f}', trend


# --- the campaign --------------------------------------------------------------------------------

def fault_sections(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the contents of the campaign's sections."""
    faults, checked = found['faults'], found['checked']
    rows = [(kind, f'{count:,}', f'{checked[kind]:,}') for kind, count in faults.items()]
    averages, extra = found['averages'], found['recovery']
    corrected, verdicts = found['corrected'], found['verdicts']
    again = [scenes for scenes in extra if scenes]
    later = f'; {len(again)} needed up to {max(again)} more' if again else ''
    summary = (
        f'{sum(faults.values()):,} faults in {found["scenes"]} scenes and {found["seconds"]:.0f} '
        f's (seed {found["seed"]}): {sum(averages.values()):,} averages were published and '
        f'checked ({", ".join(f"{name} {count:,}" for name, count in averages.items())}), '
        f'**{len(found["wrong"])} things were wrong**, {len(found["died"])} nodes died of '
        f'themselves. Of the averages with `correct_jitter`, {corrected["corrected"]:,} were '
        f'corrected and {corrected["refused"]:,} refused; {found["residuals"]:,} residuals were '
        f'recomputed and {sum(verdicts.values()):,} traces looked through '
        f'({", ".join(f"{name} {count:,}" for name, count in verdicts.items())}). In '
        f'{len(extra) - len(again)} of {len(extra)} scenes all averages were back '
        f'within the faultless 1.4 s at its end{later}.')
    memory = [(role, *growth(rss)) for role, rss in found['rss']
              if rss and rss[-1][0] - rss[0][0] > LONG]
    return {'campaign': summary,
            'faults': table(('fault', 'injected', 'averages checked in scenes with it'), rows),
            'memory': table(('node', *MEMORY), memory)}


def draw_faults(found: Mapping[str, Any], folder: Path) -> None:
    """Draw faults by kind, and the memory of every process over time."""
    kinds = list(found['faults'])[::-1]
    figure = Figure(figsize=(10.0, 0.16 * len(kinds) + 3.6), layout='constrained')
    bars, memory = figure.subplots(2, 1, height_ratios=(0.16 * len(kinds), 2.6))
    place = np.arange(len(kinds))
    bars.barh(place + 0.2, [found['checked'][kind] for kind in kinds], 0.4, color='tab:blue',
              label='averages checked in scenes with it, all true' if not found['wrong']
              else 'averages checked in scenes with it')
    bars.barh(place - 0.2, [found['faults'][kind] for kind in kinds], 0.4, color='tab:orange',
              label='injected')
    bars.set_yticks(place, kinds, fontsize=7)
    bars.set_ylim(-0.6, len(kinds) - 0.4)
    bars.set_xscale('log')
    bars.legend(loc='upper center', bbox_to_anchor=(0.5, 1.07), ncols=2, fontsize=8)
    bars.grid(axis='x', alpha=0.3)
    roles = list(dict.fromkeys(role for role, _ in found['rss']))
    for role, rss in found['rss']:
        if rss:
            times, values = np.array(rss).T
            first = role in roles
            memory.plot(times, values, '.-', markersize=2, linewidth=0.8,
                        color=f'C{list(dict.fromkeys(r for r, _ in found["rss"])).index(role)}',
                        label=role if first else None)
            if first:
                roles.remove(role)
    memory.set_xlabel('time [s]; a line ends where its process was killed')
    memory.set_ylabel('resident memory [MB]')
    memory.set_ylim(bottom=0.0)
    memory.legend(fontsize=8, ncols=5)
    memory.grid(alpha=0.3)
    figure.savefig(folder / 'reliability-faults.png', dpi=110)
