"""Alignment of two cameras: exact bearings, small pictures with known truth, refusals."""
from __future__ import annotations

import json
import math
import os
from functools import cache
from pathlib import Path

import analytic_world
import cv2
import numpy as np
import pytest
from analytic_world import World
from hypothesis import given, settings
from hypothesis import strategies as st
from two_views import angle_between, correspondences, matches, unit

from sphstereo_ros.core import rotations
from sphstereo_ros.core.calibration import (
    AlignmentCalibration,
    CalibrationResult,
    PairFit,
    configured_pose,
    estimate_alignment,
)
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, Frame, FrameKey
from sphstereo_ros.core.relative_pose import Correspondences, PoseEstimate

UP = np.array([0.0, -1.0, 0.0])  # optical
BASELINE = 0.35
FIVE = math.radians(5)
small_angles = st.tuples(*3 * [st.floats(-FIVE, FIVE)])
seeds = st.integers(0, 2**32 - 1)


def turned(rpy) -> np.ndarray:
    """bottom ← top, optical."""
    link = rotations.matrix_from_rpy(*rpy)
    return rotations.OPTICAL_FROM_LINK @ link @ rotations.OPTICAL_FROM_LINK.T


def seen(rng, rpy, count=2500, direction=UP, **more) -> Correspondences:
    return correspondences(rng, count, turned(rpy), BASELINE * unit(direction), **more)


def told(points: Correspondences, start=(0.0, 0.0, 0.0), pairs=1, *, estimate_direction=False,
         **parameters) -> CalibrationResult | Drop:
    """What `pairs` pairs with the same correspondences tell."""
    calibration = AlignmentCalibration(resolve(parameters), estimate_direction=estimate_direction)
    calibration.fits += pairs * [PairFit(turned(start), points, 1e-4)]
    return calibration.result()


# Exact bearings

@settings(max_examples=25, deadline=None)
@given(seeds, small_angles)
def test_exact_bearings_give_the_exact_angles(seed, rpy):
    points = seen(np.random.default_rng(seed), rpy)
    found = AlignmentCalibration(resolve({})).from_points(points)
    np.testing.assert_allclose(rotations.top_rpy(found.rotation), rpy, atol=1e-6)
    result = told(points)
    np.testing.assert_allclose(result.rpy, rpy, atol=1e-6)
    assert result.residual < 1e-3
    assert result.pairs == 1


@settings(max_examples=15, deadline=None)
@given(seeds, small_angles, st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)))
def test_the_direction_may_be_given_or_estimated(seed, rpy, aside):
    link = np.array([*aside, 1.0])
    direction = rotations.OPTICAL_FROM_LINK @ link
    points = seen(np.random.default_rng(seed), rpy, direction=direction)
    given_ = told(points, **{'baseline.direction': [float(x) for x in 7 * link]})
    np.testing.assert_allclose(given_.rpy, rpy, atol=1e-6)
    np.testing.assert_allclose(given_.link_direction, unit(link), atol=1e-12)
    assert not given_.direction_estimated
    found = told(points, estimate_direction=True)
    np.testing.assert_allclose(found.rpy, rpy, atol=1e-6)
    np.testing.assert_allclose(found.link_direction, unit(link), atol=1e-6)
    assert found.direction_estimated


@settings(max_examples=10, deadline=None)
@given(seeds, st.tuples(*3 * [st.floats(-1.0, 1.0)]))
def test_outliers_and_large_turns(seed, rpy):
    points = seen(np.random.default_rng(seed), rpy, outliers=0.35)
    found = AlignmentCalibration(resolve({})).from_points(points)
    assert rotations.angle(found.rotation @ turned(rpy).T) < 2e-5


def test_the_convention_is_that_of_the_parameters():
    rpy = (0.03, -0.02, 0.05)
    config = resolve(dict(zip(('camera.top.roll', 'camera.top.pitch', 'camera.top.yaw'), rpy,
                              strict=True)))
    pose = configured_pose(config, BASELINE)
    np.testing.assert_allclose(pose.rotation, turned(rpy), atol=1e-15)
    np.testing.assert_allclose(pose.direction, [0, 1, 0], atol=1e-15)  # t points straight down
    # A point ahead of the bottom camera, on the level of the top one, with the top camera yawed to
    # the left: the top one sees it on the right.
    ahead = np.array([0.0, -BASELINE, 5.0])
    seen_by_top = pose.rotation.T @ (ahead - pose.position)
    only_yaw = turned((0, 0, 0.05)).T @ (ahead - pose.position)
    np.testing.assert_allclose(only_yaw, [5 * math.sin(0.05), 0, 5 * math.cos(0.05)], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(seen_by_top), 5)


