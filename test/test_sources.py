from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from making_bags import (
    STEP,
    T0,
    drive,
    jpeg_image,
    odometry,
    picture,
    raw_image,
    write_bag,
    write_video,
)
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from sphstereo_ros.core.frames import Drop, FrameKey
from sphstereo_ros.replay import sources
from sphstereo_ros.replay.bag_messages import TYPESTORE, make
from sphstereo_ros.replay.records import FIRST_STAMP, Record
from sphstereo_ros.replay.sources import BadInput, image_topic, open_source, replayed_topics
from sphstereo_ros.replay.videos import Video, natural_order
from sphstereo_ros.ros import conversions as convert


def stamps(source, topics=None):
    return [convert.frame_key(record.message().header).stamp
            for record in source.records(topics or source.topics)]


# Whole bags

@pytest.mark.parametrize('storage', ['mcap', 'db3'])
@pytest.mark.parametrize('as_folder', [True, False])
def test_bags_of_either_kind(tmp_path, storage, as_folder):
    file = write_bag(tmp_path / 'bag', drive(6), storage)
    source = open_source(tmp_path / 'bag' if as_folder else file)
    assert dict(source.topics) == {'/odometry': 'nav_msgs/msg/Odometry',
                                   '/image/compressed': 'sensor_msgs/msg/CompressedImage'}
    records = list(source.records(source.topics))
    assert [r.time for r in records] == [T0 + k * STEP for k in range(6) for _ in range(2)]
    assert source.count(source.topics) == 12
    assert source.count(['/odometry']) == 6
    assert source.problem == ''
    positions = [r.message().pose.pose.position.x for r in source.records(['/odometry'])]
    np.testing.assert_allclose(positions, 0.3 * np.arange(6))
    images = [convert.decode_frame(r.message(), colour=True)
              for r in source.records(['/image/compressed'])]
    assert np.abs(images[3].colour.astype(int) - picture(3)).mean() < 8


def test_records_come_in_time_order(tmp_path):
    messages = list(drive(5))
    source = open_source(write_bag(tmp_path / 'bag', messages[::-1]))
    times = [record.time for record in source.records(source.topics)]
    assert times == sorted(times)


def test_record_gives_its_bytes_as_recorded():
    message = odometry(1)
    data = bytes(TYPESTORE.serialize_cdr(message, message.__msgtype__))
    assert Record('/odometry', message.__msgtype__, 0, data).serialised() == data
    assert Record('/odometry', message.__msgtype__, 0, given=message).serialised() == data


def test_message_with_damaged_bytes_is_named():
    drop = Record('/odometry', 'nav_msgs/msg/Odometry', 0, b'\x00\x01\x00\x00junk').message()
    assert isinstance(drop, Drop)
    assert drop.cause == 'undecodable_message'
    assert '/odometry' in drop.detail


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('chunked', [True, False])
def test_mcap_of_other_recorders(tmp_path, compression, chunked):
    path = tmp_path / 'other.mcap'
    with path.open('wb') as file:
        writer = McapWriter(file, compression=compression, use_chunking=chunked)
        writer.start(profile='', library='other')
        schema = writer.register_schema('nav_msgs/msg/Odometry', 'ros2msg', b'')
        channel = writer.register_channel('/odometry', 'cdr', schema)
        text = writer.register_channel('/log', 'json', 0)
        for k in range(4):
            data = bytes(TYPESTORE.serialize_cdr(odometry(k), 'nav_msgs/msg/Odometry'))
            writer.add_message(channel, T0 + k, data, T0 + k)
            writer.add_message(text, T0 + k, b'{}', T0 + k)
        writer.finish()
    source = open_source(path)
    assert dict(source.topics) == {'/odometry': 'nav_msgs/msg/Odometry'}
    assert stamps(source) == [T0 + k * STEP for k in range(4)]
    assert source.problem == ''


# Broken bags

def cut(path, share):
    content = path.read_bytes()
    size = int(share * len(content))
    assert size < len(content)
    path.write_bytes(content[:size])


