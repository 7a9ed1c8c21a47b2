"""sensor_msgs/Image and CompressedImage ↔ frames, depth images, previews.

Whatever is wrong with an incoming image is a `Drop` with one of these causes: invalid_stamp,
empty_image, wrong_size, wrong_aspect, unknown_encoding, wrong_step, wrong_data_length,
undecodable_image.
"""
from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.config import ParameterError
from sphstereo_ros.core.frames import Drop, Frame, FrameKey, Image8
from sphstereo_ros.ros.messages import MessageFactory, bad_stamp, frame_key, header

Bytes = NDArray[np.uint8]

LEAST_SIZE = 8
GREATEST_SIZE = 32768
GREATEST_HEIGHT = 16384
# A full sphere may be stored with pixels that are not square, up to this.
ASPECTS = (1.0, 4.0)


@dataclass(frozen=True)
class _Encoding:
    """Bytes a pixel, and OpenCV's conversions to grey and BGR (None: the bytes are that)."""

    size: int
    to_grey: int | None
    to_bgr: int | None
    wide: bool = False
    paired: bool = False


_MONO = _Encoding(1, None, cv2.COLOR_GRAY2BGR)
_MONO16 = _Encoding(2, None, cv2.COLOR_GRAY2BGR, wide=True)
_BGR = _Encoding(3, cv2.COLOR_BGR2GRAY, None)
_UYVY = _Encoding(2, cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2BGR_UYVY, paired=True)
_YUYV = _Encoding(2, cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2BGR_YUY2, paired=True)

# OpenCV names a Bayer pattern by the second row's second and third pixel, ROS by the first two.
ENCODINGS: dict[str, _Encoding] = {
    'mono8': _MONO, '8UC1': _MONO, 'mono16': _MONO16, '16UC1': _MONO16,
    'bgr8': _BGR, '8UC3': _BGR,
    'rgb8': _Encoding(3, cv2.COLOR_RGB2GRAY, cv2.COLOR_RGB2BGR),
    'bgra8': _Encoding(4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
    '8UC4': _Encoding(4, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
    'rgba8': _Encoding(4, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2BGR),
    'yuv422': _UYVY, 'uyvy': _UYVY, 'yuv422_yuy2': _YUYV, 'yuyv': _YUYV,
    'bayer_rggb8': _Encoding(1, cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2BGR),
    'bayer_bggr8': _Encoding(1, cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2BGR),
    'bayer_gbrg8': _Encoding(1, cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2BGR),
    'bayer_grbg8': _Encoding(1, cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2BGR),
}


def decode_frame(msg: Any, working_height: int = 0, colour: bool = False) -> Frame | Drop:
    """Image or CompressedImage → Frame, or the reason why not; never raises.

    Parameters
    ----------
    msg : sensor_msgs/Image or CompressedImage with a full-sphere equirectangular image
    working_height : rows of the frame, which has twice as many columns; 0 = the image's
    colour : whether the frame shall carry BGR too

    Returns
    -------
    Frame whose arrays are read-only (a mono8 image of the working size is not copied)

    """
    drop = bad_stamp(msg.header)
    if drop is not None:
        return drop
    try:
        decode = _decode_raw if hasattr(msg, 'encoding') else _decode_compressed
        image = decode(msg, working_height, colour)
        if isinstance(image, Drop):
            return image
        image = resize_sphere(image, working_height or image.shape[0])
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if colour else image
    except cv2.error as error:
        return Drop('undecodable_image', str(error).strip().replace('\n', ' ')[:200])
    return Frame(frame_key(msg.header), _read_only(grey), _read_only(image) if colour else None)


def _read_only(image: Image8) -> Image8:
    view = np.ascontiguousarray(image).view()
    view.flags.writeable = False
    return view


def wrong_size(height: int, width: int) -> Drop | None:
    """Drop where an image of this size can be no full sphere."""
    size = f'{width}×{height}'
    if height == 0 or width == 0:
        return Drop('empty_image', size)
    if min(height, width) < LEAST_SIZE or height > GREATEST_HEIGHT or width > GREATEST_SIZE:
        return Drop('wrong_size', size)
    if not ASPECTS[0] <= width / height <= ASPECTS[1]:
        return Drop('wrong_aspect', f'{size} is no full sphere')
    return None


def resize_sphere(image: Image8, height: int) -> Image8:
    """Bring an equirectangular image (h, w[, 3]) to (height, 2·height[, 3])."""
    rows, columns = image.shape[:2]
    width = 2 * height
    if (rows, columns) == (height, width):
        return image
    if height <= rows and width <= columns:
        smaller = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(smaller, np.uint8)
    # Interpolated across ±180° too: the seam lies in the middle of two copies side by side.
    twice = cv2.resize(np.concatenate([image, image], axis=1), (2 * width, height),
                       interpolation=cv2.INTER_LINEAR)
    return np.concatenate([twice[:, width:width + height], twice[:, height:width]], axis=1)


def _pixels(msg: Any, pixel_size: int) -> Bytes | Drop:
    """Bytes of a sensor_msgs/Image without row padding, (height, width · pixel_size)."""
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    if step < width * pixel_size:
        return Drop('wrong_step', f'{step} bytes for {width} pixels of {msg.encoding}')
    data = np.frombuffer(msg.data, np.uint8)
    if data.size != step * height:
        return Drop('wrong_data_length', f'{data.size} bytes, not {height} × {step}')
    return data.reshape(height, step)[:, :width * pixel_size]


def _decode_raw(msg: Any, working_height: int, colour: bool) -> Image8 | Drop:
    height, width = int(msg.height), int(msg.width)
    encoding = ENCODINGS.get(str(msg.encoding))
    if encoding is None:
        return Drop('unknown_encoding', repr(str(msg.encoding)[:40]))
    drop = wrong_size(height, width)
    if drop is not None:
        return drop
    if encoding.paired and width % 2:
        return Drop('wrong_size', f'{msg.encoding} of odd width {width}')
    rows = _pixels(msg, encoding.size)
    if isinstance(rows, Drop):
        return rows
    if encoding.wide:  # the high byte
        rows = rows[:, 0 if msg.is_bigendian else 1::2]
    elif encoding.size > 1:
        rows = rows.reshape(height, width, encoding.size)
    conversion = encoding.to_bgr if colour else encoding.to_grey
    if conversion is None:
        return rows
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rows), conversion), np.uint8)


