"""Small bags for tests."""
from __future__ import annotations

import cv2
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.replay.bag_messages import TYPESTORE, make
from sphstereo_ros.ros import conversions as convert

T0 = 1_700_000_000_000_000_000
STEP = 100_000_000
STORAGE = {'mcap': StoragePlugin.MCAP, 'db3': StoragePlugin.SQLITE3}


def picture(k, height=32, width=64):
    image = np.random.default_rng(1).integers(0, 256, (height, width, 3), np.uint8)
    return np.roll(cv2.blur(image, (5, 5)), 2 * k, axis=1)


def raw_image(k, **size):
    return convert.image_message(make, FrameKey(T0 + k * STEP, 'camera'), picture(k, **size))


def jpeg_image(k, **size):
    data = cv2.imencode('.jpg', picture(k, **size))[1].tobytes()
    return convert.compressed_message(make, FrameKey(T0 + k * STEP, 'camera'), 'jpeg', data)


def odometry(k):
    message = make('nav_msgs/msg/Odometry', child_frame_id='base_link',
                   header=convert.header(make, FrameKey(T0 + k * STEP, 'odom')))
    message.pose.pose.position.x = 0.3 * k
    return message


def write_bag(folder, messages, storage='mcap'):
    """Write (topic, time, message) and return the bag's one storage file."""
    writer = Writer(folder, version=9, storage_plugin=STORAGE[storage])
    with writer:
        connections = {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPESTORE)
            writer.write(connections[topic], time, TYPESTORE.serialize_cdr(message, kind))
    return next(p for p in folder.iterdir() if p.suffix == f'.{storage}')


def drive(frames=6, topic='/image/compressed', make_image=jpeg_image, **size):
    """Odometry and images, STEP apart."""
    for k in range(frames):
        yield '/odometry', T0 + k * STEP, odometry(k)
        yield topic, T0 + k * STEP, make_image(k, **size)


def write_video(path, sizes=(128, 64), frames=12, fps=25.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'mp4v'), fps, sizes)
    for k in range(frames):
        writer.write(np.full((sizes[1], sizes[0], 3), 20 * k, np.uint8))
    writer.release()
    return path
