"""Several references for one frame: far ones predicted from poses found before, then refined."""
from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from analytic_world import View, World, look, true_pose
from two_views import angle_between, matches, random_rotation, two_views

from sphstereo_ros.core import rotations, tracking
from sphstereo_ros.core.aligned_view import CurrentView, length_by_ranges, nearness
from sphstereo_ros.core.alignment import Aligner
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    PairedWindow,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from sphstereo_ros.core.relief import nearness_map, reference_in_relief, sampled
from sphstereo_ros.core.sphere import polar_axes, polar_bearings
from sphstereo_ros.core.stabilisation import Stabiliser
from sphstereo_ros.core.tracking import features, follow, follow_both_ways, spacing_for
from sphstereo_ros.core.warp import PolarGrid, polar_map, resample, with_border

HEIGHT, STEP, COUNT = 320, 0.2, 12
HALL = World(low=(-6.0, -4.0, -14.0), high=(7.0, 1.6, 16.0), cell=1.0)


@cache
def views() -> tuple[View, ...]:
    """A drive along a bend, with an unsteady camera."""
    rng = np.random.default_rng(5)
    turn, position, out = np.eye(3), np.zeros(3), []
    for _ in range(COUNT):
        turn = turn @ rotations.exp((0.0, 0.01, 0.0))
        position = position + turn @ (0.0, 0.0, STEP)
        shaken = turn @ rotations.exp(0.02 * rng.normal(size=3))
        out.append(look(HALL, position, shaken, HEIGHT))
    return tuple(out)


def frame(i: int, image: np.ndarray | None = None) -> Frame:
    return Frame(FrameKey(1000 + i, 'camera_optical'),
                 views()[i].image if image is None else image)


def paired(current: int, *backs: int, images: dict[int, np.ndarray] | None = None) -> PairedWindow:
    """A window whose priors know the lengths, but no rotation and no direction."""
    found = []
    for back in backs:
        length = true_pose(views()[current - back], views()[current]).baseline
        found.append(Reference(frame(current - back, (images or {}).get(current - back)),
                               RelativePose(np.eye(3), np.array([0.0, 0.0, -length]))))
    return PairedWindow(frame(current), tuple(found))


class Stages:
    """Stages 2 and 3, which remember what they found."""

    def __init__(self, **parameters: object) -> None:
        given = {'baseline.source': 'odometry',
                 **{name.replace('__', '.'): value for name, value in parameters.items()}}
        self.stabiliser, self.aligner = (kind(resolve(given)) for kind in (Stabiliser, Aligner))

    def process(self, window: PairedWindow) -> AlignedWindow | Drop:
        stabilised = self.stabiliser.process(window)
        return stabilised if isinstance(stabilised, Drop) else self.aligner.process(stabilised)


def errors(window: AlignedWindow, back: int) -> tuple[float, float]:
    """Of rotation and direction of the reference `back` frames back, degrees."""
    i = window.current.key.stamp - 1000
    pose, = (r.pose for r in window.references if r.frame.key.stamp == 1000 + i - back)
    true = true_pose(views()[i - back], views()[i])
    return (np.degrees(rotations.angle(pose.rotation @ true.rotation.T)),
            np.degrees(angle_between(pose.position, true.position)))


def within(found: tuple[float, float], rotation: float, direction: float) -> bool:
    return found[0] < rotation and found[1] < direction


def driven(last: int, *backs: int, skip: tuple[int, ...] = (), **parameters: object) -> Stages:
    """The stages after all frames up to `last`, but those that were dropped."""
    stages = Stages(**parameters)
    for i in range(1, last + 1):
        if i not in skip:
            stages.process(paired(i, *(b for b in backs if b <= i)))
    return stages


def test_far_references_are_as_exact_as_near_ones() -> None:
    out = driven(10, 1, 4, 10).process(paired(11, 1, 4, 10))
    assert [r.pose.baseline for r in out.references] == pytest.approx(
        [true_pose(views()[11 - b], views()[11]).baseline for b in (1, 4, 10)])
    for back, direction in ((1, 0.1), (4, 0.02), (10, 0.02)):
        assert within(errors(out, back), 0.01, direction)


