"""A 360° video into a bag of `/image/compressed`."""
from __future__ import annotations

from collections.abc import Callable

import cv2

from sphstereo_ros.core.frames import FrameKey
from sphstereo_ros.replay import bag_messages
from sphstereo_ros.replay.output import McapOutput
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.replay.videos import CAMERA, Video
from sphstereo_ros.ros.conversions import compressed_message
from sphstereo_ros.ros.images import resize_sphere


def import_video(video: Video, output: McapOutput, quality: int = 95, height: int = 0,
                 advance: Callable[[], object] = lambda: None) -> int:
    """Write the frames of `video` as JPEG; returns how many.

    quality : of the JPEG, 1 … 100; height : rows of the images, twice as many columns;
    0 = as they are; advance : called after each frame

    Raises
    ------
    BadInput
        where there is not one frame

    """
    count = 0
    for frame in video.frames():
        image = resize_sphere(frame.image, height) if height else frame.image
        good, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not good:
            raise BadInput(f'frame {count} cannot be written as JPEG')
        message = compressed_message(bag_messages.make, FrameKey(frame.stamp, CAMERA),
                                     'bgr8; jpeg compressed bgr8', data.tobytes())
        output.write('/image/compressed', frame.stamp, message)
        count += 1
        advance()
    if count == 0:
        raise BadInput('the video has no frame in this span')
    return count