def test_the_result_is_a_pose_with_what_is_known_of_it():
    result = told(seen(np.random.default_rng(1), (0.01, 0.02, 0.03), noise=1e-3),
                  estimate_direction=True)
    pose = result.pose(0.4)
    assert pose.baseline == pytest.approx(0.4)
    np.testing.assert_allclose(pose.position, 0.4 * result.direction)
    np.testing.assert_allclose(pose.covariance[:3, :3], result.covariance[:3, :3])
    np.testing.assert_allclose(pose.covariance[3:, 3:], 0.16 * result.covariance[3:, 3:])
    assert np.linalg.eigvalsh(pose.covariance).min() > -1e-15


# Uncertainty

def test_errors_are_as_large_as_is_said():
    rng = np.random.default_rng(5)
    sharp = {'alignment.rotation_sigma': 0.0, 'calibration.max_sigma': 1.0}
    ratios = []
    for _ in range(40):
        rpy = rng.uniform(-FIVE, FIVE, 3)
        result = told(seen(rng, rpy, noise=1e-3), **sharp)
        ratios.append((result.rpy - rpy) / result.rpy_sigma)
    spread = np.sqrt(np.mean(np.square(ratios)))
    assert 0.5 < spread < 1.1  # block errors and independent ones are both counted: careful


def test_twenty_pairs_tell_more_but_the_same_picture_again_does_not():
    rng = np.random.default_rng(6)
    sharp = {'alignment.rotation_sigma': 0.0}
    one = seen(rng, (0, 0, 0), noise=1e-3)
    alone = told(one, **sharp).sigma
    again = told(one, pairs=20, **sharp).sigma
    fresh = AlignmentCalibration(resolve(sharp))
    fresh.fits = [PairFit(np.eye(3), seen(rng, (0, 0, 0), noise=1e-3), 1e-4)
                  for _ in range(20)]
    assert again > 0.6 * alone
    assert fresh.result().sigma < 0.35 * alone


def test_a_wrong_direction_shows_as_lean():
    rng = np.random.default_rng(7)
    leaning = rotations.exp([0, 0, math.radians(3)]) @ UP
    points = seen(rng, (0, 0, 0), direction=leaning, noise=3e-4, near=1.0, far=6.0)
    result = told(points, **{'calibration.max_sigma': 1.0})
    assert math.degrees(result.lean) == pytest.approx(3, abs=0.1)
    assert result.lean > 5 * result.lean_sigma
    refused = told(points)
    assert refused.cause == 'wrong_direction'
    assert 'leans by 3.0° from it, and turns the cameras by ' in refused.detail
    upright = told(seen(rng, (0, 0, 0), noise=3e-4, near=1.0, far=6.0))
    assert upright.lean < 5 * upright.lean_sigma


# What does not suffice

def part_of(points: Correspondences, keep) -> Correspondences:
    return points[keep(points.current)]


PARTS = {
    'wedge of 80°': lambda f: np.abs(np.arctan2(f[:, 0], f[:, 2])) < math.radians(40),
    'band round the horizon': lambda f: np.abs(f[:, 1]) < math.sin(math.radians(10)),
    'spot': lambda f: f[:, 2] > math.cos(math.radians(25)),
}


@pytest.mark.parametrize('part', PARTS)
def test_too_little_of_the_sphere_is_refused(part):
    points = part_of(seen(np.random.default_rng(8), (0.02, 0.01, 0), 20000), PARTS[part])
    assert len(points) > 500
    assert told(points).cause == 'too_little_of_sphere'


@pytest.mark.parametrize('keep', [lambda f: f[:, 2] > 0, lambda f: f[:, 1] > 0], ids=str)
def test_half_of_the_sphere_is_enough(keep):
    points = part_of(seen(np.random.default_rng(8), (0.02, 0.01, 0), 4000), keep)
    np.testing.assert_allclose(told(points).rpy, (0.02, 0.01, 0), atol=1e-6)