@pytest.mark.parametrize('back', [4, 10])
def test_their_covariance_is_honest(back: int) -> None:
    window = driven(10, 1, 4, 10).process(paired(11, 1, 4, 10))
    pose, = (r.pose for r in window.references if r.frame.key.stamp == 1011 - back)
    true = true_pose(views()[11 - back], views()[11])
    turn = rotations.log(true.rotation @ pose.rotation.T)
    assert (np.abs(turn) < 3 * np.sqrt(np.diag(pose.covariance)[:3])).all()
    sigma = np.sqrt(np.trace(pose.covariance[3:, 3:]))
    assert np.linalg.norm(true.position - pose.position) < 3 * sigma
    assert sigma < 0.003 * pose.baseline


def test_stage_2_predicts_without_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    from sphstereo_ros.core import stabilisation
    stages = driven(10, 1)
    calls = []

    def counted(*args: object) -> object:
        calls.append(args)
        return original(*args)

    original = stabilisation.track
    monkeypatch.setattr(stabilisation, 'track', counted)
    out = stages.stabiliser.process(paired(11, 1, 4, 10))
    assert len(out.references) == 3
    assert len(calls) == 1


def test_stage_3_starts_from_its_own_chain() -> None:
    """Whatever stage 2 says of the far reference: 5° wrong, it could not be followed."""
    stages = driven(10, 1, 4, 10)
    window = stages.stabiliser.process(paired(11, 1, 10))
    near, far = window.references
    wrong = replace(far, pose=replace(far.pose, rotation=rotations.exp((0.09, 0, 0))
                                      @ far.pose.rotation))
    out = stages.aligner.process(replace(window, references=(near, wrong)))
    assert within(errors(out, 10), 0.01, 0.02)


def test_where_frames_were_dropped_the_way_leads_over_other_windows() -> None:
    """Every second window is lost: 10 frames back by way of windows that share references."""
    out = driven(10, 1, 4, skip=(2, 4, 6, 8, 10)).process(paired(11, 4, 8))
    assert within(errors(out, 8), 0.01, 0.04)


def test_without_a_chain_a_reference_is_found_as_the_first_of_all() -> None:
    out = Stages().process(paired(5, 1, 4))
    assert within(errors(out, 4), 0.01, 0.03)


def test_a_prediction_hides_no_failure() -> None:
    """The far frame shows something else: it is left out, though a chain leads there."""
    stages = driven(10, 1, 4, 10)
    rng = np.random.default_rng(3)
    other = rng.integers(0, 255, (HEIGHT, 2 * HEIGHT), np.uint8)
    out = stages.process(paired(11, 1, 4, 10, images={1: other}))
    assert [r.frame.key.stamp for r in out.references] == [1010, 1007]


def test_what_was_predicted_is_not_remembered_as_found() -> None:
    stages = driven(10, 1, 4, 10)
    newest = FrameKey(1010, 'camera_optical')
    assert [k.stamp for k in stages.stabiliser._history._poses[newest]] == [1009]
    assert [k.stamp for k in stages.aligner._history._poses[newest]] == [1009, 1006, 1000]


@pytest.mark.parametrize(('source', 'left'), [('fixed', 'no_parallax'), ('odometry', 2)])
def test_a_hover_makes_assumed_lengths_wrong(source: str, left: str | int) -> None:
    """Odometry knows how far it is nevertheless; a fixed step would be too long: too far."""
    stages = driven(8, 1, 4, baseline__source=source)
    window = paired(9, 1, 4, 8)
    still = replace(window, references=(
        replace(window.references[0], frame=frame(8, views()[9].image)), *window.references[1:]))
    out = stages.process(still)
    assert (out.cause if isinstance(out, Drop) else len(out.references)) == left
    after = stages.process(paired(10, 1, 4))
    assert not isinstance(after, Drop)
    assert [r.frame.key.stamp for r in after.references] \
        == ([1009] if source == 'fixed' else [1009, 1006])


def test_no_refinement_leaves_far_poses_as_predicted() -> None:
    stages = driven(10, 1, 4, 10, alignment__iterations=0)
    stabilised = stages.stabiliser.process(paired(11, 1, 4, 10))
    out = stages.aligner.process(stabilised)
    assert len(out.references) == 3


# --- lengths that are assumed


