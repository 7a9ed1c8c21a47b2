"""Drift of the alignment: followed slowly and within bounds, never by a jump."""
from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.drift import DriftTracker

START = rotations.exp([0.02, -0.05, 0.03])
SECOND = 10**9
RATE = 10  # measurements a second
GOOD = math.radians(0.005)


def tracker(**values) -> DriftTracker:
    return DriftTracker(START, resolve({f'calibration.{k}': v for k, v in values.items()})
                        .calibration)


def turned(vector) -> np.ndarray:
    return rotations.exp(vector) @ START


def feed(tracked, rotation, seconds, start=0.0):
    """Outcomes of RATE measurements a second."""
    return [tracked.add(round((start + k / RATE) * SECOND), rotation, GOOD)
            for k in range(round(seconds * RATE) + 1)]


def degrees_from(tracked, rotation) -> float:
    return math.degrees(rotations.angle(tracked.rotation @ rotation.T))


def test_it_begins_where_it_was_calibrated():
    tracked = tracker()
    np.testing.assert_array_equal(tracked.rotation, START)
    assert tracked.drift == 0
    assert tracked.add(5, turned([0.001, 0, 0]), GOOD) is None
    np.testing.assert_allclose(tracked.rotation, START, atol=1e-15)  # no time has passed


def test_it_follows_as_a_low_pass_filter():
    tracked = tracker(time_constant=10.0, max_rate=1.0)
    target = turned([0.0, math.radians(0.1), 0.0])
    assert set(feed(tracked, target, 10.0)) == {None}
    assert degrees_from(tracked, target) == pytest.approx(0.1 * math.exp(-1), rel=1e-3)
    assert math.degrees(tracked.drift) == pytest.approx(0.1 * (1 - math.exp(-1)), rel=1e-3)


def test_a_slow_drift_is_followed_closely():
    tracked = tracker(time_constant=5.0)
    speed = math.radians(0.3) / 600  # 0.3° in ten minutes
    for k in range(600 * 2):
        assert tracked.add(k * SECOND // 2, turned([speed * k / 2, 0, 0]), GOOD) is None
    assert degrees_from(tracked, turned([speed * 600, 0, 0])) < 0.005


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3 * SECOND), st.tuples(*3 * [st.floats(-0.3, 0.3)])),
                max_size=40))
def test_rate_and_total_are_bounded_whatever_comes(measurements):
    tracked = tracker(time_constant=0.1, jump=0.2, max_rate=0.004, max_drift=0.01)
    stamp = 0
    for wait, vector in measurements:
        stamp += wait
        before = tracked.rotation
        tracked.add(stamp, turned(vector), GOOD)
        moved = rotations.angle(tracked.rotation @ before.T)
        assert moved <= 0.004 * wait / SECOND + 1e-9
        assert tracked.drift <= 0.01 + 1e-9


def test_the_bound_is_reported():
    tracked = tracker(time_constant=1.0, max_rate=1.0, max_drift=0.001)
    outcomes = feed(tracked, turned([0.003, 0, 0]), 5.0)
    assert outcomes[-1].cause == 'calibration_drift'
    assert tracked.drift == pytest.approx(0.001)
    feed(tracked, START, 20.0, start=6.0)  # and it comes back
    assert tracked.drift < 1e-5


def test_a_jump_is_reported_and_never_adopted():
    tracked = tracker()
    feed(tracked, turned([0.0005, 0, 0]), 10.0)
    before = tracked.rotation
    outcomes = feed(tracked, turned([0, 0, math.radians(0.25)]), 60.0, start=11.0)
    assert {drop.cause for drop in outcomes} == {'calibration_jump'}
    assert 'left out' in outcomes[0].detail
    assert 'calibrate anew' in outcomes[-1].detail
    assert tracked.knocked
    np.testing.assert_array_equal(tracked.rotation, before)
    assert feed(tracked, before, 0.0, start=80.0) == [None]
    assert not tracked.knocked


def test_an_outlier_is_not_a_knock():
    tracked = tracker()
    for k in range(50):
        outlier = k % 3 == 0
        away = turned([0.1, 0, 0]) if outlier else START
        outcome = tracked.add(k * SECOND, away, GOOD)
        assert (outcome is None) != outlier
        assert not tracked.knocked
    np.testing.assert_allclose(tracked.rotation, START, atol=1e-12)


@pytest.mark.parametrize('sigma', [math.radians(0.06), math.nan, math.inf])
def test_what_is_uncertain_is_not_followed(sigma):
    tracked = tracker(max_rate=1.0)
    tracked.add(0, START, GOOD)
    assert tracked.add(SECOND, turned([0.001, 0, 0]), sigma).cause == 'calibration_uncertain'
    assert tracked.add(SECOND, np.full((3, 3), np.nan), GOOD).cause == 'calibration_uncertain'
    np.testing.assert_array_equal(tracked.rotation, START)


def test_time_that_runs_backward_or_stops_for_long():
    tracked = tracker(time_constant=1.0, max_rate=0.001)
    target = turned([0.003, 0, 0])
    tracked.add(100 * SECOND, target, GOOD)
    tracked.add(50 * SECOND, target, GOOD)
    assert tracked.drift < 1e-12
    tracked.add(1000 * SECOND, target, GOOD)
    assert tracked.drift == pytest.approx(0.001)  # as if a second had passed
