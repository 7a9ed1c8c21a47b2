"""Tracking, stabilisation, alignment and stereo on rendered pairs with exact pose and range."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from analytic_world import View, World, look, true_pose, window
from two_views import angle_between

from sphstereo_ros.core import rotations
from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import PARAMETERS, resolve
from sphstereo_ros.core.frames import (
    UNSCALED,
    AlignedWindow,
    Drop,
    RangeImage,
    RelativePose,
    StabilisedWindow,
)
from sphstereo_ros.core.range_memory import RangeMemory, Remembered
from sphstereo_ros.core.stabilisation import Stabiliser, estimate, reduced
from sphstereo_ros.core.stereo import SphericalStereo
from sphstereo_ros.core.tracking import features, follow, match, spacing_for, track

HEIGHT = 240
ROOM = World()
MATCHERS = PARAMETERS['stereo.matcher'].choices
MOTIONS = {'forward': (0, 0, 0.28), 'backward': (0, 0, -0.28), 'right': (0.28, 0, 0),
           'up': (0, -0.28, 0), 'oblique': (-0.12, 0.1, 0.232)}


@cache
def seen(world: World = ROOM, position: tuple = (0, 0, 0), turn: tuple = (0, 0, 0)) -> View:
    return look(world, position, rotations.exp(turn), HEIGHT)


def before(motion: str | tuple, turn: tuple = (0, 0, 0), world: World = ROOM) -> View:
    """The view of a camera that then moved by `motion` to the origin."""
    step = MOTIONS[motion] if isinstance(motion, str) else motion
    return seen(world, tuple(-s for s in step), turn)


def prior(rotation: np.ndarray | None = None, baseline: float = 0.28) -> RelativePose:
    return RelativePose(np.eye(3) if rotation is None else rotation,
                        np.array([0, 0, -baseline]))


def errors(got: RelativePose, reference: View, current: View) -> tuple[float, float]:
    """Of the rotation and of the direction of motion, degrees."""
    true = true_pose(reference, current)
    return (np.degrees(rotations.angle(got.rotation @ true.rotation.T)),
            np.degrees(angle_between(got.position, true.position)))


def stabilised(current: View, reference: View, believed: RelativePose | None = None,
               mask: np.ndarray | None = None, **parameters: object) -> RelativePose | Drop:
    out = Stabiliser(resolve(parameters), mask).process(
        window(current, (reference, believed or prior())))
    return out if isinstance(out, Drop) else out.references[0].pose


def aligned(current: View, reference: View, pose: RelativePose,
            mask: np.ndarray | None = None, **parameters: object) -> RelativePose | Drop:
    paired = window(current, (reference, pose))
    out = Aligner(resolve(parameters), mask).process(
        StabilisedWindow(paired.current, paired.references))
    return out if isinstance(out, Drop) else out.references[0].pose


def exact(reference: View, current: View) -> RelativePose:
    return replace(true_pose(reference, current), covariance=1e-12 * np.eye(6))


def measured(current: View, *references: tuple[View, RelativePose],
             mask: np.ndarray | None = None, **parameters: object) -> RangeImage | Drop:
    names = {name.replace('__', '.'): value for name, value in parameters.items()}
    paired = window(current, *references)
    return SphericalStereo(resolve(names), mask).process(
        AlignedWindow(paired.current, paired.references))


@cache
def ranged(matcher: str = 'flow', motion: str = 'forward', turn: tuple = (0, 0, 0)) -> RangeImage:
    """Range of the room with the true pose; the current camera turned by `turn`. It is as certain
    as the files ask for that are shipped for matchers without memory.
    """
    current, reference = seen(turn=turn), before(motion)
    return measured(current, (reference, exact(reference, current)), stereo__matcher=matcher,
                    range__max_relative_sigma=0.3)


def relative_error(got: RangeImage, view: View) -> np.ndarray:
    return np.abs(got.range - view.range) / view.range


def with_image(view: View, image: np.ndarray) -> View:
    return replace(view, image=np.ascontiguousarray(image, np.uint8))


# --- tracking


def test_features_prefer_structure_and_keep_to_what_is_usable():
    image = seen().image
    points, sigma = features(image, 12)
    assert len(points) > 0.5 * image.size / 12**2
    assert len(points) <= image.size / 12**2
    assert (sigma > 0).all()
    usable = np.zeros(image.shape, bool)
    usable[100:140, 50:90] = True
    inside, _ = features(image, 12, usable)
    assert len(inside) > 3
    u, v = inside.T.astype(int)
    assert usable[v, u].all()
    assert len(features(np.full_like(image, 77), 12)[0]) == 0


def test_features_that_are_expected_to_be_worse_have_less_contrast():
    image = seen().image
    strong, weak = (features((128 + (image - 128.0) * f).astype(np.uint8), 12)[1]
                    for f in (1.0, 0.1))
    assert np.median(weak) > 1.5 * np.median(strong)


def test_following_finds_a_known_shift():
    image = seen().image
    shifted = np.roll(image, (3, 5), axis=(0, 1))
    points, _ = features(image, 12)
    points = points[(np.abs(points - [HEIGHT, HEIGHT / 2]) < [HEIGHT - 30, HEIGHT / 2 - 30])
                    .all(axis=1)]
    moved, found = follow(image, shifted, points)
    assert found.mean() > 0.95
    assert np.abs(np.median(moved[found] - points[found], axis=0) - [5, 3]).max() < 0.02
    nothing, none = follow(image, shifted, points[:0])
    assert len(nothing) == len(none) == 0


@pytest.mark.parametrize('count', [300, 2500])
def test_no_more_points_than_asked_for(count):
    points = track(seen().image, seen().image, np.eye(3), count)
    assert 0.4 * count < len(points) <= 1.4 * count
    assert spacing_for(count, HEIGHT) >= 5


def test_tracks_cross_the_seam():
    """When a camera turns to the right by 5°, what was right of the seam comes to its left."""
    turn = (0, np.radians(5), 0)
    current, reference = seen(turn=turn), seen()
    points = track(reference.image, current.image, np.eye(3), 2500)
    back = np.abs(np.arctan2(points.current[:, 0], points.current[:, 2])) > np.radians(178)
    assert back.sum() > 0.5 * len(points) * 2 / 180
    expected = points.reference @ current.rotation  # X_cur = Rᵀ X_world
    error = np.arccos(np.clip((expected * points.current).sum(axis=1), -1, 1))
    assert np.degrees(np.median(error[back])) < 0.1


def test_points_under_the_mask_are_not_tracked():
    mask = np.zeros((HEIGHT, 2 * HEIGHT), np.uint8)
    mask[:, :HEIGHT] = 255  # the left half
    points = track(seen().image, seen().image, np.eye(3), 2500, mask)
    assert len(points) > 500
    assert (points.current[:, 0] > 0).all()


def test_reduced_images_are_no_larger_than_asked():
    image = seen().image
    assert reduced(image, HEIGHT) is image
    small = reduced(image, 60)
    assert small.shape == (60, 120)
    np.testing.assert_allclose(small, image.reshape(60, 4, 120, 4).mean(axis=(1, 3)), atol=0.6)


# --- stabilisation and alignment


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('turn', [(0.02, -0.01, 0.01), (-0.03, 0.03, 0.03)])
def test_rotation_and_direction_are_recovered(motion, turn):
    current, reference = seen(), before(motion, turn)
    first = stabilised(current, reference)
    rotation, direction = errors(first, reference, current)
    assert rotation < 0.1
    assert direction < 1.0
    pose = aligned(current, reference, first)
    rotation, direction = errors(pose, reference, current)
    assert rotation < 0.05
    assert direction < 0.3
    assert pose.baseline == pytest.approx(0.28, rel=1e-9)


@pytest.mark.parametrize('gain', [0.45, 0.7, 1.3])
def test_alignment_does_not_mind_another_exposure(gain):
    """Halved from one frame to the next, as where a camera comes out of the shade."""
    current, reference = seen(), before('forward', (0.02, -0.01, 0.01))
    dark = with_image(reference, np.clip(gain * reference.image, 0, 255))
    start = exact(reference, current)
    same, other = (aligned(current, r, start) for r in (reference, dark))
    rotation, direction = errors(other, reference, current)
    assert rotation < 0.05
    assert direction < 0.3
    assert angle_between(same.position, other.position) < np.radians(0.2)


def test_covariance_is_honest_about_the_pose():
    """Errors of the aligned pose against its covariance: neither far outside nor far inside."""
    squared = []
    for motion in MOTIONS:
        current, reference = seen(), before(motion, (0.02, -0.01, 0.01))
        pose = aligned(current, reference, stabilised(current, reference))
        true = true_pose(reference, current)
        error = np.concatenate([rotations.log(pose.rotation @ true.rotation.T),
                                pose.position - true.position])
        values, vectors = np.linalg.eigh(pose.covariance)
        assert values.min() > -1e-15
        across = values > 1e-3 * values.max()  # not along the direction: its length is given
        squared += list((vectors[:, across].T @ error)**2 / values[across])
    assert 0.05 < np.mean(squared) < 5


def test_a_large_rotation_is_taken_from_the_prior():
    turn = (0.1, 0.5, -0.2)  # 31°
    current, reference = seen(), before('forward', turn)
    believed = prior(rotations.exp((0.02, -0.02, 0.01)) @ true_pose(reference, current).rotation)
    pose = aligned(current, reference, stabilised(current, reference, believed))
    rotation, direction = errors(pose, reference, current)
    assert rotation < 0.05
    assert direction < 0.3


def test_a_camera_turned_right_round_with_its_prior():
    current, reference = seen(), before('right', (0, np.pi, 0))
    pose = stabilised(current, reference, prior(true_pose(reference, current).rotation))
    rotation, direction = errors(pose, reference, current)
    assert rotation < 0.1
    assert direction < 1.0


LARGE = {'nod': (0.6, 0, 0), 'yaw': (0, 1.5, 0), 'roll': (0, 0, -0.6), 'any': (0.5, 0.5, -0.3),
         'upside down': (np.pi, 0, 0)}


@pytest.mark.parametrize('turn', LARGE.values(), ids=LARGE)
def test_a_large_rotation_that_nothing_foretells(turn):
    current, reference = seen(), before('right', turn)
    rotation, direction = errors(stabilised(current, reference), reference, current)
    assert rotation < 0.1
    assert direction < 1.0


@pytest.mark.parametrize('turn', LARGE.values(), ids=LARGE)
def test_a_large_rotation_on_the_spot_is_no_parallax(turn):
    drop = stabilised(seen(), look(ROOM, (0, 0, 0), rotations.exp(turn), HEIGHT, noise=1.1))
    assert isinstance(drop, Drop)
    assert drop.cause == 'no_parallax'


@pytest.mark.parametrize('step', [(0, 0, 1.2), (1.2, 0, 0), (0, -0.8, 0.8)])
def test_a_large_step_is_found_where_tracking_fails(step):
    current, reference = seen(), before(step, (0.02, -0.01, 0.01))
    tracked = estimate(track(reference.image, current.image, np.eye(3), 2500), resolve({}).pose)
    assert isinstance(tracked, Drop)
    first = stabilised(current, reference)
    rotation, direction = errors(first, reference, current)
    assert rotation < 0.15
    assert direction < 0.6
    rotation, direction = errors(aligned(current, reference, first), reference, current)
    assert rotation < 0.1
    assert direction < 0.3


def test_two_places_that_have_nothing_in_common_are_a_drop():
    other = World((-3, -2.5, -7), (4, 1.9, 8), (), cell=0.5)
    drop = stabilised(seen(), seen(other, (0.3, 0.1, 0.2)))
    assert isinstance(drop, Drop)
    assert drop.cause == 'too_few_inliers'


def test_alignment_leaves_out_what_is_under_the_mask():
    reference, current = before('forward', (0.01, 0.02, 0.0)), seen()
    mask = np.full((90, 180), 255, np.uint8)  # of any size
    out = aligned(current, reference, exact(reference, current), mask)
    assert isinstance(out, Drop)
    assert out.cause == 'alignment_failed'
    mask[:, :90] = 0
    out = aligned(current, reference, exact(reference, current), mask)
    assert isinstance(out, RelativePose)
    turn, direction = errors(out, reference, current)
    assert turn < 0.05
    assert direction < 0.3


def test_descriptors_match_over_the_seam_and_beside_the_mask():
    current, reference = seen(), seen(turn=(0, 2.0, 0))
    mask = np.zeros((HEIGHT, 2 * HEIGHT), np.uint8)
    mask[:, :HEIGHT] = 255  # the left half
    points = match(reference.image, current.image, 2500)
    assert len(points) > 100
    expected = points.reference @ reference.rotation.T
    error = np.degrees(np.arccos(np.clip((expected * points.current).sum(axis=1), -1, 1)))
    assert np.median(error) < 0.3
    assert (error < 2).mean() > 0.95
    half = match(reference.image, current.image, 2500, mask)
    assert len(half) > 20
    assert (half.current[:, 0] > 0).all()
    assert (half.reference[:, 0] > 0).all()  # the vehicle is in the same place in both
    blank = np.full_like(current.image, 90)
    assert len(match(blank, current.image, 2500)) == len(match(current.image, blank, 2500)) == 0


def test_length_and_its_uncertainty_come_from_the_prior():
    current, reference = seen(), before('right')
    believed = replace(prior(), covariance=np.diag([0, 0, 0, 0, 0, 0.01**2]))
    pose = aligned(current, reference, stabilised(current, reference, believed))
    assert pose.baseline == pytest.approx(0.28, rel=1e-9)
    along = pose.direction @ pose.covariance[3:, 3:] @ pose.direction
    assert along == pytest.approx(0.01**2, rel=0.05)
    unsure = stabilised(current, reference)
    assert unsure.direction @ unsure.covariance[3:, 3:] @ unsure.direction < 1e-12


def flat(level: int) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: np.full((HEIGHT, 2 * HEIGHT), level)


NOTHING = {
    'black': (flat(0), 'too_few_points'), 'white': (flat(255), 'too_few_points'),
    'noise': (lambda rng: rng.integers(0, 256, (HEIGHT, 2 * HEIGHT)), 'too_few_inliers'),
    'weak noise': (lambda rng: 128 + 3 * rng.normal(size=(HEIGHT, 2 * HEIGHT)),
                   'too_few_inliers'),
    'smooth noise': (lambda rng: cv2.GaussianBlur(rng.uniform(0, 255, (HEIGHT, 2 * HEIGHT)),
                                                  (0, 0), 3), 'too_few_inliers')}


@pytest.mark.parametrize('content', NOTHING)
def test_frames_that_show_nothing_in_common_are_a_named_drop(content):
    make, cause = NOTHING[content]
    rng = np.random.default_rng(0)
    drop = stabilised(with_image(seen(), make(rng)), with_image(seen(), make(rng)))
    assert isinstance(drop, Drop)
    assert drop.cause == cause
    assert drop.detail


def test_a_black_frame_beside_a_good_one_is_a_named_drop():
    black = with_image(seen(), np.zeros_like(seen().image))
    for current, reference in ((black, before('forward')), (seen(), black)):
        drop = stabilised(current, reference)
        assert isinstance(drop, Drop)
        assert drop.cause in {'too_few_points', 'too_few_inliers'}


@pytest.mark.parametrize('case', ['hover', 'same frame', 'rotation', 'large rotation'])
def test_hover_and_pure_rotation_are_no_parallax(case):
    turn = {'rotation': (0.01, 0.03, -0.02), 'large rotation': (0, 0.6, 0)}.get(case, (0, 0, 0))
    current = seen()
    reference = current if case == 'same frame' else look(ROOM, (0, 0, 0), rotations.exp(turn),
                                                          HEIGHT, noise=1.1)
    believed = prior(true_pose(reference, current).rotation)
    drop = stabilised(current, reference, believed)
    assert isinstance(drop, Drop)
    assert drop.cause == 'no_parallax'


def test_far_walls_tell_no_direction():
    far = World((-500, -500, -500), (500, 500, 500), (), cell=70)
    drop = stabilised(seen(far), before('forward', world=far))
    assert isinstance(drop, Drop)
    assert drop.cause == 'no_parallax'


def vehicle(view: View) -> View:
    """The view with a strongly textured thing that moves with the camera, in the lower third."""
    image = view.image.copy()
    rng = np.random.default_rng(4)
    texture = cv2.resize(rng.integers(0, 256, (20, 120), np.uint8), (2 * HEIGHT, HEIGHT // 3))
    image[-(HEIGHT // 3):] = texture
    return with_image(view, image)


@pytest.mark.parametrize('mask_height', [HEIGHT, 90])
def test_what_the_mask_covers_neither_moves_nor_has_range(mask_height):
    mask = np.zeros((mask_height, 2 * mask_height), np.uint8)
    mask[-(mask_height // 3):] = 1
    current, reference = vehicle(seen()), vehicle(before('forward', (0.02, 0.01, 0)))
    pose = stabilised(current, reference, mask=mask)
    rotation, direction = errors(pose, reference, current)
    assert rotation < 0.1
    assert direction < 1.0
    got = measured(current, (reference, exact(reference, current)), mask=mask)
    assert np.isnan(got.range[-(HEIGHT // 3):]).all()
    assert np.isnan(got.sigma[-(HEIGHT // 3):]).all()
    assert np.isfinite(got.range[:-(HEIGHT // 3)]).mean() > 0.7


def test_a_mask_over_everything_leaves_no_points():
    mask = np.ones((HEIGHT, 2 * HEIGHT), np.uint8)
    assert stabilised(seen(), before('forward'), mask=mask).cause == 'too_few_points'


def test_references_that_fail_are_left_out():
    black = with_image(seen(), np.zeros_like(seen().image))
    good = before('forward')
    out = Stabiliser(resolve({})).process(window(seen(), (black, prior(baseline=0.1)),
                                                 (good, prior())))
    assert [r.frame.image is good.image for r in out.references] == [True]
    paired = window(seen(), (black, prior(baseline=0.1)), (good, exact(good, seen())))
    out = Aligner(resolve({})).process(StabilisedWindow(paired.current, paired.references))
    assert [r.frame.image is good.image for r in out.references] == [True]
    only = window(seen(), (black, prior()))
    drop = Aligner(resolve({})).process(StabilisedWindow(only.current, only.references))
    assert drop.cause == 'alignment_failed'


def test_frames_of_different_sizes_are_a_drop():
    other = look(ROOM, (0, 0, -0.28), height=100)
    assert stabilised(seen(), other).cause == 'size_changed'
    assert measured(seen(), (other, exact(other, seen()))).cause == 'size_changed'


def wrong_by(pose: RelativePose, degrees: float) -> RelativePose:
    axis = np.cross(pose.position, [0.3, -0.5, 0.4])
    turn = rotations.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
    return replace(pose, position=turn @ pose.position)


@pytest.mark.parametrize('motion', MOTIONS)
@pytest.mark.parametrize('method', ['refined', 'paper'])
def test_alignment_corrects_a_wrong_direction(motion, method):
    current, reference = seen(), before(motion)
    start = wrong_by(exact(reference, current), 3.0)
    assert errors(start, reference, current)[1] == pytest.approx(3.0, abs=1e-6)
    pose = aligned(current, reference, start, **{'alignment.method': method})
    rotation, direction = errors(pose, reference, current)
    assert direction < {'refined': 0.3, 'paper': 0.6}[method]
    assert rotation < {'refined': 0.05, 'paper': 1e-6}[method]  # the paper's leaves it alone
    assert pose.baseline == pytest.approx(start.baseline)


def test_the_papers_method_finds_no_motion_where_everything_runs_the_wrong_way():
    current, reference = seen(), before('forward')
    pose = exact(reference, current)
    drop = aligned(current, reference, replace(pose, position=-pose.position),
                   **{'alignment.method': 'paper'})
    assert drop.cause == 'no_parallax'


def test_no_refinement_leaves_the_pose_and_adds_the_least_uncertainty():
    current, reference = seen(), before('forward')
    start = exact(reference, current)
    pose = aligned(current, reference, start, **{
        'alignment.iterations': 0, 'alignment.rotation_sigma': 0.01,
        'alignment.direction_sigma': 0.02})
    np.testing.assert_array_equal(pose.rotation, start.rotation)
    np.testing.assert_array_equal(pose.position, start.position)
    np.testing.assert_allclose(np.diag(pose.covariance), [1e-4] * 3 + [(0.28 * 0.02)**2] * 2 + [0],
                               atol=1e-10)
    unknown = aligned(current, reference, replace(start, covariance=None),
                      **{'alignment.iterations': 0})
    assert unknown.covariance is None


# --- stereo


@pytest.mark.parametrize('matcher', MATCHERS)
@pytest.mark.parametrize('motion', ['forward', 'right', 'up'])
def test_range_of_every_matcher(matcher, motion):
    got, view = ranged(matcher, motion), seen()
    assert got.is_metric
    known = np.isfinite(got.range)
    error = relative_error(got, view)[known]
    median, coverage = {'flow_fast': (0.07, 0.75), 'joint': (0.035, 0.7),
                        'bm_judged': (0.035, 0.7)}.get(
        matcher, (0.035, 0.85))
    assert np.median(error) < median
    assert known.mean() > coverage
    assert (error > 0.5).mean() < (0.05 if matcher == 'flow_fast' else 0.01)
    # There is no bias beyond the spread.
    assert abs(np.median((got.range - view.range)[known] / view.range[known])) < 0.8 * median


@pytest.mark.parametrize('matcher', MATCHERS)
def test_sigma_says_how_large_the_error_is(matcher):
    for motion in ('forward', 'right'):
        got, view = ranged(matcher, motion), seen()
        np.testing.assert_array_equal(np.isnan(got.sigma), ~np.isfinite(got.range))
        known = np.isfinite(got.range)
        assert (got.sigma[known] > 0).all()
        ratio = np.median(np.abs(got.range - view.range)[known] / got.sigma[known])
        # The network is careful in a world that it was not fitted to.
        assert (0.04 if matcher == 'joint' else 0.1) < ratio < (
            2.5 if matcher == 'flow_fast' else 1.5)


@pytest.mark.parametrize('motion', ['forward', 'right', 'up'])
def test_the_blind_cone_is_unknown_on_both_sides(motion):
    got = ranged('flow', motion)
    axis = np.array(MOTIONS[motion]) / 0.28
    along = Equirectangular(HEIGHT, 2 * HEIGHT).bearings() @ axis
    for pole in (along, -along):
        cone = pole > np.cos(np.radians(1.5))
        assert cone.any()
        assert np.isnan(got.range[cone]).mean() > 0.7
    assert np.isfinite(got.range[np.abs(along) < 0.5]).mean() > 0.9


@pytest.mark.parametrize('matcher', [m for m in MATCHERS if m != 'flow_fast'])  # it is too noisy
@pytest.mark.parametrize('columns', [85, 140, HEIGHT])
def test_the_seam_is_matched_like_the_rest(matcher, columns):
    """Turned, the camera has its seam elsewhere: the same walls have the same range and error."""
    turn = (0, columns * np.pi / HEIGHT, 0)
    straight, turned = ranged(matcher), ranged(matcher, turn=turn)
    known = np.roll(np.isfinite(straight.range), -columns, axis=1)
    before_ = np.roll(relative_error(straight, seen()), -columns, axis=1)
    now = relative_error(turned, seen(turn=turn))
    rows = slice(HEIGHT // 6, -HEIGHT // 6)
    # How much more is known, of every four columns: a network at a part of the size does not see
    # every place alike.
    change = (np.isfinite(now[rows]).mean(0) - known[rows].mean(0)).reshape(-1, 4).mean(1)
    least = min(-0.05, np.quantile(change, 0.1))
    assert least > -0.1
    # left and right of the seam, and where neither has it
    for first in (len(change) - 1, 0, 25):
        part = rows, slice(4 * first, 4 * first + 4)
        assert first == 25 or change[first] > least
        assert np.nanmedian(now[part]) < 1.5 * np.nanmedian(before_[part]) + 0.002


def test_a_camera_turned_right_round_gives_the_turned_range_image():
    straight, turned = ranged('flow'), ranged('flow', turn=(0, np.pi, 0))
    shift = np.roll(turned.range, HEIGHT, axis=1)
    both = np.isfinite(shift) & np.isfinite(straight.range)
    assert both.mean() > np.isfinite(straight.range).mean() - 0.01
    ratio = np.abs(shift / straight.range - 1)[both]
    assert np.median(ratio) < 0.01
    assert np.quantile(ratio, 0.99) < 0.1


@pytest.mark.parametrize('matcher', MATCHERS)
def test_far_beyond_all_range_is_infinite_or_unknown_never_near(matcher):
    far = World((-500, -500, -500), (500, 500, 500), (), cell=70)
    current, reference = seen(far), before((0, 0, 2.8), world=far)
    r = measured(current, (reference, exact(reference, current)), stereo__matcher=matcher).range
    assert not np.isneginf(r).any()
    assert np.isfinite(r).mean() < 0.01
    if matcher not in {'bm', 'bm_judged', 'sgbm', 'joint_fast'}:
        assert np.isposinf(r).mean() > 0.8
    else:  # a search that ends at zero disparity cannot know
        assert not np.isposinf(r).any()


@pytest.mark.parametrize('matcher', MATCHERS)
def test_infinite_only_with_confidence(matcher):
    """At 0.28 m a match would have to be better than it is to tell 500 m from 120 m."""
    far = World((-500, -500, -500), (500, 500, 500), (), cell=70)
    current, reference = seen(far), before('forward', world=far)
    pose = replace(exact(reference, current),
                   covariance=np.diag([1e-2] * 3 + [1e-6] * 3))  # and the pose is poor
    r = measured(current, (reference, pose), stereo__matcher=matcher).range
    assert np.isnan(r).mean() > 0.99


@pytest.mark.parametrize('matcher', MATCHERS)
def test_nearer_than_the_minimum_is_minus_infinity(matcher):
    small = World((-1.2, -0.9, -1.5), (0.8, 0.9, 1.3), (), cell=0.2)
    current, reference = seen(small), before((0, 0, 0.1), world=small)
    r = measured(current, (reference, exact(reference, current)), stereo__matcher=matcher,
                 range__min=1.0).range
    near, beyond = current.range < 0.95, current.range > 1.25
    assert np.isneginf(r[near]).mean() > 0.95
    finite = near & np.isfinite(r)  # by an error of the range, not by a miss
    assert (r[finite] < 1.25 * current.range[finite]).all()
    assert np.isneginf(r[beyond]).mean() < (0.05 if matcher == 'flow_fast' else 0.01)


def test_a_relative_pose_gives_range_in_baselines():
    current, reference = seen(), before('forward')
    pose, step = exact(reference, current), 0.7  # m; the sweep ends at half a step, or at 0.3 m
    unscaled = replace(pose, position=UNSCALED / 0.28 * pose.position, covariance=None)
    pose = replace(pose, position=step / 0.28 * pose.position)
    got = measured(current, (reference, unscaled), range__min=2.0, range__max=3.0)
    metric = measured(current, (reference, pose))
    assert (got.is_metric, metric.is_metric) == (False, True)
    known = np.isfinite(got.range) & np.isfinite(metric.range)
    assert (np.isfinite(got.range) != np.isfinite(metric.range)).mean() < 0.005
    # Limits in metres do not apply.
    for one, other in ((got.range, metric.range), (got.sigma, metric.sigma)):
        assert np.median(np.abs(step * one[known] / other[known] - 1)) < 1e-3


def test_two_baselines_are_better_than_the_short_one_alone():
    current, short, long = seen(), before('forward'), before((0, 0, 1.12))
    references = [(view, exact(view, current)) for view in (short, long)]
    alone, fused = measured(current, references[0]), measured(current, *references)
    a, b = (relative_error(r, current) for r in (alone, fused))
    known = np.isfinite(a) & np.isfinite(b)
    far = known & (current.range > 6)
    assert np.isfinite(b).sum() >= 0.95 * np.isfinite(a).sum()
    assert np.median(b[far]) < 0.9 * np.median(a[far])
    assert np.median(fused.sigma[far]) < 0.7 * np.median(alone.sigma[far])


def test_without_metres_two_baselines_fuse_alike():
    """Also where only the long one knows the range: its unit is the short one's."""
    current = seen()
    views = [before('forward'), before((0, 0, 1.12))]
    half = views[0].image.copy()
    half[:, :HEIGHT] = 128  # the short pair knows nothing of the left half
    views[0] = with_image(views[0], half)
    metric = measured(current, *((v, exact(v, current)) for v in views))
    unscaled = measured(current, *(
        (v, replace(exact(v, current), covariance=None,
                    position=UNSCALED / 0.28 * true_pose(v, current).position)) for v in views))
    assert not unscaled.is_metric
    left = np.isfinite(metric.range) & np.isfinite(unscaled.range)
    left[:, HEIGHT:] = False
    assert left.sum() > 0.3 * HEIGHT**2
    # Paths that cost the same but for rounding may go either way.
    same = np.abs(0.28 * unscaled.range[left] / metric.range[left] - 1) < 0.01
    assert same.mean() > 0.999