def speeding(order: tuple[int, ...], source: str) -> AlignedWindow:
    """The last window of a drive that has these views, each step taken as 0.2 m."""
    stages = Stages(baseline__source=source)
    for n in range(1, len(order)):
        references = tuple(
            Reference(frame(order[n - back]),
                      RelativePose(np.eye(3), np.array([0, 0, -STEP * back])))
            for back in (1, 4) if back <= n)
        out = stages.process(PairedWindow(frame(order[n]), references))
    assert isinstance(out, AlignedWindow)
    return out


@pytest.mark.parametrize('order', [(0, 3, 6, 8, 9, 10), (0, 1, 2, 3, 5, 8)],
                         ids=['braking', 'accelerating'])
def test_a_changing_speed_shows_in_the_far_length(order: tuple[int, ...]) -> None:
    """The last step is what was assumed; ranges by it tell how far the far reference is."""
    out = speeding(order, 'fixed')
    near, far = (r.pose for r in out.references)
    true_near, true_far = (true_pose(views()[r.frame.key.stamp - 1000], views()[order[-1]])
                           for r in out.references)
    assert near.baseline == pytest.approx(STEP)
    assert far.baseline / STEP == pytest.approx(true_far.baseline / true_near.baseline, rel=0.01)
    assert abs(true_far.baseline / true_near.baseline - 4) > 0.5
    assert within(errors(out, order[-1] - out.references[1].frame.key.stamp + 1000), 0.02, 0.05)


def test_no_distance_at_all_is_a_named_drop() -> None:
    """Odometry may say so where `baseline.minimum` is zero, and the images too."""
    stages = driven(5, 1, 4)
    window = paired(6, 1, 4)
    still = PairedWindow(window.current, tuple(
        Reference(frame(r.frame.key.stamp - 1000, views()[6].image),
                  RelativePose(np.eye(3), np.zeros(3))) for r in window.references))
    out = stages.process(still)
    assert isinstance(out, Drop)
    assert out.cause == 'no_parallax'
    moved = PairedWindow(window.current, (window.references[0], replace(
        window.references[1], pose=RelativePose(np.eye(3), np.zeros(3)))))
    assert isinstance(stages.process(moved), AlignedWindow)


def test_a_measured_length_stays() -> None:
    out = speeding((0, 3, 6, 8, 9, 10), 'odometry')
    assert [r.pose.baseline for r in out.references] == pytest.approx([STEP, 4 * STEP])


def test_length_by_exact_ranges() -> None:
    rng = np.random.default_rng(7)
    turn, position = random_rotation(rng, 0.3), np.array([0.5, -0.2, -2.0])
    reference, current = two_views(rng, (300,), turn, position, near=3.0)
    points, index = matches(reference, current), rng.permutation(400)[:300]
    known = np.full(400, np.nan)
    ranges = nearness(points, RelativePose(turn, position))
    known[index] = ranges
    known[index[:40]] *= 1.5  # wrong
    grid = PolarGrid(100)
    view = CurrentView(grid, np.eye(3), np.zeros(grid.shape, np.uint8), np.zeros((400, 2)),
                       np.zeros(400), np.zeros((400, 3)), known, 0.3)
    length, sigma = length_by_ranges(view, points, index, RelativePose(turn, 9 * position))
    assert length == pytest.approx(np.linalg.norm(position), rel=1e-9)
    assert sigma < 0.01 * length
    few = replace(view, baseline=0.01)  # with hardly any parallax nothing is told
    assert length_by_ranges(few, points, index, RelativePose(turn, position)) is None


def test_nearness_is_the_inverse_range() -> None:
    rng = np.random.default_rng(8)
    turn, position = random_rotation(rng, 0.3), np.array([0.5, -0.2, -2.0])
    points = rng.normal(size=(50, 3)) * 6
    reference = (points - position) @ turn
    seen = matches(*(p / np.linalg.norm(p, axis=1, keepdims=True) for p in (reference, points)))
    np.testing.assert_allclose(nearness(seen, RelativePose(turn, position)),
                               1 / np.linalg.norm(points, axis=1), rtol=1e-9)


# --- resampling by range


def relief(view: View, grid: PolarGrid, axes: np.ndarray) -> np.ndarray:
    """The exact nearness on the grid."""
    theta, azimuth = np.meshgrid(grid.theta(), grid.azimuth())
    rays = polar_bearings(theta, azimuth, axes) @ view.rotation.T
    return (1 / HALL.range(view.position, rays)).astype(np.float32)


