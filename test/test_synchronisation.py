"""Pairs of two cameras' frames: every frame is used once, or counted by its cause."""
from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sphstereo_ros.core.frames import Drop, Frame, FrameKey
from sphstereo_ros.core.synchronisation import (
    PATIENCE,
    SIDES,
    FramePair,
    LoneFrame,
    Met,
    Side,
    Synchroniser,
)

MS = 1_000_000
STEP = 66 * MS  # 15 Hz


def frame(side: Side, stamp: int, height: int = 4) -> Frame:
    return Frame(FrameKey(stamp, side), np.zeros((height, 2 * height), np.uint8))


def told(met: list[Met]) -> list[object]:
    """Pairs as stamps (top, bottom), lone frames as (side, stamp), drops by cause."""
    return [(m.top.key.stamp, m.bottom.key.stamp) if isinstance(m, FramePair)
            else (m.side, m.frame.key.stamp) if isinstance(m, LoneFrame) else m.cause
            for m in met]


def fed(synchroniser: Synchroniser, *views: tuple[Side, int]) -> list[object]:
    return [one for side, stamp in views
            for one in told(synchroniser.add(side, frame(side, stamp)))]


VIEWS = st.lists(st.tuples(st.sampled_from(SIDES), st.integers(0, 400)), max_size=80)


@given(VIEWS, st.sampled_from([0.0, 0.005, 0.02, 0.1]))
def test_every_frame_is_used_once_or_counted(views: list[tuple[Side, int]],
                                             tolerance: float) -> None:
    """Whatever comes in whatever order; and never do more than a few frames wait."""
    synchroniser = Synchroniser(tolerance, max_gap=0.3)
    out: list[Met] = []
    for side, tick in views:
        out += synchroniser.add(side, frame(side, 5 * MS * tick))
        assert all(len(s.waiting) <= PATIENCE for s in synchroniser._streams.values())
    out += synchroniser.flush()
    assert sum(2 if isinstance(m, FramePair) else 1 for m in out) == len(views)
    used: Counter[tuple[Side, int]] = Counter()
    for m in out:
        if isinstance(m, FramePair):
            assert abs(m.top.key.stamp - m.bottom.key.stamp) <= tolerance * 1e9
            used.update([('top', m.top.key.stamp), ('bottom', m.bottom.key.stamp)])
        elif isinstance(m, LoneFrame):
            used[m.side, m.frame.key.stamp] += 1
    sent = Counter((side, 5 * MS * tick) for side, tick in views)
    assert not used - sent


@given(st.integers(-20, 20), st.lists(st.integers(-5, 5), min_size=4, max_size=12),
       st.randoms(use_true_random=False), st.sets(st.integers(0, 11), max_size=1))
def test_pairs_are_those_of_the_nearest_stamps_in_whatever_order_cameras_deliver(
        offset: int, jitter: list[int], random: object, lost: set[int]) -> None:
    """Stamps some ms apart with jitter; a lost frame costs its own pair alone."""
    stamps: dict[Side, list[int]] = {
        'bottom': [i * STEP for i in range(len(jitter))],
        'top': [i * STEP + (offset + j) * MS for i, j in enumerate(jitter) if i not in lost]}
    expected = [(t, b) for b in stamps['bottom'] for t in stamps['top'] if abs(t - b) <= 25 * MS]
    synchroniser = Synchroniser(0.025, max_gap=1.0)
    out: list[object] = []
    queues = {side: list(times) for side, times in stamps.items()}
    while any(queues.values()):
        # One camera may be one frame later than the other, not more.
        ready = [s for s in SIDES if queues[s] and not any(
            queues[o] and queues[o][0] < queues[s][0] - STEP - 20 * MS for o in SIDES)]
        side = random.choice(ready)  # type: ignore[attr-defined]
        out += fed(synchroniser, (side, queues[side].pop(0)))
    out += told(synchroniser.flush())
    assert [o for o in out if o in expected] == expected
    assert len(out) == len(expected) + sum(map(len, stamps.values())) - 2 * len(expected)


@pytest.mark.parametrize('lost', SIDES)
def test_a_camera_that_dies_leaves_the_other_alone_until_it_returns(lost: Side) -> None:
    alive: Side = 'bottom' if lost == 'top' else 'top'
    synchroniser = Synchroniser(0.02, max_gap=1.0)
    assert fed(synchroniser, (lost, 0), (alive, 0)) == [(0, 0)]
    for i in range(1, PATIENCE + 1):
        assert fed(synchroniser, (alive, i * STEP)) == []
    assert not synchroniser.silent
    n = PATIENCE + 1
    assert fed(synchroniser, (alive, n * STEP)) == [(alive, i * STEP) for i in range(1, n + 1)]
    assert synchroniser.silent == [lost]
    assert fed(synchroniser, (alive, (n + 1) * STEP)) == [(alive, (n + 1) * STEP)]  # at once
    # Back, at first too late for a frame that went on alone.
    assert fed(synchroniser, (lost, (n + 1) * STEP + 5 * MS)) == [f'{lost}_late']
    assert not synchroniser.silent
    assert fed(synchroniser, (alive, (n + 2) * STEP)) == []
    assert fed(synchroniser, (lost, (n + 2) * STEP)) == [((n + 2) * STEP,) * 2]


def test_what_is_wrong_with_a_frame_is_its_cause() -> None:
    synchroniser = Synchroniser(0.02, max_gap=0.5)
    assert fed(synchroniser, ('top', STEP), ('top', STEP), ('top', STEP - 1)) == [
        'top_duplicate', 'top_out_of_order']
    assert fed(synchroniser, ('bottom', 2 * STEP)) == ['bottom_missing']
    assert fed(synchroniser, ('top', 3 * STEP)) == ['top_missing']
    other = synchroniser.add('bottom', frame('bottom', 3 * STEP, height=8))
    assert told(other) == ['sizes_differ'] * 2
    assert isinstance(other[0], Drop)
    assert 'working_height' in other[0].detail


def test_a_recording_that_begins_anew() -> None:
    synchroniser = Synchroniser(0.02, max_gap=0.5)
    for i in range(100, 103):
        fed(synchroniser, ('top', i * STEP), ('bottom', i * STEP))
    assert fed(synchroniser, ('top', 103 * STEP)) == []
    assert fed(synchroniser, ('top', 0)) == ['stamp_backward']
    assert fed(synchroniser, ('bottom', 0)) == [(0, 0)]


def test_a_camera_at_half_the_rate_has_all_its_frames_paired() -> None:
    synchroniser = Synchroniser(0.02, max_gap=0.5)
    out: list[object] = []
    for i in range(10):
        out += fed(synchroniser, ('bottom', i * STEP))
        if i % 2 == 0:
            out += fed(synchroniser, ('top', i * STEP + MS))
    assert Counter(map(type, out)) == {tuple: 5, str: 4}
    assert not synchroniser.silent


def test_of_two_frames_within_the_tolerance_the_nearer_is_taken() -> None:
    synchroniser = Synchroniser(0.03, max_gap=0.5)
    assert fed(synchroniser, ('bottom', 0), ('bottom', 33 * MS), ('top', 30 * MS)) == [
        'top_missing', (30 * MS, 33 * MS)]