def test_a_far_scene_tells_the_rotation_but_not_the_direction():
    rng = np.random.default_rng(9)
    points = seen(rng, (0.02, -0.03, 0.01), 3000, noise=3e-4, near=200.0, far=2000.0)
    result = told(points)
    assert np.abs(result.rpy - (0.02, -0.03, 0.01)).max() < 1e-4
    assert math.isnan(result.lean)
    refused = told(points, estimate_direction=True)
    assert refused.cause == 'no_parallax'
    assert 'too far away' in refused.detail


def test_noise_that_leaves_the_angles_uncertain_is_refused():
    points = seen(np.random.default_rng(10), (0, 0, 0), noise=0.03)
    assert told(points).cause == 'calibration_uncertain'


def test_swapped_cameras_are_told():
    points = seen(np.random.default_rng(11), (0.01, 0, 0.02), near=1.0, far=8.0)
    swapped = Correspondences(points.current, points.reference, points.sigma)
    assert AlignmentCalibration(resolve({})).from_points(swapped).cause == 'cameras_swapped'
    under = AlignmentCalibration(resolve({'baseline.direction': [0.0, 0.0, -1.0]}))
    assert under.from_points(points).cause == 'cameras_swapped'
    assert isinstance(under.from_points(swapped), PoseEstimate)


def test_what_does_not_belong_together_fits_no_rotation():
    rng = np.random.default_rng(12)
    noise = matches(*unit(rng.normal(size=(2, 500, 3))))
    assert AlignmentCalibration(resolve({})).from_points(noise).cause == 'too_few_inliers'
    assert AlignmentCalibration(resolve({})).from_points(noise[:10]).cause == 'too_few_points'


def test_pairs_that_tell_different_rotations():
    rng = np.random.default_rng(13)
    calibration = AlignmentCalibration(resolve({}))
    assert calibration.result().cause == 'no_pairs'

    def take(rpy):
        calibration.fits.append(PairFit(turned(rpy), seen(rng, rpy), 1e-5))

    for angle in (0.01, 0.01, 0.01, 0.03):
        take((angle, 0, 0))
    result = calibration.result()  # the odd one is left out
    assert result.pairs == 3
    assert result.rpy[0] == pytest.approx(0.01, abs=1e-6)
    for angle in (0.05, 0.07, 0.09):
        take((angle, 0, 0))
    assert calibration.result().cause == 'pairs_disagree'


# Pictures

WORLD = World(cell=0.5)
HEIGHT = 240


@cache
def bottom_view(height=HEIGHT):
    return analytic_world.look(WORLD, height=height).image


@cache
def top_view(rpy, height=HEIGHT):
    return analytic_world.look(WORLD, BASELINE * UP, turned(rpy), height).image


def frame(image, frame_id='') -> Frame:
    return Frame(FrameKey(1, frame_id), image)


def from_pictures(top, bottom, mask=None, **parameters):
    return estimate_alignment([(frame(top, 'top'), frame(bottom, 'bottom'))], resolve(parameters),
                              mask)


def error(result: CalibrationResult, rpy) -> float:
    """Greatest of the three angles, degrees."""
    assert isinstance(result, CalibrationResult), result
    return float(np.degrees(np.abs(result.rpy - rpy)).max())


MISALIGNMENTS = [(FIVE, FIVE, FIVE), (-FIVE, FIVE, 0.0), (0.0, -FIVE, -FIVE), (0.01, 0.0, -0.02)]


@pytest.mark.parametrize('rpy', MISALIGNMENTS)
def test_one_pair_of_pictures(rpy):
    result = from_pictures(top_view(rpy), bottom_view())
    assert error(result, rpy) < 0.05
    assert np.abs(result.rpy - rpy).max() < 5 * result.rpy_sigma.max()
    assert result.share > 0.5


@pytest.mark.parametrize(('gain', 'offset', 'gamma'), [(0.5, 0, 1), (1.4, -30, 1), (0.8, 20, 1.5)])
def test_another_exposure_changes_nothing(gain, offset, gamma):
    rpy = MISALIGNMENTS[0]
    curve = np.clip(gain * 255 * (np.arange(256) / 255)**gamma + offset, 0, 255).astype(np.uint8)
    assert error(from_pictures(curve[top_view(rpy)], bottom_view()), rpy) < 0.05