def test_by_exact_range_the_reference_looks_like_the_current_view() -> None:
    current, reference = views()[11], views()[1]
    pose, grid = true_pose(reference, current), PolarGrid(HEIGHT, 8, 8)
    axes = polar_axes(pose.direction)
    plain = resample(with_border(current.image), polar_map(grid, axes, current.image.shape))
    moved = reference_in_relief(reference.image, pose, grid, axes, relief(current, grid, axes))
    turned = resample(with_border(reference.image),
                      polar_map(grid, pose.rotation.T @ axes, current.image.shape))
    difference, before = (np.median(np.abs(image.astype(float) - plain)) for image in
                          (moved, turned))
    assert difference < 4
    assert before > 3 * difference


def test_at_infinity_relief_is_the_plain_map() -> None:
    reference = views()[0]
    pose, grid = true_pose(reference, views()[4]), PolarGrid(HEIGHT, 8, 8)
    axes = polar_axes(pose.direction)
    flat = reference_in_relief(reference.image, pose, grid, axes,
                               np.zeros(grid.shape, np.float32))
    plain = resample(with_border(reference.image),
                     polar_map(grid, pose.rotation.T @ axes, reference.image.shape))
    assert np.abs(flat.astype(int) - plain).max() <= 1


def test_nearness_is_smooth_between_points_and_keeps_an_even_one() -> None:
    grid, rng = PolarGrid(128), np.random.default_rng(0)
    points = rng.uniform(0, 128, (400, 2)) * (1, 2)
    nearness = np.full(400, 0.25)
    nearness[::5] = np.nan
    assert nearness_map(grid, points, nearness) == pytest.approx(np.full(grid.shape, 0.25))
    assert nearness_map(grid, points, np.full(400, -1.0)).max() == 0
    assert nearness_map(grid, points, np.full(400, np.nan)).max() == 0
    sloped = nearness_map(grid, points, points[:, 1] / 256)
    inner = sloped[40:-40]
    assert np.abs(inner - np.arange(40, 216)[:, None] / 256).max() < 0.05


def test_values_between_pixels() -> None:
    ramp = np.add.outer(10.0 * np.arange(6), np.arange(8)).astype(np.float32)
    found = sampled(ramp, np.array([[2.5, 1.0], [3.0, 4.25]]))
    assert found == pytest.approx([12.5, 45.5], abs=0.1)


@pytest.mark.parametrize('switched_off', ['_ALIKE', '_FOUND_BACK'])
def test_followed_both_ways_leaves_out_what_is_hidden(
        monkeypatch: pytest.MonkeyPatch, switched_off: str) -> None:
    """A patch moves over a still ground: what is at its edge cannot be followed. Either check
    finds most of it.
    """
    monkeypatch.setattr(tracking, switched_off, 1.0 if switched_off == '_ALIKE' else np.inf)
    rng = np.random.default_rng(2)
    ground, patch = (cv2.GaussianBlur(rng.integers(0, 255, (200, 300), np.uint8), (0, 0), 2)
                     for _ in range(2))
    source, target = ground.copy(), ground.copy()
    source[60:140, 100:180], target[60:140, 106:186] = patch[:80, :80], patch[:80, :80]
    points, _ = features(source, spacing_for(2000, 200))
    truth = points + np.where(((points >= (100, 60)) & (points < (180, 140))).all(axis=1)[:, None],
                              (6, 0), (0, 0))

    def wrong(find: object) -> tuple[int, int]:
        moved, found = find(source, target, points)  # type: ignore[operator]
        apart = np.linalg.norm(moved - truth, axis=1)[found]
        return int((apart > 0.5).sum()), int((apart < 0.5).sum())

    bad, _ = wrong(follow)
    left, good = wrong(follow_both_ways)
    assert bad > 20
    assert left < bad / 4
    assert good > len(points) / 2


def test_the_aligner_takes_references_in_any_number() -> None:
    window = paired(3, 1, 2, 3)
    exact = tuple(replace(r, pose=replace(true_pose(views()[r.frame.key.stamp - 1000], views()[3]),
                                          covariance=1e-9 * np.eye(6)))
                  for r in window.references)
    out = Aligner(resolve({})).process(StabilisedWindow(window.current, exact))
    assert [r.frame.key for r in out.references] == [r.frame.key for r in exact]
    for back in (1, 2, 3):
        assert within(errors(out, back), 0.01, 0.05)
