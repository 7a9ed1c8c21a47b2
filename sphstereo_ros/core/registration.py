"""Registration of clouds by small_gicp (extra `map`).

Against rendered streets, planes fitted to the target (point-to-plane) came nearer to the truth
than generalised ICP, small_gicp's and Open3D's alike, and took half of Open3D's time. None comes
near to visual odometry between frames that share references: registration is for gaps.
"""
from __future__ import annotations

import numpy as np

from .frames import Drop, RelativePose
from .pose_graph import Floats
from .voxels import Map32

_CELL = 0.2  # m: both clouds are thinned to that
_REACH = 0.5  # m, of correspondences
_LEAST_POINTS = 500
_LEAST_SHARE = 0.5  # of the source's points that must find a partner
_MOST_ERROR = 0.15  # m, of points that have a partner: root mean square
# Share of the surfaces that must face each way (a third if all ways are alike): between two walls
# clouds slide along.
_LEAST_FACING = 0.08


def registered(target: Map32, source: Map32, start: RelativePose,
               measured: bool = False) -> RelativePose | Drop:
    """Pose of the source cloud in the target's frame.

    target, source : (N, 3) metres; start : about where the source is
    measured : whether `start` comes from a sensor: then the clouds do not move the way that they
        can slide

    Drops: `no_registration` without the library; `not_registered`, where the clouds do not fit,
    or can slide.
    """
    try:
        import small_gicp
    except ImportError:
        return Drop('no_registration', "there is no small_gicp: the extra 'map' brings it")
    if min(len(target), len(source)) < _LEAST_POINTS:
        return Drop('not_registered', f'{min(len(target), len(source))} points')
    centre = source.mean(axis=0).astype(np.float64)  # numbers stay small
    begin = np.eye(4)
    begin[:3, :3] = start.rotation
    moved = start.rotation @ centre + start.position
    result = small_gicp.align(target - moved, source - centre, begin,
                              registration_type='PLANE_ICP', downsampling_resolution=_CELL,
                              max_correspondence_distance=_REACH, num_threads=1)
    pose = np.asarray(result.T_target_source, np.float64)
    there, _ = small_gicp.preprocess_points(source - centre, downsampling_resolution=_CELL,
                                            num_threads=1)
    count = there.size()
    share = result.num_inliers / max(count, 1)
    error = (2 * result.error / max(result.num_inliers, 1))**0.5
    if not np.isfinite(pose).all() or share < _LEAST_SHARE or error > _MOST_ERROR:
        return Drop('not_registered', f'{100 * share:.0f} % of the points fit, to {error:.2f} m')
    facing, ways = np.linalg.eigh(np.asarray(result.H)[3:, 3:] / result.num_inliers)
    firm = ways[:, facing > _LEAST_FACING]
    if firm.shape[1] < 3 and not measured:
        return Drop('not_registered', 'the clouds can slide')
    rotation: Floats = pose[:3, :3]
    return RelativePose(rotation, firm @ firm.T @ pose[:3, 3] + moved - rotation @ centre)
