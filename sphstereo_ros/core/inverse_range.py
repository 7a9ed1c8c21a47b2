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
from .frames import Image8, RelativePose
from .jit import fast_kernel, rows_in_parallel
from .matching import Parallax
from .warp import Map, PolarGrid, _arctan2

Floats = NDArray[np.float64]

_UNKNOWN = np.float32(-1e3)  # instead of NaN where the kernel may re-order arithmetic
_CONFIDENT = 3.0  # standard deviations


@dataclass(frozen=True)
class InverseRange:
    """ρ and its standard deviation, float32 (H, 2H), 1/m (or 1/baseline); NaN unknown.

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
def _rows(first: int, last: int, cos_lat: Map, sin_lat: Map, cos_lon: Map, sin_lon: Map,
          axes: Map, parallax: Map, sigma: Map, pixel: np.float32, margin: int, wrap: int,
          noise: Map, rho_out: Map, sigma_out: Map) -> None:  # pragma: no cover - compiled
    baseline, rotation_sigma, direction_sigma, baseline_sigma = noise
    per_pixel = np.float32(1) / pixel
    full_turn = np.float32(2 * np.pi)
    for i in range(first, last):
        for j in range(cos_lon.size):
            x, y, z = cos_lat[i] * sin_lon[j], -sin_lat[i], cos_lat[i] * cos_lon[j]
            px = axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z
            py = axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z
            pz = axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z
            theta = _arctan2(np.sqrt(px * px + py * py), pz)
            azimuth = _arctan2(py, px)
            azimuth = azimuth + full_turn if azimuth < 0 else azimuth
            c = theta * per_pixel - np.float32(0.5) + margin
            r = azimuth * per_pixel - np.float32(0.5) + wrap
            c0, r0 = int(np.floor(c)), int(np.floor(r))
            fc, fr = c - c0, r - r0
            a, b = parallax[r0, c0], parallax[r0, c0 + 1]
            d, e = parallax[r0 + 1, c0], parallax[r0 + 1, c0 + 1]
            rn, cn = r0 + int(fr + np.float32(0.5)), c0 + int(fc + np.float32(0.5))
            if max(a, b, d, e) - min(a, b, d, e) < np.float32(1):
                n = (a * (1 - fc) + b * fc) * (1 - fr) + (d * (1 - fc) + e * fc) * fr
            else:  # an edge, or something unknown: nothing is mixed
                n = parallax[rn, cn]
            delta = n * pixel
            theta1 = theta - delta
            if n < np.float32(-900) or theta1 <= 0 or theta1 >= np.float32(np.pi):
                rho_out[i, j] = _UNKNOWN
                sigma_out[i, j] = _UNKNOWN
                continue
            s1 = np.sin(theta1)
            rho = np.sin(delta) / (baseline * s1)
            match = sigma[rn, cn] * pixel
            by_delta = np.sqrt(px * px + py * py) / (baseline * s1 * s1)
            from_match = by_delta * by_delta * (match * match + rotation_sigma * rotation_sigma)
            from_direction = rho * np.cos(theta1) / s1 * direction_sigma
            from_baseline = rho * baseline_sigma
            rho_out[i, j] = rho
            sigma_out[i, j] = np.sqrt(from_match + from_direction * from_direction
                                      + from_baseline * from_baseline)


def inverse_range(parallax: Parallax, grid: PolarGrid, axes: Floats, pose: RelativePose,
                  height: int, baseline_sigma: float = 0.0) -> InverseRange:
    """Inverse range on the current frame's equirectangular grid (height, 2·height).

    σ_ρ = |dρ/dδ| σ_δ with dρ/dδ = sin θ2 / (b sin² θ1); to the matcher's σ_δ come the rotation's
    error, and by themselves the direction's (through sin θ1) and the baseline's.

    Parameters
    ----------
    parallax : on `grid`
    axes : polar axes (3, 3) of the current view
    pose : of the reference; ρ is in 1/baselines where it is not metric
    baseline_sigma : relative standard deviation of the baseline where the pose tells none

    """
    rotation_sigma, direction_sigma, known_sigma = pose_sigmas(pose)
    noise = np.array([pose.baseline if pose.is_metric else 1.0, rotation_sigma, direction_sigma,
                      known_sigma or baseline_sigma], np.float32)
    known = np.where(np.isfinite(parallax.pixels), parallax.pixels, _UNKNOWN)
    rho, sigma = (np.empty((height, 2 * height), np.float32) for _ in range(2))
    rows_in_parallel(_rows, height, *_grid_angles(height), np.ascontiguousarray(axes, np.float32),
                     known, parallax.sigma, np.float32(grid.pixel), grid.margin, grid.wrap, noise,
                     rho, sigma)
    unknown = rho == _UNKNOWN
    rho[unknown] = np.nan
    sigma[unknown] = np.nan
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


def fuse(estimates: list[InverseRange]) -> InverseRange:
    """Average by inverse variance what agrees within three standard deviations, nearest first.

    Where a longer baseline contradicts what is already there, it is wrong as a rule (its search or
    its occlusions): the shorter one's estimate stays.
    """
    rho, sigma, signed = estimates[0].rho.copy(), estimates[0].sigma.copy(), estimates[0].signed
    for more in estimates[1:]:
        with np.errstate(invalid='ignore'):
            agrees = np.abs(more.rho - rho) < _CONFIDENT * np.hypot(more.sigma, sigma)
            w0, w1 = 1 / sigma**2, 1 / more.sigma**2
            mean, spread = (w0 * rho + w1 * more.rho) / (w0 + w1), 1 / np.sqrt(w0 + w1)
        rho = np.where(agrees, mean, np.where(np.isnan(rho), more.rho, rho)).astype(np.float32)
        sigma = np.where(agrees, spread,
                         np.where(np.isnan(sigma), more.sigma, sigma)).astype(np.float32)
        signed = signed and more.signed
    return InverseRange(rho, sigma, signed)


def published_range(estimate: InverseRange, limits: RangeConfig, is_metric: bool,
                    mask: Image8 | None = None) -> tuple[Map, Map]:
    """Range and sigma as they are published (REP-117), float32 (H, 2H).

    NaN: unknown, uncertain beyond `range.max_relative_sigma`, inconsistent, or vehicle. −Inf:
    nearer than `range.min`. +Inf: at least three standard deviations beyond `range.max`. Without
    metric scale the limits in metres do not apply.
    """
    rho, sigma = estimate.rho, estimate.sigma
    with np.errstate(divide='ignore', invalid='ignore'):
        r = np.asarray(1 / rho, np.float32)
        relative = sigma * r
        good = (relative > 0) & (relative <= limits.max_relative_sigma)
        r[~good] = np.nan
        if is_metric:
            beyond = (rho + _CONFIDENT * sigma < 1 / limits.maximum) & (rho > -_CONFIDENT * sigma)
            if estimate.signed:
                r[beyond] = np.inf
            r[(r > limits.maximum) & np.isfinite(r)] = np.nan
            r[r < limits.minimum] = -np.inf
    if mask is not None:
        r[mask != 0] = np.nan
    return r, np.where(np.isfinite(r), relative * r, np.float32(np.nan)).astype(np.float32)
