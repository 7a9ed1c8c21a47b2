"""The sweep over the sphere, against exact ranges."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from analytic_world import Ball, World
from hypothesis import given, settings
from hypothesis import strategies as st
from polar_views import PolarView, Vector, polar_view

from sphstereo_ros.core.frames import RelativePose
from sphstereo_ros.core.sphere import polar_bearings
from sphstereo_ros.core.sweep import (
    _across_rows,
    _along_rows,
    _difference,
    _scale_rows,
    levels,
    reduction,
    signature,
    sweep,
)
from sphstereo_ros.core.warp import PolarGrid

BASELINES = st.lists(st.floats(0.02, 30.0), min_size=1, max_size=10)
HEIGHTS = st.integers(16, 2048)
ROOM = World()
FORWARD: tuple[Vector, ...] = ((0, 0, -0.3), (0, 0, -1.2))


@cache
def seen(world: World = ROOM, positions: tuple[Vector, ...] = FORWARD,
         turn: Vector = (0, 0, 0), reference_turn: Vector = (0, 0, 0)) -> PolarView:
    return polar_view(world, positions, turn, reference_turn)


def coarse(view: PolarView) -> PolarGrid:
    return PolarGrid(view.grid.height // 2, view.grid.margin // 2, view.grid.wrap // 2)


def swept(view: PolarView) -> np.ndarray:
    return sweep(view.image, view.grid, view.axes, view.pairs)[0]


def pixels_off(view: PolarView) -> np.ndarray:
    """Error of the sweep in pixels of its own grid, of the longest reference's parallax."""
    grid = coarse(view)
    found = swept(view)
    assert found.shape == grid.shape
    return np.abs(found - view.rho(grid)) * view.pairs[-1][1].baseline / grid.pixel


# --- levels


@settings(deadline=None)
@given(BASELINES, HEIGHTS)
def test_levels_rise_from_beyond_infinity_and_are_never_too_many(baselines, height):
    found = levels(baselines, np.pi / height)
    assert 3 <= len(found) <= 256
    assert (np.diff(found) > 0).all()
    assert (found[:2] < 0).all()
    assert found[2] == pytest.approx(0, abs=1e-9 / max(baselines))
    assert np.array_equal(found, levels(baselines[::-1], np.pi / height))


@settings(deadline=None)
@given(BASELINES, HEIGHTS)
def test_steps_of_parallax_are_even_and_fine_for_every_baseline_that_takes_part(baselines, height):
    pixel = np.pi / height
    found = levels(baselines, pixel)
    for near, step in zip(found[:-1], np.diff(found), strict=True):
        taking_part = [b for b in baselines if near * b <= 0.6] or [min(baselines)]
        allowed = 2.0 if near * min(baselines) > 0.6 else 1.5
        assert max(taking_part) * step == pytest.approx(allowed * pixel, rel=1e-6)


@settings(deadline=None)
@given(st.floats(0.02, 30.0), st.integers(16, 960))
def test_levels_of_one_baseline_reach_to_little_more_than_it(baseline, height):
    found = levels([baseline], np.pi / height)
    assert found[-1] >= 0.93 / baseline


@settings(deadline=None)
@given(BASELINES, HEIGHTS, st.floats(0.01, 100.0))
def test_levels_are_the_same_in_every_unit_of_length(baselines, height, scale):
    found = levels(baselines, np.pi / height)
    other = levels([scale * b for b in baselines], np.pi / height)
    least = min(len(found), len(other))  # the last may be left out for rounding
    assert max(len(found), len(other)) <= least + 1
    np.testing.assert_allclose(scale * other[:least], found[:least], rtol=1e-6)


# --- census


def test_census_has_a_bit_for_every_brighter_neighbour():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 6, (20, 31), np.uint8)  # with ties
    padded = np.pad(image, 2, mode='edge')
    wanted = np.zeros(image.shape, np.uint32)
    for di in range(5):
        for dj in range(5):
            if (di, dj) != (2, 2):
                wanted = wanted << 1 | (padded[di:di + 20, dj:dj + 31] > image)
    np.testing.assert_array_equal(signature(image) >> 8, wanted)


