from __future__ import annotations

import importlib.util
import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import (
    UNSCALED,
    Drop,
    Frame,
    FrameKey,
    PairedWindow,
    PointCloud,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from sphstereo_ros.replay import bag_messages
from sphstereo_ros.ros import conversions as convert
from sphstereo_ros.ros.images import ENCODINGS, resize_sphere

KEY = FrameKey(1_700_000_000_123_456_789, 'camera_optical')


def factories():
    if importlib.util.find_spec('sensor_msgs') is None:
        return [bag_messages.make]
    from sphstereo_ros.ros import live_messages
    return [bag_messages.make, live_messages.make]


@pytest.fixture(params=factories(), ids=lambda make: make.__module__.rsplit('.', 1)[1])
def make(request):
    return request.param


def raw(data, encoding, height, width, /, **other):
    fields = {'header': convert.header(bag_messages.make, KEY), 'height': height, 'width': width,
              'encoding': encoding, 'is_bigendian': 0, 'step': data.size // height,
              'data': data.reshape(-1)}
    return bag_messages.make('sensor_msgs/msg/Image', **{**fields, **other})


def grey_ramp(height=16, width=32):
    return (np.arange(height * width, dtype=np.uint32).reshape(height, width) * 7 % 251
            ).astype(np.uint8)


def smooth(height, width):
    v, u = np.mgrid[0:height, 0:width]
    lon, lat = 2 * np.pi * (u + 0.5) / width, np.pi * (v + 0.5) / height
    return np.rint(120 + 60 * np.cos(3 * lon) * np.sin(lat) + 40 * np.cos(2 * lat)
                   ).astype(np.uint8)


def cause(result):
    assert isinstance(result, Drop), result
    return result.cause


# Headers

@given(st.integers(-2**31 * 10**9, (2**31 - 1) * 10**9 + 999_999_999), st.text(max_size=20))
def test_keys_round_trip(stamp, frame_id):
    key = FrameKey(stamp, frame_id)
    message = convert.header(bag_messages.make, key)
    assert 0 <= message.stamp.nanosec < 10**9
    assert convert.frame_key(message) == key


# Images

@given(st.integers(8, 24), st.integers(0, 2**32 - 1), st.booleans())
def test_frames_round_trip(height, seed, colour):
    image = np.random.default_rng(seed).integers(0, 256, (height, 2 * height, 3), np.uint8)
    frame = Frame(KEY, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), image if colour else None)
    decoded = convert.decode_frame(convert.frame_message(bag_messages.make, frame), 0, colour)
    assert decoded.key == KEY
    np.testing.assert_array_equal(decoded.image, frame.image)
    if colour:
        np.testing.assert_array_equal(decoded.colour, image)
    else:
        assert decoded.colour is None


def test_messages_of_both_worlds_carry_the_same(make):
    image = grey_ramp()
    message = convert.image_message(make, KEY, image)
    assert (message.height, message.width, message.step, message.encoding) == (16, 32, 32, 'mono8')
    assert bytes(message.data) == image.tobytes()
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
    assert message.header.frame_id == 'camera_optical'
    np.testing.assert_array_equal(convert.decode_frame(message).image, image)


def test_mono8_of_working_size_is_a_read_only_view(make):
    message = convert.image_message(make, KEY, grey_ramp())
    image = convert.decode_frame(message, 16).image
    assert np.shares_memory(image, np.frombuffer(message.data, np.uint8))
    assert not image.flags.writeable
    assert image.flags.c_contiguous


def test_row_padding_is_cut_off():
    image = grey_ramp()
    padded = np.full((16, 40), 255, np.uint8)
    padded[:, :32] = image
    frame = convert.decode_frame(raw(padded, 'mono8', 16, 32))
    np.testing.assert_array_equal(frame.image, image)
    assert frame.image.flags.c_contiguous


def colours():
    bgr = np.empty((16, 32, 3), np.uint8)
    bgr[...] = 20, 100, 220
    bgr[8:] = 200, 60, 10
    return bgr


