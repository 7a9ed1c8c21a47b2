from __future__ import annotations

from itertools import islice, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from making_bags import STEP, T0, jpeg_image, odometry, raw_image

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.replay.bag_messages import TYPESTORE, make
from sphstereo_ros.replay.player import (
    LATE,
    TICK,
    Due,
    Player,
    schedule,
    stamp_of,
    with_stamp,
)
from sphstereo_ros.replay.records import Record
from sphstereo_ros.ros import conversions as convert

NAMES = {'/image': 'image', '/odometry': 'odometry'}


class Listed:
    """A source of given records."""

    problem = ''

    def __init__(self, records):
        self._records = records
        self.topics = {record.topic: record.kind for record in records}

    def count(self, topics):
        return sum(record.topic in topics for record in self._records)

    def records(self, topics):
        return (record for record in self._records if record.topic in topics)


def drive(frames=5, delay=1000):
    records = []
    for k in range(frames):
        for topic, message in (('/odometry', odometry(k)), ('/image', raw_image(k))):
            kind = message.__msgtype__
            records.append(Record(topic, kind, T0 + k * STEP + delay,
                                  bytes(TYPESTORE.serialize_cdr(message, kind))))
    return Listed(records)


@given(st.integers(-2**31 * 10**9, (2**31 - 1) * 10**9), st.integers(-10**18, 10**18),
       st.booleans())
def test_stamps_are_changed_in_place(before, shift, little):
    message = convert.compressed_message(make, FrameKey(before, 'camera'), 'jpeg', b'abc')
    kind = message.__msgtype__
    cdr = bytes(TYPESTORE.serialize_cdr(message, kind, little_endian=little))
    assert stamp_of(cdr) == before
    after = max(min(before + shift, (2**31 - 1) * 10**9), -2**31 * 10**9)
    changed = TYPESTORE.deserialize_cdr(with_stamp(cdr, after), kind)
    assert convert.frame_key(changed.header) == FrameKey(after, 'camera')
    assert bytes(changed.data) == b'abc'


@pytest.mark.parametrize('rate', [0.2, 1.0, 4.0])
def test_rate_scales_real_time_and_not_the_clock(rate):
    plan = list(schedule(drive(), NAMES, rate))
    assert [due.topic for due in plan] == ['odometry', 'image'] * 5
    np.testing.assert_allclose([due.at for due in plan[::2]], 0.1 * np.arange(5) / rate)
    assert [due.clock for due in plan[::2]] == [T0 + k * STEP + 1000 for k in range(5)]
    assert [stamp_of(due.cdr) for due in plan[::2]] == [T0 + k * STEP for k in range(5)]


def test_messages_are_published_byte_for_byte():
    source = drive()
    assert [due.cdr for due in schedule(source, NAMES)] == [
        record.cdr for record in source.records(NAMES)]


def test_only_named_topics_are_played():
    plan = list(schedule(drive(), {'/image': 'image/raw'}))
    assert [due.topic for due in plan] == ['image/raw'] * 5


def test_start_offset():
    plan = list(schedule(drive(), NAMES, start_offset=0.2))
    assert plan[0].at == 0.0
    assert stamp_of(plan[0].cdr) == T0 + 2 * STEP
    assert len(plan) == 6


@pytest.mark.parametrize('start_offset', [0.0, 0.25])
def test_stamps_and_clock_never_run_backward_in_a_loop(start_offset):
    plan = list(islice(schedule(drive(), NAMES, loop=True, start_offset=start_offset), 60))
    assert len(plan) == 60
    images = [stamp_of(due.cdr) for due in plan if due.topic == 'image']
    assert {b - a for a, b in pairwise(images)} == {STEP}  # the next pass keeps the pace
    assert all(b.clock >= a.clock for a, b in pairwise(plan))
    assert all(b.at >= a.at for a, b in pairwise(plan))
    first = next(due for due in plan if due.topic == 'image')
    again = [due.cdr[12:] for due in plan if due.topic == 'image'].index(first.cdr[12:], 1)
    assert again == (5 if start_offset == 0 else 2)  # frames a pass


def test_loop_of_one_message():
    record = Record('/image', 'sensor_msgs/msg/CompressedImage', T0, given=jpeg_image(0))
    plan = list(islice(schedule(Listed([record]), NAMES, loop=True), 3))
    stamps = [stamp_of(due.cdr) for due in plan]
    assert stamps[0] < stamps[1] < stamps[2]


def test_loop_of_nothing_ends():
    assert list(schedule(Listed([]), NAMES, loop=True)) == []
    assert list(schedule(drive(), NAMES, loop=True, start_offset=100.0)) == []


def test_cut_off_messages_are_left_out():
    records = [Record('/image', 'sensor_msgs/msg/Image', T0, b'\x00\x01\x00')]
    assert list(schedule(Listed(records), NAMES)) == []


class FakeTime:
    """Real time that passes only by sleeping."""

    def __init__(self):
        self.now = 100.0
        self.events = []

    def sleep(self, seconds):
        assert seconds > 0
        self.now += seconds

    def publish(self, due):
        self.events.append(('message', self.now - 100.0, due))

    def publish_clock(self, nanoseconds):
        self.events.append(('clock', self.now - 100.0, nanoseconds))

    def player(self, rate=1.0, **other):
        return Player(self.publish, self.publish_clock, rate, monotonic=lambda: self.now,
                      sleep=self.sleep, **other)

    def of(self, kind):
        return [(at, what) for name, at, what in self.events if name == kind]


@pytest.mark.parametrize('rate', [0.5, 1.0, 3.0])
def test_player_publishes_in_time_with_a_steady_clock(rate):
    fake = FakeTime()
    assert fake.player(rate).play(schedule(drive(), NAMES, rate)) == 10
    for at, due in fake.of('message'):
        assert at == pytest.approx(due.at, abs=1e-6)
    clock = fake.of('clock')
    assert all(b[1] >= a[1] for a, b in pairwise(clock))
    assert max(b[0] - a[0] for a, b in pairwise(clock)) <= 1 / 50
    for at, nanoseconds in clock:
        assert nanoseconds - (T0 + 1000) == pytest.approx(at * rate * 1e9, abs=2 * TICK * 1e9)


def test_clock_is_told_before_each_message():
    fake = FakeTime()
    fake.player().play(schedule(drive(), NAMES))
    for before, event in pairwise(fake.events):
        if event[0] == 'message':
            assert before[:1] == ('clock',)
            assert before[2] == event[2].clock


def test_player_stops_when_told():
    fake = FakeTime()
    player = fake.player(stopped=lambda: fake.now > 100.25)
    assert player.play(schedule(drive(100), NAMES)) == 6


def test_player_does_not_hurry_after_a_stall():
    fake = FakeTime()
    plan = [Due(at, 0, 'image', '', b'') for at in (0.0, 0.1, 0.2, 0.3)]
    player = fake.player()

    def slow(due):
        fake.publish(due)
        if due.at == 0.1:
            fake.now += 2.0
    player.publish = slow
    player.play(iter(plan))
    times = [at for at, _ in fake.of('message')]
    np.testing.assert_allclose(np.diff(times), [0.1, 2.0, 0.1])


def test_small_delays_are_caught_up():
    fake = FakeTime()
    player = fake.player()

    def slow(due):
        fake.publish(due)
        fake.now += 0.9 * LATE if due.at == 0 else 0.0
    player.publish = slow
    player.play(Due(k / 10, 0, 'image', '', b'') for k in range(8))
    assert fake.of('message')[-1][0] == pytest.approx(0.7)
