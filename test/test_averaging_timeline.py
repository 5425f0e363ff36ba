# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The vibration's time line: what it keeps, in order and whole, of blocks that go wrong."""

from contextlib import suppress
import math

from hypothesis import given, strategies as st
import numpy as np
import pytest
from sa_jitter_ros.averaging.timeline import Segment, VibrationTimeline
from sa_jitter_ros.errors import SignalError
from sa_jitter_ros.samples import SampleBlock

RATE = 1000.0


def block(index, count, *, time=None, rate=RATE, channels=1, base=0.0):
    """Return a block whose samples are their index plus `base`, in every channel."""
    samples = np.tile(base + np.arange(index, index + count, dtype=float), (channels, 1))
    return SampleBlock(samples, index / rate if time is None else time, rate, index)


def timeline_of(*blocks, **options):
    """Return a time line that took these blocks."""
    timeline = VibrationTimeline(**options)
    for item in blocks:
        timeline.add(item)
    return timeline


def held(timeline):
    """Return epoch, first and last sample of every segment."""
    found = []
    for segment in timeline.segments:
        values = segment.samples[:, 0]
        np.testing.assert_array_equal(np.diff(values), 1.0)
        assert segment.end_index - segment.index == len(values)
        found.append((segment.epoch, values[0], values[-1]))
    return found


@given(st.lists(st.integers(1, 700), min_size=1, max_size=12))
def test_blocks_of_any_size_make_one_stretch(sizes):
    starts = np.concatenate(([0], np.cumsum(sizes)))
    timeline = timeline_of(*(block(int(start), size, channels=2)
                             for start, size in zip(starts, sizes)))
    assert held(timeline) == [(0, 0.0, sum(sizes) - 1.0)]
    assert timeline.end_time == pytest.approx((sum(sizes) - 1) / RATE)
    assert not timeline.messages
    assert not timeline.counts.samples_dropped


@given(st.lists(st.tuples(st.integers(1, 50), st.integers(0, 30)), min_size=1, max_size=20))
def test_memory_of_a_stretch_follows_what_it_holds(steps):
    timeline = timeline_of(block(0, 1))
    end, begin = 1, 0
    for count, forget in steps:
        timeline.add(block(end, count))
        end += count
        begin = max(begin, end - forget)
        timeline.release(0, begin / RATE + 1e-9)
        segment = timeline.segments[0]
        assert (segment.index, segment.end_index) == (begin, end)
        np.testing.assert_array_equal(segment.samples[:, 0], np.arange(begin, end))
        assert len(segment._rows._data) <= max(4 * (end - begin), 1024)


def test_time_of_a_sample_counts_from_the_first_of_its_run():
    timeline = timeline_of(block(5, 10, time=2.0), block(15, 10, time=2.0104))
    segment = timeline.segments[0]
    assert segment.start_time == 2.0
    assert segment.end_time == pytest.approx(2.019)
    np.testing.assert_allclose(segment.position(np.array([2.0, 2.0105])), [0.0, 10.5])


def test_wrong_time_is_counted_from_half_a_sample_on_and_a_new_run_from_the_tolerance_on():
    timeline = timeline_of(block(0, 100), block(100, 100, time=0.1004))
    assert timeline.counts.clock_deviation == 0
    timeline.add(block(200, 100, time=0.2006))
    assert timeline.counts.clock_deviation == 1
    assert len(held(timeline)) == 1
    timeline.add(block(300, 100, time=0.3099))
    assert timeline.counts.clock_deviation == 2
    assert len(held(timeline)) == 1
    timeline.add(block(400, 100, time=0.411))
    assert timeline.counts.clock_deviation == 3
    timeline.add(block(500, 100, time=0.511))
    assert timeline.counts.clock_deviation == 3
    assert [item.start_time for item in timeline.segments] == [0.0, 0.411]
    assert timeline.end_time == pytest.approx(0.61)
    assert timeline.epoch == 0 == timeline.counts.restarts
    assert 'sample 400 differs by +0.011 s' in timeline.messages[-1]


