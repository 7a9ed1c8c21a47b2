"""What nodes are made of, without a ROS graph: monitor, worker, matching of windows."""
from __future__ import annotations

import threading
import xml.etree.ElementTree as xml
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    PairedWindow,
    Reference,
    RelativePose,
)
from sphstereo_ros.core.pairing import MAX_BYTES
from sphstereo_ros.replay import bag_messages
from sphstereo_ros.ros.conversions import (
    WindowGeometry,
    covariance_message,
    read_window,
    window_message,
)
from sphstereo_ros.ros.matching import (
    MAX_COVARIANCES,
    MAX_PENDING,
    Covariances,
    WindowMatcher,
    frames_needed,
)
from sphstereo_ros.ros.monitor import ERROR, OK, STALL, WARN, Monitor
from sphstereo_ros.ros.transport import (
    PROFILE,
    SMALL_PROFILE,
    prepare_process,
    segment_size,
)
from sphstereo_ros.ros.worker import Worker

DEADLINE = 10.0


class FakeClock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


# Monitor

def test_monitor_counts_rates_latency_and_drops() -> None:
    clock, told = FakeClock(), []
    monitor = Monitor('stage', clock, told.append)
    assert (monitor.status().level, monitor.status().message) == (OK, 'waiting for input')
    for latency in (0.1, 0.2, 0.3):
        clock.now += 0.2
        arrival = monitor.arrived()
        clock.now += latency
        monitor.published(arrival, {'inliers': 7})
    monitor.arrived()
    monitor.dropped(Drop('too_few_inliers', '3 of 90'))
    monitor.dropped(Drop('too_few_inliers', '4 of 90'))
    clock.now = 102.0
    status = monitor.status()
    assert status.level == WARN
    assert status.message == 'dropped: 2 too_few_inliers'
    values = status.values
    assert (values['frames_in'], values['frames_out'], values['drops']) == (4, 3, 2)
    assert (values['rate_in'], values['rate_out']) == ('2.00', '1.50')
    assert (values['latency_p50_ms'], values['latency_p95_ms']) == ('200.00', '290.00')
    assert values['drops.too_few_inliers'] == 2
    assert values['last_drop'] == 'too_few_inliers: 4 of 90'
    assert values['inliers'] == 7
    assert float(str(values['memory_mb'])) > 1
    assert [drop.detail for drop in told] == ['3 of 90']
    clock.now += 1
    status = monitor.status()
    assert (status.level, status.message) == (OK, 'running')
    assert status.values['rate_in'] == '0.00'


def test_monitor_sees_stalls_and_errors() -> None:
    clock = FakeClock()
    monitor = Monitor('stage', clock)
    monitor.arrived()
    clock.now += STALL + 0.5
    assert monitor.status().message == 'stalled: no input for 2.5 s'
    monitor.arrived()
    status = monitor.status()
    assert (status.level, status.message) == (WARN, 'stalled: no output for 2.5 s')
    monitor.dropped(Drop('internal_error', 'ValueError: x'))
    assert monitor.status().level == ERROR
    monitor.published(clock.now)
    assert monitor.status().level == OK


def test_monitor_does_not_warn_of_what_must_be() -> None:
    monitor = Monitor('stage', FakeClock())
    monitor.arrived()
    monitor.dropped(Drop('first_frame'))
    status = monitor.status()
    assert (status.level, status.values['drops.first_frame']) == (OK, 1)


# Worker

class Blocked:
    """A worker whose first job holds it until `release` is called."""

    def __init__(self, capacity: int = 1) -> None:
        self.done: list[str] = []
        self.errors: list[Exception] = []
        self.superseded = 0
        self._open, self._entered = threading.Event(), threading.Event()
        self.worker = Worker('test', self._count, self.errors.append, capacity)
        self.worker.put(self._hold)
        assert self._entered.wait(DEADLINE)

    def _hold(self) -> None:
        self._entered.set()
        assert self._open.wait(DEADLINE)

    def _count(self) -> None:
        self.superseded += 1

    def job(self, name: str) -> object:
        return lambda: self.done.append(name)

    def release(self) -> list[str]:
        """Let all jobs run; returns what was done."""
        finished = threading.Event()
        self.worker.put(finished.set)
        self._open.set()
        assert finished.wait(DEADLINE)
        self.worker.stop()
        return self.done