def test_baselines_with_and_without_metres_do_not_mix():
    current, reference = seen(), before('forward')
    pose = exact(reference, current)
    unscaled = replace(pose, position=UNSCALED * pose.position)
    drop = measured(current, (reference, pose), (reference, unscaled))
    assert drop.cause == 'mixed_scale'


@pytest.mark.parametrize('matcher', MATCHERS)
def test_in_a_first_window_no_more_than_half_the_range_may_be_unsure(matcher):
    sky = World(blank_above=True)
    current, reference = seen(sky), before('forward', world=sky)
    one, other = (measured(current, (reference, exact(reference, current)),
                           stereo__matcher=matcher, range__max_relative_sigma=s).range
                  for s in (0.5, 10.0))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize('chosen', [True, False])
def test_what_the_network_chose_may_be_as_unsure_as_the_parameter_says(monkeypatch, chosen):
    current, reference = seen(), before('forward')
    rho = (1 / current.range).astype(np.float32)
    monkeypatch.setattr(RangeMemory, 'fused', lambda *_: Remembered(
        rho.copy(), 0.6 * rho, np.full_like(rho, 6), chosen))
    got = measured(current, (reference, exact(reference, current)), stereo__matcher='joint')
    assert (np.isfinite(got.range).mean() > 0.9) == chosen
    assert np.isfinite(got.range).any() == chosen


