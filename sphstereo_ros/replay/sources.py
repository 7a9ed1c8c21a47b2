"""Any input as one `Source`, and which of its topics feed the chain."""
from __future__ import annotations

from pathlib import Path

from sphstereo_ros.core.frames import Drop
from sphstereo_ros.core.synchronisation import SIDES, Side
from sphstereo_ros.replay.bags import bag_files, open_bag
from sphstereo_ros.replay.records import COMPRESSED, IMAGE, BadInput, Record, Source
from sphstereo_ros.replay.videos import FRAME_SUFFIXES, FolderSource, VideoSource
from sphstereo_ros.ros.images import ENCODINGS

__all__ = ['MOTION_TOPICS', 'STEREO_TOPICS', 'BadInput', 'Record', 'Source', 'image_topic',
           'image_topics', 'motion_topics', 'open_source', 'replayed_topics']

IMAGE_TOPICS = {'/image': IMAGE, '/image/compressed': COMPRESSED}
STEREO_TOPICS = {f'/{side}{topic}': kind for side in ('top', 'bottom')
                 for topic, kind in IMAGE_TOPICS.items()}
MOTION_TOPICS = {'/odometry': 'nav_msgs/msg/Odometry',
                 '/twist': 'geometry_msgs/msg/TwistStamped',
                 '/imu': 'sensor_msgs/msg/Imu'}


def open_source(path: Path, fps: float = 0.0) -> Source:
    """Open a bag (mcap or db3, file or folder), a video or a folder of frames.

    fps : frame rate of a folder of frames, or in place of a video's own times; 0 = not given

    Raises
    ------
    BadInput
        with the reason, where it cannot be used

    """
    try:
        if not path.exists():
            raise BadInput(f'{path} does not exist')
        if path.is_file() and path.stat().st_size == 0:
            raise BadInput(f'{path} is empty (0 bytes)')
        if bag_files(path) or (path / 'metadata.yaml').exists():
            return open_bag(path)
        if path.is_dir():
            return FolderSource(path, fps)
        if path.suffix.lower() in FRAME_SUFFIXES:
            raise BadInput(f'{path} is a single frame: give the folder of frames')
        return VideoSource(path, fps)
    except OSError as error:
        raise BadInput(f'{path}: {error.strerror or error}') from error


def image_topic(source: Source, wanted: str = '') -> str:
    """Choose the image topic: `wanted`, or the usual name, or the only one with 8-bit images.

    Raises
    ------
    BadInput
        where there is none, or more than one and none is `wanted`

    """
    images = {topic for topic, kind in source.topics.items() if kind in (IMAGE, COMPRESSED)}
    if wanted:
        if wanted not in images:
            raise BadInput(f'no image topic {wanted}; there {_listed(images)}')
        return wanted
    for topic, kind in IMAGE_TOPICS.items():
        if source.topics.get(topic) == kind and source.count([topic]):
            return topic
    found = {topic for topic in images if _has_8_bits(source, topic)}
    # An image and its compressed twin are one candidate.
    found -= {f'{topic}/compressed' for topic in found}
    if len(found) != 1:
        raise BadInput(f'no topic /image or /image/compressed, and there {_listed(found)}; '
                       'choose with --topic' if found else 'no topic with 8-bit images')
    return found.pop()


def image_topics(source: Source, binocular: bool, wanted: str = '') -> dict[str, Side | None]:
    """Which topics have the images, and of which of two cameras each is.

    Raises
    ------
    BadInput
        as `image_topic`, or where one of two cameras is not there

    """
    if not binocular:
        try:
            return {image_topic(source, wanted): None}
        except BadInput as error:
            if _of_sides(source):
                raise BadInput(f'{error} (for two cameras: pairing.mode: binocular, as in '
                               'config/binocular.yaml)') from None
            raise
    if wanted:
        raise BadInput('--topic: with two cameras the topics are top/image and bottom/image')
    found = _of_sides(source)
    for side in SIDES:
        if side not in found.values():
            raise BadInput(f'no topic /{side}/image or /{side}/image/compressed with messages '
                           '(pairing.mode is binocular)')
    return found


def _of_sides(source: Source) -> dict[str, Side | None]:
    """The topic of each of two cameras: `image`, or else its compressed twin."""
    found: dict[str, Side | None] = {}
    for side in SIDES:
        for name, kind in IMAGE_TOPICS.items():
            topic = f'/{side}{name}'
            if source.topics.get(topic) == kind and source.count([topic]):
                found[topic] = side
                break
    return found


def _listed(topics: set[str]) -> str:
    if not topics:
        return 'is none'
    return f'{"is" if len(topics) == 1 else "are"} {", ".join(sorted(topics))}'


def _has_8_bits(source: Source, topic: str) -> bool:
    record = next(source.records([topic]), None)
    message = record.message() if record else Drop('no_message')
    if isinstance(message, Drop):
        return False
    if hasattr(message, 'encoding'):
        encoding = ENCODINGS.get(message.encoding)
        return encoding is not None and not encoding.wide
    return 'compressedDepth' not in message.format


def motion_topics(source: Source) -> list[str]:
    """Which topics of odometry, twist and IMU are there, with the right type."""
    return [topic for topic, kind in MOTION_TOPICS.items() if source.topics.get(topic) == kind]


def replayed_topics(source: Source, wanted: str = '') -> dict[str, str]:
    """Which topics to replay, and the relative name each is published by.

    Raises
    ------
    BadInput
        where there is no image topic among them

    """
    usual = {**IMAGE_TOPICS, **STEREO_TOPICS}
    images = [topic for topic, kind in usual.items() if source.topics.get(topic) == kind]
    names = {topic: topic[1:] for topic in images + motion_topics(source)}
    if wanted or not images:
        topic = image_topic(source, wanted)
        names = {other: name for other, name in names.items() if other not in images}
        names[topic] = 'image' if source.topics[topic] == IMAGE else 'image/compressed'
    return names