def many(frames=40):
    return list(drive(frames, '/image', raw_image))


@pytest.fixture(scope='module', params=['mcap', 'db3'])
def whole(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp('whole') / 'bag'
    messages = list(drive(300, '/image', raw_image, height=64, width=128))
    return write_bag(folder, messages, request.param)


@pytest.mark.parametrize('share', [0.3, 0.5, 0.7, 0.9, 0.99])
@pytest.mark.parametrize('as_folder', [True, False])
def test_cut_bag_is_read_as_far_as_it_goes(whole, tmp_path, share, as_folder):
    file = tmp_path / 'bag' / whole.name
    file.parent.mkdir()
    file.write_bytes(whole.read_bytes())
    if as_folder:
        (file.parent / 'metadata.yaml').write_bytes((whole.parent / 'metadata.yaml').read_bytes())
    cut(file, share)
    source = open_source(file.parent if as_folder else file)
    read = stamps(source, ['/image'])
    assert read == [T0 + k * STEP for k in range(len(read))]
    assert len(read) == source.count(['/image'])
    assert len(read) >= share * 300 * 0.8 - 20
    assert 'truncated after' in source.problem
    assert '\n' not in source.problem


@pytest.mark.parametrize('share', [0.0001, 0.001, 0.005])
def test_bag_of_which_nothing_is_left_is_refused(whole, tmp_path, share):
    file = tmp_path / whole.name
    file.write_bytes(whole.read_bytes())
    cut(file, share)
    with pytest.raises(BadInput, match=r'holds no readable message|no bag') as refused:
        open_source(file)
    assert '\n' not in str(refused.value)


def test_folder_without_its_metadata(whole, tmp_path):
    (tmp_path / whole.name).write_bytes(whole.read_bytes())
    source = open_source(tmp_path)
    assert len(stamps(source, ['/odometry'])) == 300
    assert source.problem == ''


def test_files_of_a_folder_are_read_in_order(tmp_path):
    folder = tmp_path / 'split'
    folder.mkdir()
    for part in (2, 0, 10, 1):
        message = ('/odometry', T0 + part, odometry(part))
        write_bag(tmp_path / f'{part}', [message]).rename(folder / f'bag_{part}.mcap')
    assert stamps(open_source(folder)) == [T0 + part * STEP for part in (0, 1, 2, 10)]


@pytest.mark.parametrize('seed', range(25))
def test_flipped_bytes_have_a_clear_outcome(whole, tmp_path, seed):
    random = np.random.default_rng(seed)
    content = bytearray(whole.read_bytes())
    for at in random.integers(0, len(content), 1 + seed % 5):
        content[at] ^= int(random.integers(1, 256))
    if seed % 3 == 0:  # the head or the index
        at = int(random.integers(0, 300))
        content[at if seed % 2 else -at - 1] ^= 0x41
    assert bytes(content) != whole.read_bytes()
    file = tmp_path / whole.name
    file.write_bytes(content)
    opened = opened_or_refused(file)
    if isinstance(opened, BadInput):
        assert '\n' not in str(opened)
        return
    records = list(opened.records(opened.topics))
    for record in records:
        message = record.message()
        assert isinstance(message, Drop) or record.kind == message.__msgtype__
    if whole.suffix == '.mcap':
        assert len(records) == 600 or opened.problem
    assert '\n' not in opened.problem


def opened_or_refused(path):
    try:
        return open_source(path)
    except BadInput as refused:
        return refused


@pytest.mark.parametrize(('name', 'content', 'expected'), [
    ('none.mcap', None, 'does not exist'), ('zero.mcap', b'', 'is empty'),
    ('zero.mp4', b'', 'is empty'), ('text.mcap', b'hello' * 50, 'no readable message'),
    ('text.db3', b'hello' * 50, 'no readable message'), ('text.mp4', b'hello' * 50, 'no video'),
    ('one.jpg', b'\xff\xd8', 'folder of frames')])
def test_what_is_no_input_is_refused(tmp_path, name, content, expected):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInput, match=expected) as refused:
        open_source(tmp_path / name)
    assert '\n' not in str(refused.value)