def test_a_poor_pose_widens_sigma():
    current, reference = seen(), before('right')
    pose = exact(reference, current)
    sigmas = []
    for sigma in (0.0, 1e-2):
        covariance = np.diag([1e-12] * 3 + [(0.28 * sigma)**2, 1e-12, 1e-12])  # of the length
        got = measured(current, (reference, replace(pose, covariance=covariance)),
                       range__max_relative_sigma=1.0)
        sigmas.append(got.sigma)
    added = np.sqrt(sigmas[1]**2 - sigmas[0]**2) / current.range
    assert np.nanmedian(added) == pytest.approx(1e-2, rel=0.1)


def test_relative_sigma_of_the_baseline_stands_in_where_the_pose_tells_none():
    current, reference = seen(), before('right')
    pose = replace(exact(reference, current), covariance=None)
    without, with_it = (measured(current, (reference, pose), baseline__relative_sigma=s)
                        for s in (0.0, 0.05))
    both = np.isfinite(without.range) & np.isfinite(with_it.range)
    added = np.sqrt(with_it.sigma**2 - without.sigma**2)[both] / with_it.range[both]
    assert np.median(added) == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize('stage', [Stabiliser, Aligner, SphericalStereo])
def test_warming_up_leaves_a_stage_as_it_was(stage):
    stage(resolve({})).warm_up()


@pytest.mark.parametrize('matcher', MATCHERS)
def test_blank_surfaces_are_unknown(matcher):
    sky = World(blank_above=True)
    current, reference = seen(sky), before('forward', world=sky)
    r = measured(current, (reference, exact(reference, current)), stereo__matcher=matcher).range
    above = current.range * Equirectangular(HEIGHT, 2 * HEIGHT).bearings()[..., 1] < -3 + 1e-6
    inside = cv2.erode(above.astype(np.uint8), np.ones((25, 25))) > 0
    assert inside.mean() > 0.2
    assert np.isinf(r[inside]).mean() < 0.005
    assert np.isnan(r[inside]).mean() > 0.8