@pytest.mark.parametrize(('capacity', 'expected'), [(1, ['x', '4']), (3, ['x', '2', '3', '4'])])
def test_worker_keeps_the_newest_and_all_that_must_run(capacity: int,
                                                       expected: list[str]) -> None:
    blocked = Blocked(capacity)
    blocked.worker.put(blocked.job('x'))
    for i in range(5):
        blocked.worker.put_newest(blocked.job(str(i)))
    assert blocked.release() == expected
    assert blocked.superseded == 5 - capacity


def test_worker_survives_a_failing_job() -> None:
    blocked = Blocked()
    blocked.worker.put(lambda: [].pop())
    blocked.worker.put(blocked.job('after'))
    assert blocked.release() == ['after']
    assert [type(e) for e in blocked.errors] == [IndexError]


def test_worker_makes_a_producer_wait_until_it_is_free() -> None:
    blocked = Blocked()
    producer = threading.Thread(target=blocked.worker.put_when_free, args=(blocked.job('a'),))
    producer.start()
    producer.join(0.1)
    assert producer.is_alive()
    blocked._open.set()
    producer.join(DEADLINE)
    assert not producer.is_alive()
    assert blocked.release() == ['a']
    assert blocked.superseded == 0


def test_worker_stops_a_waiting_producer() -> None:
    blocked = Blocked()
    producer = threading.Thread(target=blocked.worker.put_when_free, args=(blocked.job('a'),))
    producer.start()
    blocked.worker.stop(timeout=0)
    producer.join(DEADLINE)
    assert not producer.is_alive()
    blocked._open.set()


# Matching

def frame(stamp: int) -> Frame:
    return Frame(FrameKey(stamp, 'c'), np.full((2, 4), stamp % 256, np.uint8))


def geometry(*stamps: int) -> WindowGeometry:
    """A window of these stamps, current first."""
    pose = RelativePose(position=np.array([0, 0, -1.0]))
    current, *others = (FrameKey(stamp, 'c') for stamp in stamps)
    return WindowGeometry(current, tuple((key, pose) for key in others))


def stamps(decided: list[tuple[PairedWindow | Drop, float]]) -> list[object]:
    return [w.cause if isinstance(w, Drop) else
            (w.current.key.stamp, *(r.frame.key.stamp for r in w.references))
            for w, _ in decided]


def test_window_waits_for_its_frames() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 5)
    assert matcher.add_frame(frame(1)) == []
    assert matcher.add_window(geometry(2, 1), 7.5) == []
    (window, arrival), = matcher.add_frame(frame(2))
    assert isinstance(window, PairedWindow)
    assert arrival == 7.5
    assert window.current.image[0, 0] == 2
    assert window.references[0].frame.image[0, 0] == 1
    assert stamps(matcher.add_window(geometry(2, 1), 8.0)) == [(2, 1)]


def test_window_without_its_frame_is_dropped_when_a_later_one_is_complete() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 5)
    matcher.add_frame(frame(2))
    assert matcher.add_window(geometry(2, 1), 0.0) == []
    assert matcher.add_frame(frame(3)) == []
    assert stamps(matcher.add_window(geometry(3, 2), 0.0)) == ['frame_missing', (3, 2)]


def test_windows_that_wait_are_bounded() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 5)
    decided = []
    for stamp in range(MAX_PENDING + 2):
        decided += matcher.add_window(geometry(stamp + 1, stamp), 0.0)
    assert stamps(decided) == ['frame_missing'] * 2


def test_frames_kept_are_bounded() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 3)
    for stamp in range(10):
        matcher.add_frame(frame(stamp))
    assert matcher.add_window(geometry(9, 6), 0.0) == []
    assert stamps(matcher.add_window(geometry(9, 7), 0.0)) == ['frame_missing', (9, 7)]


