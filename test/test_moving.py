"""What moves: marked, and never called far; what is at rest is not marked."""
from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from analytic_world import View, World, _noise, look, true_pose
from test_floor import seen

from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import AlignedWindow, Frame, FrameKey, RangeImage, Reference
from sphstereo_ros.core.joint import Measurement
from sphstereo_ros.core.matching import flow_matcher
from sphstereo_ros.core.moving import cleaned, moving_parts
from sphstereo_ros.core.range_memory import Remembered
from sphstereo_ros.core.stereo import SphericalStereo

HEIGHT, STEP, COUNT, PERIOD = 280, 0.28, 6, 33_333_333
WORLD = World(posts=())
DOWN = np.array([0.0, 1, 0])
ABOVE, BESIDE, BELOW = (95, 400), (140, 420), (200, 420)  # rows and columns of a patch's centre


@cache
def still() -> tuple[View, ...]:
    """Views of a camera that drives forward through a room at rest."""
    return tuple(look(WORLD, (0, 0, STEP * (i - COUNT)), height=HEIGHT) for i in range(COUNT))


def inside(at: tuple[float, float], size: int = 17) -> np.ndarray:
    """Pixels of a square patch."""
    v, u = np.mgrid[0:HEIGHT, 0:2 * HEIGHT]
    return (np.abs(v - at[0]) < size) & (np.abs(u - at[1]) < size)


def with_patch(view: View, at: tuple[float, float]) -> np.ndarray:
    """The picture with a textured patch over it."""
    v, u = np.mgrid[0:HEIGHT, 0:2 * HEIGHT].astype(float)
    points = np.stack([v - at[0], u - at[1], 0 * v], -1)
    grey = 128 + sum(weight * _noise(points / cell, seed) for seed, (cell, weight) in enumerate(
        ((12.0, 150.0), (6.0, 100.0), (3.0, 50.0))))
    return np.where(inside(at), np.clip(grey, 0, 255), view.image).astype(np.uint8)


def ranged(at: tuple[float, float], speed: tuple[float, float], **parameters: object
           ) -> tuple[RangeImage, np.ndarray, np.ndarray]:
    """The last range image with a patch that ends at `at` and moves by `speed` (rows, columns) a
    frame; where the patch is, and the range of the room.
    """
    stereo = SphericalStereo(resolve({'stereo.matcher': 'joint', 'baseline.source': 'odometry',
                                      **parameters}))
    frames, found = [], None
    for i, view in enumerate(still()):
        place = (at[0] + speed[0] * (i + 1 - COUNT), at[1] + speed[1] * (i + 1 - COUNT))
        frames.append(Frame(FrameKey((i + 1) * PERIOD, 'camera_optical'),
                            with_patch(view, place)))
        references = tuple(Reference(frames[i - back], true_pose(still()[i - back], view))
                           for back in (1, 4) if back <= i)
        if references:
            found = stereo.process(AlignedWindow(frames[i], references))
    assert isinstance(found, RangeImage)
    return found, inside(at), still()[-1].range


def marked(found: RangeImage) -> np.ndarray:
    assert found.moving is not None
    assert (found.moving.shape, found.moving.dtype) == (found.range.shape, np.uint8)
    assert set(np.unique(found.moving)) <= {0, 255}
    return found.moving == 255


@pytest.mark.parametrize(('at', 'speed'), [
    (BESIDE, (3.0, 0.0)), (BESIDE, (-3.0, 0.0)),  # across the meridians, which are level here
    (ABOVE, (0.0, -2.5)), (BESIDE, (0.0, -3.0))])  # backward along them
def test_what_no_resting_point_could_do_is_marked_and_unknown(at, speed):
    found, patch, exact = ranged(at, speed)
    moves = marked(found)
    assert moves[patch].mean() > 0.7
    assert moves[~inside(at, 25)].mean() < 0.003
    assert np.isnan(found.range[moves]).all()
    assert np.isnan(found.sigma[moves]).all()
    with np.errstate(invalid='ignore'):
        assert not (found.range[patch] > 1.2 * exact[patch]).any()


def test_a_room_at_rest_is_not_marked():
    """A patch that moves as a point of the wall, too."""
    found, _, exact = ranged((-100.0, -100.0), (0, 0))
    assert marked(found).mean() < 0.001
    assert np.isfinite(found.range).mean() > 0.7
    known = np.isfinite(found.range)
    assert np.median(np.abs(found.range / exact - 1)[known]) < 0.01


def test_what_keeps_pace_under_the_horizon_is_not_called_far():
    """No parallax at all: by itself it would be at infinity, which no floor lets be seen."""
    found, patch, exact = ranged(BELOW, (0.0, 0.0))
    assert marked(found)[patch].mean() > 0.7
    assert marked(found)[~inside(BELOW, 25)].mean() < 0.003
    assert not np.isposinf(found.range[patch]).any()
    with np.errstate(invalid='ignore'):
        assert not (found.range[patch] > 1.35 * exact[patch]).any()


