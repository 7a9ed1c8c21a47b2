"""From parallax on the polar grid to range on the current frame's own grid.

In between everything is kept as inverse range ρ = 1/r = sin δ / (b sin θ1): it is nearly linear
in what was measured, so its error is nearly Gaussian, it passes through zero at infinity without a
join, and estimates from several baselines can be averaged.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .config import RangeConfig
from .frames import UNSCALED, Image8, RelativePose
from .jit import fast_kernel, kernel, rows_in_parallel
from .matching import Parallax
from .warp import Map, PolarGrid, _arctan2

Floats = NDArray[np.float64]

NOTHING = 1e6

_CONFIDENT = 3.0  # standard deviations


@dataclass(frozen=True)
class InverseRange:
    """ρ and its standard deviation, float32 (H, 2H), 1/m (or 1/baseline).

    Where nothing is known, ρ is 0 and σ is NOTHING, as good as infinite.

    signed : whether the match could have found parallaxes below zero (see Parallax)
    """

    rho: Map
    sigma: Map
    signed: bool


@lru_cache(maxsize=4)
def _grid_angles(height: int) -> tuple[Map, Map, Map, Map]:
    """cos and sin of the latitudes of the rows, and of the longitudes of the columns."""
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    lon = 2 * np.pi * ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5)
    c, s, cl, sl = (np.ascontiguousarray(f(a), np.float32)
                    for a in (lat, lon) for f in (np.cos, np.sin))
    return c, s, cl, sl


@fast_kernel
def _polar_row(cos_lat: np.float32, sin_lat: np.float32, cos_lon: Map, sin_lon: Map, axes: Map,
               first: np.float32, wrap: np.float32, per_pixel: np.float32,
               out: Map) -> None:  # pragma: no cover - compiled
    """Sine and cosine of θ, and column and row on the polar grid, of a row of pixels."""
    turn = np.float32(2 * np.pi)
    for j in range(cos_lon.size):
        x, y, z = cos_lat * sin_lon[j], -sin_lat, cos_lat * cos_lon[j]
        px = axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z
        py = axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z
        pz = axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z
        sine = np.sqrt(px * px + py * py)
        azimuth = _arctan2(py, px)
        azimuth = azimuth + turn if azimuth < 0 else azimuth
        out[0, j] = sine
        out[1, j] = pz
        out[2, j] = _arctan2(sine, pz) * per_pixel + first
        out[3, j] = azimuth * per_pixel + wrap


@fast_kernel
def _sample_row(parallax: Map, sigma: Map, at: Map,
                out: Map) -> None:  # pragma: no cover - compiled
    """Parallax and its sigma where `at` lies on the grid.

    Bilinear where the four neighbours agree to a pixel, else the nearest: edges stay sharp.
    """
    half, one = np.float32(0.5), np.float32(1)
    for j in range(at.shape[1]):
        column, row = at[2, j], at[3, j]
        c0, r0 = np.int32(column), np.int32(row)
        fc, fr = column - np.float32(c0), row - np.float32(r0)
        a, b = parallax[r0, c0], parallax[r0, c0 + 1]
        d, e = parallax[r0 + 1, c0], parallax[r0 + 1, c0 + 1]
        mean = (a * (one - fc) + b * fc) * (one - fr) + (d * (one - fc) + e * fc) * fr
        rn, cn = np.int32(row + half), np.int32(column + half)
        smooth = max(max(a, b), max(d, e)) - min(min(a, b), min(d, e)) < one
        out[0, j] = mean if smooth else parallax[rn, cn]
        out[1, j] = sigma[rn >> 1, cn >> 1]


@fast_kernel
def _inverse_row(at: Map, found: Map, pixel: np.float32, noise: Map, rho_out: Map,
                 sigma_out: Map) -> None:  # pragma: no cover - compiled
    per_baseline = np.float32(1) / noise[0]
    rotation_variance = noise[1] * noise[1]
    direction_sigma, baseline_sigma = noise[2], noise[3]
    one, nothing = np.float32(1), np.float32(NOTHING)
    for j in range(at.shape[1]):
        sine, cosine = at[0, j], at[1, j]
        delta = found[0, j] * pixel
        d2 = delta * delta
        # sin δ to 3e-8 up to 1 rad
        sin_d = delta * (one - d2 * np.float32(1 / 6) * (one - d2 * np.float32(1 / 20) * (
            one - d2 * np.float32(1 / 42) * (one - d2 * np.float32(1 / 72)))))
        cos_d = np.sqrt(max(one - sin_d * sin_d, np.float32(0)))
        sin1 = sine * cos_d - cosine * sin_d  # θ1 = θ2 − δ
        possible = (abs(delta) < one) & (sin1 > np.float32(1e-6))
        per_sin1 = one / max(sin1, np.float32(1e-6))
        rho = sin_d * per_baseline * per_sin1
        match = found[1, j] * pixel
        by_delta = sine * per_baseline * per_sin1 * per_sin1
        by_direction = rho * (cosine * cos_d + sine * sin_d) * per_sin1 * direction_sigma
        by_baseline = rho * baseline_sigma
        spread = np.sqrt(by_delta * by_delta * (match * match + rotation_variance)
                         + by_direction * by_direction + by_baseline * by_baseline)
        rho_out[j] = rho if possible else np.float32(0)
        sigma_out[j] = spread if possible else nothing


@fast_kernel
def _rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
          axes: Map, parallax: Map, sigma: Map, pixel: np.float32, margin: np.float32,
          wrap: np.float32, noise: Map, rho_out: Map,
          sigma_out: Map) -> None:  # pragma: no cover - compiled
    half = np.float32(0.5)
    at = np.empty((4, cos_lon.size), np.float32)
    found = np.empty((2, cos_lon.size), np.float32)
    for i in range(first, last):
        _polar_row(cos_lat[i], sin_lat[i], cos_lon, sin_lon, axes, margin - half, wrap - half,
                   np.float32(1) / pixel, at)
        _sample_row(parallax, sigma, at, found)
        _inverse_row(at, found, pixel, noise, rho_out[i], sigma_out[i])


def inverse_range(parallax: Parallax, grid: PolarGrid, axes: Floats, pose: RelativePose,
                  height: int, baseline_sigma: float = 0.0) -> InverseRange:
    """Inverse range on the current frame's equirectangular grid (height, 2·height).

    σ_ρ = |dρ/dδ| σ_δ with dρ/dδ = sin θ2 / (b sin² θ1); to the matcher's σ_δ come the rotation's
    error, and by themselves the direction's (through sin θ1) and the baseline's.

    Parameters
    ----------
    parallax : on `grid`
    axes : polar axes (3, 3) of the current view
    pose : of the reference; ρ is per step between frames where it is not metric
    baseline_sigma : relative standard deviation of the baseline where the pose tells none

    """
    rotation_sigma, direction_sigma, known_sigma = pose_sigmas(pose)
    baseline = pose.baseline if pose.is_metric else pose.baseline / UNSCALED
    noise = np.array([baseline, rotation_sigma, direction_sigma, known_sigma or baseline_sigma],
                     np.float32)
    rho, sigma = (np.empty((height, 2 * height), np.float32) for _ in range(2))
    pixel, margin, wrap = (np.float32(n) for n in (grid.pixel, grid.margin, grid.wrap))
    rows_in_parallel(_rows, height, *_grid_angles(height), np.ascontiguousarray(axes, np.float32),
                     parallax.pixels, parallax.sigma, pixel, margin, wrap, noise, rho, sigma)
    return InverseRange(rho, sigma, parallax.signed)


def pose_sigmas(pose: RelativePose) -> tuple[float, float, float]:
    """Standard deviations of a rotation about one axis (rad), of the direction one way (rad), and
    of the baseline as a share of it. Zero where the pose has no covariance.
    """
    if pose.covariance is None:
        return 0.0, 0.0, 0.0
    rotation = float(np.trace(pose.covariance[:3, :3])) / 3
    position = pose.covariance[3:, 3:] / pose.baseline**2
    along = max(float(pose.direction @ position @ pose.direction), 0.0)
    across = max((float(np.trace(position)) - along) / 2, 0.0)
    return rotation**0.5, across**0.5, along**0.5


def fuse(estimates: list[InverseRange], judged: bool = False) -> InverseRange:
    """Average by inverse variance what agrees within three standard deviations, nearest first.

    Where a longer baseline contradicts what is already there, it is wrong as a rule (its search or
    its occlusions): the shorter one's estimate stays. Where a search that ends takes part, a
    longer baseline does not speak alone, unless it is judged: it reports what is nearer than its
    search as far.
    """
    rho, sigma, signed = estimates[0].rho, estimates[0].sigma, estimates[0].signed
    for more in estimates[1:]:
        agrees = np.abs(more.rho - rho) < _CONFIDENT * np.hypot(more.sigma, sigma)
        if not (more.signed or judged):
            agrees &= sigma < NOTHING
        w0, w1 = 1 / sigma**2, 1 / more.sigma**2
        rho = np.where(agrees, (w0 * rho + w1 * more.rho) / (w0 + w1), rho)
        sigma = np.where(agrees, 1 / np.sqrt(w0 + w1), sigma)
        signed = signed and more.signed
    return InverseRange(rho, sigma, signed)


@fast_kernel
def beyond(rho: np.float32, sigma: np.float32,
           farthest: np.float32) -> bool:  # pragma: no cover - compiled
    """Whether it is confidently farther than an inverse range of `farthest`."""
    spread = np.float32(_CONFIDENT) * sigma
    return bool(rho + spread < farthest and rho > -spread)


@kernel
def _publish(first: int, last: int, rho: Map, sigma: Map, limits: Map, signed: bool, r_out: Map,
             sigma_out: Map) -> None:  # pragma: no cover - compiled
    nearest, farthest, max_relative = limits
    nothing = np.float32(np.nan)
    for i in range(first, last):
        for j in range(rho.shape[1]):
            p, s = rho[i, j], sigma[i, j]
            r, spread = nothing, nothing
            if signed and beyond(p, s, farthest):
                r = np.float32(np.inf)
            elif p > 0 and s <= max_relative * p:
                if p > nearest:
                    r = np.float32(-np.inf)
                elif p >= farthest:
                    r, spread = 1 / p, s / (p * p)
            r_out[i, j] = r
            sigma_out[i, j] = spread


def published_range(estimate: InverseRange, limits: RangeConfig, is_metric: bool,
                    mask: Image8 | None = None) -> tuple[Map, Map]:
    """Range and sigma as they are published (REP-117), float32 (H, 2H).

    NaN: unknown, uncertain beyond `range.max_relative_sigma`, inconsistent, or vehicle. −Inf:
    nearer than `range.min`. +Inf: at least three standard deviations beyond `range.max`. Without
    metric scale the limits in metres do not apply.
    """
    r, sigma = np.empty_like(estimate.rho), np.empty_like(estimate.rho)
    nearest = 1 / max(limits.minimum, 1e-9) if is_metric else np.inf
    farthest = 1 / limits.maximum if is_metric else 0.0
    bounds = np.array([nearest, farthest, limits.max_relative_sigma], np.float32)
    rows_in_parallel(_publish, r.shape[0], estimate.rho, estimate.sigma, bounds,
                     estimate.signed and is_metric, r, sigma)
    if mask is not None:
        r[mask != 0] = np.nan
        sigma[mask != 0] = np.nan
    return r, sigma
