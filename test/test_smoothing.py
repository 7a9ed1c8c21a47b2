"""Inverse range goes on as its surface does, and stays on it."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from analytic_world import World, look, true_pose
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import smoothing, stereo
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import AlignedWindow, Frame, FrameKey, RangeImage, Reference
from sphstereo_ros.core.inverse_range import NOTHING
from sphstereo_ros.core.range_memory import RangeMemory, Remembered
from sphstereo_ros.core.stereo import SphericalStereo

HEIGHT = 96
SHARE = 0.05  # of the inverse range, that it is noisy


def directions() -> np.ndarray:
    """(H, 2H, 3), y down, z ahead."""
    latitude = np.pi * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None]
    longitude = 2 * np.pi * ((np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT) - 0.5)[None]
    return np.stack([np.cos(latitude) * np.sin(longitude), -np.sin(latitude) + 0 * longitude,
                     np.cos(latitude) * np.cos(longitude)], -1)


def plane(*normal: float) -> np.ndarray:
    """Inverse range of the plane n·x = 1, 0 where it is not seen."""
    return np.maximum(directions() @ np.array(normal), 0).astype(np.float32)


def noisy(true: np.ndarray, seed: int = 0, share: float = SHARE) -> tuple[np.ndarray, np.ndarray]:
    """Inverse range and sigma."""
    sigma = np.where(true > 0.002, share * true, NOTHING).astype(np.float32)
    error = np.random.default_rng(seed).normal(size=true.shape) * share * true
    return np.where(sigma < NOTHING, true + error, 0).astype(np.float32), sigma


def smoothed(rho: np.ndarray, sigma: np.ndarray, view: np.ndarray) -> np.ndarray:
    return smoothing.smoothed(rho, sigma, np.zeros_like(rho), view)


def even(shape: tuple[int, ...]) -> np.ndarray:
    return np.full(shape, 128, np.uint8)


def errors(rho: np.ndarray, true: np.ndarray, where: np.ndarray) -> float:
    return float(np.median(np.abs(rho - true)[where] / true[where]))


@pytest.mark.parametrize('normal', [(0, 0, 0.05), (0.1, 0, 0.02), (0.03, -0.04, 0.02)])
def test_a_plane_is_found_again_however_it_lies(normal):
    true = plane(*normal)
    rho, sigma = noisy(true)
    band = true > 0.3 * np.linalg.norm(normal)
    band[:20] = band[-20:] = False  # towards the poles the picture bends
    found = smoothed(rho, sigma, even(true.shape))
    assert errors(found, true, band) < 0.6 * errors(rho, true, band)
    bias = np.median((found - true)[band] / true[band])
    assert abs(bias) < 0.02 * SHARE


def test_surfaces_side_by_side_are_not_mixed():
    true = np.full((HEIGHT, 2 * HEIGHT), 1 / 20, np.float32)
    true[:, 80:84] = 1 / 8  # a post
    true[:, 120:] = 1 / 12
    found = smoothed(*noisy(true), even(true.shape))
    rim = np.zeros(true.shape, bool)
    rim[:, 76:88] = rim[:, 114:126] = True
    assert errors(found, true, rim) < 0.5 * SHARE
    bias = np.median(found / true - 1, 0)
    assert np.abs(bias[rim[0]]).max() < 0.4 * SHARE


def test_what_looks_different_counts_less():
    """At a rim that is smaller than its errors the grey tells which surface goes on."""
    true = np.full((HEIGHT, 2 * HEIGHT), 0.05, np.float32)
    true[:, 96:] *= 1.1
    view = even(true.shape)
    lit = view.copy()
    lit[:, 96:] = 250
    rho, sigma = noisy(true)
    rim = np.zeros(true.shape, bool)
    rim[:, 94:98] = True
    alike, told_apart = (errors(smoothed(rho, sigma, v), true, rim) for v in (view, lit))
    assert told_apart < 0.8 * alike


def test_one_that_is_wrong_pulls_nothing_away():
    true = plane(0, 0, 0.05)
    rho, sigma = noisy(true)
    wrong = rho.copy()
    wrong[48, 96] *= 3
    view = even(true.shape)
    there, gone = smoothed(wrong, sigma, view), smoothed(rho, sigma, view)
    others = np.ones(true.shape, bool)
    others[48, 96] = False
    assert np.abs(there - gone)[others & (sigma < NOTHING)].max() < SHARE * 0.05


def test_the_surer_counts_more():
    true = plane(0, 0, 0.05)
    rho, sigma = noisy(true)
    checked = np.zeros(true.shape, bool)
    checked[::3, ::3] = True
    exact = np.where(checked, true, rho)
    sure = np.where(checked, 0.002 * true, sigma).astype(np.float32)
    band = ~checked & (true > 0.02)
    band[:20] = band[-20:] = False
    view = even(true.shape)
    assert errors(smoothed(exact, sure, view), true, band) < 0.5 * errors(
        smoothed(rho, sigma, view), true, band)


def test_what_is_unknown_or_accurate_stays_as_it_is():
    true = plane(0, 0, 0.05)
    rho, sigma = noisy(true)
    accurate = np.zeros(true.shape, bool)
    accurate[40:60, 80:100] = True
    sigma[accurate] = 0.0029 * true[accurate]
    rho[accurate] = true[accurate]
    found = smoothed(rho, sigma, even(true.shape))
    unknown = sigma >= NOTHING
    assert unknown.any()
    np.testing.assert_array_equal(found[unknown | accurate], rho[unknown | accurate])


def test_what_is_unknown_counts_nowhere():
    true = plane(0, 0, 0.05)
    rho, sigma = noisy(true)
    holes = np.random.default_rng(1).random(true.shape) < 0.3
    sigma[holes] = NOTHING
    other = np.where(sigma < NOTHING, rho, 7).astype(np.float32)
    zero = np.where(sigma < NOTHING, rho, 0).astype(np.float32)
    known = sigma < NOTHING
    np.testing.assert_array_equal(smoothed(other, sigma, even(true.shape))[known],
                                  smoothed(zero, sigma, even(true.shape))[known])


def test_what_the_pose_adds_to_sigma_changes_nothing():
    """Its error is that of the neighbours too."""
    true = plane(0, 0, 0.05)
    rho, sigma = noisy(true)
    pose = 0.1 * true
    both = np.where(sigma < NOTHING, np.hypot(sigma, pose), sigma).astype(np.float32)
    view = even(true.shape)
    found = smoothing.smoothed(rho, both, pose, view)
    np.testing.assert_allclose(found, smoothed(rho, sigma, view), rtol=2e-3)
    assert np.abs(smoothed(rho, both, view) - found).max() > 0.002


@pytest.mark.parametrize('height', [2, 4, 6, 10])
def test_of_tiny_pictures_only_what_lies_on_them_is_looked_at(height):
    """A picture amid others that would be mixed in, in memory."""
    rng = np.random.default_rng(0)
    shape = (3 * height, 2 * height)
    rho, sigma = np.full(shape, 0.1, np.float32), np.full(shape, 0.02, np.float32)
    inside = np.s_[height:2 * height]
    rho[inside] += rng.normal(0, 0.01, (height, 2 * height)).astype(np.float32)
    view = rng.integers(0, 255, shape).astype(np.uint8)
    one = smoothed(rho[inside], sigma[inside], view[inside])
    rho[:height] = rho[2 * height:] = 0.11
    np.testing.assert_array_equal(smoothed(rho[inside], sigma[inside], view[inside]), one)


def test_it_goes_on_over_the_seam():
    true = plane(0.02, 0.01, -0.05)  # behind, where the image ends and begins
    rho, sigma = noisy(true)
    view = np.random.default_rng(2).integers(0, 255, true.shape).astype(np.uint8)
    whole = smoothed(rho, sigma, view)
    turned = smoothed(*(np.ascontiguousarray(np.roll(m, 61, 1)) for m in (rho, sigma, view)))
    np.testing.assert_allclose(turned, np.roll(whole, 61, 1), rtol=1e-6)


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0.001, 2), power=st.integers(-3, 9))
def test_nothing_is_moved_far_whatever_comes(seed, share, power):
    """By 15 % at most; and the unit does not matter (a power of two rounds nothing)."""
    rng = np.random.default_rng(seed)
    rho = rng.exponential(0.1, (32, 64)).astype(np.float32)
    rho[rng.random(rho.shape) < 0.2] = 0
    rho[rng.random(rho.shape) < 0.1] *= -1
    sigma = (share * rng.exponential(1, rho.shape) * np.abs(rho) + 1e-9).astype(np.float32)
    sigma[rng.random(rho.shape) < 0.3] = NOTHING
    view = rng.integers(0, 255, rho.shape).astype(np.uint8)
    found = smoothed(rho, sigma, view)
    assert np.isfinite(found).all()
    moved = np.abs(found - rho)
    assert (moved <= 0.15001 * np.maximum(rho, 0) + 1e-9).all()
    unit = np.float32(2.0**power)
    scaled = smoothed(rho * unit, np.where(sigma < NOTHING, sigma * unit, sigma), view)
    np.testing.assert_allclose(scaled / unit, found, rtol=1e-6)


def told_of_room() -> tuple[RangeImage, np.ndarray]:
    """Of a room seen in noisy frames, the second time it is told; and the true range."""
    matcher = SphericalStereo(resolve({}))
    views = [look(World(), (0, 0, 0.15 * k), height=160, noise=4) for k in range(4)]
    frames = [Frame(FrameKey(33_000_000 * (k + 1), 'camera_optical'), view.image)
              for k, view in enumerate(views)]
    for k in (2, 3):
        told = matcher.process(AlignedWindow(frames[k], tuple(
            Reference(frames[n], replace(true_pose(views[n], views[k]),
                                         covariance=1e-12 * np.eye(6)))
            for n in (k - 1, k - 2))))
    return told, views[-1].range


def test_what_is_told_is_smooth_and_what_is_remembered_is_not(monkeypatch):
    smooth, true = told_of_room()
    kept = []
    monkeypatch.setattr(stereo, 'smoothed', lambda rho, *_: kept.append(rho.copy()) or rho)
    rough, _ = told_of_room()
    error, before = (np.nanmedian(np.abs(told.range / true - 1)) for told in (smooth, rough))
    assert error < 0.85 * before
    given_to = []
    smooth_it = smoothing.smoothed
    monkeypatch.setattr(stereo, 'smoothed',
                        lambda *given: given_to.append(given[0].copy()) or smooth_it(*given))
    told_of_room()
    np.testing.assert_array_equal(given_to[-1], kept[-1])


def test_nothing_is_told_to_be_free_because_it_was_smoothed(monkeypatch):
    """Within range.max, or not surely beyond it."""
    for near in (1.01, 0.95):
        rho = np.full((160, 320), near / 120, np.float32)
        monkeypatch.setattr(RangeMemory, 'fused', lambda *_, rho=rho: Remembered(
            rho.copy(), 0.03 * rho, np.full_like(rho, 6), chosen=True))
        monkeypatch.setattr(stereo, 'smoothed', lambda rho, *_: 0.85 * rho)
        assert not np.isposinf(told_of_room()[0].range).any()
