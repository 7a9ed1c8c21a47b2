from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from two_views import (
    MOTIONS,
    angle_between,
    correspondences,
    matches,
    random_rotation,
    unit,
)

from sphstereo_ros.core import rotations
from sphstereo_ros.core.config import PoseConfig
from sphstereo_ros.core.five_point import decompose
from sphstereo_ros.core.frames import Drop, RelativePose
from sphstereo_ros.core.relative_pose import (
    Correspondences,
    PoseEstimate,
    cells_of,
    epipolar_residuals,
    in_front,
    parallax,
    ransac,
    refine,
    rotation_between,
    tangent,
    weighted_by_neighbours,
)
from sphstereo_ros.core.stabilisation import estimate, with_length

seeds = st.integers(0, 2**32 - 1)
THRESHOLD = 0.003


def rotation_error(a: np.ndarray, b: np.ndarray) -> float:
    return rotations.angle(a @ b.T)


@given(seeds, st.floats(0, 3.1))
@settings(deadline=None)
def test_residuals_of_exact_views_are_zero(seed, angle):
    rng = np.random.default_rng(seed)
    rotation, position = random_rotation(rng, angle), unit(rng.normal(size=3))
    points = correspondences(rng, 50, rotation, position)
    np.testing.assert_allclose(epipolar_residuals(rotation, position, points), 0, atol=1e-9)
    assert in_front(rotation, position, points).all()


def test_residual_is_the_angle_to_the_epipolar_plane():
    """All around, in front and behind, an error across the plane counts as the same angle."""
    rng = np.random.default_rng(0)
    position = unit([0.2, 0.1, -1.0])
    exact = correspondences(rng, 200, np.eye(3), position)
    normal = unit(np.cross(position, exact.reference))
    for error in (1e-3, -0.2):
        moved = np.cos(error) * exact.current + np.sin(error) * normal
        got = epipolar_residuals(np.eye(3), position, matches(exact.reference, moved))
        np.testing.assert_allclose(got, np.sin(error), atol=1e-12)


def test_residuals_at_the_epipole_are_finite():
    points = matches(np.array([[0.0, 0, 1]]), np.array([[0.0, 0, 1]]))
    assert epipolar_residuals(np.eye(3), np.array([0.0, 0, 1]), points) == [0.0]


@given(seeds, st.floats(0, 3.1))
@settings(deadline=None)
def test_in_front_holds_for_one_of_the_four_poses(seed, angle):
    rng = np.random.default_rng(seed)
    rotation, position = random_rotation(rng, angle), unit(rng.normal(size=3))
    points = correspondences(rng, 30, rotation, position)
    poses = decompose(rotations.skew(position) @ rotation)
    counts = [int(in_front(r, p, points).sum()) for r, p in poses]
    best = int(np.argmax(counts))
    assert counts[best] == 30
    assert sorted(counts)[-2] < 30
    assert rotation_error(poses[best][0], rotation) < 1e-6
    assert angle_between(poses[best][1], position) < 1e-6


def test_parallax_is_what_rotation_does_not_explain():
    rng = np.random.default_rng(0)
    rotation = random_rotation(rng, 1.0)
    far = correspondences(rng, 20, rotation, np.zeros(3))
    np.testing.assert_allclose(parallax(rotation, far), 0, atol=1e-7)
    # 1 m to the side of a point 2 m ahead: atan(1/2)
    one = matches(unit([[1.0, 0, 2]]) @ rotation, np.array([[0.0, 0, 1]]))
    assert parallax(rotation, one) == pytest.approx([np.arctan(0.5)])


@given(seeds, st.floats(0, 3.1))
@settings(deadline=None)
def test_rotation_between_far_views(seed, angle):
    rng = np.random.default_rng(seed)
    rotation = random_rotation(rng, angle)
    points = correspondences(rng, 20, rotation, np.zeros(3))
    np.testing.assert_allclose(rotation_between(points), rotation, atol=1e-9)
    noisy = correspondences(rng, 500, rotation, np.zeros(3), noise=1e-3)
    assert rotation_error(rotation_between(noisy), rotation) < 5e-4


def test_tangent_spans_the_plane_across():
    for direction in unit(np.random.default_rng(0).normal(size=(20, 3))):
        basis = np.column_stack([tangent(direction), direction])
        np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('outliers', [0.0, 0.3, 0.4])