def encoded(encoding):
    """Two fields of colour in `encoding`."""
    bgr = colours()
    if encoding in ('uyvy', 'yuv422', 'yuyv', 'yuv422_yuy2'):
        full, red, blue = np.moveaxis(cv2.cvtColor(bgr, cv2.COLOR_BGR2YCrCb).astype(float), 2, 0)
        y = (16 + full * (219 / 255)).astype(np.uint8)  # BT.601, studio range
        chroma = np.where(np.arange(32) % 2 == 0, blue, red)
        chroma = (128 + (chroma - 128) * (224 / 255)).astype(np.uint8)
        order = (chroma, y) if encoding in ('uyvy', 'yuv422') else (y, chroma)
        return np.stack(order, axis=2)
    if encoding.startswith('bayer'):
        pattern = encoding.split('_')[1][:4]
        mosaic = np.empty((16, 32), np.uint8)
        for i, letter in enumerate(pattern):
            mosaic[i // 2::2, i % 2::2] = bgr[i // 2::2, i % 2::2, 'bgr'.index(letter)]
        return mosaic
    if encoding in ('rgb8', 'rgba8'):
        bgr = bgr[..., ::-1]
    if encoding in ('bgra8', 'rgba8', '8UC4'):
        bgr = np.concatenate([bgr, np.full((16, 32, 1), 7, np.uint8)], axis=2)
    return np.ascontiguousarray(bgr)


@pytest.mark.parametrize('encoding', sorted(
    e for e in ENCODINGS if 'mono' not in e and 'UC1' not in e))
def test_colour_encodings_tell_red_from_blue(encoding):
    frame = convert.decode_frame(raw(encoded(encoding), encoding, 16, 32), 0, colour=True)
    for row in (4, 12):
        np.testing.assert_allclose(frame.colour[row, 10].astype(int), colours()[row, 10], atol=16)
    grey = convert.decode_frame(raw(encoded(encoding), encoding, 16, 32)).image
    luma = cv2.cvtColor(colours(), cv2.COLOR_BGR2GRAY)
    np.testing.assert_allclose(grey[[4, 12], 10].astype(int), luma[[4, 12], 10], atol=16)


@pytest.mark.parametrize('encoding', ['mono16', '16UC1'])
@pytest.mark.parametrize('big', [0, 1])
def test_mono16_in_either_byte_order(encoding, big):
    wide = (grey_ramp().astype(np.uint16) << 8) + 99
    data = wide.astype('>u2' if big else '<u2').view(np.uint8)
    frame = convert.decode_frame(raw(data, encoding, 16, 32, is_bigendian=big))
    np.testing.assert_array_equal(frame.image, grey_ramp())


@pytest.mark.parametrize(('change', 'expected'), [
    ({'encoding': 'mono9'}, 'unknown_encoding'),
    ({'encoding': '32FC1'}, 'unknown_encoding'),
    ({'height': 0}, 'empty_image'),
    ({'width': 0}, 'empty_image'),
    ({'step': 0}, 'wrong_step'),
    ({'step': 31}, 'wrong_step'),
    ({'encoding': 'bgr8'}, 'wrong_step'),
    ({'step': 33}, 'wrong_data_length'),
    ({'data': np.zeros(16 * 32 - 1, np.uint8)}, 'wrong_data_length'),
    ({'data': np.zeros(0, np.uint8)}, 'wrong_data_length'),
    ({'height': 4}, 'wrong_size'),
    ({'height': 2**32 - 1}, 'wrong_size'),
    ({'width': 15}, 'wrong_aspect'),
    ({'width': 65}, 'wrong_aspect'),
    ({'encoding': 'uyvy', 'width': 17}, 'wrong_size'),
])
def test_what_is_wrong_with_an_image_has_a_name(change, expected):
    assert cause(convert.decode_frame(raw(grey_ramp(), 'mono8', 16, 32, **change))) == expected


def test_impossible_nanoseconds_are_refused():
    message = raw(grey_ramp(), 'mono8', 16, 32)
    message.header.stamp.nanosec = 10**9
    assert cause(convert.decode_frame(message)) == 'invalid_stamp'


@settings(max_examples=200)
@given(st.integers(0, 70), st.integers(0, 140), st.integers(0, 600), st.integers(0, 1),
       st.sampled_from([*ENCODINGS, '', 'rgb', '32FC1']), st.integers(0, 3000),
       st.sampled_from([0, 16]), st.booleans())
def test_malformed_images_never_raise(height, width, step, big, encoding, length, working, colour):
    message = SimpleNamespace(
        header=convert.header(bag_messages.make, KEY), height=height, width=width, step=step,
        is_bigendian=big, encoding=encoding, data=np.zeros(length, np.uint8))
    result = convert.decode_frame(message, working, colour)
    if isinstance(result, Drop):
        assert result.cause
    else:
        assert length == step * height
        rows = working or height
        assert result.image.shape == (rows, 2 * rows)


# Sizes

@pytest.mark.parametrize('size', [(60, 120), (90, 160), (120, 240), (45, 45), (30, 60), (30, 75)])
def test_any_size_is_brought_to_the_working_size(size):
    frame = convert.decode_frame(convert.image_message(bag_messages.make, KEY, smooth(*size)), 60)
    assert frame.image.shape == (60, 120)
    inner = np.s_[4:-4]  # beside the poles a coarse grid cannot follow
    difference = frame.image[inner].astype(int) - smooth(60, 120)[inner]
    assert np.abs(difference).max() <= 8


def test_height_zero_keeps_the_height_and_squares_the_pixels():
    frame = convert.decode_frame(convert.image_message(bag_messages.make, KEY, smooth(90, 160)))
    assert frame.image.shape == (90, 180)


@given(st.integers(8, 20), st.integers(8, 40), st.integers(21, 40), st.integers(0, 2**32 - 1))
def test_the_seam_is_interpolated_like_any_column(height, width, working, seed):
    width = max(height, min(width, 2 * working - 1))
    image = np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)
    enlarged = resize_sphere(image, working)
    half = resize_sphere(np.roll(image, 1, axis=1), working)
    shift = 2 * working / width
    if shift == int(shift):  # a turned sphere is enlarged to the same sphere, turned
        np.testing.assert_array_equal(half, np.roll(enlarged, int(shift), axis=1))
    assert enlarged.shape == (working, 2 * working)


