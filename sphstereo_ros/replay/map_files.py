"""Maps and tracks as files: clouds as PLY, PCD or LAS, tracks in TUM's format."""
from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import FrameKey, PointCloud
from sphstereo_ros.core.rotations import quaternion_from_matrix
from sphstereo_ros.replay.ply import write_ply
from sphstereo_ros.replay.records import BadInput

Floats = NDArray[np.float64]

SUFFIXES = ('.ply', '.pcd', '.las')
_LAS_STEP = 1e-4  # m
_LIBRARIES = {'.ply': 'trimesh', '.pcd': 'pypcd4', '.las': 'laspy'}


def written_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside `path` by `write`, then give it that name: it is there whole or not.

    Raises
    ------
    BadInput
        where it cannot be written: no room, no permission

    """
    beside = path.with_name(f'.{path.stem}.{os.getpid()}{path.suffix}')
    try:
        write(beside)
        with beside.open('rb+') as file:
            os.fsync(file.fileno())
        beside.replace(path)
    except OSError as error:
        raise BadInput(f'cannot write {path}: {error.strerror or error}') from error
    finally:
        beside.unlink(missing_ok=True)


def known_suffix(path: Path) -> str:
    """The suffix of a cloud's file, if there is a library for it.

    Raises
    ------
    BadInput
        for another suffix, or where the library is missing

    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise BadInput(f'{path}: clouds are {", ".join(SUFFIXES)} files')
    if suffix != '.ply':
        _library(suffix)
    return suffix


def _library(suffix: str) -> Any:
    import importlib
    try:
        return importlib.import_module(_LIBRARIES[suffix])
    except ImportError as error:
        raise BadInput(f"{suffix} files need {error.name}: the extra 'map' brings it") from error


def save_cloud(path: Path, cloud: PointCloud) -> None:
    """Write a cloud with its colour (bgr) and sigma; the suffix tells the format.

    Raises
    ------
    BadInput
        as `known_suffix` and `written_whole`

    """
    writers = {'.ply': write_ply, '.pcd': _write_pcd, '.las': _write_las}
    writer = writers[known_suffix(path)]
    written_whole(path, lambda beside: writer(beside, cloud))


def load_cloud(path: Path) -> PointCloud:
    """Read what `save_cloud` writes.

    Raises
    ------
    BadInput
        where it cannot be read, or has no x, y, z

    """
    readers = {'.ply': _read_ply, '.pcd': _read_pcd, '.las': _read_las}
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise BadInput(f'{path}: clouds are {", ".join(SUFFIXES)} files')
    library = _library(suffix)
    try:
        return readers[suffix](library, path)
    except Exception as error:  # damaged files fail in many ways
        raise BadInput(f'{path} is no cloud that can be read: {error}') from error


def _bgr(cloud: PointCloud) -> NDArray[np.uint8]:
    if cloud.bgr is not None:
        return cloud.bgr
    grey = np.zeros(len(cloud.xyz), np.uint8) if cloud.intensity is None else cloud.intensity
    return np.repeat(grey[:, None], 3, axis=1)


def _write_pcd(path: Path, cloud: PointCloud) -> None:
    library = _library('.pcd')
    bgr = _bgr(cloud).astype(np.uint32)
    packed = (bgr[:, 2] << 16 | bgr[:, 1] << 8 | bgr[:, 0]).view(np.float32)
    library.PointCloud.from_points(
        [*np.ascontiguousarray(cloud.xyz.T), packed, cloud.sigma], ('x', 'y', 'z', 'rgb', 'sigma'),
        (np.float32,) * 5).save(path)


def _write_las(path: Path, cloud: PointCloud) -> None:
    library = _library('.las')
    header = library.LasHeader(point_format=2, version='1.2')
    header.scales = np.full(3, _LAS_STEP)
    header.offsets = np.floor(cloud.xyz.min(axis=0)) if len(cloud.xyz) else np.zeros(3)
    header.add_extra_dim(library.ExtraBytesParams(name='sigma', type=np.float32))
    las = library.LasData(header)
    las.x, las.y, las.z = cloud.xyz.astype(np.float64).T
    for channel, name in enumerate(('blue', 'green', 'red')):
        setattr(las, name, _bgr(cloud)[:, channel].astype(np.uint16) * 257)
    las.sigma = cloud.sigma
    las.write(str(path))


def _read_ply(library: Any, path: Path) -> PointCloud:
    raw = library.load(path, file_type='ply').metadata['_ply_raw']
    vertex = raw['vertex']['data']
    names = vertex.dtype.names
    colours = [vertex[c] for c in ('blue', 'green', 'red')] if 'red' in names else None
    return _cloud([vertex[a] for a in 'xyz'], vertex['sigma'] if 'sigma' in names else None,
                  colours)


def _read_pcd(library: Any, path: Path) -> PointCloud:
    pcd = library.PointCloud.from_path(path)
    data = pcd.pc_data
    colours = None
    if 'rgb' in data.dtype.names:
        packed = np.ascontiguousarray(data['rgb']).view(np.uint32)
        colours = [packed & 255, packed >> 8 & 255, packed >> 16 & 255]
    return _cloud([data[a] for a in 'xyz'],
                  data['sigma'] if 'sigma' in data.dtype.names else None, colours)


def _read_las(library: Any, path: Path) -> PointCloud:
    las = library.read(str(path))
    names = set(las.point_format.dimension_names)
    colours = [np.asarray(las[c]) // 257 for c in ('blue', 'green', 'red')] \
        if 'red' in names else None
    return _cloud([las.x, las.y, las.z], las['sigma'] if 'sigma' in names else None, colours)


def _cloud(xyz: Sequence[Any], sigma: Any, colours: Sequence[Any] | None) -> PointCloud:
    places = np.stack([np.asarray(a, np.float32) for a in xyz], axis=1)
    spread = np.full(len(places), np.nan, np.float32) if sigma is None \
        else np.array(sigma, np.float32)
    bgr = None if colours is None else np.stack([np.asarray(c, np.uint8) for c in colours], axis=1)
    return PointCloud(FrameKey(0, ''), places, spread, bgr=bgr)


def track_lines(stamps: Sequence[int], rotations: Sequence[Floats],
                positions: Sequence[Floats]) -> str:
    """Poses in TUM's format: seconds, x y z, quaternion x y z w; one line each."""
    lines = ['# stamp(s) x y z qx qy qz qw: base_link in odom, metres']
    for stamp, rotation, position in zip(stamps, rotations, positions, strict=True):
        numbers = ' '.join(f'{value:.9g}' for value in (
            *position, *quaternion_from_matrix(rotation)))
        lines.append(f'{stamp // 10**9}.{stamp % 10**9:09d} {numbers}')
    return '\n'.join(lines) + '\n'
