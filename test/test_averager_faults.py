"""
Random faults, seeded: every average that the node publishes is that of the cycles it claims.

Runs of machines that differ in amplitude and speed are cut into blocks of random size and damaged;
pulses lead or trail. Whatever arrives, each average must belong to one run, match its truth in
time, amplitude and phase, contain no lost sample, and carry the angle on from its predecessor or
begin anew at 0.
"""

from bench import AveragerBench
from machine import Machine
import numpy as np
import pytest
from sa_jitter_ros.averaging.timeline import SampleBlock
from sa_jitter_ros.nodes import messages

RATE = 6400.0
ORDERS = [1.0, 5.0, 12.0]
RATIOS = {'tach': 1.0, 'gear': 2.40789}
CYCLES = 6
RUNS = 3
SECONDS = 5.0


def machine_of(run):
    """Return the machine of a run, unlike the others in all that an average shows."""
    size = 1.0 + 2.0 * run
    return Machine(speed=(25.0, 31.7, 28.3)[run], rate=RATE, components={
        1.0: (size, 0.4 + run), 5.0 * 2.40789: (0.5 * size, -1.1), 5.0: (0.7 * size, 2.0 - run)})


class Campaign:
    """The events of one seed, in order of arrival, and what they cost."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.lost = {run: [] for run in range(RUNS)}  # spans (s) of each run
        self.faults = dict.fromkeys(
            ('lost', 'repeated', 'swapped', 'nan', 'malformed', 'channels', 'time'), 0)
        self.events = []
        self.strays = 0  # pulses that no tooth made
        self.lag = self.rng.uniform(-0.4, 0.4)
        for run in range(RUNS):
            self.add_run(run, 100.0 * run)

    def add_run(self, run, begin):
        """Add a run whose first event is at the time `begin` of arrival."""
        machine, blocks, index = machine_of(run), [], 0
        while index < SECONDS * RATE:
            count = int(self.rng.choice([self.rng.integers(1, 20), self.rng.integers(20, 1200)],
                                        p=[0.2, 0.8]))
            blocks.append(machine.block(index, count))
            index += count
        arrivals = [(begin + block.end_index / RATE, item) for block, item in self.damage(
            run, blocks)]
        pulses = self.damage_pulses(machine.pulses(index / RATE - 1e-3))
        arrivals += [(begin + max(pulse + self.lag, 0.0) + 1e-6 * k,
                      messages.encode_pulse_reference(float(pulse), 'kp'))
                     for k, pulse in enumerate(pulses)]
        self.events += [item for _, item in sorted(arrivals, key=lambda each: each[0])]

    def damage_pulses(self, pulses):
        """Return the pulses with some of them missing, doubled or preceded by a stray one."""
        inner = self.rng.choice(np.arange(6, pulses.size - 6, 6), 4, replace=False)
        missing, double, early = inner[:1], inner[1:3], inner[3:]
        self.strays += 3
        return np.sort(np.concatenate((np.delete(pulses, missing), pulses[double] + 2e-3,
                                       pulses[early] - 0.3 * pulses[1])))

    def damage(self, run, blocks):
        """Yield (block by which it arrives, message), some of which are faulty."""
        number = 0
        while number < len(blocks):
            block = blocks[number]
            fault = None
            if 1 < number < len(blocks) - 4 and self.rng.random() < 0.15:
                fault = str(self.rng.choice(list(self.faults)))
                self.faults[fault] += 1
            if fault == 'swapped':
                later = blocks[number + 1]
                yield block, messages.encode_samples(later)
                yield block, messages.encode_samples(block)
                self.lose(run, block)
                number += 2
                continue
            yield from ((block, message) for message in self.messages_of(run, block, fault))
            number += 1

    def messages_of(self, run, block, fault):
        """Return the messages that carry a block with this fault."""
        good = messages.encode_samples(block)
        if fault == 'repeated':
            return [good, good]
        if fault is None:
            return [good]
        if fault == 'malformed':  # beside a good one: only the bad one is lost
            bad = messages.encode_samples(block)
            bad.layout.dim[int(self.rng.integers(2))].size += int(self.rng.integers(1, 5))
            return [bad, good]
        self.lose(run, block)
        if fault == 'nan':
            samples = block.samples.copy()
            samples[int(self.rng.integers(2))] = self.rng.choice([np.nan, np.inf, -np.inf])
            return [messages.encode_samples(SampleBlock(
                samples, block.start_time, RATE, block.index))]
        if fault == 'channels':
            return [messages.encode_samples(SampleBlock(
                block.samples[:1], block.start_time, RATE, block.index))]
        if fault == 'time':
            wrong = block.start_time + self.rng.choice([-1.0, 1.0]) * self.rng.choice(
                [0.05, 1.0, 1e6])
            return [messages.encode_samples(SampleBlock(
                block.samples, float(wrong), RATE, block.index))]
        return []

    def lose(self, run, block):
        """Remember that a block is not there."""
        self.lost[run].append((block.start_time, block.end_index / RATE))


def run_of(average):
    """Return the run an average must be of, told by its speed."""
    speeds = [machine_of(run).speed for run in range(RUNS)]
    return int(np.argmin(np.abs(np.array(speeds) - average.header.mean_trigger_speed)))


def assert_true(campaign, averages, cycles):
    """Check every average of one shaft; return how many each run has."""
    found, angle, end, last = [0] * RUNS, 0.0, -np.inf, 0
    for number, average in enumerate(averages):
        header, run = average.header, run_of(average)
        machine = machine_of(run)
        assert header.sequence == number
        assert run >= last
        first = round(header.start_time * machine.speed)
        pulses = np.arange(first, first + CYCLES + 1) / machine.speed
        np.testing.assert_allclose((header.start_time, header.end_time), pulses[[0, -1]],
                                   atol=2e-9)
        for start, stop in campaign.lost[run]:
            assert header.end_time <= start or header.start_time >= stop - 1.0 / RATE
        angle = angle if run == last and abs(header.start_time - end) < 1e-6 else 0.0
        truth = machine.amplitudes(pulses, ORDERS, cycles=cycles, angle=angle)
        scale = 1.0 + 2.0 * run
        for channel, row in enumerate(average.values):
            np.testing.assert_allclose(row[:, 1] * np.exp(1j * row[:, 2]), (channel + 1) * truth,
                                       atol=2e-3 * scale * (channel + 1))
        angle, end, last = angle + CYCLES * cycles, header.end_time, run
        found[run] += 1
    return found


@pytest.mark.parametrize('seed', range(8))
def test_every_average_is_true_whatever_happens(ros_context, executor_for, seed):
    campaign = Campaign(seed)
    options = {f'{name}__orders': ORDERS for name in RATIOS}
    b = AveragerBench(ros_context, executor_for, shafts=tuple(RATIOS), trigger_cycles=CYCLES,
                      gear__ratio=RATIOS['gear'], **options)
    for message in campaign.events:
        b.send('vibration' if hasattr(message, 'layout') else 'tach_pulse', message)
    b.settle()
    status = b.status()
    for name, ratio in RATIOS.items():
        found = assert_true(campaign, b.amplitudes(name), ratio)
        for run, count in enumerate(found):
            # a fault costs the average it falls into and at most the one before or after
            whole = SECONDS * machine_of(run).speed // CYCLES
            assert count >= whole - 2 * (len(campaign.lost[run]) + 2) - 3
            assert count > 0
    faults = campaign.faults
    assert status['restarts'] >= RUNS - 1  # a wrong time that is repeated looks like one
    assert status['messages_rejected'] == faults['malformed'] + faults['channels']
    assert status['clock_deviation'] >= faults['time']
    assert status['repeats'] >= faults['repeated'] + faults['swapped']
    assert status['gaps'] >= faults['lost'] + faults['swapped']
    assert status['cycles_dropped'] >= sum(map(bool, campaign.lost.values()))
    assert status['samples_dropped'] > 0
    assert status['pulses_dropped'] == campaign.strays


def test_node_goes_on_after_nonsense_of_every_kind(ros_context, executor_for):
    """Random layouts, headers and data: rejected or used, never raised; then it still works."""
    rng = np.random.default_rng(5)
    b = AveragerBench(ros_context, executor_for, shafts=('tach',), trigger_cycles=CYCLES,
                      tach__orders=ORDERS)
    wild = [0.0, 1.0, -1.0, 0.5, 1e6, 1e300, -1e300, np.nan, np.inf, 2.0**53, 6400.0]
    for _ in range(300):
        message = messages.encode_samples(SampleBlock(
            rng.standard_normal(rng.integers(1, (4, 50))), 0.0, RATE, 0))
        for position in range(3):
            if rng.random() < 0.5:
                message.data[position] = float(rng.choice(wild))
        if rng.random() < 0.2:
            message.layout.dim[int(rng.integers(2))].size = int(rng.integers(0, 60))
        if rng.random() < 0.1:
            message.layout.data_offset = int(rng.integers(0, 5))
        if rng.random() < 0.1:
            message.layout.dim.clear()
        b.send('vibration', message)
        if rng.random() < 0.3:
            pulse = messages.encode_pulse_reference(float(rng.uniform(-10, 10)), 'kp')
            pulse.time_ref.sec = int(rng.choice([0, 1, -2**31, 2**31 - 1, pulse.time_ref.sec]))
            b.send('tach_pulse', pulse)
    assert b.status()['messages_rejected'] > 50
    machine = machine_of(0)
    before = len(b.amplitudes('tach'))
    b.play(machine, 8.0, start=20.0)
    later = b.amplitudes('tach')[before:]
    assert len(later) >= 2
    for average in later[1:]:
        np.testing.assert_allclose(average.values[0, :2, 1], [1.0, 0.7], atol=5e-3)


def test_memory_is_bounded_without_pulses_and_without_vibration(ros_context, executor_for):
    b = AveragerBench(ros_context, executor_for, buffer_seconds=0.5, trigger_cycles=CYCLES,
                      shaft__orders=ORDERS)
    machine = machine_of(0)
    for index in range(0, 64000, 3200):
        b.send('vibration', messages.encode_samples(machine.block(index, 3200)))
    b.settle()
    status = b.status()
    assert status['samples_dropped'] == 64000 - 3200
    b.send_pulses(machine.pulses(10.0, 20.0))
    b.settle()
    assert b.status()['pulses_dropped'] > 200
    assert 'waited longer than buffer_seconds' in b.diagnostics()[1] or (
        b.status()['cycles_dropped'] > 200)
    b.play(machine, 2.0, start=40.0)
    assert len(b.amplitudes()) >= 4
