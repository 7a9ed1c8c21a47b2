"""The floor: found as a plane, and what lies under it."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.floor import floor_plane, floor_seen, under_floor
from sphstereo_ros.core.inverse_range import NOTHING

DOWN = np.array([0.0, 1, 0])


def seen(height: float = 1.7, tilt: float = 0.0, rows: int = 192) -> tuple[
        np.ndarray, np.ndarray, np.ndarray]:
    """ρ, σ and bearings: a floor `height` metres down, inclined by `tilt` rad, out to 40 m."""
    bearings = Equirectangular(rows, 2 * rows).bearings()
    normal = np.array([np.sin(tilt), np.cos(tilt), 0]) / height
    rho = bearings @ normal
    known = rho > 1 / 40
    return (np.where(known, rho, 0).astype(np.float32),
            np.where(known, 0.02 * rho, NOTHING).astype(np.float32), bearings)


@pytest.mark.parametrize(('height', 'tilt'), [(1.7, 0.0), (0.4, 0.1), (30.0, -0.2)])
def test_the_floor_is_found_through_what_stands_on_it(height, tilt):
    rho, sigma, bearings = seen(height, tilt)
    rng = np.random.default_rng(1)
    rho *= (1 + 0.01 * rng.normal(size=rho.shape)).astype(np.float32)
    stands = (bearings[..., 0] > 0.2) & (bearings[..., 2] > 0)
    rho[stands] *= 2
    plane = floor_plane(rho, sigma, DOWN)
    assert plane is not None
    np.testing.assert_allclose(plane, [np.sin(tilt) / height, np.cos(tilt) / height, 0],
                               atol=0.01 / height)
    again = floor_plane(rho, sigma, DOWN)
    assert again is not None
    assert (again == plane).all()


def test_where_there_is_no_floor_none_is_found():
    rho, sigma, bearings = seen()
    assert floor_plane(rho, np.full_like(sigma, NOTHING), DOWN) is None
    assert floor_plane(np.full_like(rho, 0.2), np.full_like(sigma, 0.01), DOWN) is None  # a ball
    assert floor_plane(rho, sigma, np.array([0.0, -1, 0])) is None  # upside down
    steep, sigma_of_it, _ = seen(tilt=0.5)
    assert floor_plane(steep, sigma_of_it, DOWN) is None  # a bank is no floor
    pit = rho.copy()
    pit[bearings[..., 2] > 0.25] /= 2  # a terrace with much beneath
    assert floor_plane(pit, sigma, DOWN) is None


def test_under_the_floor_is_what_lies_clearly_under_it():
    rho, sigma, bearings = seen()
    plane = np.array([0.0, 1 / 1.7, 0])
    downward = bearings[..., 1] > 0.1
    assert not under_floor(rho, sigma, plane).any()
    lower, _, _ = seen(1.2 * 1.7)  # a kerb, a ditch
    assert not under_floor(lower, np.float32(0.001) + 0 * sigma, plane).any()
    falling = (bearings @ np.array([0, np.cos(0.045), -np.sin(0.045)]) / 1.7).astype(np.float32)
    assert not under_floor(np.maximum(falling, 0), 0 * sigma, plane).any()
    far = np.full_like(rho, 1 / 120)
    assert (under_floor(far, 0 * sigma, plane)[downward] == 255).all()
    assert not under_floor(far, 0 * sigma, plane)[bearings[..., 1] < 0.05].any()
    assert not under_floor(far, 0.3 + 0 * sigma, plane).any()  # nothing is sure


@pytest.mark.parametrize(('height', 'tilt'), [(1.7, 0.0), (0.4, 0.1), (30.0, -0.2)])
def test_the_floor_is_seen_where_nothing_hides_it(height, tilt):
    rows = 97  # odd, so one row looks at the horizon
    _, _, bearings = seen(height, tilt, rows)
    found = floor_seen(np.array([np.sin(tilt), np.cos(tilt), 0]) / height, rows)
    up = bearings @ np.array([np.sin(tilt), np.cos(tilt), 0]) < 0
    assert found.dtype == np.float32
    assert not found[up].any()
    points = bearings / np.maximum(found, 1e-9)[..., None]
    heights = points @ np.array([np.sin(tilt), np.cos(tilt), 0])
    np.testing.assert_allclose(heights[found > 1e-3 / height], height, rtol=1e-3)
    assert not floor_seen(None, rows).any()