def test_the_last_byte_tells_brighter_from_darker_than_round_about():
    image = np.full((40, 40), 90, np.uint8)
    image[20, 20], image[5, 5] = 150, 40
    contrast = (signature(image) & 255).astype(int) - 128
    assert contrast[20, 20] == pytest.approx(60, abs=1)
    assert contrast[5, 5] == pytest.approx(-50, abs=1)
    assert contrast[30, 8] == 0


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_bits_that_differ_cost_two_and_contrast_half_a_grey_level_up_to_a_limit(a, b):
    contrast = min(abs((a & 255) - (b & 255)) // 2, 12)
    wanted = 2 * (a >> 8 ^ b >> 8).bit_count() + contrast
    assert _difference(np.uint32(a), np.uint32(b)) == wanted


def test_costs_are_scaled_to_bytes_and_the_volume_is_emptied():
    volume = np.array([[[0, 10, 600]]], np.uint16)
    cost = np.empty(volume.shape, np.uint8)
    _scale_rows(0, 1, volume, 0.5, cost)
    np.testing.assert_array_equal(cost, [[[0, 5, 255]]])
    assert not volume.any()


# --- paths through the image


def path_costs(cost: np.ndarray, image: np.ndarray, way: tuple[int, int]) -> np.ndarray:
    """Hirschmüller's recursion along one way (rows, columns), which does not leave the image.

    A path that would start outside goes on along the border.
    """
    rows, columns, count = cost.shape
    out = np.zeros(cost.shape, int)
    for n, m in np.ndindex(rows, columns):
        i, j = (n if way[0] >= 0 else rows - 1 - n), (m if way[1] >= 0 else columns - 1 - m)
        ip, jp = i - way[0], min(max(j - way[1], 0), columns - 1)
        first = not 0 <= ip < rows if way[0] else jp == j
        before = np.zeros(count, int) if first else out[ip, jp]
        ip, jp = (i, j) if first and not way[0] else (min(max(ip, 0), rows - 1), jp)
        step = abs(int(image[i, j]) - int(image[ip, jp]))
        jump = max(40, 200 * 8 // (8 + step))
        beside = np.pad(before, 1, constant_values=10**6)
        out[i, j] = cost[i, j].astype(int) - before.min() + np.minimum.reduce(
            [before, beside[:-2] + 10, beside[2:] + 10, np.full(count, before.min() + jump)])
    return out


@pytest.mark.parametrize('levels_', [3, 7])
def test_all_paths_are_summed(levels_):
    rng = np.random.default_rng(levels_)
    cost = rng.integers(0, 250, (11, 9, levels_), np.uint8)
    image = rng.integers(0, 255, (11, 9), np.uint8)
    total = np.zeros(cost.shape, np.uint16)
    _along_rows(0, 11, cost, image, total)
    np.testing.assert_array_equal(total, sum(
        path_costs(cost, image, way) for way in ((0, 1), (0, -1))))
    for slant in (0, 1, -1):
        total[:] = 0
        _across_rows(0, 9, cost, image, slant, total)
        np.testing.assert_array_equal(total, sum(
            path_costs(cost, image, way) for way in ((1, slant), (-1, -slant))))


@dataclass(frozen=True)
class Blotched(Ball):
    """A ball with one blank blotch, 16° wide."""

    def brightness(self, points: np.ndarray) -> np.ndarray:
        return np.where(blotch(points), 128.0, super().brightness(points))


def blotch(points: np.ndarray) -> np.ndarray:
    """Whether points (..., 3) are in the direction of the blotch."""
    return points[..., 0] > np.cos(np.radians(8)) * np.linalg.norm(points, axis=-1)


def test_paths_carry_the_range_over_what_is_blank():
    """From all sides."""
    view = seen(Blotched(cell=0.8))
    grid = coarse(view)
    inside = blotch(polar_bearings(grid.theta()[None], grid.azimuth()[:, None], view.axes))
    assert inside.sum() > 40
    assert (np.abs(swept(view) * 3.0 - 1) < 0.1)[inside].mean() > 0.9


def test_paths_of_all_ways_see_through_noise():
    view, rng = seen(Ball(cell=0.8)), np.random.default_rng(0)

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(image + 40 * rng.normal(size=image.shape), 0, 255).astype(np.uint8)

    found, _ = sweep(noisy(view.image), view.grid, view.axes,
                     [(noisy(image), pose) for image, pose in view.pairs])
    theta = view.theta(coarse(view))
    right = np.abs(found * 3.0 - 1)[(theta > 15) & (theta < 165)] < 0.1
    assert right.mean() > 0.54  # with the paths along the rows alone: under 0.5


# --- the sweep


@pytest.mark.parametrize('radius', [1.0, 3.0, 12.0, 60.0])
def test_a_hollow_sphere_has_one_range_everywhere(radius):
    """Also at the seam of the grid, and beside both poles, where parallax still tells."""
    ball = Ball(cell=0.27 * radius, radius=radius)
    view = seen(ball, ((0, 0, -0.1 * radius), (0, 0, -0.4 * radius)))
    off, theta = pixels_off(view), view.theta(coarse(view))
    assert np.median(off[(theta > 15) & (theta < 165)]) < 0.2
    assert (off[(theta > 15) & (theta < 165)] < 1.0).mean() > 0.95
    assert (off[(theta > 5) & (theta < 175)] < 1.5).mean() > 0.9
    for seam in (off[:6], off[-6:]):
        assert (seam[:, 20:-20] < 1.0).mean() > 0.9


@pytest.mark.parametrize('radius', [1e4, 0.25])
def test_beyond_all_levels_and_nearer_than_all(radius):
    ball = Ball(cell=0.27 * radius, radius=radius)
    view = seen(ball, ((0, 0, -0.1), (0, 0, -0.1 * min(radius, 4))))
    middle = np.abs(view.theta(coarse(view)) - 90) < 60
    found = np.median(swept(view)[middle])
    assert found == pytest.approx(1 / radius, abs=0.02) if radius > 1 else found > 3


@pytest.mark.parametrize(('positions', 'turn', 'reference_turn'), [
    (((0, 0, -0.3),), (0, 0, 0), (0, 0, 0)),
    (((0, 0, 0.3),), (0, 0, 0), (0, 0, 0)),
    (((0.3, 0, 0),), (0, 0, 0), (0, 0, 0)),
    (((0, -0.3, 0),), (0, 0, 0), (0, 0, 0)),
    (((0.17, 0.1, -0.22),), (0, 0, 0), (0, 0, 0)),
    (FORWARD, (0, 0, 0), (0, 0, 0)),
    (FORWARD, (0.3, 2.9, 0.2), (0.1, 0.2, -0.1)),
    (((0, 0, -0.3), (0.21, 0, -1.18)), (0, 0, 0), (0, 0, 0)),  # the farther 10° aside
    (((0, 0, -0.3), (0, 0.6, -0.9)), (0, 1.0, 0), (0, 0.9, 0)),
], ids=str)
def test_the_room_is_found_in_every_direction_of_motion(positions, turn, reference_turn):
    view = seen(ROOM, positions, turn, reference_turn)
    off, theta = pixels_off(view), view.theta(coarse(view))
    clear = (theta > 15) & (theta < 165)
    assert np.median(off[clear]) < 0.35
    assert (off[clear] < 1.5).mean() > 0.85


def test_a_longer_reference_makes_it_finer():
    """Of a wall 10 m away, 0.3 m tell little."""
    alone, both = (seen(ROOM, FORWARD[:n]) for n in (1, 2))
    errors = [np.abs(swept(view) / view.rho(coarse(view)) - 1) for view in (alone, both)]
    theta = alone.theta(coarse(alone))
    clear = (theta > 15) & (theta < 165)
    assert np.median(errors[1][clear]) < 0.5 * np.median(errors[0][clear])


def test_what_is_too_near_for_the_long_reference_the_short_one_decides():
    """Two long ones agree on another range: from inside, a larger sphere looks alike."""
    positions = ((0, 0, -0.3), (0, 0, -0.88), (0, 0, -0.9))
    view, decoys = (seen(Ball(cell=0.27 * radius, radius=radius), positions)
                    for radius in (1.0, 1.25))
    assert np.abs(view.image.astype(int) - decoys.image).mean() < 2
    pairs = [*view.pairs[:1], *decoys.pairs[1:]]
    found, _ = sweep(view.image, view.grid, view.axes, pairs)
    middle = np.abs(view.theta(coarse(view)) - 90) < 60
    assert np.median(found[middle]) == pytest.approx(1.0, abs=0.1)


def test_brightness_and_contrast_of_a_reference_matter_little():
    view = seen()
    dimmed = [(np.clip(0.8 * image + 15, 0, 255).astype(np.uint8), pose)
              for image, pose in view.pairs]
    found, _ = sweep(view.image, view.grid, view.axes, dimmed)
    theta = view.theta(coarse(view))
    clear = (theta > 15) & (theta < 165)
    off = np.abs(found - view.rho(coarse(view))) * 1.2 / coarse(view).pixel
    assert np.median(off[clear]) < 0.4


@pytest.mark.parametrize('images', ['blank', 'noise'])
def test_where_nothing_can_be_told_there_is_still_a_value(images):
    rng, view = np.random.default_rng(0), seen()
    def image(shape: tuple[int, ...]) -> np.ndarray:
        return (np.full(shape, 90, np.uint8) if images == 'blank'
                else rng.integers(0, 256, shape, np.uint8))
    pairs = [(image(i.shape), pose) for i, pose in view.pairs]
    found, step = sweep(image(view.image.shape), view.grid, view.axes, pairs)
    assert np.isfinite(found).all()
    level = levels([pose.baseline for _, pose in pairs], coarse(view).pixel)
    assert step == pytest.approx(level[1] - level[0])
    assert found.min() >= level[0] - 1e-6
    assert found.max() <= level[-1] + 1e-6


@pytest.mark.parametrize('height', [480, 1200, 1208, 2400, 2408, 8192])
def test_large_grids_are_shrunk_to_what_fits_into_memory(height):
    by = reduction(height)
    assert by in (2, 4, 8)
    assert height / by <= 600 or by == 8
    assert height <= 1200 or by > 2


def test_the_number_of_threads_does_not_matter(monkeypatch):
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (256, 512), np.uint8)
    grid, axes = PolarGrid(256, 8, 8), np.eye(3)
    view = rng.integers(0, 255, grid.shape, np.uint8)
    pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -0.28]))
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setattr('sphstereo_ros.core.jit._threads', lambda threads=threads: threads)
        results.append(sweep(view, grid, axes, [(image, pose)])[0])
    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])