def test_stamps_that_stand_still_are_named():
    timeline = timeline_of(block(0, 100, time=0.0), block(100, 100, time=0.0),
                           block(200, 100, time=0.0), block(300, 100, time=0.3))
    assert sum('stamps stand still, send the time of each block' in line
               for line in timeline.messages) == 2


def test_time_that_jumps_back_over_consecutive_indices_is_another_epoch():
    timeline = timeline_of(block(0, 1000), block(1000, 100, time=0.9), block(1100, 100, time=1.0))
    assert [item[0] for item in held(timeline)] == [0, 1]
    assert timeline.counts.restarts == 1 == timeline.counts.clock_deviation


@pytest.mark.parametrize('offset', [3600.0, -3600.0])
def test_one_block_with_a_wrong_time_does_not_set_the_clock(offset):
    timeline = timeline_of(block(0, 100), block(100, 100, time=0.1 + offset), block(200, 100),
                           block(300, 100))
    assert timeline.end_time == pytest.approx(0.399)
    times = [(item.start_time, item.end_time) for item in timeline.segments]
    np.testing.assert_allclose(times, [(0.0, 0.099), (0.2, 0.399)])
    assert timeline.counts.clock_deviation == 1 == timeline.counts.gaps
    assert timeline.counts.samples_dropped == 100
    assert timeline.epoch == 0


def test_gap_ends_a_stretch():
    timeline = timeline_of(block(0, 100), block(150, 100))
    assert held(timeline) == [(0, 0.0, 99.0), (0, 150.0, 249.0)]
    assert [item.closed for item in timeline.segments] == [True, False]
    assert timeline.segments[1].start_time == 0.15
    assert timeline.counts.gaps == 1
    assert timeline.messages == ['samples 100 to 149 are missing']


@pytest.mark.parametrize('again', [(100, 100), (120, 80), (120, 40)])
def test_repeated_samples_are_dropped(again):
    timeline = timeline_of(block(0, 100), block(100, 100), block(*again), block(200, 100))
    assert held(timeline) == [(0, 0.0, 299.0)]
    assert timeline.counts.repeats == 1
    assert timeline.counts.samples_dropped == again[1]
    assert timeline.counts.restarts == 0 == timeline.counts.gaps


def test_overlapping_block_adds_its_new_part():
    timeline = timeline_of(block(0, 100), block(60, 100), block(160, 40))
    assert held(timeline) == [(0, 0.0, 199.0)]
    assert not timeline.messages


@pytest.mark.parametrize(('late', 'follows'), [(0, 400), (100, 400), (200, 400)])
def test_block_from_before_is_dropped_when_the_next_does_not_continue_it(late, follows):
    timeline = timeline_of(*(block(i, 100) for i in range(0, 400, 100)))
    timeline.add(block(late, 100))
    timeline.add(block(follows, 100))
    assert held(timeline) == [(0, 0.0, 499.0)]
    assert timeline.counts.repeats == 1
    assert timeline.counts.restarts == 0


def test_swapped_blocks_lose_the_late_one():
    timeline = timeline_of(block(0, 100), block(200, 100), block(100, 100), block(300, 100))
    assert held(timeline) == [(0, 0.0, 99.0), (0, 200.0, 399.0)]
    assert (timeline.counts.gaps, timeline.counts.repeats) == (1, 1)
    assert 'samples 100 to 199 are repeated or out of order: dropped' in timeline.messages[-1]


FATES = ('good', 'lost', 'late', 'repeated', 'wrong time', 'refused', 'twice late')


