from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core.voxels import VoxelMap, VoxelPoints

GREY = np.uint8(7)


def add(voxels: VoxelMap, xyz: list[list[float]], sigma: float | list[float],
        frame: int = 0) -> None:
    count = len(xyz)
    voxels.add(np.array(xyz, np.float32), np.broadcast_to(np.float32(sigma), count).copy(),
               np.full((count, 3), GREY), frame)


def test_points_of_a_voxel_are_averaged_by_their_weights():
    voxels = VoxelMap(0.1, 100)
    voxels.add(np.float32([[0.01, 0.02, -0.03], [0.03, 0.04, -0.05]]), np.float32([0.01, 0.02]),
               np.uint8([[10, 0, 255], [20, 100, 255]]), 0)
    points = voxels.points()
    assert len(points) == 1
    np.testing.assert_allclose(points.xyz, [[0.014, 0.024, -0.034]], atol=1e-6)
    assert points.bgr.tolist() == [[12, 20, 255]]
    # Weights 10,000 and 2,500 of two points: no gain is claimed of averaging.
    assert points.sigma[0] == pytest.approx((2 / 12500)**0.5)


def test_a_voxel_counts_each_frame_once():
    voxels = VoxelMap(0.1, 100)
    for frame in (0, 0, 1, 1, 1, 2):
        add(voxels, [[0.05, 0.05, 0.05]], 0.01, frame)
    assert voxels.points().frames.tolist() == [3]


def test_an_uncertain_point_goes_into_a_larger_voxel():
    voxels = VoxelMap(0.1, 100)
    add(voxels, [[0.05, 0.05, 0.05]] * 3, [0.39, 0.6, 1.4])
    assert sorted(voxels.points().level.tolist()) == [0, 1, 2]


def test_where_a_sharper_point_is_the_others_go():
    voxels = VoxelMap(0.1, 100)
    add(voxels, [[0.05, 0.05, 0.05], [0.15, 0.15, 0.15], [-0.15, 0.15, 0.15], [1.3, 0.1, 0.1]],
        [0.01, 0.6, 0.6, 0.6])
    points = voxels.points().finest()
    np.testing.assert_allclose(sorted(points.xyz[:, 0]), [-0.15, 0.05, 1.3], atol=1e-6)


def test_negative_coordinates_do_not_share_the_voxels_of_positive_ones():
    voxels = VoxelMap(0.1, 100)
    add(voxels, [[-0.01, 0.01, 0.01], [0.01, 0.01, 0.01]], 0.01)
    assert len(voxels) == 2


def test_what_is_out_of_reach_is_counted():
    voxels = VoxelMap(0.001, 100)
    add(voxels, [[1e6, 0, 0], [np.nan, 0, 0], [0, 0, 0]], 0.0001)
    assert (len(voxels), voxels.out_of_reach) == (1, 2)


def seen(xyz: np.ndarray, weight: np.ndarray, frames: int) -> VoxelPoints:
    count = len(xyz)
    return VoxelPoints(xyz, np.full((count, 3), GREY), np.full(count, frames, np.uint16),
                       np.ones(count, np.float32), weight, np.zeros(count, np.uint8), 0.05)


@pytest.mark.parametrize(('often', 'edge', 'kept'), [(700, 0.05, 700), (300, 0.1, 300)])
def test_what_one_frame_saw_goes_first_unless_it_is_the_most(often, edge, kept):
    """A line of points 0.06 m apart in a map of 1000 voxels of 0.05 m."""
    voxels = VoxelMap(0.05, 1000)
    xyz = np.zeros((1001, 3), np.float32)
    xyz[:, 0] = 0.06 * np.arange(1001) + 0.01
    frames = np.where(np.arange(1001) < often, 2, 1).astype(np.uint16)
    voxels.add_voxels(replace(seen(xyz, np.full(1001, 1e4, np.float32), 1), frames=frames))
    points = voxels.points()
    assert voxels.edge == pytest.approx(edge)
    assert points.points[points.frames > 1].sum() >= kept
    assert len(points) == (often + 1 if edge == 0.05 else pytest.approx(600, abs=20))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(1000, 3000))
def test_the_budget_holds_and_no_weight_is_lost(seed, most):
    rng = np.random.default_rng(seed)
    voxels, weights, moments = VoxelMap(0.05, most), 0.0, np.zeros(3)
    for _ in range(6):
        xyz = rng.uniform(-3, 3, (1500, 3)).astype(np.float32)
        weight = rng.uniform(25, 10_000, 1500).astype(np.float32)
        voxels.add_voxels(seen(xyz, weight, 2))
        weights += float(weight.sum(dtype=float))
        moments += (xyz * weight.astype(float)[:, None]).sum(axis=0)
        assert len(voxels) <= most
    points = voxels.points()
    assert voxels.edge > 0.05
    assert points.points.sum() == 9000
    assert points.weight.sum(dtype=float) == pytest.approx(weights, rel=1e-4)
    mean = (points.xyz * points.weight[:, None]).sum(axis=0, dtype=float)
    np.testing.assert_allclose(mean / weights, moments / weights, atol=1e-4)
    assert (points.bgr == GREY).all()


def test_a_map_in_a_map_is_the_same_map():
    rng = np.random.default_rng(1)
    one, other = VoxelMap(0.05, 5000), VoxelMap(0.05, 5000)
    add(one, rng.uniform(-1, 1, (800, 3)).tolist(), 0.02)
    other.add_voxels(one.points())
    a, b = one.points(), other.points()
    order_a, order_b = (np.lexsort(p.xyz.T) for p in (a, b))
    np.testing.assert_allclose(a.xyz[order_a], b.xyz[order_b], atol=1e-6)
    assert sorted(a.frames.tolist()) == sorted(b.frames.tolist())


def test_moved_points_keep_their_relative_sigma():
    voxels = VoxelMap(0.05, 100)
    add(voxels, [[1.0, 2.0, 3.0]], 0.02)
    moved = voxels.points().moved(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 0, 0]), 2.0)
    np.testing.assert_allclose(moved.xyz, [[-1.0, -4.0, 6.0]], atol=1e-5)
    assert moved.sigma[0] == pytest.approx(0.04, rel=1e-5)