def test_block_matching_knows_the_floor_alone():
    assert ranged(BESIDE, (3.0, 0.0), **{'stereo.matcher': 'joint_fast'})[0].moving is not None


@pytest.mark.parametrize('matcher', ['hybrid', 'bm'])
def test_pair_by_pair_cannot_tell(matcher):
    stereo = SphericalStereo(resolve({'stereo.matcher': matcher}))
    view, before = still()[1], still()[0]
    found = stereo.process(AlignedWindow(Frame(FrameKey(1, ''), view.image), (
        Reference(Frame(FrameKey(0, ''), before.image), true_pose(before, view)),)))
    assert isinstance(found, RangeImage)
    assert found.moving is None


def test_the_vehicle_does_not_move():
    mask = np.uint8(255) * inside(BELOW, 20)
    stereo = SphericalStereo(resolve({'stereo.matcher': 'joint'}), mask)
    frames = [Frame(FrameKey((i + 1) * PERIOD, ''), with_patch(v, BELOW))
              for i, v in enumerate(still()[:4])]
    for i in (1, 2, 3):
        found = stereo.process(AlignedWindow(frames[i], (
            Reference(frames[i - 1], true_pose(still()[i - 1], still()[i])),)))
    assert isinstance(found, RangeImage)
    assert not marked(found)[mask != 0].any()


@pytest.mark.parametrize('shift', [0.0, 2.5, -4.0])
def test_flow_says_how_far_it_leaves_the_meridian(shift):
    rows, columns = np.mgrid[0:160, 0:160].astype(float)
    now, then = (np.clip(128 + 150 * _noise(np.stack([r / 9, columns / 9, 0 * r], -1), 0), 0, 255)
                 .astype(np.uint8) for r in (rows, rows + shift))
    found = flow_matcher('fast', 1, 40.0, (0.1, 2.0))(now, then)
    assert found.across is not None
    assert found.across.shape == found.sigma.shape == (80, 80)
    assert np.median(found.across[10:-10, 10:-10]) == pytest.approx(-shift, abs=0.15)


def test_a_speck_under_the_floor_is_wrong_but_does_not_move():
    """A mirror image, an error of the match."""
    rho, sigma, _ = seen()
    known = Remembered(rho.copy(), sigma.copy(), np.ones_like(rho))
    known.rho[140, 100] = 1 / 100
    known.sigma[140, 100] = 1e-3
    new = Measurement(rho, sigma, rho.copy(), np.ones(rho.shape, np.int8), sigma,
                      0 * sigma)
    wrong, moving = moving_parts(known, new, DOWN)
    assert np.argwhere(wrong).tolist() == [[140, 100]]
    assert not moving.any()
    seen_there = new.other.copy()
    new.rho[130:150, 90:110] = new.other[130:150, 90:110] = 1 / 100
    wrong, moving = moving_parts(known, new, DOWN)
    assert (moving[130:150, 90:110] == 255).all()
    assert wrong[moving == 255].all()
    new.other[:] = seen_there  # a second opinion that knows nothing of it
    assert not moving_parts(known, new, DOWN)[1].any()


def test_the_roof_of_what_keeps_pace_is_not_told_as_the_house_behind():
    rho, sigma, bearings = seen()
    along = np.hypot(bearings[..., 0], bearings[..., 2])
    rho = np.maximum(rho, along / 15).astype(np.float32)  # a house all around
    sigma = np.float32(0.03) * rho
    over_floor = 1.7 - 3 * bearings[..., 1] / along  # m, 3 m away
    beside = np.abs(np.arctan2(bearings[..., 2], bearings[..., 0])) < 0.4
    body, roof = (beside & (over_floor > low) & (over_floor < high)
                  for low, high in ((0, 0.8), (0.8, 1.2)))
    rho[body] = 0
    known = Remembered(rho, sigma, np.ones_like(rho))
    new = Measurement(rho, sigma, rho.copy(), np.ones(rho.shape, np.int8), sigma,
                      0 * sigma)
    wrong, moving = moving_parts(known, new, DOWN)
    assert (moving[body] == 255).mean() > 0.9
    assert (moving[roof] == 255).mean() < 0.5
    assert wrong[roof].mean() > 0.95
    assert wrong[~beside].mean() < 0.02
    wrong, _ = moving_parts(known, new, DOWN, metric=False)  # how tall is that, in steps?
    assert (wrong == (moving != 0))[roof].all()


def test_specks_go_and_gaps_close_over_the_seam():
    mask = np.zeros((60, 120), np.uint8)
    mask[10, 20] = mask[30:32, 50:52] = 255
    mask[20:40, -8:] = mask[20:40, :8] = 255
    mask[29:31, :] = 0
    out = cleaned(mask)
    assert not out[:, 15:100].any()
    assert (out[22:38, -5:] == 255).all()
    assert (out[22:38, :5] == 255).all()
