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
How exactly pulse errors are recovered from whole recordings of another simulator's machines.

`python benchmarks/record_recovery.py` draws machines (`independent_machines`), lets happen to them
what their declared model lacks (`independent_effects`), fits each recording
(`inference/record_fit.py`) and compares its pulse errors and lines with the true ones. With
`--gear0 FILE` it does so with the measured gearbox whose keyphasor is timed by a clock of 6 kHz,
with all lines that it finds, and as the loop does, and compares with what the averager recovers.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
import sys
import time

from independent_effects import draw_case
from independent_machines import Array, Machine, pulses, record
import numpy as np
from page import table
import sa_jitter_ros as sa
from sa_jitter_ros.inference.record_fit import OpenRecord, RecordFit
from sa_jitter_ros.inference.record_pulses import RecordPulses
from sa_jitter_ros.inference.record_recovery import recover_record
from sa_jitter_ros.prediction.influence import common_turn
from sa_jitter_ros.prediction.model import DeclaredModel
from worse_pulses import with_slower_clock

EFFECTS = ((), ('excess_jitter',), ('correlated_jitter',), ('target_geometry',), ('clock_skew',),
           ('missing_pulses',), ('speed_fluctuation',), ('interfering_tone',))
_EDGE = 15  # samples at either end that interpolation cannot read


@dataclass(frozen=True)
class Fitted:
    """
    The fit of a machine's recording and its truth.

    `true` (pulse,) are the errors of the trigger pulses (s, NaN where one is missing), `wrong` the
    recovered errors less these, but for a delay and a turn of all, which are not observable.
    """

    machine: Machine
    fit: RecordFit
    true: Array
    wrong: Array
    seconds: float

    @property
    def undeclared(self) -> Array:
        """Return the undeclared orders of the machine, each once."""
        return np.unique(np.round(self.machine.components[self.machine.orders.size:], 9))

    @property
    def near(self) -> Array:
        """Return how far found orders are from true ones, in what the record resolves."""
        span = self.machine.cycle_length * (self.true.size - 1)
        orders = self.fit.orders[self.machine.orders.size:]
        return np.asarray(np.abs(orders[:, None] - self.undeclared) * span)


def fitted(names: tuple[str, ...], seed: int) -> Fitted:
    """Draw a machine to which `names` happen, and fit its recording."""
    case = draw_case(names, seed)
    machine, what = case.machine, case.what
    times, true = pulses(machine, what, np.random.default_rng([seed, 1]))
    samples = record(machine, what, np.random.default_rng([seed, 1]))['vibration'].T
    measured = np.full(true.size, np.nan)
    number = np.rint(np.interp(times, true, np.arange(true.size))).astype(int)
    measured[number if times.size < true.size else slice(None)] = times
    measured, true = (item[::machine.pulses_per_trigger] for item in (measured, true))
    first = machine.start_time + _EDGE / machine.sample_rate
    last = machine.start_time + (len(samples) - _EDGE) / machine.sample_rate
    inside = np.flatnonzero((measured > first) & (measured < last))  # false where NaN
    part = slice(inside[0], inside[-1] + 1)
    measured, true = measured[part], true[part]
    there = np.isfinite(measured)
    times = np.interp(np.arange(measured.size), np.flatnonzero(there), measured[there])
    begin = time.process_time()
    found = OpenRecord(
        samples, machine.sample_rate, machine.start_time, times,
        measured=there, cycle_length=machine.cycle_length, orders=machine.orders.tolist(),
        jitter_std=1.0 / np.sqrt(12.0) / machine.keyphasor_rate).fit()
    seconds = time.process_time() - begin
    wrong = (found.errors - (measured - true)) / found.standard_errors
    common = np.stack([np.ones(times.size), common_turn(times - found.errors, there)], axis=1)
    common /= found.standard_errors[:, None]
    seen = np.isfinite(wrong)
    wrong -= common @ np.linalg.lstsq(common[seen], wrong[seen], rcond=None)[0]
    return Fitted(machine, found, measured - true, wrong * found.standard_errors, seconds)


def measured(path: Path) -> str:
    """Return errors against the better keyphasor: of averager, fit of all lines, and loop (us)."""
    clock, orders = 6000.0, [23.0, 46.0, 69.0, 92.0, 115.0]
    recording = with_slower_clock(sa.read(path), clock)
    times, better = recording.pulse_times, recording.reference_pulse_times
    assert times is not None
    assert better is not None
    samples = recording.read()
    averages = sa.average(
        samples, recording.sample_rate, times, start_time=recording.start_time, orders=orders,
        trigger_cycles=40, correct_jitter=True, keyphasor_rate=clock)
    variance = []
    for average in averages:
        part = np.searchsorted(times, average.pulses - 0.5 / clock)
        assert average.correction is not None
        variance.append(np.var(average.correction.pulse_errors - (times - better)[part]))
    recovery = recover_record(
        samples.T, recording.start_time, recording.sample_rate, RecordPulses.unbroken(times),
        DeclaredModel(keyphasor_rate=clock, trigger_speed=33.33, trigger_cycles=40,
                      orders=tuple(orders)))
    inside = np.isfinite(recovery.errors)
    fitted = recovery.fits[0].errors, recovery.errors[inside]
    everything, loop = (np.std(item - (times - better)[inside]) for item in fitted)
    return (f'averager {1e6 * np.sqrt(np.mean(variance)):.1f} us, fit of all lines '
            f'{1e6 * everything:.1f} us, loop {1e6 * loop:.1f} us, '
            f'true errors {1e6 * np.std(times - better):.1f} us')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seeds', type=int, default=6, help='machines an effect')
    parser.add_argument('--first', type=int, default=300, help='first seed')
    parser.add_argument('--gear0', type=Path, help='gear0_gearbox.npz, the measured gearbox')
    options = parser.parse_args(arguments)
    if options.gear0:
        print(measured(options.gear0))
        return 0
    rows = []
    for names in EFFECTS:
        runs = [fitted(names, seed) for seed in range(options.first,
                                                      options.first + options.seeds)]
        share = [np.nanstd(run.wrong) / np.nanstd(run.true) for run in runs]
        z = [np.sqrt(np.nanmean((run.wrong / run.fit.standard_errors) ** 2)) for run in runs]
        made_up = sum(int(np.sum(run.near.min(axis=1) > 0.5)) for run in runs if run.near.size)
        found = sum(int(np.sum(run.near.min(axis=0) < 0.5)) for run in runs if run.near.size)
        rows.append([
            ' + '.join(names) or 'declared model', str(len(runs)), f'{np.median(share):.4f}',
            f'{max(share):.4f}', f'{np.median(z):.2f}',
            f'{found} of {sum(run.undeclared.size for run in runs)}', str(made_up),
            f'{np.median([run.seconds for run in runs]):.1f} s'])
    print(table(['undeclared', 'runs', 'error over true errors (median)', 'worst',
                 'error over standard error (median)', 'undeclared orders found', 'made up',
                 'time'], rows))
    return 0


if __name__ == '__main__':
    sys.exit(main())