def _decode_compressed(msg: Any, working_height: int, colour: bool) -> Image8 | Drop:
    data = np.frombuffer(msg.data, np.uint8)
    size = compressed_size(data.tobytes())
    if isinstance(size, Drop):
        return size
    drop = wrong_size(size.height, size.width)
    if drop is not None:
        return drop
    mode = _scale_flag(size, working_height, colour) | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(data, mode)
    if image is None:
        return Drop('undecodable_image', f'{size.kind} of {size.width}×{size.height}')
    return np.asarray(image, np.uint8)


@dataclass(frozen=True)
class CompressedSize:
    """What the head of a compressed image says: kind is jpeg or png."""

    kind: str
    height: int
    width: int


def _scale_flag(size: CompressedSize, working_height: int, colour: bool) -> int:
    """How to decode: at the least scale that is no smaller than the working size.

    Only sizes that divide evenly: others would be rounded up, and shift the sphere.
    """
    whole = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    if size.kind != 'jpeg' or working_height == 0:
        return int(whole)
    for scale, grey, bgr in ((8, cv2.IMREAD_REDUCED_GRAYSCALE_8, cv2.IMREAD_REDUCED_COLOR_8),
                             (4, cv2.IMREAD_REDUCED_GRAYSCALE_4, cv2.IMREAD_REDUCED_COLOR_4),
                             (2, cv2.IMREAD_REDUCED_GRAYSCALE_2, cv2.IMREAD_REDUCED_COLOR_2)):
        even = size.height % scale == 0 and size.width % scale == 0
        if even and size.height >= scale * working_height and \
                size.width >= 2 * scale * working_height:
            return int(bgr if colour else grey)
    return int(whole)


def compressed_size(data: bytes) -> CompressedSize | Drop:
    """Read the size from the head of a JPEG or PNG, and check that it is there to its end.

    OpenCV fills up what is missing of a cut JPEG in grey and calls it an image.
    """
    if not data:
        return Drop('empty_image', 'no data')
    if data.startswith(b'\xff\xd8'):
        return _jpeg_size(data)
    if data.startswith(_PNG):
        return _png_size(data)
    return Drop('unknown_encoding', 'neither JPEG nor PNG')


_PNG = b'\x89PNG\r\n\x1a\n'


