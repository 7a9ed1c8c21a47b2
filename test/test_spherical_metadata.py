from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from making_bags import write_video

from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.spherical_metadata import SphericalLayout, read_layout
from sphstereo_ros.replay.videos import Video

UUID = bytes.fromhex('ffcc8263f8554a938814587a02521fdd')
PATH = [b'moov', b'trak', b'mdia', b'minf', b'stbl', b'stsd', b'mp4v']
SKIPPED = {b'stsd': 8, b'mp4v': 78}  # bytes before the first box inside


def box(kind: bytes, *content: bytes, full: bool = False) -> bytes:
    data = bytes(4 * full) + b''.join(content)
    return struct.pack('>I4s', 8 + len(data), kind) + data


def xml(**told: object) -> bytes:
    inner = ''.join(f'<GSpherical:{name}>{value}</GSpherical:{name}>'
                    for name, value in told.items())
    return box(b'uuid', UUID, f'<rdf:SphericalVideo>{inner}</rdf:SphericalVideo>'.encode())


def stereo(mode: int) -> bytes:
    return box(b'st3d', bytes([mode]), full=True)


def projection(kind: bytes, *content: bytes) -> bytes:
    return box(b'sv3d', box(b'svhd', b'maker\0', full=True), box(b'proj', box(
        b'prhd', bytes(12), full=True), box(kind, *content, full=True)))


def equirectangular(*bounds: int) -> bytes:
    return projection(b'equi', struct.pack('>4I', *(bounds or (0, 0, 0, 0))))


def with_box(data: bytes, path: list[bytes], more: bytes) -> bytes:
    """The file with `more` at the end of the box at `path`; `moov` comes after the pictures."""
    at, sizes = 0, []
    for kind in path:
        while data[at + 4:at + 8] != kind:
            at += struct.unpack('>I', data[at:at + 4])[0]
        sizes.append(at)
        end = at + struct.unpack('>I', data[at:at + 4])[0]
        at += 8 + SKIPPED.get(kind, 0)
    out = bytearray(data[:end] + more + data[end:])
    for begin in sizes:
        out[begin:begin + 4] = struct.pack(
            '>I', struct.unpack('>I', out[begin:begin + 4])[0] + len(more))
    return bytes(out)


@pytest.fixture
def video(tmp_path):
    """A video file with the given size and boxes in its track or its sample entry."""
    def made(sizes=(128, 64), entry: bytes = b'', track: bytes = b''):
        path = write_video(tmp_path / 'ride.mp4', sizes)
        data = path.read_bytes()
        if entry:
            data = with_box(data, PATH, entry)
        path.write_bytes(with_box(data, PATH[:2], track) if track else data)
        return path
    return made


@pytest.mark.parametrize(('boxes', 'layout'), [
    ({}, SphericalLayout()),
    ({'entry': equirectangular()}, SphericalLayout('equirectangular')),
    ({'entry': stereo(1) + equirectangular()}, SphericalLayout('equirectangular', 'top-bottom')),
    ({'entry': stereo(2)}, SphericalLayout('', 'left-right')),
    ({'entry': stereo(3)}, SphericalLayout('', 'mode 3')),
    ({'entry': equirectangular(0, 0, 2**30, 2**30)},
     SphericalLayout('equirectangular', is_whole=False)),
    ({'entry': projection(b'cbmp', bytes(8))}, SphericalLayout('cubemap')),
    ({'entry': projection(b'mshp', bytes(8))}, SphericalLayout('mesh')),
    ({'track': xml(Spherical='true', ProjectionType='equirectangular', StereoMode='left-right')},
     SphericalLayout('equirectangular', 'left-right')),
    ({'track': xml(ProjectionType='equirectangular', CroppedAreaImageWidthPixels=1000,
                   FullPanoWidthPixels=2000)}, SphericalLayout('equirectangular', is_whole=False)),
    ({'track': xml(StereoMode='left-right'), 'entry': stereo(0)}, SphericalLayout()),
    ({'track': box(b'uuid', bytes(16), b'<GSpherical:ProjectionType>cube</')}, SphericalLayout()),
])
def test_metadata_of_both_versions_is_read(video, boxes, layout):
    path = video(**boxes)
    assert read_layout(path) == layout
    capture = cv2.VideoCapture(str(path))  # what was made is still a video
    assert capture.read()[0]


@pytest.mark.parametrize(('boxes', 'told'), [
    ({'entry': projection(b'cbmp', bytes(8))}, 'projection is cubemap'),
    ({'entry': equirectangular(0, 0, 2**30, 2**30)}, 'a part of the sphere'),
    ({'entry': stereo(3)}, 'stereo layout is mode 3'),
])
def test_what_is_no_full_sphere_by_its_metadata_is_refused(video, boxes, told):
    with pytest.raises(BadInput, match=told):
        Video(video(**boxes))


@pytest.mark.parametrize(('mode', 'sizes'), [(1, (128, 128)), (2, (256, 64)), (4, (256, 64))])
def test_one_eye_of_two_is_taken(video, monkeypatch, mode, sizes):
    path = video(sizes, stereo(mode))
    picture = np.random.default_rng(1).integers(0, 256, (sizes[1], sizes[0], 3), np.uint8)
    monkeypatch.setattr(cv2, 'VideoCapture', lambda _: Pictures(picture))
    found = Video(path)
    assert (found.height, found.width) == (64, 128)
    np.testing.assert_array_equal(next(found.frames()).image, picture[:64, :128])


class Pictures:
    """A video of one picture."""

    def __init__(self, picture):
        self.picture = picture

    def isOpened(self):
        return True

    def get(self, _):
        return 1.0

    def grab(self):
        return True

    def retrieve(self):
        return True, self.picture

    read = retrieve

    def release(self):
        pass


def test_without_metadata_the_whole_picture_is_one_sphere(video):
    found = Video(video((128, 128)))
    assert (found.height, found.width) == (128, 128)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_broken_metadata_tells_nothing_and_breaks_nothing(tmp_path_factory, data):
    path = tmp_path_factory.mktemp('video') / 'ride.mp4'
    whole = box(b'moov', box(b'trak', xml(StereoMode='mono'), box(b'mdia', box(b'minf', box(
        b'stbl', box(b'stsd', bytes(8), box(b'mp4v', bytes(78), stereo(1),
                                            equirectangular())))))))
    path.write_bytes(whole)
    assert read_layout(path) == SphericalLayout('equirectangular', 'top-bottom')
    broken = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(broken)[:data.draw(st.integers(0, len(broken)))])
    assert isinstance(read_layout(path), SphericalLayout)