@given(st.lists(st.tuples(st.sampled_from(FATES), st.integers(1, 3)), max_size=8))
def test_every_sample_that_is_not_used_is_counted_once(fates):
    """As lost or as dropped, whatever becomes of every fourth block."""
    sent, counts = [], [10 + 7 * k for k in range(4 * len(fates) + 5)]
    starts = np.concatenate(([0], np.cumsum(counts))).tolist()
    lost = came = 0
    for number, (start, count) in enumerate(zip(starts, counts)):
        fate, later = fates[number // 4] if number % 4 == 1 and number // 4 < len(fates) else (
            'good', 0)
        good = block(start, count)
        arrivals = {'lost': (), 'repeated': (number, number), 'late': (number + later + 0.5,),
                    'twice late': 2 * (number + later + 0.5,)}.get(fate, (number,))
        bad = {'wrong time': block(start, count, time=start / RATE + 9.0),
               'refused': block(start, count, channels=2)}.get(fate, good)
        sent += [(arrival, bad) for arrival in arrivals]
        lost += count if fate in ('lost', 'late', 'twice late') else 0
        came += count * len(arrivals)
    timeline = VibrationTimeline()
    for _, item in sorted(sent, key=lambda event: event[0]):
        with suppress(SignalError):
            timeline.add(item)
    total = timeline.counts
    assert total.samples_lost == lost
    late = sum(counts[4 * k + 1] for k, (fate, _) in enumerate(fates) if 'late' in fate)
    assert came - late == sum(len(item.samples) for item in timeline.segments) + (
        total.samples_dropped)
    assert total.restarts == 0


@pytest.mark.parametrize('length', [100, 150, 1000])
@pytest.mark.parametrize('received', [1, 2, 7])
def test_source_that_starts_again_is_another_epoch_however_long_it_ran(received, length):
    timeline = timeline_of(*(block(100 * k, 100) for k in range(received)))
    for k in range(3):
        timeline.add(block(length * k, length, base=0.5))
    assert held(timeline) == [(0, 0.0, 100.0 * received - 1.0), (1, 0.5, 3.0 * length - 0.5)]
    assert timeline.counts.restarts == 1
    assert timeline.counts.gaps == 0


def test_restart_loses_nothing_when_it_overlaps_what_the_last_block_held():
    timeline = timeline_of(block(0, 100), block(0, 40, base=0.5), block(40, 100, base=0.5))
    assert held(timeline) == [(0, 0.0, 99.0), (1, 0.5, 139.5)]


def test_restart_whose_second_block_is_lost_is_found_by_the_next_two():
    timeline = timeline_of(*(block(100 * k, 100) for k in range(9)))
    for start in (0, 200, 300, 400):
        timeline.add(block(start, 100))
    assert held(timeline) == [(0, 0.0, 899.0), (1, 200.0, 499.0)]
    assert timeline.counts.samples_dropped == 100


def test_one_index_far_ahead_does_not_leave_later_pulses_in_the_past():
    timeline = timeline_of(block(0, 100), block(100, 100), block(10**9, 100), block(200, 100),
                           block(300, 100), block(400, 100))
    assert held(timeline)[-1] == (1, 200.0, 499.0)
    assert [timeline.epoch_near(time, 0) for time in (0.15, 0.45)] == [0, 1]


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_a_sample_that_no_channel_has_is_a_gap(bad):
    samples = np.tile(np.arange(100.0), (3, 1))
    samples[:, [5, 40, 41, 99]] = bad
    timeline = timeline_of(SampleBlock(samples, 0.0, RATE, 0), block(100, 50, channels=3))
    assert held(timeline) == [(0, 0.0, 4.0), (0, 6.0, 39.0), (0, 42.0, 98.0), (0, 100.0, 149.0)]
    np.testing.assert_allclose([item.start_time for item in timeline.segments],
                               [0.0, 0.006, 0.042, 0.1])
    assert timeline.counts.non_finite == 4 == timeline.counts.samples_dropped
    assert timeline.messages == ['4 samples from index 5 on are NaN or infinite in all channels: '
                                 'their cycles are discarded']


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_a_sample_that_one_channel_lacks_is_none_of_the_others(bad):
    samples = np.tile(np.arange(100.0), (3, 1))
    samples[1, [7, 40, 41, 99]] = bad
    following = SampleBlock(samples, 0.1, RATE, 100)
    timeline = timeline_of(SampleBlock(samples, 0.0, RATE, 0), following)
    segment, = timeline.segments
    assert segment.lacks_channels
    assert np.flatnonzero(np.isnan(segment.samples[:100, 1])).tolist() == [7, 40, 41, 99]
    assert np.isfinite(segment.samples[:, [0, 2]]).all()
    assert timeline.counts.non_finite == 8
    assert timeline.counts.samples_dropped == 0
    assert timeline.messages == ['samples from index 7 on are NaN or infinite in channels [1]: '
                                 'they have no average there']