def test_turned_sphere_enlarges_to_the_turned_sphere():
    image = np.random.default_rng(3).integers(0, 256, (10, 20), np.uint8)
    turned = resize_sphere(np.roll(image, 5, axis=1), 40)
    np.testing.assert_array_equal(turned, np.roll(resize_sphere(image, 40), 20, axis=1))


# Compressed images

def compressed(data, format='jpeg'):
    return convert.compressed_message(bag_messages.make, KEY, format, bytes(data))


def jpeg(image, quality=95, *options):
    return cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality, *options])[1].tobytes()


@pytest.mark.parametrize('working', [0, 240, 120, 60, 30, 100, 500])
def test_jpeg_at_any_scale_is_the_same_sphere(working):
    frame = convert.decode_frame(compressed(jpeg(smooth(240, 480))), working)
    rows = working or 240
    assert frame.image.shape == (rows, 2 * rows)
    assert frame.colour is None
    inner = np.s_[rows // 12:-rows // 12]
    difference = frame.image[inner].astype(int) - smooth(rows, 2 * rows)[inner]
    assert np.abs(difference).max() <= 6
    assert abs(difference.mean()) < 0.5


def test_scale_of_decoding(monkeypatch):
    flags = []
    imdecode = cv2.imdecode
    monkeypatch.setattr(cv2, 'imdecode',
                        lambda data, flag: flags.append(flag) or imdecode(data, flag))
    data = jpeg(smooth(240, 480))
    ignore = cv2.IMREAD_IGNORE_ORIENTATION
    for working, colour, expected in (
            (0, False, cv2.IMREAD_GRAYSCALE), (240, False, cv2.IMREAD_GRAYSCALE),
            (121, False, cv2.IMREAD_GRAYSCALE), (120, False, cv2.IMREAD_REDUCED_GRAYSCALE_2),
            (60, False, cv2.IMREAD_REDUCED_GRAYSCALE_4), (30, True, cv2.IMREAD_REDUCED_COLOR_8)):
        convert.decode_frame(compressed(data), working, colour)
        assert flags.pop() == expected | ignore
    convert.decode_frame(compressed(jpeg(smooth(241, 480))), 60)  # 241 rows do not halve
    assert flags.pop() == cv2.IMREAD_GRAYSCALE | ignore


def test_png_is_exact():
    data = cv2.imencode('.png', grey_ramp())[1].tobytes()
    np.testing.assert_array_equal(convert.decode_frame(compressed(data, 'png')).image, grey_ramp())


def test_colour_of_a_jpeg():
    frame = convert.decode_frame(compressed(jpeg(colours())), 0, colour=True)
    np.testing.assert_allclose(frame.colour[[2, 13], 10].astype(int), colours()[[2, 13], 10],
                               atol=6)
    np.testing.assert_array_equal(frame.image, cv2.cvtColor(frame.colour, cv2.COLOR_BGR2GRAY))


@pytest.mark.parametrize('progressive', [0, 1])
@pytest.mark.parametrize('share', [0.0, 0.01, 0.1, 0.5, 0.9, 0.999])
def test_cut_jpeg_is_no_image(share, progressive):
    data = jpeg(smooth(64, 128), 95, cv2.IMWRITE_JPEG_PROGRESSIVE, progressive)
    whole = convert.decode_frame(compressed(data))
    assert isinstance(whole, Frame)
    expected = 'empty_image' if share == 0 else None
    found = cause(convert.decode_frame(compressed(data[:int(share * len(data))])))
    assert found == (expected or 'undecodable_image')


def test_bytes_after_a_jpeg_do_not_matter():
    frame = convert.decode_frame(compressed(jpeg(smooth(64, 128)) + b'trailer'))
    assert isinstance(frame, Frame)


@pytest.mark.parametrize('share', [0.01, 0.1, 0.5, 0.9, 0.995])
def test_cut_png_is_no_image(share):
    data = cv2.imencode('.png', smooth(64, 128))[1].tobytes()
    result = convert.decode_frame(compressed(data[:int(share * len(data))]))
    assert cause(result) in ('undecodable_image', 'unknown_encoding')


@pytest.mark.parametrize('data', [b'GIF89a' + bytes(100), b'RIFF....WEBP', bytes(1000)])
def test_other_formats_are_named(data):
    assert cause(convert.decode_frame(compressed(data))) == 'unknown_encoding'


def test_a_huge_jpeg_is_refused_before_it_is_decoded(monkeypatch):
    data = bytearray(jpeg(smooth(64, 128)))
    at = data.index(b'\xff\xc0')
    data[at + 5:at + 9] = b'\xff\xff\xff\xff'
    monkeypatch.setattr(cv2, 'imdecode', lambda *_: pytest.fail('decoded'))
    assert cause(convert.decode_frame(compressed(data))) == 'wrong_size'


@given(st.data())
def test_damaged_compressed_images_never_raise(data):
    kind = data.draw(st.sampled_from(['.jpg', '.png']))
    content = bytearray(cv2.imencode(kind, smooth(16, 32))[1].tobytes())
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    result = convert.decode_frame(compressed(content), data.draw(st.sampled_from([0, 8])))
    assert isinstance(result, (Frame, Drop))


@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_no_image(data):
    assert isinstance(convert.decode_frame(compressed(b'\xff\xd8' + data)), Drop)


# Frame windows

finite = st.floats(-100, 100)
triples = st.tuples(finite, finite, finite).map(np.array)
turns = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)


