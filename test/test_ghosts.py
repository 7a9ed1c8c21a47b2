"""Nothing that left is remembered for more than half a second."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.core.config import PARAMETERS, RangeConfig
from sphstereo_ros.core.frames import Frame, FrameKey, Reference, RelativePose
from sphstereo_ros.core.inverse_range import NOTHING, InverseRange, published_range
from sphstereo_ros.core.joint import Measurement
from sphstereo_ros.core.range_memory import RangeMemory, Remembered

ROWS = 60
LONGEST = 500_000_000  # ns
SECONDS = PARAMETERS['stereo.memory'].default
NEAR = 0.2  # 1/m
PATCH = (slice(20, 40), slice(50, 80))


def measurement(rho: float, sigma: float, told: float, frames: int) -> Measurement:
    """A wall 20 m away, and in PATCH what is given."""
    full = np.full((ROWS, 2 * ROWS), 1 / 20, np.float32)
    found = Measurement(full, np.full_like(full, 0.002), full.copy(),
                        np.ones(full.shape, np.int8), np.full_like(full, 0.001),
                        np.zeros_like(full))
    for image, value in ((found.rho, rho), (found.sigma, sigma), (found.told, told),
                         (found.frames, frames)):
        image[PATCH] = value
    return found


class Camera:
    """One that drives very slowly, so that nothing but time matters."""

    def __init__(self, period: int) -> None:
        self.memory = RangeMemory(SECONDS)
        self.period, self.stamp = period, 0

    def see(self, new: Measurement) -> Remembered:
        before, self.stamp = self.stamp, self.stamp + self.period
        pose = RelativePose(np.eye(3), np.array([0, 0, -0.002]))
        image = np.zeros((ROWS, 2 * ROWS), np.uint8)
        return self.memory.fused(FrameKey(self.stamp, ''), (
            Reference(Frame(FrameKey(before, ''), image), pose),), new)


def near(known: Remembered) -> float:
    """The share of PATCH that is published as near."""
    r, _ = published_range(InverseRange(known.rho, known.sigma, True), RangeConfig(), True)
    with np.errstate(invalid='ignore'):
        return float((r[PATCH] < 10).mean())


@pytest.mark.parametrize('period', [33_333_333, 83_333_333])
@pytest.mark.parametrize('after', [
    measurement(0.05, 0.002, 0.05, 1),  # what is behind
    measurement(0.0, 0.01, 0.0, 1),  # sky with clouds
    measurement(0.0, 0.05, 0.0, 1),
    measurement(0.0, 0.5, 0.0, 1),  # sky, of which nothing can be told
    measurement(0.05, 0.2, 0.05, 1),
    measurement(0.05, 0.2, 0.05, 0),
    measurement(0.05, 0.002, NEAR, 0),  # the second opinion keeps to what was there
    measurement(NEAR, 0.5, 0.0, 0),  # so does the refinement, of which nothing can be told
    measurement(0.0, NOTHING, 0.0, 0)])
def test_what_left_is_gone_within_half_a_second(period, after):
    camera = Camera(period)
    for _ in range(20):
        known = camera.see(measurement(NEAR, 0.004, NEAR, 1))
    assert near(known) == 1
    for _ in range(LONGEST // period):
        known = camera.see(after)
    assert near(known) == 0


def test_what_stays_is_kept_through_a_short_gap():
    camera = Camera(33_333_333)
    for _ in range(20):
        camera.see(measurement(NEAR, 0.004, NEAR, 1))
    for _ in range(5):
        known = camera.see(measurement(NEAR, 0.01, NEAR, 0))
    assert near(known) == 1


def test_what_is_far_and_barely_told_is_confirmed_all_the_same():
    """At 40 m a sigma of 10 m is usual."""
    camera = Camera(33_333_333)
    rng = np.random.default_rng(0)
    for _ in range(30):
        new = measurement(0.0, 0.007, 0.0, 1)
        new.rho[PATCH] = 1 / 40 + 0.007 * rng.normal(size=new.rho[PATCH].shape)
        known = camera.see(new)
    assert (known.sigma[PATCH] < NOTHING).mean() > 0.9
    assert np.median(known.rho[PATCH]) == pytest.approx(1 / 40, rel=0.1)