def test_another_frame_id_is_another_frame() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 3)
    matcher.add_frame(Frame(FrameKey(1, 'other'), np.zeros((2, 4), np.uint8)))
    matcher.add_frame(frame(2))
    assert matcher.add_window(geometry(2, 1), 0.0) == []


@given(st.permutations(range(12)))
def test_any_order_of_arrival_gives_the_same_windows(order: list[int]) -> None:
    """Frames and windows in any order: a window comes out once its frames are there, or a later
    one does; none is told of twice.
    """
    matcher = WindowMatcher(PairedWindow, lambda _: 20)
    decided: list[tuple[PairedWindow | Drop, float]] = []
    for event in order:
        if event < 6:
            decided += matcher.add_frame(frame(event))
        elif event < 11:
            decided += matcher.add_window(geometry(event - 5, event - 6), float(event))
    assert len(decided) + len(matcher._pending) == 5
    for window, arrival in decided:
        if not isinstance(window, Drop):
            assert window.current.key.stamp == arrival - 5


def test_frames_needed_follow_the_pairing() -> None:
    assert frames_needed(resolve({'pairing.intervals': (4, 10)})) == 40
    far = resolve({'pairing.baselines': (1.0,), 'baseline.length': 0.3})
    assert frames_needed(far) == 130
    assert frames_needed(far, MAX_BYTES // 20) == 50


def test_more_frames_are_kept_where_windows_reach_farther() -> None:
    """The node that pairs was told of farther references; this one was not."""
    matcher = WindowMatcher(PairedWindow, lambda _: 5)
    outcomes = []
    for stamp in range(60):
        matcher.add_frame(frame(stamp))
        if stamp >= 12:
            outcomes.append(matcher.add_window(geometry(stamp, stamp - 12), 0.0))
    assert outcomes[0] == []  # the frame is gone for good
    assert all(stamps(o)[-1:] == [(i, i - 12)] for i, o in enumerate(outcomes[30:], start=42))
    assert 13 <= len(matcher._frames) <= 40
    matcher.configure(lambda _: 6)
    matcher.add_frame(frame(99))
    assert len(matcher._frames) == 6


def test_a_window_of_old_frames_does_not_fill_the_memory() -> None:
    matcher = WindowMatcher(PairedWindow, lambda _: 2)
    huge = np.lib.stride_tricks.as_strided(np.zeros(1, np.uint8), (2**13, 2**14), (0, 0))
    for stamp in range(100, 160):  # 128 MB each, if they were real
        matcher.add_frame(Frame(FrameKey(stamp, 'camera_optical'), huge))
        matcher.add_window(geometry(stamp, 1), 0.0)
    assert len(matcher._frames) <= 4


# Covariances beside the windows

def aligned(*covariances: np.ndarray | None, scale: float = 1.0) -> AlignedWindow:
    turn = rotations.exp([0.1, -0.2, 0.3])
    return AlignedWindow(frame(2_000_000_000), tuple(
        Reference(frame(1_000_000_000 - i), RelativePose(
            turn, (i + 1) * scale * np.array([0.36, 0.48, -0.8]), covariance))
        for i, covariance in enumerate(covariances)))


def spread(seed: int = 3) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(6, 6)) * 1e-3
    return root @ root.T


def told(window: AlignedWindow) -> list[Any]:
    return [covariance_message(bag_messages.make, window.current.key, r.pose)
            for r in window.references if r.pose.covariance is not None]


def over_the_wire(window: AlignedWindow) -> AlignedWindow:
    """The window as a nav_msgs/Path brings it: without covariances."""
    geometry = read_window(window_message(bag_messages.make, window))
    assert isinstance(geometry, WindowGeometry)
    frames = {f.key: f for f in (window.current, *(r.frame for r in window.references))}
    joined = geometry.with_frames(AlignedWindow, frames)
    assert isinstance(joined, AlignedWindow)
    return joined


