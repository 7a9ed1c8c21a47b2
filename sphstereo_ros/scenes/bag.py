"""A saved sequence as a bag: frames, odometry, and the true range as a topic."""
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.core.rotations import OPTICAL_FROM_LINK, quaternion_from_matrix
from sphstereo_ros.replay.bag_messages import make
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.ros.conversions import compressed_message, depth_message
from sphstereo_ros.ros.conversions import header as header_message

from .sequence import SavedSequence, TruthFrame, rounded_range

CAMERA, ODOM, BASE = 'camera_optical', 'odom', 'base_link'
TOP_CAMERA = 'top_camera_optical'


def write_bag(sequence: SavedSequence, path: Path) -> None:
    """Write `/image/compressed`, `/odometry` (the camera's mount is none) and
    `/ground_truth/range` (32FC1; at reduced height where the folder has it) into one mcap file.
    """
    with McapOutput(path) as out:
        for index, frame in enumerate(sequence):
            key = FrameKey(frame.stamp, CAMERA)
            out.write('/odometry', frame.stamp, odometry(frame))
            out.write('/image/compressed', frame.stamp,
                      compressed_message(make, key, 'bgr8; jpeg compressed bgr8', jpeg(frame)))
            out.write('/ground_truth/range', frame.stamp,
                      depth_message(make, key, _range(sequence, index, frame)))


def write_binocular_bag(sequence: SavedSequence, path: Path) -> None:
    """Write the pairs of a folder as `/bottom/image/compressed`, `/top/image/compressed`, and, of
    the bottom camera, `/odometry` and `/ground_truth/range` as `write_bag` does.

    Raises
    ------
    ValueError
        where the folder has no pairs

    """
    pairs = sequence.meta.get('pairs')
    if not pairs:
        raise ValueError(f'{sequence.folder} has no pairs of frames')
    with McapOutput(path) as out:
        for pair in pairs:
            for side, camera in (('top', TOP_CAMERA), ('bottom', CAMERA)):
                index = pair[side]
                frame = sequence[index]
                key = FrameKey(frame.stamp, camera)
                image = compressed_message(make, key, 'bgr8; jpeg compressed bgr8', jpeg(frame))
                if side == 'bottom':
                    out.write('/odometry', frame.stamp, odometry(frame))
                    out.write('/ground_truth/range', frame.stamp,
                              depth_message(make, key, _range(sequence, index, frame)))
                out.write(f'/{side}/image/compressed', frame.stamp, image)


def odometry(frame: TruthFrame) -> object:
    """The pose of `base_link`, which is `camera_link`, in `odom`; covariance and twist unknown."""
    x, y, z, w = quaternion_from_matrix(frame.rotation @ OPTICAL_FROM_LINK)
    px, py, pz = (float(p) for p in frame.position)
    position = make('geometry_msgs/msg/Point', x=px, y=py, z=pz)
    attitude = make('geometry_msgs/msg/Quaternion', x=float(x), y=float(y), z=float(z),
                    w=float(w))
    pose = make('geometry_msgs/msg/Pose', position=position, orientation=attitude)
    return make('nav_msgs/msg/Odometry', header=header_message(make, FrameKey(frame.stamp, ODOM)),
                child_frame_id=BASE, pose=make('geometry_msgs/msg/PoseWithCovariance', pose=pose))


def jpeg(frame: TruthFrame) -> bytes:
    """The frame as it was saved, or at quality 95."""
    if frame.jpeg is not None:
        return frame.jpeg
    return bytes(cv2.imencode('.jpg', frame.image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1])


def _range(sequence: SavedSequence, index: int, frame: TruthFrame) -> NDArray[np.float32]:
    small = sequence.meta['frames'][index].get('range_small')
    if small is None:
        return rounded_range(frame.range)
    with np.load(sequence.folder / small) as data:
        return np.asarray(data['range'], np.float32)