def test_block_without_a_finite_sample_is_counted():
    timeline = timeline_of(block(0, 10), SampleBlock(np.full((1, 10), np.nan), 0.01, RATE, 10),
                           block(20, 10))
    assert held(timeline) == [(0, 0.0, 9.0), (0, 20.0, 29.0)]
    assert timeline.counts.non_finite == 10


@pytest.mark.parametrize(('samples', 'time', 'rate', 'says'), [
    (np.empty((0, 10)), 0.0, RATE, r'shape \(0, 10\)'),
    (np.empty((1, 0)), 0.0, RATE, r'shape \(1, 0\)'),
    (np.zeros(10), 0.0, RATE, r'shape \(10,\)'),
    (np.array(0.0), 0.0, RATE, r'shape \(\)'),
    (np.zeros((1, 10)), math.nan, RATE, 'nan s'),
    (np.zeros((1, 10)), 0.0, math.inf, 'inf Hz'),
    (np.zeros((1, 10)), 0.0, 0.0, '0.0 Hz'),
    (np.zeros((1, 10)), 0.0, -RATE, '-1000.0 Hz'),
])
def test_unusable_block_is_refused_and_changes_nothing(samples, time, rate, says):
    timeline = timeline_of(block(0, 100))
    with pytest.raises(SignalError, match=says):
        timeline.add(SampleBlock(samples, time, rate, 100))
    timeline.add(block(100, 100))
    assert held(timeline) == [(0, 0.0, 199.0)]
    assert timeline.counts.blocks_rejected == 1


@pytest.mark.parametrize('odd', [{'channels': 2}, {'rate': 2000.0, 'time': 0.1}])
def test_one_block_of_another_layout_is_a_fault_and_leaves_a_gap(odd):
    timeline = timeline_of(block(0, 100))
    with pytest.raises(SignalError, match='in a stream of 1 at 1000 Hz'):
        timeline.add(block(100, 100, **odd))
    timeline.add(block(200, 100))
    assert held(timeline) == [(0, 0.0, 99.0), (0, 200.0, 299.0)]
    assert timeline.layout == (1, RATE)
    assert timeline.counts.samples_dropped == 100


@pytest.mark.parametrize('new', [{'channels': 2}, {'rate': 500.0}])
def test_source_that_changed_for_good_is_followed_from_its_second_block_on(new):
    timeline = timeline_of(block(0, 100))
    with pytest.raises(SignalError):
        timeline.add(block(100, 100, **new))
    timeline.add(block(200, 100, **new))
    timeline.add(block(300, 100, **new))
    # the run is new, but time did not run back
    assert held(timeline) == [(0, 0.0, 99.0), (0, 200.0, 399.0)]
    assert timeline.counts.gaps == 1
    assert timeline.layout == (new.get('channels', 1), new.get('rate', RATE))


def test_rate_may_be_measured_anew_for_each_block():
    rates = RATE * (1.0 + np.array([2.0, -3.0, 1.0, 5.0, -7.0, 9.0]) * 1e-5)
    timeline = timeline_of(*(block(100 * k, 100, rate=rate) for k, rate in enumerate(rates)))
    assert [(item.index, item.end_index, item.clock.rate) for item in timeline.segments] == [
        (0, 600, rates[0])]
    assert timeline.layout == (1, rates[0])
    assert (timeline.counts.blocks_rejected, timeline.messages) == (0, [])


