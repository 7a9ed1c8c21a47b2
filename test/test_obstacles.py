"""Obstacle detection against worlds whose truth is known in closed form."""
from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.bench.methods import Method
from sphstereo_ros.bench.obstacle_truth import true_sectors
from sphstereo_ros.bench.obstacles import ObstacleContest, frames_of_bag, sequence_line
from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.contact import time_to_contact
from sphstereo_ros.core.frames import Drop, FrameKey, RangeImage
from sphstereo_ros.core.level import (
    Attitude,
    AttitudeHistory,
    attitude,
    attitude_from_quaternion,
)
from sphstereo_ros.core.motion import OdometrySample
from sphstereo_ros.core.obstacles import ObstacleDetection
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK, matrix_from_rpy
from sphstereo_ros.core.sectors import SECTORS, ObstacleSectors, SectorState, sector_centres

HEIGHT = 480
Shape = Callable[[np.ndarray, np.ndarray], np.ndarray]


def floor(depth: float) -> Shape:
    """Ground that lies `depth` below the camera."""
    def distance(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide='ignore'):
            return np.where(rays[..., 2] < 0, (-depth - origin[2]) / rays[..., 2], np.inf)
    return distance


def post(x: float, y: float, radius: float, low: float = -np.inf,
         high: float = np.inf) -> Shape:
    """An upright post."""
    def distance(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        flat = rays[..., :2]
        to = np.array([x, y]) - origin[:2]
        a, b = (flat**2).sum(-1), flat @ to
        with np.errstate(invalid='ignore', divide='ignore'):
            r = (b - np.sqrt(b**2 - a * (to @ to - radius**2))) / a
        z = origin[2] + r * rays[..., 2]
        return np.where((r > 0) & (z > low) & (z < high), r, np.inf)
    return distance


def wall(ahead: float) -> Shape:
    """A wall across, so far ahead."""
    def distance(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        with np.errstate(divide='ignore'):
            return np.where(rays[..., 0] > 0, (ahead - origin[0]) / rays[..., 0], np.inf)
    return distance


def seen(*shapes: Shape, tilt: np.ndarray | None = None, height: int = HEIGHT,
         sigma: float = 0.003) -> RangeImage:
    """What a camera at the origin sees; tilt : (3, 3) level frame ← `base_link`."""
    turn = (np.eye(3) if tilt is None else tilt) @ OPTICAL_FROM_LINK.T
    rays = Equirectangular(height, 2 * height).bearings() @ turn.T
    r = np.full(rays.shape[:2], np.inf)
    for shape in shapes:
        r = np.minimum(r, shape(np.zeros(3), rays))
    r = np.where(r > 120, np.inf, np.where(r < 0.3, -np.inf, r)).astype(np.float32)
    with np.errstate(invalid='ignore'):
        spread = np.where(np.isfinite(r), sigma * r, np.nan).astype(np.float32)
    return RangeImage(FrameKey(1, 'camera_optical'), r, spread, True)


def detect(image: RangeImage, level: Attitude | None = None,
           **parameters: object) -> ObstacleSectors:
    config = resolve({f'obstacles.{name}': value for name, value in parameters.items()})
    out = ObstacleDetection(config).process(image, level or Attitude())
    assert isinstance(out, ObstacleSectors)
    return out


def sector_of(x: float, y: float) -> int:
    """The sector in which (x, y) lies."""
    turn = np.arctan2(-y, x)
    off = (sector_centres() - turn + np.pi) % (2 * np.pi) - np.pi
    return int(np.argmin(np.abs(off)))


def test_nothing_is_known_of_nothing() -> None:
    image = seen()
    image.range[:] = np.nan
    out = detect(image)
    assert (out.state == SectorState.UNKNOWN).all()
    assert np.isnan(out.distance).all()
    assert out.nearest is None


def test_sky_all_round_is_free() -> None:
    out = detect(seen())
    assert (out.state == SectorState.FREE).all()
    assert np.isnan(out.distance).all()


@pytest.mark.parametrize('depth', [0.3, 0.7, 2.0])
def test_ground_is_no_obstacle(depth: float) -> None:
    assert (detect(seen(floor(depth))).state == SectorState.FREE).all()


@pytest.mark.parametrize('height', [480, 960])
def test_a_thin_pole_is_found_where_it_stands(height: int) -> None:
    x, y = 6 * np.cos(0.6), 6 * np.sin(0.6)
    out = detect(seen(floor(1.5), post(x, y, 0.075), height=height))
    at = sector_of(x, y)
    assert out.state[at] == SectorState.MEASURED
    assert out.distance[at] == pytest.approx(5.925, rel=0.01)
    others = np.delete(out.state, [at - 1, at, at + 1])
    assert (others == SectorState.FREE).all()


@pytest.mark.parametrize(('roll', 'pitch'), [(0.35, 0.0), (0.0, -0.35), (-0.25, 0.25)])
def test_tilt_does_not_turn_ground_into_obstacles(roll: float, pitch: float) -> None:
    tilt = matrix_from_rpy(roll, pitch, 0.0)
    level = attitude(matrix_from_rpy(roll, pitch, 1.0))
    assert isinstance(level, Attitude)
    image = seen(floor(0.8), post(0, 4, 0.2), tilt=tilt)
    out = detect(image, level)
    at = sector_of(0, 4)
    assert out.distance[at] == pytest.approx(3.8, rel=0.01)
    assert np.flatnonzero(out.state != SectorState.FREE).tolist() == [
        i for i in (at - 1, at, at + 1) if out.state[i] == SectorState.MEASURED]


def test_a_wall_is_as_far_as_its_nearest_point_in_the_sector() -> None:
    out = detect(seen(wall(6.0), floor(1.5)))
    for at in range(SECTORS):
        angle = abs((np.degrees(sector_centres()[at]) + 180) % 360 - 180)
        if angle <= 60:
            expected = 6 / np.cos(np.radians(max(angle - 2.5, 0)))
            assert out.distance[at] == pytest.approx(expected, rel=0.02)
        elif angle > 80:
            assert out.state[at] == SectorState.FREE


@pytest.mark.parametrize(('low', 'high'), [(-1.5, -0.885), (0.885, 1.6)])
def test_what_is_measured_too_far_does_not_leave_the_band(low: float, high: float) -> None:
    """It reaches 11.5 cm into the band; 3 % farther along its rays that is 9."""
    image = seen(floor(1.5), post(3, 0, 0.4, low, high), wall(9.0), height=960)
    near = image.range < 4.2
    image.range[near] *= 1.03
    image.sigma[near] *= 1.03
    assert detect(image).distance[sector_of(1, 0)] == pytest.approx(2.6 * 1.03, rel=0.02)


def test_under_what_hangs_just_above_the_band_nothing_is_free() -> None:
    """The crown of a tree begins nowhere exactly: single leaves hang lower, unseen."""
    at = sector_of(8, 1)
    over = detect(seen(floor(1.8), post(8, 1, 0.6, low=1.1)))
    assert over.state[at] == SectorState.UNKNOWN
    high = detect(seen(floor(1.8), post(8, 1, 0.6, low=2.0)))
    assert high.state[at] == SectorState.FREE


def test_what_stands_on_the_edge_is_in_both_sectors() -> None:
    edge = np.radians(-2.5)
    out = detect(seen(post(5 * np.cos(edge), -5 * np.sin(edge), 0.1)))
    left, right = sector_of(5, 0.4), sector_of(5, 0.0)
    assert (left + 1) % SECTORS == right
    assert out.distance[[left, right]] == pytest.approx([4.9, 4.9], rel=0.01)


@pytest.mark.parametrize('depth', [0.3, 1.2])
def test_a_box_on_the_ground_stays(depth: float) -> None:
    out = detect(seen(floor(depth), post(5, 0, 0.25, -depth, 0.5 - depth)))
    at = sector_of(5, 0)
    assert out.distance[at] == pytest.approx(4.75, rel=0.02)
    assert out.state[(at + SECTORS // 2) % SECTORS] == SectorState.FREE


def test_a_kerb_goes_and_uncertain_ground_stays_ground() -> None:
    rng = np.random.default_rng(3)
    image = seen(floor(0.7), post(5, 0, 0.5, -0.7, -0.6), sigma=0.05)
    image.range[:] *= 1 + 0.05 * rng.standard_normal(image.range.shape).astype(np.float32)
    assert SectorState.MEASURED not in detect(image).state


def test_unknown_pixels_that_could_hide_a_pole_are_not_free() -> None:
    image = seen(floor(1.5))
    columns = slice(HEIGHT - 2, HEIGHT + 2)  # 1.5° ahead
    rows = slice(HEIGHT // 2 - 8, HEIGHT // 2 + 8)  # ±3°
    image.range[rows, columns] = np.nan
    out = detect(image)
    at = sector_of(1, 0)
    assert out.state[at] == SectorState.UNKNOWN
    assert (np.delete(out.state, at) == SectorState.FREE).all()


def test_single_unknown_pixels_leave_a_sector_free() -> None:
    image = seen(floor(1.5))
    image.range[::7, ::7] = np.nan
    assert (detect(image).state == SectorState.FREE).all()


def test_uncertain_range_beyond_the_maximum_is_not_free() -> None:
    out = detect(seen(wall(24.0), floor(1.5), sigma=0.2), max=20.0)
    assert out.state[sector_of(1, 0)] == SectorState.UNKNOWN
    out = detect(seen(wall(24.0), floor(1.5), sigma=0.02), max=20.0)
    assert out.state[sector_of(1, 0)] == SectorState.FREE


def test_stray_near_pixels_are_no_obstacle_but_doubt() -> None:
    image = seen(floor(1.5))
    for row, column in ((-3, 1), (2, 2), (0, 4), (5, 0)):
        image.range[HEIGHT // 2 + row, HEIGHT + column] = 9.0
        image.sigma[HEIGHT // 2 + row, HEIGHT + column] = 0.05
    out = detect(image)
    assert out.state[sector_of(1, 0)] == SectorState.UNKNOWN
    assert SectorState.MEASURED not in out.state


def test_nearer_than_the_minimum_is_measured_too_close() -> None:
    image = seen(floor(1.5), post(0.5, 0, 0.3))  # its front is 0.2 m away: −Inf
    out = detect(image)
    at = sector_of(1, 0)
    assert out.too_close[at]
    assert out.distance[at] == pytest.approx(0.3)
    assert out.nearest == pytest.approx(0.3)


def test_the_vehicle_is_neither_obstacle_nor_free() -> None:
    mask = np.zeros((HEIGHT, 2 * HEIGHT), np.uint8)
    mask[:, HEIGHT - 60:HEIGHT + 60] = 255  # ±22° ahead
    detection = ObstacleDetection(resolve({}), mask)
    out = detection.process(seen(floor(1.5), post(1, 0, 0.3)), Attitude())
    assert isinstance(out, ObstacleSectors)
    assert out.state[sector_of(1, 0)] == SectorState.UNKNOWN
    assert out.state[sector_of(-1, 0)] == SectorState.FREE


def test_what_could_hide_a_body_makes_the_wall_behind_unknown() -> None:
    image = seen(wall(10.0), floor(1.2))
    rows, columns = slice(HEIGHT // 2 + 3, HEIGHT // 2 + 35), slice(HEIGHT - 60, HEIGHT + 60)
    image.range[rows, columns] = np.nan
    at = sector_of(1, 0)
    assert detect(image).state[at] == SectorState.UNKNOWN
    assert detect(image, hidden_width=0.0).state[at] == SectorState.MEASURED


def test_what_could_hide_a_post_makes_the_wall_behind_unknown() -> None:
    image = seen(wall(10.0), floor(1.2))
    columns = slice(HEIGHT - 4, HEIGHT + 4)  # 3°: 0.15 m at 2.9 m
    image.range[HEIGHT // 2 - 60:HEIGHT // 2 + 60, columns] = np.nan
    at = sector_of(1, 0)
    assert detect(image).state[at] == SectorState.UNKNOWN
    assert detect(image, hidden_width=0.0).state[at] == SectorState.MEASURED
    image = seen(wall(10.0), floor(1.2))
    image.range[HEIGHT // 2 - 60:HEIGHT // 2 + 60, HEIGHT:HEIGHT + 1] = np.nan
    assert detect(image).state[at] == SectorState.MEASURED


def test_a_low_edge_in_the_band_is_told_not_the_wall_behind() -> None:
    out = detect(seen(floor(1.6), wall(12.0), post(3.0, 0, 0.6, high=-0.98)), height_below=1.0)
    for sector in (sector_of(1, 0), sector_of(1, 0.1)):
        assert out.distance[sector] == pytest.approx(2.4, rel=0.05)


def test_plain_sky_is_unknown_unless_it_is_trusted() -> None:
    image = seen(floor(1.5), wall(30.0))
    lat = 90 - (np.arange(HEIGHT) + 0.5) / HEIGHT * 180
    image.range[lat > 11] = np.nan
    at = sector_of(1, 0)
    assert detect(image).state[at] == SectorState.UNKNOWN
    assert detect(image, trust_sky=True).state[at] == SectorState.FREE


def test_the_mount_counts() -> None:
    config = resolve({'camera.mount.x': 0.5, 'camera.mount.z': 0.4, 'camera.mount.yaw': 0.3})
    x, y = 4 * np.cos(-0.3), 4 * np.sin(-0.3)  # straight ahead of the vehicle, 4 m from the camera
    out = ObstacleDetection(config).process(seen(floor(1.2), post(x, y, 0.1)), Attitude())
    assert isinstance(out, ObstacleSectors)
    assert out.distance[sector_of(1, 0)] == pytest.approx(4.4, rel=0.01)
    assert out.points[:, 2].max() == pytest.approx(1.0, abs=0.05)


@settings(max_examples=25, deadline=None)
@given(turn=st.integers(1, 71), seed=st.integers(0, 1000))
def test_turning_the_world_turns_the_sectors(turn: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    posts = [(r, a, w) for r, a, w in zip(rng.uniform(1, 15, 6), rng.uniform(0, 2 * np.pi, 6),
                                          rng.uniform(0.1, 0.4, 6), strict=True)]

    image = seen(floor(0.9), *(post(r * np.cos(a), r * np.sin(a), w) for r, a, w in posts),
                 height=144)
    by = turn * 2 * 144 // SECTORS  # pixels, to the right
    here = detect(image)
    turned = detect(dataclasses.replace(image, range=np.roll(image.range, by, axis=1),
                                        sigma=np.roll(image.sigma, by, axis=1)))
    assert turned.state.tolist() == np.roll(here.state, turn).tolist()
    np.testing.assert_allclose(turned.distance, np.roll(here.distance, turn), rtol=0.012)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_a_nearer_point_never_increases_its_sectors_distance(data: st.DataObject) -> None:
    """What is too small to be believed hides what is behind it: that is unknown then."""
    height = 144
    image = seen(floor(0.9), post(6, 1, 0.5), wall(9.0), height=height)
    before = detect(image)
    row = data.draw(st.integers(height // 2 - 20, height // 2))
    column = data.draw(st.integers(0, 2 * height - 1))
    size = data.draw(st.integers(1, 6))
    share = data.draw(st.floats(0.05, 0.95))
    part = (slice(row, row + size), slice(column, column + size))
    old = np.where(np.isfinite(image.range[part]), image.range[part], 18.0)
    image.range[part] = np.maximum(share * old, 0.31)
    image.sigma[part] = 0.003 * image.range[part]
    after = detect(image)
    told = (before.state == SectorState.MEASURED) & (after.state != SectorState.UNKNOWN)
    assert (after.distance[told] <= before.distance[told] * 1.0001).all()
    assert not (after.state == SectorState.FREE)[before.state != SectorState.FREE].any()


def sectors(**measured: float) -> tuple[np.ndarray, np.ndarray]:
    """All free but those at the degrees named (`at_90` is on the right)."""
    state = np.full(SECTORS, SectorState.FREE, np.uint8)
    distance = np.full(SECTORS, np.nan, np.float32)
    for name, metres in measured.items():
        at = sector_of(*np.array([np.cos(a := np.radians(float(name[3:]))), -np.sin(a)]))
        state[at], distance[at] = SectorState.MEASURED, metres
    return state, distance


def test_time_to_contact() -> None:
    ahead, right = np.array([2.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    state, distance = sectors(at_0=8.0, at_90=3.0)
    assert time_to_contact(state, distance, ahead, 0.6) == pytest.approx(4.0)
    assert time_to_contact(state, distance, right, 0.6) == pytest.approx(3.0)
    assert time_to_contact(state, distance, -ahead, 0.6) == np.inf
    assert time_to_contact(state, distance, 0.01 * ahead, 0.6) == np.inf
    assert time_to_contact(state, distance, None, 0.6) is None
    state[sector_of(-1, 0)] = SectorState.UNKNOWN
    assert time_to_contact(state, distance, -ahead, 0.6) is None


def test_what_the_vehicle_would_brush_counts_for_contact() -> None:
    state, distance = sectors(at_20=1.0)
    assert time_to_contact(state, distance, np.array([1.0, 0, 0]), 0.4) == np.inf
    assert time_to_contact(state, distance, np.array([1.0, 0, 0]), 0.8) == pytest.approx(
        np.cos(np.radians(17.5)))


def test_velocity_comes_from_odometry() -> None:
    history = AttitudeHistory()
    turn = matrix_from_rpy(0.1, -0.2, 0.7)
    for k in range(3):
        position = turn @ np.array([0.05 * k, 0.0, 0.0])
        history.add_odometry(OdometrySample(k * 25_000_000, position, turn))
    found = history.at(30_000_000)
    assert isinstance(found, Attitude)
    assert found.velocity is not None
    np.testing.assert_allclose(found.rotation, matrix_from_rpy(0.1, -0.2, 0.0), atol=1e-9)
    np.testing.assert_allclose(found.velocity, found.rotation @ [2.0, 0, 0], atol=1e-9)
    assert history.at(500_000_000) is None


@pytest.mark.parametrize(('quaternion', 'cause'), [
    ((0, 0, 0, 0), 'invalid_quaternion'), ((0, 0, 0, np.nan), 'not_finite'),
    ((0, 0, 0, 2), 'invalid_quaternion'), ((0, np.sqrt(0.5), 0, np.sqrt(0.5)), 'steep_attitude')])
def test_quaternions_that_tell_no_attitude(quaternion: tuple[float, ...], cause: str) -> None:
    out = attitude_from_quaternion(quaternion)
    assert isinstance(out, Drop)
    assert out.cause == cause


def test_truth_agrees_with_closed_forms() -> None:
    image = seen(wall(6.0), floor(1.5), post(0, -3, 0.1), height=960)
    limits = resolve({}).obstacles
    truth = true_sectors(image.range.astype(float), OPTICAL_FROM_LINK.T, 1.5, limits)
    assert truth[sector_of(1, 0)] == pytest.approx(6.0, rel=0.01)
    assert truth[sector_of(0, -1)] == pytest.approx(2.9, rel=0.01)
    assert truth[sector_of(-1, 0)] == np.inf


def test_truth_has_what_is_beside_where_it_is_widened() -> None:
    """Also behind, where the picture ends, and in the first sector."""
    limits = resolve({}).obstacles
    for turn in np.radians([180, -20]):
        at = turn + np.radians([3.3, -3.3])  # beyond the edges of the sector at `turn`
        image = seen(post(5 * np.cos(at[0]), -5 * np.sin(at[0]), 0.05),
                     post(8 * np.cos(at[1]), -8 * np.sin(at[1]), 0.07))
        sector = sector_of(np.cos(turn), -np.sin(turn))
        found = [true_sectors(image.range.astype(float), OPTICAL_FROM_LINK.T, 1.5, limits,
                              widened)[sector] for widened in (0.0, 1.2)]
        assert found[0] == np.inf
        assert found[1] == pytest.approx(4.95, rel=0.01)


def test_what_one_sequence_gives_is_told_and_kept() -> None:
    frames = list(frames_of_bag(Path(__file__).parents[1] / 'bags' / 'street.mcap'))[:3]
    small = Method({'stereo.matcher': 'bm', 'pairing.intervals': [1],
                    'stereo.working_height': 192})
    contest = ObstacleContest({'small': small})
    told = contest.add('one', frames[:2])
    assert told['small']['frames'] == 1
    line = sequence_line('one', 'small', told['small'])
    assert line.startswith('one, small: 1 (')
    assert f"nearer than 10 m {told['small']['near']}," in line
    again = contest.add('one', frames[1:])
    both = contest.summaries()['one']['small']
    assert both['near'] == told['small']['near'] + again['small']['near'] > 20
    assert both['frames'] == 2


def test_the_sample_bag_is_read_with_its_truth() -> None:
    frames = list(frames_of_bag(Path(__file__).parents[1] / 'bags' / 'street.mcap'))
    assert len(frames) == 20
    assert frames[3].range.shape == (240, 480)
    truth = true_sectors(frames[3].range.astype(float), frames[3].rotation,
                         frames[3].position[2], resolve({}).obstacles)
    assert 1.0 < truth.min() < 10.0


def test_what_is_on_the_left_is_on_the_left() -> None:
    out = detect(seen(post(0, 5, 0.3)))
    at = int(np.nanargmin(out.distance))
    assert np.degrees(sector_centres()[at]) % 360 == pytest.approx(270, abs=2.6)
    assert out.points[:, 1] == pytest.approx(4.7, abs=0.3)


def test_range_that_cannot_be_used_is_dropped() -> None:
    image = seen()
    detection = ObstacleDetection(resolve({}))

    def cause(given: RangeImage, level: Attitude | None) -> str:
        out = detection.process(given, level)
        assert isinstance(out, Drop)
        return out.cause

    replace = dataclasses.replace
    assert cause(replace(image, is_metric=False), Attitude()) == 'not_metric'
    assert cause(replace(image, sigma=image.sigma[:-1]), Attitude()) == 'wrong_size'
    narrow = replace(image, range=image.range[:, :-2], sigma=image.sigma[:, :-2])
    assert cause(narrow, Attitude()) == 'wrong_size'
    assert cause(image, None) == 'no_attitude'
    assert len(detect(image).state) == SECTORS
