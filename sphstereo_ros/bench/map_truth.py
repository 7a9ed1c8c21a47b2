"""A map against the scene it is of: errors of its track, of its points, and what it covers."""
from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sphstereo_ros.core.camera import Equirectangular
from sphstereo_ros.core.rotations import angle
from sphstereo_ros.core.track import TrackedFrame
from sphstereo_ros.core.voxels import VoxelPoints
from sphstereo_ros.scenes.sequence import TruthFrame

if TYPE_CHECKING:
    from sphstereo_ros.scenes.scene import Scene

Floats = NDArray[np.float64]
Figures = dict[str, float]

NEAR = 10.0  # m from the track: which points are judged
WITHIN, SHARE = 0.05, 0.01  # m, and of the distance from the track: so near a surface is right
LOOSE = 0.03  # of the distance, where only an average speed is known
PIECE = 10  # frames: relative errors are those of so long pieces
COVERED, PATCH = 0.2, 0.1  # m: a patch of surface of that size counts with a point so near
_JUDGED, _RAYS = 40_000, 64
_EVERY = 5  # so many frames tell what surfaces the camera saw


def in_world(track: Sequence[TrackedFrame], xyz: Floats,
             truth: Sequence[TruthFrame]) -> tuple[Floats, Floats, Floats]:
    """Rotations (F, 3, 3), positions (F, 3) and points (N, 3) moved so that the first pose is
    the true one.
    """
    first = next(f for f in truth if f.stamp == track[0].key.stamp)
    turn = first.rotation @ track[0].rotation.T
    shift = first.position - turn @ track[0].position
    return (turn @ np.stack([f.rotation for f in track]),
            np.stack([f.position for f in track]) @ turn.T + shift, xyz @ turn.T + shift)


def way_length(positions: Floats) -> float:
    """Metres along positions (N, 3)."""
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def track_errors(rotations: Floats, positions: Floats, truth: Sequence[TruthFrame]) -> Figures:
    """Errors of poses whose first one is the true one.

    Returns
    -------
    ate : root mean square of positions after the best rigid fit (Sturm et al. 2012), as the
    largest and the last error, without a fit, in % of the distance; rpe : root mean square error
    of the way of a piece, in % of its length; scale : largest error of a piece's length, in %

    """
    there = np.stack([f.position for f in truth])
    off = np.linalg.norm(positions - there, axis=1)
    length = way_length(there)
    piece = min(PIECE, len(truth) - 1)
    pieces = [np.einsum('fab,fa->fb', turned[:-piece], place[piece:] - place[:-piece])
              for turned, place in ((rotations, positions),
                                    (np.stack([f.rotation for f in truth]), there))]
    lengths = [np.linalg.norm(p, axis=1) for p in pieces]
    wrong = np.linalg.norm(pieces[0] - pieces[1], axis=1) / lengths[1]
    turned = [angle(r.T @ f.rotation) for r, f in zip(rotations, truth, strict=True)]
    return {'distance_m': length,
            'ate_percent': 100 * _rms(_fitted(positions, there) - there) / length,
            'largest_percent': 100 * float(off.max()) / length,
            'end_percent': 100 * float(off[-1]) / length,
            'rpe_percent': 100 * float(np.sqrt((wrong**2).mean())),
            'scale_percent': 100 * float(np.abs(lengths[0] / lengths[1] - 1).max()),
            'turn_deg': float(np.degrees(max(turned)))}


def _rms(errors: Floats) -> float:
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


def _fitted(positions: Floats, there: Floats) -> Floats:
    """The positions (N, 3) turned and shifted so that they fit best (Umeyama 1991, no scale)."""
    a, b = positions.mean(axis=0), there.mean(axis=0)
    u, _, vt = np.linalg.svd((there - b).T @ (positions - a))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return np.asarray((positions - a) @ turn.T + b)


def surface_distance(scene: Scene, xyz: Floats) -> Floats:
    """Distance (N,) of points (N, 3) to the nearest surface: the shortest of many rays, then of
    the two along the normal of what that one hit.
    """
    rng = np.random.default_rng(0)
    rays = rng.normal(size=(_RAYS, 3))
    rays = np.concatenate([np.eye(3), -np.eye(3), rays / np.linalg.norm(rays, axis=1)[:, None]])
    nearest, face = np.full(len(xyz), np.inf), np.zeros(len(xyz), np.int64)
    for ray in rays:
        hits = scene.cast(xyz, np.broadcast_to(ray, xyz.shape))
        better = hits.distance < nearest
        nearest[better], face[better] = hits.distance[better], hits.face[better]
    for side in (1.0, -1.0):
        nearest = np.minimum(nearest, scene.cast(xyz, side * scene.normals[face]).distance)
    return nearest


def point_errors(xyz: Floats, positions: Floats, scene: Scene) -> Figures:
    """How far points near the track are from the surfaces."""
    distance, _ = KDTree(positions).query(xyz)
    near = np.nonzero(distance < NEAR)[0]
    if not len(near):
        return {'points_near': 0}
    chosen = np.random.default_rng(0).choice(near, min(_JUDGED, len(near)), replace=False)
    off, away = surface_distance(scene, xyz[chosen]), distance[chosen]
    return {'points_near': len(near),
            'right_percent': 100 * float((off <= WITHIN + SHARE * away).mean()),
            'loose_percent': 100 * float((off <= WITHIN + LOOSE * away).mean()),
            'median_m': float(np.median(off)), 'p95_m': float(np.percentile(off, 95))}


def seen_surface(truth: Sequence[TruthFrame]) -> Floats:
    """Points (N, 3), one a patch, of the surfaces within NEAR that the cameras saw."""
    height, width = truth[0].range.shape
    bearings = Equirectangular(height, width).bearings()
    found = []
    for frame in [truth[k] for k in range(0, len(truth), _EVERY)]:
        near = frame.range < NEAR
        xyz = (bearings[near] * frame.range[near][:, None]) @ frame.rotation.T + frame.position
        found.append(_one_a_patch(xyz))
    return _one_a_patch(np.concatenate(found))


def _one_a_patch(xyz: Floats) -> Floats:
    cells = np.floor(xyz / PATCH).astype(np.int64)
    key = (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]
    return np.asarray(xyz[np.unique(key, return_index=True)[1]])


def coverage(surface: Floats, xyz: Floats) -> Figures:
    """Share of the surface that has a point near."""
    away, _ = KDTree(xyz).query(surface, distance_upper_bound=COVERED)
    return {'covered_percent': 100 * float(np.isfinite(away).mean())}


def errors(track: Sequence[TrackedFrame], points: VoxelPoints, truth: Sequence[TruthFrame],
           scene: Scene, surface: Floats) -> Figures:
    """All figures of one map; frames without a place are left out, and counted."""
    rotations, positions, xyz = in_world(track, points.xyz.astype(np.float64), truth)
    placed = {f.key.stamp for f in track}
    there = [f for f in truth if f.stamp in placed]
    return {'frames': len(truth), 'placed': len(track), 'points': len(points),
            **track_errors(rotations, positions, there),
            **point_errors(xyz, positions, scene), **coverage(surface, xyz)}