def test_rates_that_differ_look_different_in_the_message():
    timeline = timeline_of(block(0, 100))
    with pytest.raises(SignalError, match=r'1 channels at 1000\.2 Hz in a stream of 1 at 1000 Hz'):
        timeline.add(block(100, 100, rate=1000.2))


def test_oldest_samples_go_beyond_the_buffer():
    timeline = VibrationTimeline(buffer_seconds=0.25)
    for index in (0, 100, 250, 350, 450):
        timeline.add(block(index, 100))
        timeline.bound()
    assert held(timeline) == [(0, 300.0, 549.0)]
    assert timeline.counts.samples_dropped == 250


def test_a_thousand_segments_are_bounded_in_one_pass(monkeypatch):
    timeline, size, reads = VibrationTimeline(buffer_seconds=2.0), Segment.size, []
    for k in range(20):
        item = block(200 * k, 200)
        item.samples[:, ::4] = np.nan
        timeline.add(item)
    monkeypatch.setattr(Segment, 'size', property(
        lambda segment: reads.append(0) or size.fget(segment)))
    timeline.bound()
    assert len(reads) < 4 * 1000
    assert sum(len(item.samples) for item in timeline.segments) == 2000
    assert timeline.counts.samples_dropped == 1000 + 1000
    assert sum(len(item._rows._data) for item in timeline.segments) < 100 * len(timeline.segments)
    for segment in timeline.segments[::50]:
        assert segment in timeline.around(0, segment.start_time)
        assert segment in timeline.around(0, segment.end_time)


def test_release_forgets_older_epochs_and_closed_segments():
    timeline = timeline_of(block(0, 100), block(150, 100), block(250, 100, time=0.1),
                           block(350, 100, time=0.2))
    timeline.release(0, 0.2)
    assert held(timeline) == [(0, 200.0, 249.0), (1, 250.0, 449.0)]
    timeline.release(1, -np.inf)
    assert held(timeline) == [(1, 250.0, 449.0)]


def test_take_empties_the_time_line_and_keeps_its_place():
    timeline = timeline_of(block(0, 100), block(150, 100))
    taken = timeline.take()
    assert [(epoch, item.index, item.samples.shape) for epoch, item in taken] == [
        (0, 0, (1, 100)), (0, 150, (1, 100))]
    assert timeline.take() == []
    timeline.add(block(250, 10))
    (epoch, item), = timeline.take()
    assert (epoch, item.index, item.start_time) == (0, 250, 0.25)


@given(st.lists(st.tuples(st.integers(-2, 30), st.integers(1, 40), st.sampled_from(
    [0.0, 0.0, 0.0, 0.004, -0.3, 0.3, 1e9, -1e9])), max_size=40))
def test_whatever_comes_every_stretch_is_consecutive_and_memory_bounded(blocks):
    timeline = VibrationTimeline(buffer_seconds=0.2)
    for start, count, lie in blocks:
        timeline.add(block(max(start, 0) * 10, count, time=start * 0.01 + lie))
        timeline.bound()
        held(timeline)
        assert sum(len(item.samples) for item in timeline.segments) <= 200
        assert len(timeline.segments) <= 201


@pytest.mark.parametrize(('time', 'resolved'), [
    (1.8e9, True), (-1.8e9, True), (1e10, False), (-1e12, False), (1e15, False)])
def test_times_that_a_float_does_not_resolve_are_refused(time, resolved):
    timeline = VibrationTimeline()
    if resolved:
        timeline.add(block(0, 100, time=time, rate=12800.0))
        assert held(timeline) == [(0, 0.0, 99.0)]
        return
    with pytest.raises(SignalError, match='so large that a float64 rounds it to '):
        timeline.add(block(0, 100, time=time, rate=12800.0))
    assert timeline.counts.blocks_rejected == 1