def test_bag_without_messages_is_refused(tmp_path):
    with pytest.raises(BadInput, match='no readable message'):
        open_source(write_bag(tmp_path / 'bag', []))


def test_empty_folder_is_refused(tmp_path):
    with pytest.raises(BadInput, match='no bag and no frames'):
        open_source(tmp_path)


# Videos and folders of frames

def test_video_with_its_own_times(tmp_path):
    source = open_source(write_video(tmp_path / 'ride.mp4', fps=25.0))
    assert source.count(['/image']) == 12
    assert stamps(source) == [FIRST_STAMP + k * 40_000_000 for k in range(12)]
    shades = [r.message().data.mean() for r in source.records(['/image'])]
    np.testing.assert_allclose(shades, 20 * np.arange(12), atol=8)
    assert source.problem == ''
    assert list(source.records(['/odometry'])) == []


def test_frame_rate_can_be_given(tmp_path):
    source = open_source(write_video(tmp_path / 'ride.mp4'), fps=10.0)
    assert stamps(source) == [FIRST_STAMP + k * 10**8 for k in range(12)]


def test_part_of_a_video(tmp_path):
    video = Video(write_video(tmp_path / 'ride.mp4', fps=25.0), start=0.1, end=0.3)
    frames = list(video.frames())
    assert [f.stamp - FIRST_STAMP for f in frames] == [k * 40_000_000 for k in range(3, 8)]
    assert abs(video.count() - 5) <= 1


class TimelessCapture:
    """A container that tells no times."""

    def __init__(self, path):
        self._left = 5

    def isOpened(self):
        return True

    def get(self, name):
        return {cv2.CAP_PROP_FPS: 0.0, cv2.CAP_PROP_FRAME_COUNT: 5}.get(name, 0.0)

    def grab(self):
        self._left -= 1
        return self._left >= 0

    def retrieve(self):
        return True, np.zeros((64, 128, 3), np.uint8)

    def read(self):
        return self.retrieve()

    def release(self):
        pass


def test_video_without_times_or_rate_gets_regular_stamps(tmp_path, monkeypatch):
    monkeypatch.setattr(cv2, 'VideoCapture', TimelessCapture)
    frames = list(Video(tmp_path / 'any').frames())
    assert [f.stamp for f in frames] == [FIRST_STAMP + round(k * 1e9 / 30) for k in range(5)]


def test_cut_video_ends_with_a_warning_or_is_refused(tmp_path):
    path = tmp_path / 'ride.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 25, (128, 64))
    for k in range(50):
        writer.write(picture(k, 64, 128))
    writer.release()
    cut(path, 0.5)
    source = open_source(path)
    read = stamps(source)
    assert 10 < len(read) < 40
    assert read == sorted(set(read))
    if source.count(['/image']) == 50:  # the header still says so
        assert 'broken off after' in source.problem


def test_portrait_video_is_refused(tmp_path):
    with pytest.raises(BadInput, match='64×128 is no full sphere'):
        open_source(write_video(tmp_path / 'phone.mp4', (64, 128)))


def test_folder_of_frames(tmp_path):
    for k in (10, 9, 0):
        cv2.imwrite(str(tmp_path / f'frame_{k}.png'), np.full((16, 32), k, np.uint8))
    (tmp_path / 'notes.txt').write_text('not a frame')
    source = open_source(tmp_path, fps=20.0)
    assert source.count(source.topics) == 3
    records = list(source.records(source.topics))
    assert [r.time for r in records] == [FIRST_STAMP + k * 50_000_000 for k in range(3)]
    frames = [convert.decode_frame(r.message()) for r in records]
    assert [int(f.image[0, 0]) for f in frames] == [0, 9, 10]
    assert frames[1].key == FrameKey(FIRST_STAMP + 50_000_000, 'camera_optical')


def test_mask_beside_the_frames_is_no_frame(tmp_path):
    for name in ('1.jpg', '2.JPG', 'mask.png'):
        cv2.imwrite(str(tmp_path / name), np.zeros((16, 32), np.uint8))
    source = open_source(tmp_path)
    assert source.count(source.topics) == 2


