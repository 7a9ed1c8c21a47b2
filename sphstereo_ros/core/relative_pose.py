"""Relative pose from correspondences of bearings: RANSAC, then robust least squares.

Residuals are angles between a bearing and its epipolar plane, so points ahead, behind and at the
side count alike. Convention: X_cur = R X_ref + p; from correspondences |p| = 1.
"""
from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import rotations
from .five_point import decompose, essential_matrices
from .jit import fast_kernel, kernel

Floats = NDArray[np.float64]

_TUKEY = 4.685
_SMALL_STEP = 1e-6  # rad, after which refinement stops
# Neighbours: residuals count up to so many medians; their mean is so many medians as a rule, which
# so many points more are taken to have; how strongly it counts; how much alike neighbours err.
_MOST, _USUAL, _FEW, _TRUST, _ALIKE = 3.0, 1.1, 4, 3, 0.1


@dataclass(frozen=True)
class Correspondences:
    """The same points seen from two views: unit bearings (N, 3), each in its view's frame, and the
    expected standard deviation (N,) of each match, rad (only their ratios matter).
    """

    reference: Floats
    current: Floats
    sigma: Floats

    def __len__(self) -> int:
        return len(self.reference)

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.intp]) -> Correspondences:
        return Correspondences(self.reference[index], self.current[index], self.sigma[index])


@dataclass(frozen=True)
class PoseEstimate:
    """rotation (3, 3); direction p of the reference camera in the current frame, (3,), |p| = 1;
    inliers (N,) bool; covariance (5, 5) of a small rotation (rad) and of the direction along its
    `tangent` (3, 2); residual: robust standard deviation of the inliers, rad.
    """

    rotation: Floats
    direction: Floats
    inliers: NDArray[np.bool_]
    covariance: Floats
    residual: float

    @property
    def covariance6(self) -> Floats:
        """Covariance (6, 6) of the small rotation and of the unit direction (3,)."""
        spread = _spread(self.direction)
        return spread @ self.covariance @ spread.T


def tangent(direction: Floats) -> Floats:
    """Two unit vectors (3, 2) that span the plane normal to the unit vector `direction`.

    Duff et al., Building an Orthonormal Basis, Revisited, JCGT 2017.
    """
    x, y, z = (float(value) for value in direction)
    sign = math.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, b], [sign * b, sign + y * y * a], [-sign * x, -y]])


def epipolar_residuals(rotation: Floats, direction: Floats, points: Correspondences) -> Floats:
    """Signed sine of the angle from each current bearing to its epipolar plane, (N,)."""
    normal = np.cross(direction, points.reference @ rotation.T)
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-9)
    return np.asarray(np.einsum('na,na->n', points.current, normal) / length)


def parallax(rotation: Floats, points: Correspondences) -> Floats:
    """Angle between each current bearing and the rotated reference bearing, rad, (N,)."""
    turned = points.reference @ rotation.T
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(turned, points.current), axis=1),
                                 np.einsum('na,na->n', turned, points.current)))


def rotation_between(points: Correspondences) -> Floats:
    """Rotation (3, 3) that brings the reference bearings nearest to the current ones."""
    u, _, vt = np.linalg.svd(points.current.T @ points.reference)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def in_front(rotation: Floats, direction: Floats, points: Correspondences) -> NDArray[np.bool_]:
    """Which points lie on the positive side of both bearings, when triangulated, (N,) bool."""
    turned = points.reference @ rotation.T
    c = np.einsum('na,na->n', turned, points.current)
    a = turned @ direction
    b = points.current @ direction
    # λ_cur · current = λ_ref · turned + p, least squares, common positive factor left out
    return np.asarray(((b * c - a) > 0) & ((b - a * c) > 0))


@fast_kernel
def _judge(models: Floats, reference: Floats, current: Floats, threshold: float, cost: Floats,
           share: Floats) -> None:  # pragma: no cover - compiled
    """MSAC cost and share of inliers of each model (M, 3, 3); bearings are (3, N)."""
    count = reference.shape[1]
    for m in range(len(models)):
        e = models[m]
        total, inliers = 0.0, 0
        for k in range(count):
            x, y, z = reference[0, k], reference[1, k], reference[2, k]
            nx = e[0, 0] * x + e[0, 1] * y + e[0, 2] * z
            ny = e[1, 0] * x + e[1, 1] * y + e[1, 2] * z
            nz = e[2, 0] * x + e[2, 1] * y + e[2, 2] * z
            across = nx * current[0, k] + ny * current[1, k] + nz * current[2, k]
            ratio = across * across / (threshold * threshold
                                       * max(nx * nx + ny * ny + nz * nz, 1e-18))
            total += min(ratio, 1.0)
            inliers += ratio < 1.0
        cost[m] = total / count
        share[m] = inliers / count


def _best_model(models: Floats, points: Correspondences,
                threshold: float) -> tuple[Floats, float, float]:
    """The model of least MSAC cost, that cost, and its share of inliers."""
    cost, share = np.empty(len(models)), np.empty(len(models))
    _judge(models, np.ascontiguousarray(points.reference.T),
           np.ascontiguousarray(points.current.T), threshold, cost, share)
    best = int(np.argmin(cost))
    return models[best], float(cost[best]), float(share[best])


