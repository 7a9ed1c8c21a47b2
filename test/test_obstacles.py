"""Obstacle detection against worlds whose truth is known in closed form."""
from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, FrameKey, RangeImage
from sphstereo_ros.core.level import Attitude, attitude
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
