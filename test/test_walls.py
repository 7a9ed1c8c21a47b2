"""Walls: found as upright planes, and told for what is before them."""
from __future__ import annotations

import numpy as np
import pytest

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.floor import floor_seen
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.walls import walls_seen

DOWN = np.array([0.0, 1, 0])
PIXEL = 1e-3
ROWS = 240
FLOOR = DOWN / 1.7
# A street turned by 20°, houses 6 m to the right and 9 m to the left, and one across, 30 m away.
TURN = np.deg2rad(20)
HOUSES = [np.array([np.cos(a + TURN), 0, np.sin(a + TURN)]) / d
          for a, d in ((0, 6.0), (np.pi, 9.0), (np.pi / 2, 30.0))]


def street(rows: int = ROWS, up: float = 0.35) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse range of what is seen, of the houses alone, and bearings; houses end where the sine
    of the elevation is `up`.
    """
    bearings = Equirectangular(rows, 2 * rows).bearings()
    houses = np.max([bearings @ p for p in HOUSES], axis=0)
    houses = np.where(-bearings[..., 1] < up, houses, 0)
    return (np.maximum(houses, bearings @ FLOOR).astype(np.float32), houses.astype(np.float32),
            bearings)


def seen(rho: np.ndarray, sigma: np.ndarray | None = None, pixel: float = PIXEL,
         floor: np.ndarray = FLOOR) -> tuple[np.ndarray, np.ndarray]:
    spread = 0.01 * rho if sigma is None else sigma
    return walls_seen(rho, spread.astype(np.float32), floor_seen(floor, len(rho)), DOWN, pixel)


def test_walls_are_found_behind_what_hides_them():
    rho, houses, bearings = street()
    rng = np.random.default_rng(1)
    rho *= (1 + 0.005 * rng.normal(size=rho.shape)).astype(np.float32)
    sigma, beside = 0.01 * rho, np.abs(-bearings[..., 1] - 0.1) < 0.25
    leaves = beside & (rng.random(rho.shape) < 0.4)  # in front, and sure
    rho[leaves] *= 1.8
    blank = beside & (rng.random(rho.shape) < 0.3)
    sigma[blank] = NOTHING
    wall, support = seen(rho, sigma)
    hidden = (leaves | blank) & (houses > 1 / 25) & (houses > 1.3 * (bearings @ FLOOR))
    assert hidden.sum() > 2000
    assert (np.abs(wall - houses) < 0.02 * houses)[hidden].mean() > 0.95
    assert (support[hidden] > 0.1).mean() > 0.95


def test_the_share_is_of_what_is_round_about():
    rho, houses, bearings = street()
    wall, support = seen(rho)
    amid = (np.abs(bearings[..., 1]) < 0.05) & (np.abs(bearings @ HOUSES[0] * 6) > 0.8)
    assert (support[amid] > 0.9).all()
    np.testing.assert_allclose(wall[amid], houses[amid], rtol=1e-3)
    assert not support[-bearings[..., 1] > 0.6].any()  # far from all walls
    assert ((wall > 0) == (support > 0)).all()
    assert support.max() <= 1 + 1e-5


def test_a_ceiling_and_a_floor_are_no_walls():
    bearings = Equirectangular(ROWS, 2 * ROWS).bearings()
    rho = (np.abs(bearings[..., 1]) / 1.7).astype(np.float32)
    wall, _ = seen(rho)
    on_one = (wall > 0) & (np.abs(wall / np.maximum(rho, 1e-6) - 1) < 0.02)
    assert on_one.mean() < 0.05


@pytest.mark.parametrize('sigma', [NOTHING, 0.06])
def test_of_what_is_not_sure_no_walls_are_made(sigma):
    rho, _, _ = street()
    wall, support = seen(rho, np.full_like(rho, NOTHING) if sigma == NOTHING else sigma * rho)
    assert not wall.any()
    assert not support.any()


def test_what_hardly_moves_makes_no_wall():
    rho, _, _ = street()
    wall, _ = seen(rho, pixel=0.2, floor=0 * FLOOR)
    assert not (wall > 0)[rho < 0.3].any()


def test_the_scale_does_not_matter():
    rho, _, _ = street()
    one = seen(rho)
    other = seen(np.float32(8) * rho, pixel=8 * PIXEL, floor=8 * FLOOR)
    np.testing.assert_allclose(other[0], 8 * one[0], rtol=1e-4)
    np.testing.assert_allclose(other[1], one[1], atol=1e-6)


@pytest.mark.parametrize('rows', [16, 97, 480])
def test_any_size_will_do(rows):
    rho, houses, bearings = street(rows)
    wall, support = seen(rho)
    assert wall.shape == support.shape == rho.shape
    assert wall.dtype == support.dtype == np.float32
    amid = (np.abs(bearings[..., 1]) < 0.05) & (np.abs(bearings @ HOUSES[0] * 6) > 0.8)
    if rows > 16:
        np.testing.assert_allclose(wall[amid], houses[amid], rtol=1e-2)
