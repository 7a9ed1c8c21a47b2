"""A camera driver for the live benchmark: publishes prepared frames at a steady rate.

Run as `python -m sphstereo_ros.bench.camera FRAMES.npy --rate 30 …`. Stamps are monotonic time at
sending, so that any process of this machine can tell the latency. At the end it writes the stamps
of all frames it sent, as JSON.
"""
from __future__ import annotations

import argparse
import json
import struct
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.serialization import serialize_message

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.ros import qos
from sphstereo_ros.ros.conversions import compressed_message, image_message
from sphstereo_ros.ros.live_messages import make, message_class
from sphstereo_ros.ros.messages import SECOND
from sphstereo_ros.ros.transport import prepare_process

ENCODINGS = ('mono8', 'bgr8', 'jpeg')


def messages(frames: Any, encoding: str) -> list[bytearray]:
    """Serialised messages of (N, H, W) or (N, H, W, 3) uint8 frames, stamps zero."""
    key = FrameKey(0, 'camera_optical')
    made = []
    for frame in frames:
        if encoding == 'jpeg':
            data = cv2.imencode('.jpg', frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
            message = compressed_message(make, key, 'jpeg', data)
        else:
            message = image_message(make, key, frame)
        made.append(bytearray(serialize_message(message)))
    return made


def play(publisher: Any, frames: list[bytearray], rate: float) -> list[int]:
    """Publish until interrupted; returns the stamps."""
    stamps: list[int] = []
    due = time.monotonic()
    try:
        while rclpy.ok():
            time.sleep(max(0.0, due - time.monotonic()))
            # Late frames are left out, as a camera does, not sent in a bunch.
            due = max(due + 1 / rate, time.monotonic())
            message = frames[len(stamps) % len(frames)]
            stamp = time.monotonic_ns()
            struct.pack_into('<iI', message, 4, *divmod(stamp, SECOND))
            publisher.publish(bytes(message))
            stamps.append(stamp)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    return stamps


def main() -> int:
    """Run the camera; returns its exit status."""
    parser = argparse.ArgumentParser(description='publishes prepared frames')
    parser.add_argument('frames', type=Path)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--encoding', choices=ENCODINGS, default='mono8')
    parser.add_argument('--sent', type=Path, required=True, help='file for the stamps')
    arguments = parser.parse_args()
    prepare_process()
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('camera')
    topic, kind = (('image/compressed', 'CompressedImage') if arguments.encoding == 'jpeg'
                   else ('image', 'Image'))
    publisher = node.create_publisher(message_class(f'sensor_msgs/msg/{kind}'), topic,
                                      qos.IMAGE_INPUT)
    stamps = play(publisher, messages(np.load(arguments.frames), arguments.encoding),
                  arguments.rate)
    arguments.sent.write_text(json.dumps(stamps))
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