@pytest.mark.parametrize('yaw', [0.7, -2.0, math.pi - 0.01])
def test_a_camera_that_looks_elsewhere(yaw):
    rpy = (0.02, -0.03, yaw)
    result = from_pictures(top_view(rpy), bottom_view())
    assert error(result, rpy) < 0.05


def test_a_prior_is_where_the_search_begins():
    rpy = (0.02, -0.03, 2.5)
    prior = {f'camera.top.{n}': a for n, a in zip(('roll', 'pitch', 'yaw'), (0.0, 0.0, 2.45),
                                                  strict=True)}
    assert error(from_pictures(top_view(rpy), bottom_view(), **prior), rpy) < 0.05


def test_the_direction_from_pictures():
    rpy = MISALIGNMENTS[2]
    calibration = AlignmentCalibration(resolve({}), estimate_direction=True)
    calibration.add(frame(top_view(rpy)), frame(bottom_view()))
    result = calibration.result()
    assert error(result, rpy) < 0.08
    assert math.degrees(angle_between(result.direction, UP)) < 0.3


def test_what_stays_in_the_picture_is_masked():
    """A vehicle that both cameras see in the same place tells of no rotation."""
    rpy = MISALIGNMENTS[1]
    rng = np.random.default_rng(3)
    vehicle = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, 2 * HEIGHT), np.uint8), (5, 5), 1.5)
    mask = np.zeros((HEIGHT, 2 * HEIGHT), np.uint8)
    mask[HEIGHT // 2:, HEIGHT // 5:HEIGHT * 9 // 5] = 255
    top, bottom = (np.where(mask, vehicle, im) for im in (top_view(rpy), bottom_view()))
    result = from_pictures(top, bottom, cv2.resize(mask, (300, 150)))
    assert error(result, rpy) < 0.05
    without = from_pictures(top, bottom)
    assert isinstance(without, Drop) or error(without, rpy) > 1


def test_pictures_without_texture_or_of_other_places_are_refused():
    blank = np.full((HEIGHT, 2 * HEIGHT), 90, np.uint8)
    refused = from_pictures(blank, blank)
    assert refused.cause == 'too_few_points'
    elsewhere = analytic_world.look(World(cell=0.31), (0.7, 0.2, 3.0), height=HEIGHT).image
    assert from_pictures(elsewhere, bottom_view()).cause == 'too_few_inliers'
    assert from_pictures(bottom_view()[::2, ::2], bottom_view()).cause == 'size_changed'


def test_a_spot_of_texture_is_too_little():
    rpy = MISALIGNMENTS[3]
    blank = np.full((HEIGHT, 2 * HEIGHT), 90, np.uint8)
    top, bottom = blank.copy(), blank.copy()
    for image, full in ((top, top_view(rpy)), (bottom, bottom_view())):
        image[HEIGHT // 3:HEIGHT * 2 // 3, HEIGHT * 2 // 3:HEIGHT * 4 // 3] = \
            full[HEIGHT // 3:HEIGHT * 2 // 3, HEIGHT * 2 // 3:HEIGHT * 4 // 3]
    assert from_pictures(top, bottom).cause in (
        'too_little_of_sphere', 'too_few_points', 'too_few_inliers')


def test_the_same_input_gives_the_same_output():
    rpy = MISALIGNMENTS[0]
    first, second = (from_pictures(top_view(rpy), bottom_view()) for _ in range(2))
    np.testing.assert_array_equal(first.rotation, second.rotation)
    np.testing.assert_array_equal(first.covariance, second.covariance)


@pytest.mark.skipif('SPHSTEREO_GROUND_TRUTH' not in os.environ,
                    reason='SPHSTEREO_GROUND_TRUTH is unset')
def test_a_pair_rendered_elsewhere():
    folder = Path(os.environ['SPHSTEREO_GROUND_TRUTH']) / 'binocular'
    if not folder.is_dir():
        pytest.skip(f'{folder} is not there')
    meta = json.loads((folder / 'meta.json').read_text())
    for pair in meta['pairs']:
        top, bottom = (cv2.imread(str(folder / meta['frames'][pair[side]]['image']),
                                  cv2.IMREAD_GRAYSCALE) for side in ('top', 'bottom'))
        result = from_pictures(top, bottom)
        assert error(result, np.radians(pair['top_in_bottom_rpy_deg'])) < 0.02