def best_rotation(candidates: Floats, direction: Floats, points: Correspondences,
                  threshold: float) -> Floats:
    """The one of the rotations (M, 3, 3) that most points support (MSAC), the direction being
    known.
    """
    models = rotations.skew(direction) @ candidates
    cost, share = np.empty(len(models)), np.empty(len(models))
    _judge(np.ascontiguousarray(models), np.ascontiguousarray(points.reference.T),
           np.ascontiguousarray(points.current.T), threshold, cost, share)
    return np.asarray(candidates[int(np.argmin(cost))])


def ransac(points: Correspondences, threshold: float, rng: np.random.Generator, *,
           batch: int = 24, max_batches: int = 24, scored: int = 600,
           confidence: float = 0.999) -> tuple[Floats, Floats] | None:
    """Rotation (3, 3) and direction (3,) with the most support, or None where nothing fits.

    Parameters
    ----------
    points : at least five correspondences; samples are drawn from the half that is expected to be
        followed best
    threshold : angular residual of an inlier, rad
    rng : decides the samples
    batch, max_batches : samples at a time, and how often at most
    scored : so many correspondences (drawn once) judge each model
    confidence : that one sample without outliers was drawn

    """
    pool = points[points.sigma <= np.median(points.sigma)]
    subset = pool[rng.permutation(len(pool))[:scored]]
    best: Floats | None = None
    lowest, inliers = np.inf, 0.0
    for tried in range(1, max_batches + 1):
        sample = rng.integers(0, len(pool), (batch, 5))
        models = essential_matrices(pool.reference[sample], pool.current[sample])
        if len(models):
            model, cost, share = _best_model(models, subset, threshold)
            if cost < lowest:
                best, lowest, inliers = model, cost, share
        if (1 - inliers**5)**(tried * batch) < 1 - confidence:
            break
    if best is None:
        return None
    poses = decompose(best)
    support = points[np.abs(epipolar_residuals(*poses[0], points)) < threshold]
    rotation, direction = max(poses,
                              key=lambda pose: int(in_front(pose[0], pose[1], support).sum()))
    # Far points lie on either side by chance; the sign is for those that moved to tell.
    moved = support[parallax(rotation, support) > threshold]
    ahead, behind = (int(in_front(rotation, p, moved).sum()) for p in (direction, -direction))
    return rotation, direction if ahead >= behind else -direction


@kernel
def _residuals(rotation: Floats, direction: Floats, reference: Floats, current: Floats,
               out: Floats, jacobian: Floats) -> None:  # pragma: no cover - compiled
    """Residuals (N,), and derivatives (N, 6) by a left small rotation and by the direction.

    With g = R f1, n = p × g: residual f2·n/|n|; h = (f2 − residual n/|n|)/|n| gives
    g × (h × p) for the rotation and g × h for the direction.
    """
    for k in range(len(reference)):
        f1x, f1y, f1z = reference[k]
        f2x, f2y, f2z = current[k]
        px, py, pz = direction
        gx = rotation[0, 0] * f1x + rotation[0, 1] * f1y + rotation[0, 2] * f1z
        gy = rotation[1, 0] * f1x + rotation[1, 1] * f1y + rotation[1, 2] * f1z
        gz = rotation[2, 0] * f1x + rotation[2, 1] * f1y + rotation[2, 2] * f1z
        nx, ny, nz = py * gz - pz * gy, pz * gx - px * gz, px * gy - py * gx
        length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-9)
        nx, ny, nz = nx / length, ny / length, nz / length
        r = f2x * nx + f2y * ny + f2z * nz
        hx, hy, hz = (f2x - r * nx) / length, (f2y - r * ny) / length, (f2z - r * nz) / length
        kx, ky, kz = hy * pz - hz * py, hz * px - hx * pz, hx * py - hy * px
        out[k] = r
        jacobian[k, 0], jacobian[k, 3] = gy * kz - gz * ky, gy * hz - gz * hy
        jacobian[k, 1], jacobian[k, 4] = gz * kx - gx * kz, gz * hx - gx * hz
        jacobian[k, 2], jacobian[k, 5] = gx * ky - gy * kx, gx * hy - gy * hx


def linearised(rotation: Floats, direction: Floats,
               points: Correspondences) -> tuple[Floats, Floats]:
    """Residuals (N,), and their derivatives (N, 6) by a small rotation about the current camera's
    axes and by the direction.
    """
    residual, derivatives = np.empty(len(points)), np.empty((len(points), 6))
    _residuals(rotation, direction, points.reference, points.current, residual, derivatives)
    return residual, derivatives


def tukey_weights(residual: Floats, sigma: Floats, scale: float) -> Floats:
    """Weights (N,) of least squares in 1/rad², as `refine` takes them at that scale."""
    ratio = residual / (sigma * _TUKEY * scale)
    return np.asarray((np.clip(1 - ratio**2, 0, None) / sigma)**2)