def frame(stamp, frame_id='camera'):
    return Frame(FrameKey(stamp, frame_id), np.zeros((8, 16), np.uint8))


@st.composite
def windows(draw):
    count = draw(st.integers(1, 5))
    references = tuple(
        Reference(frame(10**9 - i), RelativePose(rotations.exp(draw(turns)), draw(triples)))
        for i in range(1, count + 1))
    return StabilisedWindow(frame(10**9), references)


@given(windows())
def test_windows_round_trip(window):
    message = convert.window_message(bag_messages.make, window)
    assert [convert.frame_key(p.header).stamp for p in message.poses] == sorted(
        [r.frame.key.stamp for r in window.references] + [10**9])
    geometry = convert.read_window(message)
    frames = {f.key: f for f in (window.current, *(r.frame for r in window.references))}
    again = geometry.with_frames(StabilisedWindow, frames)
    assert isinstance(again, StabilisedWindow)
    assert again.current is window.current
    for one, other in zip(again.references, window.references, strict=True):
        assert one.frame is other.frame
        np.testing.assert_array_equal(one.pose.position, other.pose.position)
        np.testing.assert_allclose(one.pose.rotation, other.pose.rotation, atol=1e-12)


def pair(length=0.3, **other):
    pose = RelativePose(position=np.array([0.0, 0.0, -length]), **other)
    return StabilisedWindow(frame(2 * 10**8, 'bottom'), (Reference(frame(10**8, 'top'), pose),))