def _png_size(data: bytes) -> CompressedSize | Drop:
    """Walk the chunks: a wrong length makes OpenCV ask for gigabytes."""
    at, size = len(_PNG), None
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at:at + 4], 'big')
        kind = data[at + 4:at + 8]
        if zlib.crc32(data[at + 4:end]) != int.from_bytes(data[end:end + 4], 'big'):
            return Drop('undecodable_image', 'PNG is damaged or cut off')
        if kind == b'IHDR':
            size = CompressedSize('png', int.from_bytes(data[at + 12:at + 16], 'big'),
                                  int.from_bytes(data[at + 8:at + 12], 'big'))
        if kind == b'IEND' and size is not None:
            return size
        at = end + 4
    return Drop('undecodable_image', 'PNG is cut off')


_FRAME_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_START_OF_SCAN = 0xDA


def _jpeg_size(data: bytes) -> CompressedSize | Drop:
    at, size = 2, None
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in _FRAME_MARKERS:
            size = CompressedSize('jpeg', int.from_bytes(data[at + 5:at + 7], 'big'),
                                  int.from_bytes(data[at + 7:at + 9], 'big'))
        if marker == _START_OF_SCAN and size is not None:
            if data.rfind(b'\xff\xd9') < at:
                return Drop('undecodable_image', 'JPEG is cut off')
            return size
        at += 2 + int.from_bytes(data[at + 2:at + 4], 'big')
    return Drop('undecodable_image', 'no JPEG header')


def read_mask(path: str) -> Image8 | None:
    """Read `camera.mask`: (H, W), non-zero = vehicle; None for an empty path.

    Raises
    ------
    ParameterError
        where it is no image

    """
    if not path:
        return None
    try:
        data = np.fromfile(path, np.uint8)
    except OSError:
        data = np.empty(0, np.uint8)
    # Not imread: it writes a line of its own where there is no file.
    mask = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    if mask is None:
        raise ParameterError(f'camera.mask: cannot read an image from {path}')
    return np.asarray(mask, np.uint8)


def image_message(make: MessageFactory, key: FrameKey, image: Image8) -> Any:
    """Make a sensor_msgs/Image of (H, W) uint8 as mono8, or of (H, W, 3) as bgr8."""
    pixel_size = 1 if image.ndim == 2 else image.shape[2]
    return make('sensor_msgs/msg/Image', header=header(make, key), height=image.shape[0],
                width=image.shape[1], encoding={1: 'mono8', 3: 'bgr8'}[pixel_size],
                is_bigendian=0, step=image.shape[1] * pixel_size,
                data=np.ascontiguousarray(image).reshape(-1))


def frame_message(make: MessageFactory, frame: Frame) -> Any:
    """Make a sensor_msgs/Image of a frame: bgr8 where it carries colour, else mono8."""
    return image_message(make, frame.key, frame.image if frame.colour is None else frame.colour)


def compressed_message(make: MessageFactory, key: FrameKey, format: str, data: bytes) -> Any:
    """Make a sensor_msgs/CompressedImage of encoded bytes; `format` is jpeg or png."""
    return make('sensor_msgs/msg/CompressedImage', header=header(make, key), format=format,
                data=np.frombuffer(data, np.uint8))


def depth_message(make: MessageFactory, key: FrameKey, depth: NDArray[np.float32]) -> Any:
    """Make a 32FC1 sensor_msgs/Image of (H, W): range or sigma."""
    data = np.ascontiguousarray(depth, '<f4').reshape(-1).view(np.uint8)
    return make('sensor_msgs/msg/Image', header=header(make, key), height=depth.shape[0],
                width=depth.shape[1], encoding='32FC1', is_bigendian=0, step=4 * depth.shape[1],
                data=data)


def read_depth(msg: Any) -> NDArray[np.float32] | Drop:
    """Read a 32FC1 sensor_msgs/Image as (H, W) float32, or say why not."""
    if msg.encoding != '32FC1':
        return Drop('unknown_encoding', repr(str(msg.encoding)[:40]))
    if int(msg.height) == 0 or int(msg.width) == 0:
        return Drop('empty_image', f'{msg.width}×{msg.height}')
    rows = _pixels(msg, 4)
    if isinstance(rows, Drop):
        return rows
    order = '>f4' if msg.is_bigendian else '<f4'
    return np.ascontiguousarray(rows).view(order).astype(np.float32, copy=False)
