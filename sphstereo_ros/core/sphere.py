"""The exact geometry of a pair on the sphere.

A reference view C1 and a current view C2 = C1 + b·t. θ1 and θ2 are the angles between t and the
ray to the same point from C1 and C2; the parallax is δ = θ2 − θ1 ≥ 0. The law of sines gives
r1 = b·sin θ2 / sin δ and r2 = b·sin θ1 / sin δ. (The paper's equation 2 divides by cos φ where
its own appendix says to multiply: that error points toward "farther than it is".)
"""
from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def polar_axes(direction: ArrayLike) -> Floats:
    """Right-handed axes (3, 3) as columns (e0, e1, t), with the pole along `direction`.

    A point at polar angle θ and azimuth α has the bearing sin θ (cos α e0 + sin α e1) + cos θ t.
    e0 is the axis of the camera that is least along t, made orthogonal, so the azimuth changes
    smoothly with t except where that choice changes.
    """
    t = np.asarray(direction, np.float64)
    t = t / np.linalg.norm(t)
    helper = np.eye(3)[int(np.argmin(np.abs(t)))]
    e0 = helper - t * (helper @ t)
    e0 /= np.linalg.norm(e0)
    return np.stack([e0, np.cross(t, e0), t], axis=1)


def polar_bearings(theta: ArrayLike, azimuth: ArrayLike, axes: Floats) -> Floats:
    """Bearings (..., 3) at polar angle `theta` and `azimuth` (rad) about the last of `axes`."""
    theta, azimuth = np.broadcast_arrays(np.asarray(theta, np.float64),
                                         np.asarray(azimuth, np.float64))
    polar = np.stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth),
                      np.cos(theta)], axis=-1)
    return np.asarray(polar @ axes.T)


def polar_angles(bearings: Floats, axes: Floats) -> Floats:
    """Polar angle θ in [0, π] and azimuth in [0, 2π) of bearings (..., 3), as (..., 2), rad."""
    polar = np.asarray(bearings) @ axes
    theta = np.arctan2(np.hypot(polar[..., 0], polar[..., 1]), polar[..., 2])
    return np.stack([theta, np.arctan2(polar[..., 1], polar[..., 0]) % (2 * np.pi)], axis=-1)


def range_from_parallax(theta2: ArrayLike, parallax: ArrayLike, baseline: float) -> Floats:
    """Range r2 seen from the current view (law of sines).

    Parameters
    ----------
    theta2 : angle between the motion direction and the ray from the current view, rad
    parallax : δ = θ2 − θ1, rad
    baseline : metres

    Returns
    -------
    Metres, of the broadcast shape; NaN where no point in front of both views fits: δ < 0, or
    δ ≥ θ2. A parallax of zero is +Inf.

    """
    theta2, delta = np.broadcast_arrays(np.asarray(theta2, np.float64),
                                        np.asarray(parallax, np.float64))
    possible = (delta >= 0) & (delta < theta2) & (theta2 <= np.pi)
    with np.errstate(divide='ignore', invalid='ignore'):
        r = baseline * np.sin(theta2 - delta) / np.sin(delta)
    return np.asarray(np.where(possible, r, np.nan))


def parallax_from_range(theta2: ArrayLike, range2: ArrayLike, baseline: float) -> Floats:
    """Parallax δ (rad) of a point at range r2 (m) and angle θ2 (rad) from the current view.

    The reference sees the point at (r2 sin θ2, r2 cos θ2 + b) along and across t.
    """
    theta2, r2 = np.broadcast_arrays(np.asarray(theta2, np.float64),
                                     np.asarray(range2, np.float64))
    return np.asarray(np.arctan2(baseline * np.sin(theta2), r2 + baseline * np.cos(theta2)))


def range_sigma(theta2: ArrayLike, parallax: ArrayLike, baseline: float, *,
                parallax_sigma: ArrayLike, baseline_sigma: float = 0.0) -> Floats:
    """One standard deviation of r2, metres: dr2/dδ = −b sin θ2 / sin² δ, and dr2/db = r2/b."""
    theta2, delta = np.broadcast_arrays(np.asarray(theta2, np.float64),
                                        np.asarray(parallax, np.float64))
    with np.errstate(divide='ignore', invalid='ignore'):
        from_parallax = np.asarray(parallax_sigma) * baseline * np.sin(theta2) / np.sin(delta)**2
        from_baseline = np.sin(theta2 - delta) / np.sin(delta) * baseline_sigma
    return np.asarray(np.hypot(from_parallax, from_baseline))


def paper_range(latitude: ArrayLike, pixels: ArrayLike, polar_height: int,
                baseline: float) -> Floats:
    """Range by the paper's equation 1, times cos φ as its appendix says (equation 2 divides).

    For comparison only: it takes the tangent of δ and the latitude φ = π/2 − θ of one view.

    Parameters
    ----------
    latitude : φ, rad
    pixels : parallax n in pixels of a polar image with `polar_height` rows
    polar_height : R_vertical
    baseline : d, metres

    """
    delta = np.asarray(pixels, np.float64) * np.pi / polar_height
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(baseline / np.tan(delta) * np.cos(np.asarray(latitude, np.float64)))
