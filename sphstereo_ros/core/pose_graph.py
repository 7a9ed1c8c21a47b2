"""Poses of many frames, and the scale of each window, from relative poses: least squares.

Frame i has the pose X_map = R_i · X_camera + c_i. The window of frame i measured X_i = R · X_k + p
for its references k, in units of its own: s_i map units each. What is minimised are the errors of
R against R_iᵀ R_k, and of p against R_iᵀ (c_k − c_i) / s_i, by Gauss and Newton, with weights that
let a wrong relative pose go (Cauchy).
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import rotations

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

_DAMPING = 1e-9  # keeps what nothing fixes where it is
_ROBUST = 12.0  # squared normalised error of an edge (6 numbers) from which its weight falls


@dataclass(frozen=True)
class Poses:
    """rotations : (N, 3, 3) map ← camera; positions : (N, 3); log_scales : (N,) of map units in
    a unit of the frame's own window.
    """

    rotations: Floats
    positions: Floats
    log_scales: Floats


@dataclass(frozen=True)
class Edges:
    """E measured relative poses.

    current, reference : (E,) indices of frames; rotation : (E, 3, 3) and position : (E, 3), the
    reference in the current camera's axes; whitening : (E, 6, 6), turns (rotation, position)
    errors to unit variance
    """

    current: Indices
    reference: Indices
    rotation: Floats
    position: Floats
    whitening: Floats


@dataclass(frozen=True)
class Priors:
    """What is known of scales by themselves: log_scale (N,) and its standard deviation (N,), NaN
    where nothing is.
    """

    log_scale: Floats
    log_scale_sigma: Floats


def whitening(covariance: Floats) -> Floats:
    """(6, 6) W with W · C · Wᵀ = 1."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def optimised(start: Poses, edges: Edges, priors: Priors, held: int = 1,
              free_scales: bool = False, iterations: int = 5) -> Poses:
    """The poses that fit best.

    start : near the solution
    held : so many first frames keep position and rotation; a held frame's scale is kept, too
    free_scales : whether windows have scales of their own
    """
    poses, count = start, len(start.positions)
    if count <= held or not len(edges.current):
        return start
    for _ in range(iterations):
        matrix, right = _normal_equations(poses, edges, priors, free_scales)
        live = np.zeros((count, 7), bool)
        live[held:, :6] = True
        live[held if held > 1 else 0:, 6] = free_scales
        live &= np.diag(matrix).reshape(count, 7) > 0
        chosen = np.nonzero(live.ravel())[0]
        step = np.zeros(7 * count)
        part = matrix[np.ix_(chosen, chosen)]
        part[np.diag_indices_from(part)] *= 1 + _DAMPING
        step[chosen] = np.linalg.solve(part, right[chosen])
        poses = _moved(poses, step.reshape(count, 7))
        if np.abs(step).max() < 1e-8:
            break
    return poses


def _moved(poses: Poses, step: Floats) -> Poses:
    turned = np.stack([r @ rotations.exp(v) for r, v in
                       zip(poses.rotations, step[:, :3], strict=True)])
    return Poses(turned, poses.positions + step[:, 3:6], poses.log_scales + step[:, 6])


def _skew(vectors: Floats) -> Floats:
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1),
                     np.stack([-y, x, zero], -1)], 1)


def _residuals(poses: Poses, edges: Edges) -> tuple[Floats, Floats, Floats]:
    """(E, 6) errors, and the predicted rotation (E, 3, 3) and position (E, 3), in the unit of
    the current frame's window.
    """
    i, k = edges.current, edges.reference
    back = poses.rotations[i].transpose(0, 2, 1)
    turn = back @ poses.rotations[k]
    place = np.einsum('eab,eb->ea', back, poses.positions[k] - poses.positions[i])
    place *= np.exp(-poses.log_scales[i])[:, None]
    error = np.empty((len(i), 6))
    error[:, :3] = [rotations.log(t @ r.T) for t, r in zip(turn, edges.rotation, strict=True)]
    error[:, 3:] = place - edges.position
    return error, turn, place


def _normal_equations(poses: Poses, edges: Edges, priors: Priors,
                      free_scales: bool) -> tuple[Floats, Floats]:
    """JᵀWJ (7N, 7N) and −JᵀWr (7N,) in (turn about the camera's axes, position, log scale)."""
    count, i, k = len(poses.positions), edges.current, edges.reference
    error, turn, place = _residuals(poses, edges)
    back = poses.rotations[i].transpose(0, 2, 1) * np.exp(-poses.log_scales[i])[:, None, None]
    at_current, at_reference = np.zeros((2, len(i), 6, 7))
    at_current[:, :3, :3] = -np.eye(3)
    at_current[:, 3:, :3] = _skew(place)
    at_current[:, 3:, 3:6] = -back
    if free_scales:
        at_current[:, 3:, 6] = -place
    at_reference[:, :3, :3] = turn
    at_reference[:, 3:, 3:6] = back
    white = np.einsum('eab,eb->ea', edges.whitening, error)
    weight = 1 / (1 + (white**2).sum(axis=1) / _ROBUST)
    a, b = edges.whitening @ at_current, edges.whitening @ at_reference
    matrix, right = np.zeros((count, count, 7, 7)), np.zeros((count, 7))
    for left, at in ((a, i), (b, k)):
        np.add.at(right, at, -np.einsum('e,eam,ea->em', weight, left, white))
        for other, at_other in ((a, i), (b, k)):
            np.add.at(matrix, (at, at_other), np.einsum('e,eam,ean->emn', weight, left, other))
    _add_priors(poses, priors, matrix, right)
    return matrix.transpose(0, 2, 1, 3).reshape(7 * count, 7 * count), right.ravel()


def _add_priors(poses: Poses, priors: Priors, matrix: Floats, right: Floats) -> None:
    for n in np.nonzero(np.isfinite(priors.log_scale))[0]:
        weight = priors.log_scale_sigma[n] ** -2
        matrix[n, n, 6, 6] += weight
        right[n, 6] += weight * (priors.log_scale[n] - poses.log_scales[n])