def test_folder_of_portraits_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / 'a.jpg'), np.zeros((64, 32), np.uint8))
    with pytest.raises(BadInput, match='no full sphere'):
        open_source(tmp_path)


def test_natural_order(tmp_path):
    names = ['b1', 'a10', 'a9', 'a', '10', '9']
    ordered = sorted((tmp_path / name for name in names), key=natural_order)
    assert [p.name for p in ordered] == ['9', '10', 'a', 'a9', 'a10', 'b1']


# Which topics

class Fake:
    """A source with one message a topic."""

    problem = ''

    def __init__(self, messages):
        self.messages = messages
        self.topics = {topic: message.__msgtype__ for topic, message in messages.items()}

    def count(self, topics):
        return sum(topic in topics for topic in self.messages)

    def records(self, topics):
        return (Record(t, m.__msgtype__, 0, given=m) for t, m in self.messages.items()
                if t in topics)


def depth():
    return convert.depth_message(make, FrameKey(0, ''), np.full((8, 16), math.nan, np.float32))


def zipped_depth():
    return make('sensor_msgs/msg/CompressedImage', format='32FC1; compressedDepth png')


@pytest.mark.parametrize(('messages', 'wanted', 'expected'), [
    ({'/image': raw_image(0), '/other': raw_image(0)}, '', '/image'),
    ({'/image': raw_image(0), '/image/compressed': jpeg_image(0)}, '', '/image'),
    ({'/image/compressed': jpeg_image(0), '/other': raw_image(0)}, '', '/image/compressed'),
    ({'/image': odometry(0), '/other': raw_image(0)}, '', '/other'),
    ({'/camera': raw_image(0), '/depth': depth()}, '', '/camera'),
    ({'/camera': raw_image(0), '/camera/compressed': jpeg_image(0)}, '', '/camera'),
    ({'/a': jpeg_image(0), '/depth': zipped_depth(), '/odometry': odometry(0)}, '', '/a'),
    ({'/image': raw_image(0), '/other': raw_image(0)}, '/other', '/other')])
def test_image_topic(messages, wanted, expected):
    assert image_topic(Fake(messages), wanted) == expected


@pytest.mark.parametrize(('messages', 'wanted', 'expected'), [
    ({'/a': raw_image(0), '/b': jpeg_image(0)}, '', 'there are /a, /b; choose with --topic'),
    ({'/depth': depth(), '/odometry': odometry(0)}, '', 'no topic with 8-bit images'),
    ({'/a': raw_image(0)}, '/b', 'no image topic /b; there is /a'),
    ({'/odometry': odometry(0)}, '/odometry', 'there is none')])
def test_image_topic_that_cannot_be_chosen(messages, wanted, expected):
    with pytest.raises(BadInput, match=expected):
        image_topic(Fake(messages), wanted)


def test_motion_topics_need_their_type():
    source = Fake({'/odometry': odometry(0), '/twist': odometry(0)})
    assert sources.motion_topics(source) == ['/odometry']


def test_replayed_topics_leave_out_ground_truth():
    source = Fake({'/image': raw_image(0), '/truth/range': depth(), '/odometry': odometry(0)})
    assert replayed_topics(source) == {'/image': 'image', '/odometry': 'odometry'}


def test_replayed_pair_of_cameras():
    source = Fake({'/top/image': raw_image(0), '/bottom/image': raw_image(0)})
    assert replayed_topics(source) == {'/top/image': 'top/image', '/bottom/image': 'bottom/image'}


def test_only_image_topic_is_replayed_under_the_usual_name():
    source = Fake({'/cam/compressed': jpeg_image(0), '/odometry': odometry(0)})
    assert replayed_topics(source) == {'/odometry': 'odometry',
                                       '/cam/compressed': 'image/compressed'}
    source = Fake({'/image': raw_image(0), '/rear': raw_image(0)})
    assert replayed_topics(source, '/rear') == {'/rear': 'image'}
