"""Point clouds as anybody writes them, and many of them as one."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import Drop, PointCloud
from sphstereo_ros.report.tracks import Track
from sphstereo_ros.ros.messages import bad_stamp, frame_key

# sensor_msgs/PointField
_TYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
# What is shown of accumulated clouds: as certain, and as near (m), as this.
GREATEST_SIGMA, GREATEST_RANGE = 0.05, 60.0
_LEAST_VOXEL = 0.02


def read_points(message: Any) -> PointCloud | Drop:
    """Read any sensor_msgs/PointCloud2 with x, y, z; and rgb, intensity, sigma where they are.

    Points that are not finite are left out; a sigma that is not told is NaN. Causes:
    invalid_stamp, unknown_fields, wrong_data_length.
    """
    drop = bad_stamp(message.header)
    if drop is not None:
        return drop
    order = '>' if message.is_bigendian else '<'
    fields = {f.name: (order + _TYPES[f.datatype], f.offset) for f in message.fields
              if f.datatype in _TYPES and f.count == 1}
    size, count = int(message.point_step), int(message.width) * int(message.height)
    ends = [offset + np.dtype(kind).itemsize for kind, offset in fields.values()]
    if not {'x', 'y', 'z'} <= fields.keys() or max(ends) > size:
        return Drop('unknown_fields', ' '.join(f.name for f in message.fields)[:80])
    data = np.frombuffer(message.data, np.uint8)
    if data.size != size * count or int(message.row_step) != size * int(message.width):
        return Drop('wrong_data_length', f'{data.size} bytes for {count} points')
    points = data.view(np.dtype({'names': list(fields), 'itemsize': size,
                                 'formats': [kind for kind, _ in fields.values()],
                                 'offsets': [offset for _, offset in fields.values()]}))
    xyz = np.stack([points[axis] for axis in 'xyz'], axis=1).astype(np.float32)
    points, xyz = points[(finite := np.isfinite(xyz).all(axis=1))], xyz[finite]
    sigma = points['sigma'].astype(np.float32) if 'sigma' in fields else np.full(
        len(xyz), np.nan, np.float32)
    return PointCloud(frame_key(message.header), xyz, sigma, **_colours(points))


def _colours(points: NDArray[Any]) -> dict[str, NDArray[np.uint8]]:
    names = points.dtype.names or ()
    if 'rgb' in names and points.dtype['rgb'].itemsize == 4:
        packed = np.ascontiguousarray(points['rgb']).view(
            points.dtype['rgb'].str[0] + 'u4').astype(np.uint32)
        return {'bgr': np.stack([packed, packed >> 8, packed >> 16], axis=1).astype(np.uint8)}
    if 'intensity' in names:
        with np.errstate(invalid='ignore'):
            grey = np.nan_to_num(points['intensity'].astype(np.float64))
        return {'intensity': np.clip(grey, 0, 255).astype(np.uint8)}
    return {}


def chosen(cloud: PointCloud, keep: NDArray[Any]) -> PointCloud:
    """The points of these indices (or this mask)."""
    return PointCloud(cloud.key, cloud.xyz[keep], cloud.sigma[keep],
                      None if cloud.intensity is None else cloud.intensity[keep],
                      None if cloud.bgr is None else cloud.bgr[keep])


def certain(cloud: PointCloud) -> PointCloud:
    """What is near, and certain to a twentieth of its range; all that is near, if none tells."""
    distance = np.linalg.norm(cloud.xyz, axis=1)
    near = distance < GREATEST_RANGE
    if np.isnan(cloud.sigma).all():
        return chosen(cloud, near)
    with np.errstate(invalid='ignore'):
        return chosen(cloud, near & (cloud.sigma < GREATEST_SIGMA * distance))


def thinned(cloud: PointCloud, most: int) -> PointCloud:
    """At most `most` points: the most certain one of each voxel, as small as that allows."""
    if len(cloud.xyz) <= most:
        return cloud
    order = np.argsort(cloud.sigma, kind='stable')  # NaN last
    points = cloud.xyz[order].astype(np.float64)
    points -= points.min(axis=0)
    voxel = _LEAST_VOXEL
    while True:
        cells = np.floor(points / voxel).astype(np.int64)
        sizes = cells.max(axis=0) + 1
        _, first = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(sizes)),
                             return_index=True)
        if len(first) <= most:
            return chosen(cloud, np.sort(order[first]))
        voxel *= 1.25


def moved(cloud: PointCloud, track: Track) -> PointCloud | None:
    """A cloud in `base_link` in the frame of the track; None outside of its times."""
    pose = track.at(cloud.key.stamp)
    if pose is None:
        return None
    position, rotation = pose
    xyz = cloud.xyz.astype(np.float64) @ rotation.T + position
    return PointCloud(cloud.key, xyz.astype(np.float32), cloud.sigma, cloud.intensity, cloud.bgr)


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """All points as one cloud; with colour or intensity where all have it."""
    def together(name: str) -> Any:
        parts = [getattr(cloud, name) for cloud in clouds]
        return None if any(part is None for part in parts) else np.concatenate(parts)
    return PointCloud(clouds[-1].key, together('xyz'), together('sigma'), together('intensity'),
                      together('bgr'))