def refine(rotation: Floats, direction: Floats, points: Correspondences, *, iterations: int = 8,
           floor: float = 0.2, free_direction: bool = True) -> PoseEstimate | None:
    """Minimise the angular residuals with Tukey weights (Gauss–Newton on SO(3) × S²).

    Parameters
    ----------
    rotation, direction : the start
    points : correspondences, outliers among them
    iterations : at most
    floor : least scale of the residuals taken, as a share of the expected ones
    free_direction : else only the rotation is estimated, and the direction is taken as exact

    Returns
    -------
    None where the correspondences do not fix the parameters.

    """
    residual, derivatives = np.empty(len(points)), np.empty((len(points), 6))
    for iteration in range(iterations):
        spread = _spread(direction)[:, :5 if free_direction else 3]
        _residuals(rotation, direction, points.reference, points.current, residual, derivatives)
        normalised = residual / points.sigma
        scale = max(1.4826 * float(np.median(np.abs(normalised))), floor)
        # Near points fix the direction, and a wrong start moves them most: first a wide loss.
        width = _TUKEY * scale * max(4 * 0.5**iteration, 1)
        sums = np.zeros((6, 7))
        inliers = _normal_equations(residual, derivatives, points.sigma, width, sums)
        normal = spread.T @ sums[:, :6] @ spread
        if not np.isfinite(normal).all() or _is_singular(normal):
            return None
        step = -np.linalg.solve(normal, spread.T @ sums[:, 6])
        rotation = rotations.exp(step[:3]) @ rotation
        if free_direction:
            direction = direction + spread[3:, 3:] @ step[3:]
            direction = direction / np.linalg.norm(direction)
        if width <= _TUKEY * scale and np.abs(step).max() < _SMALL_STEP:
            break
    covariance = np.zeros((5, 5))
    covariance[:len(normal), :len(normal)] = np.linalg.inv(normal) * scale**2
    return PoseEstimate(rotation, direction, inliers, covariance,
                        scale * float(np.median(points.sigma)))


def _is_singular(normal: Floats) -> bool:
    """Whether a symmetric matrix fixes too little."""
    sizes = np.abs(np.linalg.eigvalsh(normal))
    return float(sizes.max()) > 1e10 * float(sizes.min())


def cells_of(pixels: NDArray[np.floating], size: int) -> NDArray[np.intp]:
    """The square cell of `size` px in which each position (N, 2) lies: (N,); none is negative."""
    column, row = (np.asarray(pixels) // size).astype(np.intp).T
    return np.asarray(row * (column.max(initial=0) + 1) + column)


def weighted_by_neighbours(points: Correspondences, cells: NDArray[np.intp],
                           estimate: PoseEstimate) -> Correspondences:
    """The points with a larger sigma where those around them contradict the estimate.

    What glides over glossy ground, or is matched at rims, misleads many points in one place, each
    by too little to be an outlier. And neighbours err alike: ten tell less than ten times as much
    as one.

    Parameters
    ----------
    points : (N,) correspondences
    cells : (N,) which cell of the image each lies in, from 0
    estimate : a first estimate from them

    """
    residual = epipolar_residuals(estimate.rotation, estimate.direction, points) / points.sigma
    size = np.abs(residual)
    size = np.minimum(size / max(float(np.median(size)), 1e-12), _MOST)
    count = np.bincount(cells)
    mean = (np.bincount(cells, size) / _USUAL + _FEW) / (count + _FEW)
    share = np.maximum(mean, 1)**_TRUST * np.sqrt(1 + _ALIKE * (count - 1))
    return Correspondences(points.reference, points.current, points.sigma * share[cells])


def warm_up() -> None:
    """Compile what `ransac` and `refine` need."""
    rng = np.random.default_rng(0)
    bearings = rng.normal(size=(2, 20, 3))
    bearings /= np.linalg.norm(bearings, axis=-1, keepdims=True)
    points = Correspondences(bearings[0], bearings[1], np.full(20, 1e-3))
    ransac(points, 1e-3, rng, max_batches=1)
    refine(np.eye(3), np.array([0.0, 0.0, -1.0]), points, iterations=1)


def _spread(direction: Floats) -> Floats:
    """(6, 5): a small rotation and two angles of the direction → rotation and direction."""
    spread = np.zeros((6, 5))
    spread[:3, :3] = np.eye(3)
    spread[3:, 3:] = tangent(direction)
    return spread


@kernel
def _normal_equations(residual: Floats, derivatives: Floats, sigma: Floats, width: float,
                      sums: Floats) -> NDArray[np.bool_]:  # pragma: no cover - compiled
    """Add JᵀWJ and JᵀWr with Tukey's weights to `sums` (6, 7); which points have a weight."""
    inliers = np.zeros(len(residual), np.bool_)
    for k in range(len(residual)):
        ratio = residual[k] / (sigma[k] * width)
        root = 1 - ratio * ratio
        if not root > 0:
            continue
        inliers[k] = True
        weight = (root / sigma[k])**2
        for a in range(6):
            scaled = weight * derivatives[k, a]
            for b in range(6):
                sums[a, b] += scaled * derivatives[k, b]
            sums[a, 6] += scaled * residual[k]
    return inliers
