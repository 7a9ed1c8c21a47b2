"""The memory of range: exact ranges go in, and what was kept is compared with the truth."""
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from analytic_world import Ball, World
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.frames import UNSCALED, Frame, FrameKey, Reference, RelativePose
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.joint import Measurement
from sphstereo_ros.core.range_memory import RangeMemory, Remembered

HEIGHT = 48
SECONDS = 0.45
PERIOD = 33_333_333
NEAR, FAR = 0.2, 0.05  # 1/m
VECTOR = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array)
MOTION = VECTOR.filter(lambda v: np.linalg.norm(v) > 0.01)  # no hover


def measurement(rho: np.ndarray | float, frames: np.ndarray | int = 1, sigma: float = 0.02,
                told: float = 0.01, height: int = HEIGHT) -> Measurement:
    """Of `rho` (1/m), with relative standard deviations."""
    def whole(value: np.ndarray | float, kind: type) -> np.ndarray:
        return np.ascontiguousarray(np.broadcast_to(value, (height, 2 * height)), kind)

    rho = whole(rho, np.float32)
    return Measurement(rho, sigma * np.abs(rho), rho, whole(frames, np.int8),
                       told * np.abs(rho), 0 * rho)


@dataclass
class Camera:
    """A camera that tells a memory what it measures, frame by frame."""

    memory: RangeMemory = field(default_factory=lambda: RangeMemory(SECONDS))
    places: dict[FrameKey, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    stamp: int = 10**18

    def moves(self, position: np.ndarray, rotation: np.ndarray | None = None, after: int = PERIOD,
              frame_id: str = 'camera') -> FrameKey:
        """Take the next frame, `after` nanoseconds later."""
        self.stamp += after
        key = FrameKey(self.stamp, frame_id)
        self.places[key] = (np.asarray(position, float),
                            np.eye(3) if rotation is None else rotation)
        return key

    def pose(self, reference: FrameKey, current: FrameKey, scale: float = 1.0) -> RelativePose:
        (p, r), (q, s) = self.places[reference], self.places[current]
        return RelativePose(s.T @ r, scale * (s.T @ (p - q)))

    def tells(self, key: FrameKey, seen: Measurement, *references: FrameKey, scale: float = 1.0,
              vehicle: np.ndarray | None = None) -> Remembered:
        found = self.memory.fused(key, tuple(
            Reference(Frame(r, np.zeros((2, 4), np.uint8)), self.pose(r, key, scale))
            for r in references), seen, vehicle)
        for values in (found.rho, found.sigma, found.evidence):
            assert values.shape == seen.rho.shape
            assert np.isfinite(values).all()
        return found


class Ahead(Camera):
    """Goes ahead by so little that all stays where it is."""

    def sees(self, seen: Measurement, after: int = PERIOD, **more: object) -> Remembered:
        if not self.places:
            self.moves([0, 0, 0])
        last = list(self.places)[-1]
        frame_id = more.pop('frame_id', 'camera')
        key = self.moves([0, 0, 2e-3 * len(self.places)], after=after, frame_id=frame_id)
        return self.tells(key, seen, last, **more)


class Across(Camera):
    """Goes to and fro across a hollow sphere, and measures it: everything beside moves far."""

    truth: np.ndarray

    def sees(self, share: np.ndarray | float = 1.0, sigma: float = 0.02) -> Remembered:
        """What is true times `share`."""
        last = list(self.places)[-1] if self.places else self.moves([-1, 0, 0])
        place = np.array([2.0 * (len(self.places) % 2) - 1, 0, 0])
        self.truth = exact(Ball(radius=5.0), place, np.eye(3), HEIGHT)
        return self.tells(self.moves(place), measurement(self.truth * share, sigma=sigma), last)


def known(found: Remembered) -> np.ndarray:
    return found.sigma < NOTHING


def practised(frames: int = 6, rho: float = NEAR, seconds: float = SECONDS) -> Ahead:
    """A camera that has seen the same in so many frames."""
    camera = Ahead(RangeMemory(seconds))
    for _ in range(frames):
        camera.sees(measurement(rho))
    return camera


NONE = measurement(NEAR, frames=0, told=1.0)  # its grey tells nothing
AGAIN = measurement(1.03 * NEAR, frames=0)
ELSEWHERE = measurement(0.8 * NEAR, frames=0, sigma=0.5)  # could as well be the same
NOWHERE_NEAR = measurement(1.0, frames=0, told=1e-3)


# --- evidence


def test_the_first_window_is_published_as_it_is():
    believed = np.zeros((HEIGHT, 2 * HEIGHT), bool)
    believed[:20] = True
    seen = measurement(NEAR, believed)
    found = Ahead().sees(seen)
    np.testing.assert_array_equal(known(found), believed)
    np.testing.assert_array_equal(found.rho[:20], seen.rho[:20])
    np.testing.assert_array_equal(found.sigma[:20], seen.sigma[:20])


def test_what_is_new_later_waits_for_a_second_frame():
    half = np.zeros((HEIGHT, 2 * HEIGHT), bool)
    half[:, :HEIGHT] = True
    camera = Ahead()
    for _ in range(4):
        camera.sees(measurement(NEAR, half))
    first, second = (camera.sees(measurement(NEAR)) for _ in range(2))
    assert known(first)[:, :HEIGHT - 2].all()
    assert not known(first)[:, HEIGHT + 2:].any()
    assert known(second).all()


def test_evidence_grows_by_one_a_frame_to_six():
    camera = Ahead()
    for n in range(1, 9):
        found = camera.sees(measurement(NEAR))
        np.testing.assert_allclose(found.evidence, min(n, 6))


def test_frames_that_agree_are_averaged_by_their_variance():
    camera = Across()
    first = camera.sees(sigma=0.02)
    second = camera.sees(1.03, sigma=0.01)
    share = np.median(second.rho / camera.truth)
    assert 1.02 < share < 1.03  # the newer is the more certain
    assert np.median(second.sigma / camera.truth) < 0.01 * 1.03
    assert np.median(second.sigma) > 0.3 * np.median(first.sigma)


def test_many_frames_with_errors_of_their_own_come_nearer_to_the_truth():
    rng, camera = np.random.default_rng(0), Across()
    errors = []
    for _ in range(12):
        found = camera.sees(1 + 0.05 * rng.normal(size=(HEIGHT, 2 * HEIGHT)), sigma=0.05)
        errors.append(np.sqrt(np.mean((found.rho / camera.truth - 1)[known(found)]**2)))
    assert errors[-1] < 0.6 * errors[0]
    z = np.abs(found.rho - camera.truth)[known(found)] / found.sigma[known(found)]
    assert 0.5 < np.median(z) < 0.9  # of a normal distribution: 0.67


def test_frames_in_which_hardly_anything_moves_err_alike():
    """However many there are, sigma is that of one; the poles of the motion hardly move at all."""
    rng, still, across = np.random.default_rng(0), Ahead(), Across()
    error = 1 + 0.02 * rng.normal(size=(HEIGHT, 2 * HEIGHT))
    for _ in range(12):
        alike = still.sees(measurement(NEAR * error))
        moved = across.sees()
    z = np.abs(alike.rho - NEAR) / alike.sigma
    assert 0.5 < np.median(z) < 0.7
    share = moved.sigma / across.truth / 0.02  # of one frame's
    pole, equator = share[HEIGHT // 2 - 1, 3 * HEIGHT // 2 - 1], share[4:-4, HEIGHT]
    assert pole > 0.9
    assert (equator < 0.8).all()
    assert (equator > 0.675).all()  # errors of what moves much are somewhat alike, too


@pytest.mark.parametrize(('scale', 'rho', 'sigma', 'told'), [
    (1.0, 0.1, 0.35, False), (1.0, 0.1, 0.25, True), (1.0, 0.02, 0.35, True),
    (UNSCALED / 0.5, 0.1, 0.35, False), (UNSCALED / 0.5, 0.02, 0.35, True)])
def test_nothing_uncertain_is_told_to_be_near_by(scale, rho, sigma, told):
    """Nearer than 40 baselines, of 0.5 m; also where metres are unknown."""
    camera, unit = Camera(), 1.0 if scale == 1.0 else 0.5
    keys = [camera.moves([0, 0, 0.5 * n]) for n in range(2)]
    found = camera.tells(keys[1], measurement(rho * unit, sigma=sigma), keys[0], scale=scale)
    assert (known(found) == told).all()


def test_sigma_has_a_floor_however_long_it_looks():
    """Errors of consecutive frames are much alike."""
    camera = practised(30)
    found = camera.sees(measurement(NEAR))
    assert (found.sigma > 0.3 * 0.02 * NEAR).all()


@pytest.mark.parametrize(('seen', 'left'), [
    (NONE, [6 - 6 / SECONDS / 30 * n for n in (1, 2, 3)]), (AGAIN, [2, 1, 0]),
    (ELSEWHERE, [1, 0, 0]), (NOWHERE_NEAR, [1, 0, 0])], ids=['blind', 'again', 'else', 'far off'])
def test_what_nothing_confirms_fades(seen, left):
    camera = practised()
    levels = [float(np.median(camera.sees(seen).evidence)) for _ in range(3)]
    np.testing.assert_allclose(np.maximum(levels, 0), left, atol=1e-3)


def test_what_may_have_come_before_it_is_gone_at_once():
    """It is not believed that something is nearer; nor that what was there is all there is."""
    veiled = np.where(np.arange(2 * HEIGHT) < HEIGHT, -1, 0)
    camera = practised()
    found = camera.sees(measurement(NEAR, veiled, told=1.0))
    assert not known(found)[:, 2:HEIGHT - 2].any()
    assert known(found)[2:-2, HEIGHT + 2:-2].all()
    assert known(camera.sees(NONE))[2:-2].mean() > 0.95  # it was no contradiction


def test_what_looks_plain_needs_no_second_frame():
    plain = np.where(np.arange(2 * HEIGHT) < HEIGHT, 2, 1)
    camera = Ahead()
    for _ in range(3):
        camera.sees(measurement(NEAR, frames=0))
    found = camera.sees(measurement(NEAR, plain))
    np.testing.assert_array_equal(known(found), plain[None] * np.ones((HEIGHT, 1)) == 2)


@settings(deadline=None)
@given(st.floats(0.005, 0.44), st.sampled_from([NONE, AGAIN, ELSEWHERE, NOWHERE_NEAR]))
def test_nothing_is_kept_longer_than_the_memory(period, seen):
    camera = practised()
    time = 0.0
    while time < SECONDS:
        found = camera.sees(seen, after=round(period * 1e9))
        time += period
    assert not known(found).any()
    again = camera.sees(seen)
    assert not known(again).any()


def test_a_short_memory_fades_sooner():
    camera = practised(seconds=0.12)
    found = [known(camera.sees(NONE)).any() for _ in range(4)]
    assert found == [True, True, False, False]


# --- contradiction


def test_what_is_nearer_counts_at_once():
    """Nothing is reported where it was farther; one frame later the nearer is."""
    camera = practised(rho=FAR)
    found = camera.sees(measurement(NEAR))
    assert not (known(found) & (found.rho < 0.9 * NEAR)).any()
    found = camera.sees(measurement(NEAR))
    assert known(found).all()
    np.testing.assert_allclose(found.rho, NEAR, rtol=0.01)


def test_a_thing_that_is_seen_but_not_believed_takes_away_what_was_far():
    """Its own inverse range says what its grey tells, not that of what is behind."""
    camera = practised(rho=FAR)
    seen = measurement(1.0, frames=0, told=0.01)
    levels = [float(np.median(camera.sees(seen).evidence)) for _ in range(2)]
    np.testing.assert_allclose(np.maximum(levels, 0), [1, 0])


def test_what_is_not_believed_moves_nothing():
    camera = practised(rho=0.3)
    before = camera.sees(measurement(0.3))
    found = camera.sees(measurement(0.2, frames=0, sigma=0.5, told=1.0))
    np.testing.assert_allclose(found.rho, 0.3, rtol=5e-3)
    assert (found.sigma >= before.sigma).all()


def test_what_is_farther_waits_for_a_second_frame_however_plain():
    camera = practised(2)
    assert not known(camera.sees(measurement(FAR, frames=2))).any()
    assert known(camera.sees(measurement(FAR, frames=2))).all()


@settings(deadline=None)
@given(st.floats(0.03, 0.44), st.sampled_from([1, 2]))
def test_what_is_contradicted_is_not_kept_longer_than_the_memory(period, frames):
    camera = practised()
    time = 0.0
    while time < SECONDS:
        found = camera.sees(measurement(FAR, frames), after=round(period * 1e9))
        time += period
    assert not (known(found) & (found.rho > 2 * FAR)).any()


def test_what_is_farther_has_to_insist():
    camera = practised(rho=NEAR)
    for n in range(1, 6):
        found = camera.sees(measurement(FAR))
        old, new = (known(found) & (np.abs(found.rho / rho - 1) < 0.05) for rho in (NEAR, FAR))
        assert old.mean() > 0.95 if n < 3 else not old.any()
        assert new.mean() > 0.95 if n > 3 else not new.any()


# --- every frame by itself


def test_no_memory_is_every_frame_by_itself():
    camera = practised(seconds=0.0)
    seen = measurement(FAR, np.arange(2 * HEIGHT) < 30)
    found = camera.sees(seen)
    np.testing.assert_array_equal(known(found), seen.frames != 0)
    np.testing.assert_array_equal(found.rho[:, :30], seen.rho[:, :30])


def breaks() -> dict[str, dict]:
    return {'a gap': {'after': round(0.46 * 1e9)}, 'the same stamp': {'after': 0},
            'backward': {'after': -3 * PERIOD + 1}, 'another frame_id': {'frame_id': 'other'},
            'no metres': {'scale': 5 * UNSCALED}}


@pytest.mark.parametrize('case', breaks())
def test_after_a_break_nothing_is_left_and_the_frame_stands_by_itself(case):
    half = measurement(FAR, np.arange(2 * HEIGHT) < HEIGHT)
    camera = practised()
    found = camera.sees(half, **breaks()[case])
    np.testing.assert_array_equal(known(found), half.frames != 0)
    np.testing.assert_array_equal(found.rho[:, :HEIGHT], half.rho[:, :HEIGHT])


def test_without_a_break_it_would_be_left():
    assert known(practised().sees(NONE)).mean() > 0.95


def test_another_size_begins_anew():
    camera = practised()
    found = camera.sees(measurement(FAR, height=40))
    assert known(found).all()
    np.testing.assert_array_equal(found.rho, np.float32(FAR))


def test_frames_that_nothing_links_begin_anew():
    camera = practised()
    apart = camera.moves([0, 0, 1])
    found = camera.tells(camera.moves([0, 0, 1.1]), NONE, apart)
    assert not known(found).any()


def test_after_backward_stamps_it_learns_again():
    camera = practised()
    camera.sees(measurement(NEAR), after=-4 * PERIOD + 1)
    for _ in range(3):
        camera.sees(measurement(NEAR))
    assert known(camera.sees(NONE)).mean() > 0.95


# --- mask


def test_what_the_vehicle_covers_is_never_learnt():
    vehicle = np.zeros((HEIGHT, 2 * HEIGHT), bool)
    vehicle[30:] = True
    camera, seen = Ahead(), measurement(NEAR)
    for _ in range(4):
        found = camera.sees(seen, vehicle=vehicle)
    assert not known(found)[32:].any()
    assert known(found)[:30].all()
    assert (seen.frames == 1).all()  # the measurement is the caller's


# --- motion


def exact(world: World, position: np.ndarray, rotation: np.ndarray, height: int) -> np.ndarray:
    rays = Equirectangular(height, 2 * height).bearings() @ rotation.T
    return (1 / world.range(np.asarray(position, float), rays)).astype(np.float32)


def carried(world: World, position: np.ndarray, rotation: np.ndarray,
            height: int = HEIGHT) -> tuple[Remembered, np.ndarray]:
    """What a memory of four frames at the origin tells when the camera has moved; the truth."""
    camera, start = Camera(), exact(world, np.zeros(3), np.eye(3), height)
    last = camera.moves([0, 0, 0])
    for n in (1, 2, 3, 4, 0):
        key = camera.moves([2e-3 * n, 0, 0])
        camera.tells(key, measurement(start, height=height), last)
        last = key
    key = camera.moves(position, rotation)
    blind = measurement(start, frames=0, sigma=1e3, told=1e3, height=height)
    return camera.tells(key, blind, last), exact(world, position, rotation, height)


@settings(deadline=None)
@given(MOTION, VECTOR, st.sampled_from([48, 49, 50, 51]))
def test_moved_range_is_what_the_moved_camera_sees(position, turn, height):
    """Any motion: in a room without posts nothing hides anything."""
    room = World(posts=())
    found, truth = carried(room, 0.7 * position, rotations.exp(2 * turn), height)
    inside = slice(3, -3)
    assert known(found)[inside].mean() > 0.75
    off = np.abs(found.rho / truth - 1)[known(found)]
    assert np.median(off) < 0.03  # half a pixel is 1.9°
    assert np.quantile(off, 0.9) < 0.12


@settings(deadline=None)
@given(MOTION, VECTOR)
def test_moved_range_is_not_biased(position, turn):
    """In a hollow sphere range changes little from pixel to pixel: rounding does not matter."""
    found, truth = carried(Ball(radius=4.0), 0.5 * position, rotations.exp(2 * turn))
    ratio = (found.rho / truth)[known(found)]
    assert np.quantile(np.abs(ratio - 1), 0.95) < 0.02
    assert abs(np.median(ratio) - 1) < 0.004


@pytest.mark.parametrize('height', [64, 65])
@pytest.mark.parametrize('turn', [(0, 0.4, 0), (0.5, 0, 0), (0.2, -2.0, 0.3)], ids=str)
def test_turned_range_is_where_the_turned_camera_sees_it(height, turn):
    """A pure rotation: one bright pixel goes to where its bearing is."""
    camera = Camera()
    rays = Equirectangular(height, 2 * height).bearings()
    rho = np.full((height, 2 * height), 1e-4, np.float32)
    spots = [(20, 30), (height // 2, 100), (height - 12, 7)]
    for spot in spots:
        rho[spot] = 0.01
    last = camera.moves([0, 0, 0])
    for n in range(1, 5):
        key = camera.moves([0.002 * n, 0, 0])
        camera.tells(key, measurement(rho, height=height), last)
        last = key
    rotation = rotations.exp(turn)
    found = camera.tells(camera.moves([0.01, 0, 0], rotation), measurement(
        rho, frames=0, sigma=1e6, told=1e6, height=height), last)
    near = found.rho > 0.005
    assert near.sum() <= 4 * len(spots)
    for spot in spots:
        apart = np.arccos(np.clip(rays[near] @ (rotation.T @ rays[spot]), -1, 1))
        assert apart.min() < 0.71 * np.pi / height
        mine = rays[near][apart < 3 * np.pi / height]
        centre = mine.mean(axis=0)
        assert np.linalg.norm(centre - rotation.T @ rays[spot]) < 0.5 * np.pi / height


def test_what_is_nearer_hides_what_is_farther():
    """A post, seen from aside: no wall shows through it, though walls are kept too."""
    room = World(posts=((0.0, 2.0, 0.4),))
    found, truth = carried(room, np.array([0.5, 0, 0]), np.eye(3), 96)
    post = truth > 0.45
    post[:30] = post[-30:] = False
    inside = post & np.roll(post, 1, 1) & np.roll(post, -1, 1)
    assert inside.sum() > 100
    assert known(found)[inside].mean() > 0.75
    assert (found.rho > 0.9 * truth)[inside & known(found)].all()


@pytest.mark.parametrize('pixels', [0.3, 0.5, 0.8])
def test_of_one_surface_not_the_nearest_is_kept(pixels):
    """Of two pixels that fall on one, the nearer errs towards the camera as a rule."""
    rng, camera = np.random.default_rng(0), Camera()
    noisy = NEAR * (1 + 0.02 * rng.normal(size=(HEIGHT, 2 * HEIGHT)))
    last = camera.moves([0, 0, 0])
    for n in range(1, 5):
        key = camera.moves([0, 0, 2e-3 * n])
        camera.tells(key, measurement(noisy), last)
        last = key
    key = camera.moves([0, 0, 0], rotations.exp(
        np.array([0, pixels * np.pi / HEIGHT, 0])))
    found = camera.tells(key, measurement(NEAR, frames=0, sigma=1e3, told=1e3), last)
    row = np.s_[HEIGHT // 2 - 8:HEIGHT // 2 + 8]
    assert known(found)[row].mean() > 0.9
    error = (found.rho / NEAR - 1)[row][known(found)[row]]
    assert abs(error.mean()) < 0.2 * 0.02
    assert error.std() == pytest.approx(0.02, rel=0.1)


def test_sigma_is_that_of_the_moved_range():
    """Straight ahead, r shrinks and its sigma does not."""
    found, truth = carried(Ball(radius=4.0), np.array([0, 0, 2.0]), np.eye(3))
    ahead = (HEIGHT // 2, HEIGHT)
    before, _ = carried(Ball(radius=4.0), np.array([0, 0, 3e-3]), np.eye(3))
    metres = [f.sigma[ahead] / f.rho[ahead]**2 for f in (before, found)]
    assert truth[ahead] == pytest.approx(0.5, rel=0.01)
    assert metres[1] == pytest.approx(metres[0], rel=0.05)


# --- windows that were dropped


@pytest.mark.parametrize('links', ['direct', 'chained'])
def test_a_frame_after_dropped_windows_still_finds_its_pose(links):
    """A late stage takes the newest window: frames are skipped, references lead back."""
    ball, camera = Ball(radius=4.0), Camera()
    keys = [camera.moves([0, 0, 0.02 * n]) for n in range(6)]
    for n in range(1, 6):
        start = exact(ball, camera.places[keys[n]][0], np.eye(3), HEIGHT)
        camera.tells(keys[n], measurement(start), *keys[max(n - 3, 0):n])
    for n in range(3):  # nobody takes these
        keys.append(camera.moves([0.1 * n, 0, 0.1]))
    rotation = rotations.exp([0.3, 0.5, 0.1])
    last = camera.moves([1.0, 0, 0.5], rotation)
    old = keys[5] if links == 'direct' else keys[2]  # that one is a reference of frame 5
    found = camera.tells(last, measurement(0.2, frames=0, sigma=1e3, told=1e3), keys[7], old)
    truth = exact(ball, camera.places[last][0], rotation, HEIGHT)
    assert known(found).mean() > 0.8
    assert np.quantile(np.abs(found.rho / truth - 1)[known(found)], 0.9) < 0.03


def test_poses_in_metres_and_in_steps_make_no_chain():
    """Metres are lost, and come again: no path leads through what was without."""
    camera = Camera()
    keys = [camera.moves([0, 0, 0.2 * n]) for n in range(8)]
    camera.tells(keys[1], measurement(NEAR), keys[0])
    camera.tells(keys[2], measurement(NEAR), keys[1])
    for n in (3, 4, 5):  # steps between frames, of 0.2 m
        found = camera.tells(keys[n], measurement(0.2 * NEAR), keys[n - 1], keys[1],
                             scale=5 * UNSCALED)
        assert known(found).any()
    found = camera.tells(keys[7], measurement(0.2 * NEAR, frames=0), keys[6], keys[0],
                         scale=5 * UNSCALED)
    assert not known(found).any()  # frame 0 is linked in metres only


# --- determinism


def test_the_same_input_gives_the_same_output():
    rng = np.random.default_rng(0)
    seen = [measurement(NEAR * (1 + 0.03 * rng.normal(size=(HEIGHT, 2 * HEIGHT))),
                        rng.random((HEIGHT, 2 * HEIGHT)) < 0.7) for _ in range(5)]
    runs = []
    for _ in range(2):
        camera = Ahead()
        runs.append([camera.sees(m) for m in seen])
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.rho, other.rho)
        np.testing.assert_array_equal(one.sigma, other.sigma)
        np.testing.assert_array_equal(one.evidence, other.evidence)


def test_what_was_told_is_not_changed_by_later_frames():
    camera = practised(2)
    found = camera.sees(measurement(NEAR))
    copies = [m.copy() for m in (found.rho, found.sigma, found.evidence)]
    for _ in range(3):
        camera.sees(measurement(FAR))
    for copy, now in zip(copies, (found.rho, found.sigma, found.evidence), strict=True):
        np.testing.assert_array_equal(copy, now)


def test_what_is_to_be_forgotten_is():
    camera = practised()
    where = np.zeros((HEIGHT, 2 * HEIGHT), bool)
    where[10:30] = True
    camera.memory.forget(where)
    found = camera.sees(NONE)
    assert not known(found)[12:28].any()
    assert known(found)[32:-2].mean() > 0.95
    camera = practised()
    camera.memory.forget(where)
    found = camera.sees(measurement(1.01 * NEAR))
    np.testing.assert_allclose(found.rho[12:28], 1.01 * NEAR, rtol=1e-6)  # no average with it
