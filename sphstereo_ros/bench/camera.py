"""A camera driver for the live benchmark: publishes prepared frames at a steady rate.

Run as `python -m sphstereo_ros.bench.camera FRAMES.npy --rate 30 …`; with two files it is two
cameras, the bottom one and the top one. Stamps are monotonic time at sending, so that any process
of this machine can tell the latency. At the end it writes the stamps of all frames it sent (of the
bottom camera), as JSON.
"""
from __future__ import annotations

import argparse
import json
import signal
import struct
import time
from collections.abc import Callable, Sequence
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


def messages(frames: Any, encoding: str, frame_id: str = 'camera_optical') -> list[bytearray]:
    """Serialised messages of (N, H, W) or (N, H, W, 3) uint8 frames, stamps zero."""
    key = FrameKey(0, frame_id)
    made = []
    for frame in frames:
        if encoding == 'jpeg':
            data = cv2.imencode('.jpg', frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
            message = compressed_message(make, key, 'jpeg', data)
        else:
            message = image_message(make, key, frame)
        made.append(bytearray(serialize_message(message)))
    return made


def play(outputs: Sequence[tuple[Any, list[bytearray]]], rate: float,
         later: Callable[[], float] = lambda: 0.0) -> list[int]:
    """Publish until interrupted; returns the stamps of the first output.

    outputs : one or two of publisher and its messages, which are sent in turn
    later : tells how many seconds after the first the second sends, each time anew
    """
    stamps: list[int] = []
    due = time.monotonic()
    count = 0
    try:
        while rclpy.ok():
            _wait(due)
            # Late frames are left out, as a camera does, not sent in a bunch.
            due = max(due + 1 / rate, time.monotonic())
            after = [0.0, later()][:len(outputs)]
            stamp, sent = 0, min(after)
            for n in sorted(range(len(outputs)), key=after.__getitem__):
                _wait(stamp / SECOND + after[n] - sent)
                publisher, messages = outputs[n]
                message = messages[count % len(messages)]
                # The second stamps when it was due, as a camera that exposes does, however late
                # this process gets its turn.
                stamp = stamp + round((after[n] - sent) * SECOND) if stamp else time.monotonic_ns()
                sent = after[n]
                struct.pack_into('<iI', message, 4, *divmod(stamp, SECOND))
                publisher.publish(bytes(message))
                if n == 0:
                    stamps.append(stamp)
            count += 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    return stamps


def _wait(until: float) -> None:
    time.sleep(max(0.0, until - time.monotonic()))


def main() -> int:
    """Run the camera; returns its exit status."""
    parser = argparse.ArgumentParser(description='publishes prepared frames')
    parser.add_argument('frames', type=Path, nargs='+', help='of one camera, or of the bottom and '
                        'the top one')
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--encoding', choices=ENCODINGS, default='mono8')
    parser.add_argument('--apart', type=float, default=0.0, help='ms from a frame of the bottom '
                        'camera to that of the top one')
    parser.add_argument('--jitter', type=float, default=0.0, help='ms by which that varies')
    parser.add_argument('--sent', type=Path, required=True, help='file for the stamps')
    arguments = parser.parse_args()
    prepare_process()
    # A process that a shell put into the background starts with it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    rclpy.init(signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node('camera')
    name, kind = (('image/compressed', 'CompressedImage') if arguments.encoding == 'jpeg'
                  else ('image', 'Image'))
    sides = ('',) if len(arguments.frames) == 1 else ('bottom/', 'top/')
    image = message_class(f'sensor_msgs/msg/{kind}')
    outputs = [(node.create_publisher(image, f'{side}{name}', qos.IMAGE_INPUT),
                messages(np.load(file), arguments.encoding,
                         f'{side}camera_optical'.replace('/', '_')))
               for side, file in zip(sides, arguments.frames, strict=True)]
    rng = np.random.default_rng(0)

    def later() -> float:
        return 1e-3 * float(arguments.apart + arguments.jitter * rng.uniform(-1, 1))
    stamps = play(outputs, arguments.rate, later)
    arguments.sent.write_text(json.dumps(stamps))
    node.destroy_node()
    rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
