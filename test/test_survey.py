"""The survey of a picture, against the same in plain NumPy."""
from __future__ import annotations

import math

import numpy as np
import pytest

from sphstereo_ros.core.open_space import STEEPEST
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK, matrix_from_rpy
from sphstereo_ros.core.survey import WEIGHT, Band, points_of, survey

HEIGHT, COLUMNS, CELL = 96, 144, math.radians(2.0)
DISTANCES = np.array([0.5, 1.5, 4.0, 12.0, 20.0], np.float32)
BAND = Band(1.0, 0.8, 0.3, 20.0, 0.2, 0.3, 120.0, (0.02, -0.05, -0.7))


def angles() -> tuple[np.ndarray, np.ndarray]:
    lat = np.pi * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT)
    lon = 2 * np.pi * ((np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT) - 0.5)
    rows, columns = (np.stack([np.cos(a), np.sin(a)], axis=1).astype(np.float32)
                     for a in (lat, lon))
    return rows, columns


def picture(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ranges of all sorts, a third of them nonsense."""
    rng = np.random.default_rng(seed)
    r = np.exp(rng.uniform(-1.5, 4, (HEIGHT, 2 * HEIGHT))).astype(np.float32)
    sigma = (r * rng.uniform(0.0, 0.3, r.shape)).astype(np.float32)
    for value in (np.nan, np.inf, -np.inf, 0.0, -2.0):
        r[rng.random(r.shape) < 0.06] = value
    for value in (np.nan, np.inf, -1.0):
        sigma[rng.random(r.shape) < 0.03] = value
    return r, sigma


def expected(r: np.ndarray, sigma: np.ndarray, turn: np.ndarray,
             camera: np.ndarray) -> tuple[np.ndarray, ...]:
    """Layer, cell and column of every ray; distance and direction of what stands; weights."""
    rows, columns = (a.astype(float) for a in angles())
    rays = np.stack([rows[:, :1] * columns[:, 1], -rows[:, 1:] + 0 * columns[:, 1],
                     rows[:, :1] * columns[:, 0]], axis=-1) @ turn.T.astype(float)
    across = np.hypot(rays[..., 0], rays[..., 1])
    cell = (np.arctan2(rays[..., 2], across) + STEEPEST) / CELL

    def place(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        clockwise = np.radians(22.5) - np.arctan2(y, x)
        return clockwise / (2 * np.pi) * COLUMNS % COLUMNS
    with np.errstate(invalid='ignore'):
        sure = np.where((r > 0) & (sigma >= 0), (r - 3 * sigma) * across, 0)
        sure = np.where(r == np.inf, BAND.range_max * across, sure)
        layer = np.where(np.isnan(r), len(DISTANCES) + 1, (sure[..., None] >= DISTANCES).sum(-1))
        d = np.where(r == -np.inf, BAND.range_min, r).astype(float)
        x, y, z = np.moveaxis(camera + d[..., None] * rays, -1, 0)
        flat = np.hypot(x, y)
        ground = 0.02 * x - 0.05 * y - 0.7
        slack = np.nan_to_num(np.minimum(np.maximum(2 * sigma * np.abs(rays[..., 2]), 0), 0.1))
        is_ground = (z < ground + 0.2 + slack) & (ground < 0.2 + 0.05 * flat)
        stands = ((d > 0) & np.isfinite(d) & (z >= -1) & (z <= 0.8) & (flat <= 20) & ~is_ground
                  & (cell >= 0) & (cell < np.ceil(2 * STEEPEST / CELL)))
    flat = np.where(r < 0, np.minimum(flat, 0.999 * 0.3), flat)
    return layer, cell, place(rays[..., 1], rays[..., 0]), stands, flat, place(y, x), x, y, z


@pytest.mark.parametrize(('tilt', 'camera'), [
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), ((0.3, -0.2, 0.4), (0.5, -0.2, 0.3)),
    ((0.0, 1.2, 0.0), (0.0, 0.0, -0.4)), ((3.1, 0.0, 0.0), (0.1, 0.0, 0.0))])
def test_the_survey_is_that_of_plain_numpy(tilt: tuple[float, float, float],
                                           camera: tuple[float, float, float]) -> None:
    r, sigma = picture(int(10 * sum(tilt)))
    turn = (matrix_from_rpy(*tilt) @ OPTICAL_FROM_LINK.T).astype(np.float32)
    at = np.array(camera, np.float32)
    seen = np.zeros((len(DISTANCES) + 2, math.ceil(2 * STEEPEST / CELL), COLUMNS), np.int32)
    flat, column = np.full(r.shape, np.nan, np.float32), np.full(r.shape, -1, np.int16)
    survey(r, sigma, *angles(), turn, at, BAND.array(), DISTANCES, CELL, seen, flat, column)
    layer, cell, ray_column, stands, away, azimuth, *_ = expected(r, sigma, turn, at)
    inside = (cell >= 0) & (cell < seen.shape[1])
    wanted = np.zeros_like(seen)
    weight = np.maximum(1, (WEIGHT * angles()[0][:, :1] + 0.5).astype(int)) + 0 * layer
    np.add.at(wanted, tuple(a[inside].astype(int) for a in (layer, cell, ray_column)),
              weight[inside])
    # A pixel on an edge of float32 may be counted on either side of it.
    assert seen.sum() == pytest.approx(wanted.sum(), rel=1e-3)
    assert np.abs(seen - wanted).sum() <= 4e-3 * wanted.sum()
    assert (stands != (flat > 0)).mean() < 1e-4
    both = stands & (flat > 0)
    np.testing.assert_allclose(flat[both], away[both], rtol=1e-5)
    assert (column[both] != np.floor(azimuth[both])).mean() < 1e-3


def test_points_are_where_the_pixels_are() -> None:
    r, sigma = picture(3)
    turn = (matrix_from_rpy(0.1, 0.2, 0.3) @ OPTICAL_FROM_LINK.T).astype(np.float32)
    at = np.array([0.3, 0.2, 0.1], np.float32)
    *_, x, y, z = expected(r, sigma, turn, at)
    believed = np.isfinite(r) & (r > 0) & (np.arange(r.size).reshape(r.shape) % 3 == 0)
    out = np.empty((r[::2, ::2].size, 3), np.float32)
    count = points_of(believed, r, *angles(), turn, at, 2, 0.3, out)
    wanted = np.stack([x, y, z], axis=-1)[::2, ::2][believed[::2, ::2]]
    assert count == len(wanted) > 100
    np.testing.assert_allclose(out[:count], wanted, rtol=1e-4, atol=1e-4)