def test_path_names_each_frame_by_its_own_header(make):
    message = convert.window_message(make, pair())
    assert [p.header.frame_id for p in message.poses] == ['top', 'bottom']
    assert [p.header.stamp.nanosec for p in message.poses] == [10**8, 2 * 10**8]
    assert (message.header.frame_id, message.header.stamp.nanosec) == ('bottom', 2 * 10**8)
    assert message.poses[0].pose.position.z == -0.3
    assert message.poses[1].pose.orientation.w == 1.0


def test_unknown_length_survives():
    geometry = convert.read_window(convert.window_message(bag_messages.make, pair(UNSCALED)))
    assert not geometry.references[0][1].is_metric
    np.testing.assert_allclose(geometry.references[0][1].direction, [0, 0, 1])


def test_a_frame_that_is_not_there_is_named():
    window = pair()
    geometry = convert.read_window(convert.window_message(bag_messages.make, window))
    assert geometry.keys == (window.references[0].frame.key, window.current.key)
    missing = geometry.with_frames(PairedWindow, {window.current.key: window.current})
    assert missing == Drop('missing_frame', '1 of 2')


def spoil(path, what):
    first, last = path.poses
    if what == 'nan_position':
        first.pose.position.x = math.nan
    elif what == 'inf_position':
        first.pose.position.y = math.inf
    elif what == 'nan_orientation':
        first.pose.orientation.x = math.nan
    elif what == 'long_quaternion':
        first.pose.orientation.w = 1.01
    elif what == 'zero_quaternion':
        first.pose.orientation.w = 0.0
    elif what == 'one_pose':
        del path.poses[0]
    elif what == 'no_pose':
        del path.poses[:]
    elif what == 'other_frame_last':
        path.poses.reverse()
    elif what == 'other_frame_id':
        path.header.frame_id = 'top'
    elif what == 'moved_current':
        last.pose.position.z = 0.1
    elif what == 'turned_current':
        last.pose.orientation.w, last.pose.orientation.x = math.sqrt(0.5), math.sqrt(0.5)
    elif what == 'twice':
        path.poses.insert(0, first)
    elif what == 'stamp':
        first.header.stamp.nanosec = 2 * 10**9


@pytest.mark.parametrize(('what', 'expected'), [
    ('nan_position', 'not_finite'), ('inf_position', 'not_finite'),
    ('nan_orientation', 'not_finite'), ('long_quaternion', 'invalid_quaternion'),
    ('zero_quaternion', 'invalid_quaternion'), ('one_pose', 'too_few_poses'),
    ('no_pose', 'too_few_poses'), ('other_frame_last', 'wrong_current'),
    ('other_frame_id', 'wrong_current'), ('moved_current', 'wrong_current'),
    ('turned_current', 'wrong_current'), ('twice', 'duplicate_frame'), ('stamp', 'invalid_stamp')])
def test_what_is_wrong_with_a_window_has_a_name(make, what, expected):
    path = convert.window_message(make, pair())
    spoil(path, what)
    assert cause(convert.read_window(path)) == expected


anything = st.floats(allow_nan=True, allow_infinity=True)


@given(st.lists(st.tuples(*[anything] * 7, st.integers(0, 3)), max_size=4), st.integers(0, 3))
def test_malformed_windows_never_raise(poses, stamp):
    make = bag_messages.make
    path = make('nav_msgs/msg/Path', header=convert.header(make, FrameKey(stamp, '')))
    for x, y, z, qx, qy, qz, qw, own in poses:
        path.poses.append(make(
            'geometry_msgs/msg/PoseStamped', header=convert.header(make, FrameKey(own, '')),
            pose=make('geometry_msgs/msg/Pose',
                      position=make('geometry_msgs/msg/Point', x=x, y=y, z=z),
                      orientation=make('geometry_msgs/msg/Quaternion', x=qx, y=qy, z=qz, w=qw))))
    result = convert.read_window(path)
    if not isinstance(result, Drop):
        assert all(np.isfinite(pose.position).all() for _, pose in result.references)