@pytest.mark.parametrize('scale', [1.0, 1e-6])
def test_covariances_of_all_references_survive_the_way(scale: float) -> None:
    covariances = Covariances()
    window = aligned(spread(1), None, spread(2), scale=scale)
    for message in reversed(told(window)):
        assert covariances.add(message) is None
    back = covariances.attached(over_the_wire(window))
    assert isinstance(back, AlignedWindow)
    for reference, seed in zip(back.references, (1, None, 2), strict=True):
        if seed is None:
            assert reference.pose.covariance is None
        else:
            np.testing.assert_allclose(reference.pose.covariance, spread(seed), rtol=1e-12)


def test_covariances_of_messages_are_of_the_position_first() -> None:
    message, = told(aligned(np.diag([1.0, 2.0, 3.0, 40.0, 50.0, 60.0])))
    assert list(np.diag(np.reshape(message.pose.covariance, (6, 6)))) == [40, 50, 60, 1, 2, 3]
    assert (message.header.stamp.sec, message.header.frame_id) == (2, 'c')


def test_a_known_covariance_stays_and_another_frames_is_not_taken() -> None:
    covariances = Covariances()
    for message in told(aligned(spread())):
        covariances.add(message)
    own = covariances.attached(aligned(np.eye(6)))
    np.testing.assert_array_equal(own.references[0].pose.covariance, np.eye(6))
    later = replace(aligned(None), current=frame(3_000_000_000))
    assert covariances.attached(later).references[0].pose.covariance is None
    moved = covariances.attached(aligned(None, scale=1.001))
    assert moved.references[0].pose.covariance is None


def test_a_covariance_that_tells_nothing_is_named() -> None:
    covariances = Covariances()
    for wrong in (np.zeros(36), np.full(36, np.nan), -np.eye(6).reshape(-1)):
        message, = told(aligned(spread()))
        message.pose.covariance = wrong
        drop = covariances.add(message)
        assert isinstance(drop, Drop)
        assert drop.cause == 'unknown_covariance'
    message, = told(aligned(spread()))
    message.pose.pose.position.x = np.nan
    drop = covariances.add(message)
    assert isinstance(drop, Drop)
    assert drop.cause == 'not_finite'
    assert covariances.attached(aligned(None)).references[0].pose.covariance is None


def test_covariances_are_bounded() -> None:
    covariances = Covariances()
    message, = told(aligned(spread()))
    for seconds in range(2, MAX_COVARIANCES + 3):
        message.header.stamp.sec = seconds
        covariances.add(message)
    assert covariances.attached(aligned(None)).references[0].pose.covariance is None
    assert len(covariances._known) == MAX_COVARIANCES


# Transport

def test_profile_is_loaded_unless_the_user_chose_one() -> None:
    environment: dict[str, str] = {}
    prepare_process(environment=environment)
    assert environment == {'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE)}
    for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_BUILTIN_TRANSPORTS'):
        chosen = {name: 'mine'}
        assert prepare_process(environment=chosen) == ''
        assert chosen == {name: 'mine'}


def test_too_little_shared_memory_is_told(tmp_path: Path) -> None:
    profile = tmp_path / 'huge.xml'
    profile.write_text(f'<segment_size>{2**60}</segment_size>')
    assert 'large messages travel by UDP' in prepare_process(profile, {})


def numbers(profile: Path) -> dict[str, int]:
    tree = xml.fromstring(profile.read_text())
    return {e.tag.rpartition('}')[2]: int(e.text) for e in tree.iter()
            if e.text and e.text.strip().isdigit()}


def test_profile_holds_what_a_process_has_under_way() -> None:
    pixels = 1920 * 960
    outputs = 3 * (4 * pixels + 4 * pixels + 8_000_000 + 3 * pixels) + 5 * 3 * pixels
    found = numbers(PROFILE)
    assert found['segment_size'] == segment_size(PROFILE) > outputs
    assert found['port_queue_capacity'] * 65500 >= outputs
    small = numbers(SMALL_PROFILE)
    assert small['segment_size'] < found['segment_size'] / 4
    assert small['port_queue_capacity'] == found['port_queue_capacity']