def test_ransac_and_refinement_find_the_motion_among_outliers(motion, outliers):
    rng = np.random.default_rng(5)
    position, rotation = unit(MOTIONS[motion]), random_rotation(rng, 0.05)
    points = correspondences(rng, 800, rotation, position, noise=5e-4, outliers=outliers)
    found = ransac(points, THRESHOLD, np.random.default_rng(1))
    assert found is not None
    assert np.degrees(rotation_error(found[0], rotation)) < 1.0
    assert np.degrees(angle_between(found[1], position)) < 5.0
    pose = refine(*found, points)
    assert pose is not None
    assert np.degrees(rotation_error(pose.rotation, rotation)) < 0.02
    assert np.degrees(angle_between(pose.direction, position)) < 0.15
    wrong = round(outliers * 800)
    assert pose.inliers[wrong:].mean() > 0.95
    assert pose.inliers[:wrong].mean() < 0.05 if wrong else True


def test_ransac_is_decided_by_the_generator():
    rng = np.random.default_rng(6)
    points = correspondences(rng, 300, random_rotation(rng, 0.1), unit([1, 1, 0]), noise=1e-3,
                             outliers=0.3)
    first, again, other = (ransac(points, THRESHOLD, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert np.abs(first[1] - other[1]).max() > 0  # the noise of another sample


@pytest.mark.parametrize('motion', MOTIONS)
def test_refinement_reaches_the_exact_motion(motion):
    rng = np.random.default_rng(7)
    position, rotation = unit(MOTIONS[motion]), random_rotation(rng, 0.05)
    points = correspondences(rng, 300, rotation, position)
    start = unit(position + 0.1 * rng.normal(size=3))
    pose = refine(random_rotation(rng, 0.02) @ rotation, start, points, iterations=20)
    assert pose is not None
    assert rotation_error(pose.rotation, rotation) < 1e-7
    assert angle_between(pose.direction, position) < 1e-7
    assert pose.inliers.all()


def test_matches_that_are_expected_to_be_worse_count_less():
    rng = np.random.default_rng(8)
    position, rotation = unit([1, 0, 1]), random_rotation(rng, 0.05)
    errors = {'told': [], 'not told': []}
    for _ in range(40):
        good = correspondences(rng, 150, rotation, position, noise=1e-4)
        poor = correspondences(rng, 150, rotation, position, noise=2e-3)
        both = [np.concatenate(p) for p in ((good.reference, poor.reference),
                                            (good.current, poor.current))]
        for name, sigma in (('told', 2e-3), ('not told', 1e-4)):
            sigmas = np.repeat([1e-4, sigma], 150)
            pose = refine(rotation, position, Correspondences(*both, sigmas))
            errors[name].append(angle_between(pose.direction, position))
    assert np.median(errors['told']) < 0.75 * np.median(errors['not told'])


def test_part_of_the_correspondences_keeps_their_sigmas():
    points = correspondences(np.random.default_rng(0), 10, np.eye(3), unit([1, 0, 0]))
    points = Correspondences(points.reference, points.current, np.arange(10.0))
    part = points[np.array([7, 2])]
    assert len(part) == 2
    np.testing.assert_array_equal(part.sigma, [7, 2])
    np.testing.assert_array_equal(part.current, points.current[[7, 2]])


def monte_carlo(motion: str, trials: int = 150) -> tuple[np.ndarray, list[PoseEstimate]]:
    """Errors (trials, 5) of the estimates, in the parameters of their covariance."""
    rng = np.random.default_rng(9)
    position, rotation = unit(MOTIONS[motion]), random_rotation(rng, 0.05)
    poses, errors = [], []
    for _ in range(trials):
        points = correspondences(rng, 150, rotation, position, noise=1e-3)
        pose = refine(rotation, position, points, iterations=15)
        small = rotations.log(pose.rotation @ rotation.T)
        errors.append(np.concatenate([small, tangent(pose.direction).T
                                      @ (pose.direction - position)]))
        poses.append(pose)
    return np.array(errors), poses


@pytest.mark.parametrize('motion', ['forward', 'left', 'oblique'])
def test_covariance_is_that_of_repeated_estimates(motion):
    errors, poses = monte_carlo(motion)
    predicted = np.mean([p.covariance for p in poses], axis=0)
    ratio = np.mean(errors**2, axis=0) / np.diag(predicted)
    assert (ratio < 1.5).all()
    assert (ratio > 0.5).all()
    # Also together: the errors' Mahalanobis distances are those of five Gaussians.
    squared = [e @ np.linalg.solve(p.covariance, e) for e, p in zip(errors, poses, strict=True)]
    assert 0.5 * 5 < np.mean(squared) < 1.6 * 5
    assert np.mean([p.residual for p in poses]) == pytest.approx(1e-3 * np.sqrt(2), rel=0.3)


@pytest.mark.parametrize('seed', range(5))
def test_neighbours_that_contradict_count_less(seed):
    """What is matched in one place errs across the meridians, too little to be an outlier."""
    rng = np.random.default_rng(seed)
    rotation, position = random_rotation(rng, 0.02), unit([0.1, 0.0, -1.0])
    points = correspondences(rng, 1500, rotation, position, noise=1e-4)
    longitude = np.arctan2(points.current[:, 1], points.current[:, 0])
    cells = cells_of(np.stack([longitude + np.pi, points.current[:, 2] + 1], axis=1), 1)
    slipping = cells == 3
    across = unit(np.cross(position, points.current))
    slipped = unit(points.current + 4e-4 * slipping[:, None] * across)
    points = Correspondences(points.reference, slipped, points.sigma)
    first = refine(rotation, position, points)
    weighted = weighted_by_neighbours(points, cells, first)
    assert weighted.sigma[slipping].min() > 1.5 * weighted.sigma[~slipping].max()
    second = refine(first.rotation, first.direction, weighted)
    assert rotation_error(second.rotation, rotation) < 0.5 * rotation_error(first.rotation,
                                                                            rotation)


def test_cells_are_squares():
    pixels = np.array([[0, 0], [9.9, 0], [10, 0], [0, 10], [35, 10]], np.float32)
    assert cells_of(pixels, 10).tolist() == [0, 0, 1, 4, 7]
    assert cells_of(np.zeros((0, 2), np.float32), 10).tolist() == []


def test_covariance_of_six_has_no_share_along_the_direction():
    _, (pose, *_) = monte_carlo('oblique', trials=1)
    assert pose.covariance6.shape == (6, 6)
    np.testing.assert_allclose(pose.covariance6[3:] @ np.r_[0, 0, 0, pose.direction], 0,
                               atol=1e-15)
    np.testing.assert_allclose(pose.covariance6[:3, :3], pose.covariance[:3, :3])
    assert np.trace(pose.covariance6) == pytest.approx(np.trace(pose.covariance))


@pytest.mark.parametrize('length', [1.0, 0.1, 20.0])
def test_the_estimate_takes_the_length_of_the_prior(length):
    """The position and its covariance grow with the length; the direction's angle does not."""
    _, (pose, *_) = monte_carlo('oblique', trials=1)
    prior = RelativePose(np.eye(3), np.array([0, 0, -length]))
    got = with_length(pose, prior)
    np.testing.assert_allclose(got.position, length * pose.direction)
    np.testing.assert_array_equal(got.rotation, pose.rotation)
    scale = np.repeat([1.0, length], 3)
    np.testing.assert_allclose(got.covariance, pose.covariance6 * np.outer(scale, scale))
    # The prior's uncertainty of the length, not of its direction, comes on top.
    sure = replace(prior, covariance=np.diag([1.0] * 5 + [0.0]))
    np.testing.assert_allclose(with_length(pose, sure).covariance, got.covariance)
    unsure = with_length(pose, replace(prior, covariance=np.diag([0.0] * 5 + [0.04])))
    np.testing.assert_allclose(unsure.covariance[3:, 3:] - got.covariance[3:, 3:],
                               0.04 * np.outer(pose.direction, pose.direction), atol=1e-12)


def far_views(rng: np.random.Generator, rotation: np.ndarray, noise: float) -> Correspondences:
    return correspondences(rng, 300, rotation, np.zeros(3), noise=noise)


class TestDegenerate:
    """No pose is a None or a named drop, never an exception and never an identity."""

    def test_the_same_point_over_and_over(self):
        one = np.tile([[0.0, 0.6, 0.8]], (100, 1))
        points = matches(one, one.copy())
        assert refine(np.eye(3), np.array([1.0, 0, 0]), points) is None
        assert estimate(points, PoseConfig()).cause == 'no_parallax'

    @pytest.mark.parametrize('count', [0, 1, 4, 59])
    def test_too_few_points(self, count):
        points = correspondences(np.random.default_rng(0), count, np.eye(3), unit([1, 0, 0]))
        assert estimate(points, PoseConfig(min_inliers=60)).cause == 'too_few_points'

    @pytest.mark.parametrize('count', [1, 2, 4])
    def test_fewer_than_five_points_fix_no_pose(self, count):
        points = correspondences(np.random.default_rng(0), count, np.eye(3), unit([1, 0, 0]))
        assert refine(np.eye(3), unit([1, 0.1, 0]), points) is None

    @pytest.mark.parametrize('angle', [0.0, 0.02, 1.0])
    @pytest.mark.parametrize('noise', [0.0, 1e-4])
    def test_pure_rotation_and_hover(self, angle, noise):
        rng = np.random.default_rng(0)
        points = far_views(rng, random_rotation(rng, angle), noise)
        drop = estimate(points, PoseConfig())
        assert isinstance(drop, Drop)
        assert drop.cause == 'no_parallax'

    def test_unrelated_bearings(self):
        rng = np.random.default_rng(0)
        points = matches(*unit(rng.normal(size=(2, 400, 3))))
        assert estimate(points, PoseConfig()).cause == 'too_few_inliers'

    def test_too_small_a_share_of_inliers(self):
        rng = np.random.default_rng(0)
        points = correspondences(rng, 400, np.eye(3), unit([1, 0, 0]), outliers=0.45)
        assert isinstance(estimate(points, PoseConfig(min_inlier_ratio=0.3)), PoseEstimate)
        drop = estimate(points, PoseConfig(min_inlier_ratio=0.7))
        assert drop.cause == 'too_few_inliers'
        assert drop.detail.endswith('of 400')


def test_estimate_is_the_same_for_the_same_seed():
    points = correspondences(np.random.default_rng(1), 400, np.eye(3), unit([1, 0, 0]),
                             noise=1e-3, outliers=0.3)
    a, b = (estimate(points, PoseConfig(seed=5)) for _ in range(2))
    np.testing.assert_array_equal(a.rotation, b.rotation)
    np.testing.assert_array_equal(a.direction, b.direction)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def distant_with_noise(rng: np.random.Generator, count: int, sigma: float,
                       ) -> Correspondences:
    """Points so far that only noise moves them: they fit every motion, ahead or behind."""
    bearings = unit(rng.normal(size=(count, 3)))
    return matches(unit(bearings + sigma * rng.normal(size=bearings.shape)), bearings)


def joined(*parts: Correspondences) -> Correspondences:
    return Correspondences(*(np.concatenate([getattr(p, name) for p in parts])
                             for name in ('reference', 'current', 'sigma')))


@pytest.mark.parametrize('seed', range(10))
def test_the_points_that_moved_tell_the_sign_of_the_motion(seed):
    rng = np.random.default_rng(seed)
    position = unit([0.3, -0.6, 0.7])
    near = correspondences(rng, 60, np.eye(3), position, near=5.0, far=30.0)
    far = distant_with_noise(rng, 500, 4e-4)
    # Noise that agrees on the wrong side.
    turned = in_front(np.eye(3), position, far)
    far = Correspondences(np.where(turned[:, None], far.current, far.reference),
                          np.where(turned[:, None], far.reference, far.current), far.sigma)
    found = ransac(joined(near, far), THRESHOLD, rng)
    assert found is not None
    assert found[1] @ position > 0


@pytest.mark.parametrize('share', [0.2, 0.5])
def test_points_behind_the_cameras_are_no_inliers(share):
    rng = np.random.default_rng(3)
    position = unit([0.0, 0.0, -1.0])
    good = correspondences(rng, 1000, np.eye(3), position, noise=2e-4)
    swap = np.arange(1000) < share * 1000  # they fit the plane, but went the other way
    mixed = Correspondences(np.where(swap[:, None], good.current, good.reference),
                            np.where(swap[:, None], good.reference, good.current), good.sigma)
    got = estimate(mixed, PoseConfig())
    if share < 1 / 3:
        assert isinstance(got, PoseEstimate)
        assert angle_between(got.direction, position) < np.radians(0.5)
    else:
        assert isinstance(got, Drop)
        assert got.cause == 'too_few_inliers'
        assert 'behind' in got.detail