# Depth

@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**32 - 1))
def test_depth_round_trip(height, width, seed):
    depth = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    depth.flat[0] = np.random.default_rng(seed).choice([np.nan, np.inf, -np.inf])
    message = convert.depth_message(bag_messages.make, KEY, depth)
    assert convert.frame_key(message.header) == KEY
    np.testing.assert_array_equal(convert.read_depth(message), depth)


def test_depth_is_little_endian_metres(make):
    message = convert.depth_message(make, KEY, np.array([[1.0, -np.inf]], np.float32))
    assert (message.encoding, message.is_bigendian, message.step) == ('32FC1', 0, 8)
    assert bytes(message.data) == b'\x00\x00\x80\x3f\x00\x00\x80\xff'


def test_depth_of_big_endian_and_padded_rows():
    rows = np.zeros((2, 12), np.uint8)
    rows[:, :8] = np.array([[1, 2], [3, 4]], '>f4').view(np.uint8)
    depth = convert.read_depth(raw(rows, '32FC1', 2, 2, is_bigendian=1))
    np.testing.assert_array_equal(depth, [[1, 2], [3, 4]])
    assert depth.dtype == np.float32


@pytest.mark.parametrize(('change', 'expected'), [
    ({'encoding': '16UC1'}, 'unknown_encoding'), ({'height': 0}, 'empty_image'),
    ({'step': 4}, 'wrong_step'), ({'data': np.zeros(3, np.uint8)}, 'wrong_data_length')])
def test_what_is_wrong_with_depth_has_a_name(change, expected):
    message = raw(np.zeros((2, 8), np.uint8), '32FC1', 2, 2, **change)
    assert cause(convert.read_depth(message)) == expected


# Clouds

@given(st.integers(0, 20), st.integers(0, 2**32 - 1), st.booleans())
def test_clouds_round_trip(count, seed, colour):
    random = np.random.default_rng(seed)
    shades = random.integers(0, 256, (count, 3), np.uint8)
    cloud = PointCloud(KEY, random.normal(size=(count, 3)).astype(np.float32),
                       random.random(count).astype(np.float32),
                       **({'bgr': shades} if colour else {'intensity': shades[:, 0]}))
    again = convert.read_cloud(convert.cloud_message(bag_messages.make, cloud))
    assert again.key == FrameKey(KEY.stamp, 'base_link')
    np.testing.assert_array_equal(again.xyz, cloud.xyz)
    np.testing.assert_array_equal(again.sigma, cloud.sigma)
    if colour:
        np.testing.assert_array_equal(again.bgr, cloud.bgr)
    else:
        np.testing.assert_array_equal(again.intensity, cloud.intensity)


def test_layout_of_a_cloud(make):
    cloud = PointCloud(KEY, np.array([[1, 2, 3]], np.float32), np.array([0.5], np.float32),
                       bgr=np.array([[1, 2, 3]], np.uint8))
    message = convert.cloud_message(make, cloud)
    assert [(f.name, f.offset, f.datatype, f.count) for f in message.fields] == [
        ('x', 0, 7, 1), ('y', 4, 7, 1), ('z', 8, 7, 1), ('rgb', 12, 7, 1), ('sigma', 16, 7, 1)]
    assert (message.point_step, message.row_step, message.height, message.width) == (20, 20, 1, 1)
    assert message.is_dense
    assert not message.is_bigendian
    assert bytes(message.data)[12:16] == b'\x01\x02\x03\x00'


@pytest.mark.parametrize(('field', 'value', 'expected'), [
    ('data', np.zeros(19, np.uint8), 'wrong_data_length'), ('width', 2, 'wrong_data_length'),
    ('point_step', 16, 'unknown_fields'), ('fields', [], 'unknown_fields'),
    ('is_bigendian', True, 'unknown_fields')])
