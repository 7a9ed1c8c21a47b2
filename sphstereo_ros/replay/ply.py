"""Point clouds as PLY files."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from sphstereo_ros.core.frames import PointCloud

_COLOURS = ('red', 'green', 'blue')


def write_ply(path: Path, cloud: PointCloud) -> None:
    """Write a binary PLY: x y z (m), red green blue (grey for intensity), sigma (m)."""
    kind = np.dtype([*((name, '<f4') for name in 'xyz'), *((name, 'u1') for name in _COLOURS),
                     ('sigma', '<f4')])
    points = np.zeros(len(cloud.xyz), kind)
    for axis, name in enumerate('xyz'):
        points[name] = cloud.xyz[:, axis]
    for channel, name in enumerate(_COLOURS):
        if cloud.bgr is not None:
            points[name] = cloud.bgr[:, 2 - channel]
        elif cloud.intensity is not None:
            points[name] = cloud.intensity
    points['sigma'] = cloud.sigma
    properties = [f'property {"uchar" if name in _COLOURS else "float"} {name}'
                  for name in kind.names or ()]
    header = ['ply', 'format binary_little_endian 1.0', f'element vertex {len(points)}',
              *properties, 'end_header', '']
    path.write_bytes('\n'.join(header).encode('ascii') + points.tobytes())
