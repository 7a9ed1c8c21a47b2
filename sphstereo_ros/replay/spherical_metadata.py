"""What MP4 and MOV files tell of the sphere in their pictures.

Google's Spherical Video metadata, version 2 (boxes `st3d` and `sv3d`) before version 1 (XML in a
`uuid` box): github.com/google/spatial-media, docs/. Boxes as in ISO/IEC 14496-12.
"""
from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from sphstereo_ros.core.frames import Image8

_XML = bytes.fromhex('ffcc8263f8554a938814587a02521fdd')
_TRACK = (b'mdia', b'minf', b'stbl', b'stsd')
_ENTRY = 78  # bytes of a visual sample entry before its boxes
_LONGEST = 1 << 20
_STEREO = {0: 'mono', 1: 'top-bottom', 2: 'left-right', 4: 'right-left'}
_PROJECTIONS = {b'equi': 'equirectangular', b'cbmp': 'cubemap', b'mshp': 'mesh'}
_BOUND = 1e-3  # of the picture: less is no crop


@dataclass(frozen=True)
class SphericalLayout:
    """projection : 'equirectangular', 'cubemap', 'mesh' or another name; '' where nothing tells
    stereo : 'mono', 'top-bottom', 'left-right', 'right-left', or another name
    is_whole : whether the pictures show the full sphere
    """

    projection: str = ''
    stereo: str = 'mono'
    is_whole: bool = True

    @property
    def problem(self) -> str:
        """Why the pictures cannot be used; empty where they can."""
        if self.projection not in ('', 'equirectangular'):
            return f'its projection is {self.projection}, not equirectangular'
        if not self.is_whole:
            return 'it shows a part of the sphere only'
        if self.stereo not in _STEREO.values():
            return f'its stereo layout is {self.stereo}'
        return ''

    def one_eye(self, image: Image8) -> Image8:
        """The upper or left half of two eyes' pictures; the picture itself of one."""
        height, width = image.shape[:2]
        if self.stereo == 'top-bottom':
            return image[:height // 2]
        return image if self.stereo == 'mono' else image[:, :width // 2].copy()


def read_layout(path: Path) -> SphericalLayout:
    """What the file's first video track with such metadata tells; a file without, or one that is
    broken, tells nothing.
    """
    try:
        with path.open('rb') as file:
            return _layout(file, path.stat().st_size)
    except (OSError, struct.error, ValueError, IndexError):
        return SphericalLayout()


def _layout(file: BinaryIO, size: int) -> SphericalLayout:
    for _, start, end in _boxes(file, 0, size, b'moov'):
        for _, first, last in _boxes(file, start, end, b'trak'):
            found = _by_boxes(file, first, last) or _by_xml(file, first, last)
            if found is not None:
                return found
    return SphericalLayout()


def _boxes(file: BinaryIO, at: int, end: int, wanted: bytes = b'') -> Iterator[
        tuple[bytes, int, int]]:
    """Kind, and where the content begins and ends, of the boxes that lie between."""
    while at + 8 <= end:
        file.seek(at)
        length, kind = struct.unpack('>I4s', file.read(8))
        begin = at + 8
        if length == 1:
            length, begin = struct.unpack('>Q', file.read(8))[0], at + 16
        after = at + length if length else end
        if not begin <= after <= end:
            return
        if wanted in (b'', kind):
            yield kind, begin, after
        at = after


def _by_boxes(file: BinaryIO, at: int, end: int) -> SphericalLayout | None:
    for level in _TRACK:
        inner = next(_boxes(file, at, end, level), None)
        if inner is None:
            return None
        _, at, end = inner
    found, is_told = SphericalLayout(), False
    for _, start, last in _boxes(file, at + 8, end):  # after version, flags and count
        for kind, first, after in _boxes(file, start + _ENTRY, last):
            if kind == b'st3d':
                file.seek(first + 4)
                mode = file.read(1)[0]
                found, is_told = replace(found, stereo=_STEREO.get(mode, f'mode {mode}')), True
            elif kind == b'sv3d':
                found, is_told = _projection(file, first, after, found), True
    return found if is_told else None


def _projection(file: BinaryIO, at: int, end: int, found: SphericalLayout) -> SphericalLayout:
    for _, start, last in _boxes(file, at, end, b'proj'):
        for kind, first, _ in _boxes(file, start, last):
            if kind in _PROJECTIONS:
                found = replace(found, projection=_PROJECTIONS[kind])
            if kind == b'equi':
                file.seek(first + 4)
                bounds = struct.unpack('>4I', file.read(16))
                found = replace(found, is_whole=max(bounds) < _BOUND * 2**32)
    return found


def _by_xml(file: BinaryIO, at: int, end: int) -> SphericalLayout | None:
    for _, start, last in _boxes(file, at, end, b'uuid'):
        file.seek(start)
        if file.read(16) != _XML:
            continue
        text = file.read(min(last - start - 16, _LONGEST)).decode('utf-8', 'replace')
        told = dict(re.findall(r'<GSpherical:(\w+)>\s*([^<]*?)\s*</', text))
        sizes = [(int(told[f'CroppedAreaImage{side}Pixels']), int(told[f'FullPano{side}Pixels']))
                 for side in ('Width', 'Height') if f'FullPano{side}Pixels' in told
                 and f'CroppedAreaImage{side}Pixels' in told]
        return SphericalLayout(told.get('ProjectionType', ''), told.get('StereoMode', 'mono'),
                               all(part >= (1 - _BOUND) * full for part, full in sizes))
    return None