def test_what_is_wrong_with_a_cloud_has_a_name(field, value, expected):
    cloud = PointCloud(KEY, np.zeros((1, 3), np.float32), np.zeros(1, np.float32),
                       intensity=np.zeros(1, np.uint8))
    message = convert.cloud_message(bag_messages.make, cloud)
    setattr(message, field, value)
    assert cause(convert.read_cloud(message)) == expected


# Motion

def odometry(make, **pose):
    q = rotations.quaternion_from_matrix(rotations.exp([0, 0, 0.5]))
    fields = {'position': make('geometry_msgs/msg/Point', x=1.0, y=2.0, z=3.0),
              'orientation': make('geometry_msgs/msg/Quaternion', **dict(
                  zip('xyzw', map(float, q), strict=True)))}
    message = make('nav_msgs/msg/Odometry', header=convert.header(make, KEY))
    message.pose.pose = make('geometry_msgs/msg/Pose', **{**fields, **pose})
    return message


def test_odometry_sample(make):
    message = odometry(make)
    message.pose.covariance = np.arange(36, dtype=np.float64)
    sample = convert.odometry_sample(message)
    assert sample.stamp == KEY.stamp
    np.testing.assert_array_equal(sample.position, [1, 2, 3])
    np.testing.assert_allclose(sample.rotation, rotations.exp([0, 0, 0.5]), atol=1e-12)
    np.testing.assert_array_equal(sample.covariance, np.arange(36).reshape(6, 6))


@pytest.mark.parametrize('covariance', [np.zeros(36), np.full(36, np.nan), -np.eye(6).ravel()])
def test_covariance_that_says_nothing_is_unknown(covariance):
    message = odometry(bag_messages.make)
    message.pose.covariance = covariance
    assert convert.odometry_sample(message).covariance is None


def test_bad_odometry_is_refused():
    make = bag_messages.make
    position = make('geometry_msgs/msg/Point', y=math.nan)
    assert cause(convert.odometry_sample(odometry(make, position=position))) == 'not_finite'
    turn = make('geometry_msgs/msg/Quaternion')
    assert cause(convert.odometry_sample(odometry(make, orientation=turn))) == 'invalid_quaternion'
    message = odometry(make)
    message.header.stamp.nanosec = 10**9
    assert cause(convert.odometry_sample(message)) == 'invalid_stamp'


def test_twist_sample(make):
    message = make('geometry_msgs/msg/TwistStamped', header=convert.header(make, KEY))
    message.twist.linear.x, message.twist.angular.z = 8.0, -0.5
    sample = convert.twist_sample(message)
    assert sample.stamp == KEY.stamp
    np.testing.assert_array_equal(sample.linear, [8, 0, 0])
    np.testing.assert_array_equal(sample.angular, [0, 0, -0.5])
    message.twist.angular.y = math.inf
    assert cause(convert.twist_sample(message)) == 'not_finite'


def imu(make, covariance=0.0, **orientation):
    message = make('sensor_msgs/msg/Imu', header=convert.header(make, KEY))
    message.angular_velocity.y = 0.25
    message.orientation_covariance[0] = covariance
    for name, value in orientation.items():
        setattr(message.orientation, name, value)
    return message


def test_imu_sample(make):
    sample = convert.imu_sample(imu(make, x=1.0, w=0.0))
    assert sample.stamp == KEY.stamp
    np.testing.assert_array_equal(sample.angular, [0, 0.25, 0])
    np.testing.assert_array_equal(sample.orientation, np.diag([1, -1, -1]))


@pytest.mark.parametrize('given', [{'covariance': -1.0}, {'covariance': -1.0, 'w': math.nan},
                                   {'w': 0.0}])
def test_imu_without_orientation(make, given):
    sample = convert.imu_sample(imu(make, **given))
    assert sample.orientation is None
    np.testing.assert_array_equal(sample.angular, [0, 0.25, 0])


def test_bad_imu_is_refused(make):
    assert cause(convert.imu_sample(imu(make, w=1.1))) == 'invalid_quaternion'
    assert cause(convert.imu_sample(imu(make, w=math.nan))) == 'not_finite'
    message = imu(make)
    message.angular_velocity.x = math.nan
    assert cause(convert.imu_sample(message)) == 'not_finite'
    message.angular_velocity_covariance[0] = -1.0
    assert cause(convert.imu_sample(message)) == 'no_angular_velocity'


@given(turns, triples.filter(lambda p: np.linalg.norm(p) > 0.01), st.integers(0, 2**32 - 1))
def test_visual_odometry_is_the_inverse_of_the_pose(turn, position, seed):
    random = np.random.default_rng(seed)
    root = random.normal(size=(6, 6)) * 1e-3
    pose = RelativePose(rotations.exp(turn), position, root @ root.T)
    window = StabilisedWindow(frame(2 * 10**8, 'now'), (Reference(frame(10**8, 'then'), pose),))
    message = convert.odometry_message(bag_messages.make, window)
    assert (message.header.frame_id, message.child_frame_id) == ('then', 'now')
    sample = convert.odometry_sample(message)
    assert sample.stamp == 2 * 10**8
    # a point in the current frame, by way of the message and back by way of the pose
    point = random.normal(size=3)
    reference = sample.rotation @ point + sample.position
    np.testing.assert_allclose(pose.rotation @ reference + pose.position, point, atol=1e-9)
    # covariance, against finite differences
    step = 1e-6
    columns = []
    for k in range(6):
        change = np.eye(6)[k] * step
        rotation = rotations.exp(change[:3]) @ pose.rotation
        moved = -rotation.T @ (pose.position + change[3:])
        turned = rotations.log(rotation.T @ sample.rotation.T)
        columns.append(np.concatenate([moved - sample.position, turned]) / step)
    jacobian = np.stack(columns, axis=1)
    np.testing.assert_allclose(sample.covariance, jacobian @ pose.covariance @ jacobian.T,
                               rtol=1e-3, atol=1e-5)


def test_velocity_of_visual_odometry(make):
    pose = RelativePose(rotations.exp([0, -0.01, 0]), np.array([0, 0, -0.3]), np.eye(6) * 1e-6)
    window = StabilisedWindow(frame(2 * 10**8), (Reference(frame(10**8), pose),))
    message = convert.odometry_message(make, window)
    assert message.twist.twist.linear.z == pytest.approx(3.0)
    assert message.twist.twist.angular.y == pytest.approx(0.1)
    np.testing.assert_allclose(np.diag(np.reshape(message.twist.covariance, (6, 6))), 1e-4)


def test_unknown_motion_is_nan_not_zero(make):
    message = convert.odometry_message(make, pair(UNSCALED))
    assert math.isnan(message.pose.pose.position.z)
    assert math.isnan(message.twist.twist.linear.z)
    assert message.pose.pose.orientation.w == 1.0
    two = StabilisedWindow(frame(5, 'bottom'), (Reference(
        frame(5, 'top'), RelativePose(position=np.array([0, 1.0, 0]))),))
    message = convert.odometry_message(make, two)
    assert message.pose.pose.position.y == -1.0
    assert math.isnan(message.twist.twist.linear.y)


# Diagnostics

def test_diagnostics(make):
    message = convert.diagnostic_message(make, KEY.stamp, [
        convert.Status('frame_pairing', 1, '2 drops', {'drops/wrong_step': 2})])
    status, = message.status
    assert status.level in (1, b'\x01')
    assert (status.name, status.message) == ('frame_pairing', '2 drops')
    assert [(v.key, v.value) for v in status.values] == [('drops/wrong_step', '2')]
    assert convert.nanoseconds(message.header.stamp) == KEY.stamp


def test_unknown_fields_are_refused(make):
    with pytest.raises((AttributeError, KeyError)):
        make('std_msgs/msg/Header', colour='red')


@pytest.mark.parametrize('name', [
    'sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry', 'diagnostic_msgs/msg/DiagnosticArray',
    'sensor_msgs/msg/PointCloud2', 'sensor_msgs/msg/CompressedImage', 'rosgraph_msgs/msg/Clock'])
def test_defaults_can_be_written_and_read(name):
    message = bag_messages.make(name)
    data = bag_messages.TYPESTORE.serialize_cdr(message, name)
    again = bag_messages.TYPESTORE.deserialize_cdr(data, name)
    assert bag_messages.TYPESTORE.serialize_cdr(again, name) == data
