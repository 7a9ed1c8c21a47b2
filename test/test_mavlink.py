"""MAVLink as an autopilot gets it: bytes on real sockets, decoded with pymavlink."""
from __future__ import annotations

import math
import os
import pty
import re
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

mavlink = pytest.importorskip('pymavlink.dialects.v20.ardupilotmega')

from sectors import FORWARD, LEFT, RIGHT, STAMP, sectors  # noqa: E402

from sphstereo_ros.core.config import MavlinkConfig  # noqa: E402
from sphstereo_ros.core.sectors import SECTORS, ObstacleSectors  # noqa: E402
from sphstereo_ros.mavlink import link as link_module  # noqa: E402
from sphstereo_ros.mavlink.encoding import Decoder, MissingLibraryError  # noqa: E402
from sphstereo_ros.mavlink.link import MavlinkLink  # noqa: E402
from sphstereo_ros.mavlink.timesync import TimeSync  # noqa: E402
from sphstereo_ros.mavlink.transports import Address, parse_url  # noqa: E402
from sphstereo_ros.ros.monitor import ERROR, OK, WARN, Monitor  # noqa: E402

PATIENCE = 10.0
OFFSET = 1_699_999_000_000_000_000  # our clock less the autopilot's, nanoseconds


def until(condition: Callable[[], Any], what: str) -> Any:
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, f'waited in vain for {what}'
        time.sleep(0.005)
    return found


class Autopilot:
    """The other end: keeps what comes, decoded, and writes what it is told to."""

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self.damaged = 0
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._decoder = mavlink.MAVLink(None)
        self._decoder.robust_parsing = True
        self._closed = False

    def listen(self) -> None:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closed:
            try:
                data = self._read()
            except (TimeoutError, BlockingIOError):
                continue
            except OSError:
                return
            for message in self._decoder.parse_buffer(data) or []:
                if message.get_type() == 'BAD_DATA':
                    self.damaged += 1
                self.messages.append(message)

    def of(self, kind: str) -> list[Any]:
        return [m for m in self.messages if m.get_type() == kind]

    def wait(self, kind: str, count: int = 1) -> list[Any]:
        return until(lambda: self.of(kind)[count - 1:] and self.of(kind), f'{count} {kind}')

    def say(self, message: Any) -> None:
        self._write(message.pack(self._mav))

    def close(self) -> None:
        self._closed = True
        self._shut()
        self._thread.join(PATIENCE)

    def _read(self) -> bytes:
        raise NotImplementedError

    def _write(self, data: bytes) -> None:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError


class UdpAutopilot(Autopilot):
    def __init__(self) -> None:
        super().__init__()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(('127.0.0.1', 0))
        self._socket.settimeout(0.1)
        self.sender: Any = None
        self.url = f'udpout:127.0.0.1:{self._socket.getsockname()[1]}'
        self.listen()

    def _read(self) -> bytes:
        data, self.sender = self._socket.recvfrom(65536)
        return data

    def _write(self, data: bytes) -> None:
        until(lambda: self.sender, 'a sender')
        self._socket.sendto(data, self.sender)

    def _shut(self) -> None:
        self._socket.close()


class TcpAutopilot(Autopilot):
    def __init__(self, port: int = 0) -> None:
        super().__init__()
        self._server = socket.create_server(('127.0.0.1', port))
        self._server.settimeout(PATIENCE)
        self.port = self._server.getsockname()[1]
        self.url = f'tcp:127.0.0.1:{self.port}'
        self._socket: socket.socket | None = None
        self.listen()

    def _read(self) -> bytes:
        if self._socket is None:
            self._socket, _ = self._server.accept()
            self._socket.settimeout(0.1)
        data = self._socket.recv(65536)
        if not data:
            raise ConnectionResetError
        return data

    def _write(self, data: bytes) -> None:
        until(lambda: self._socket, 'a connection').sendall(data)

    def _shut(self) -> None:
        for each in (self._socket, self._server):
            if each is not None:
                each.close()


class SerialAutopilot(Autopilot):
    """The far side of a pseudo-terminal."""

    def __init__(self) -> None:
        super().__init__()
        self._far, self._near = pty.openpty()
        os.set_blocking(self._far, False)
        self.url = f'{os.ttyname(self._near)},57600'
        self.listen()

    def _read(self) -> bytes:
        try:
            return os.read(self._far, 4096)
        except BlockingIOError:
            time.sleep(0.01)
            raise

    def _write(self, data: bytes) -> None:
        os.write(self._far, data)

    def _shut(self) -> None:
        os.close(self._near)


class Told(Monitor):
    """Counts, and says so."""

    def __init__(self) -> None:
        super().__init__('mavlink')

    def drops(self) -> Counter[str]:
        return Counter({key.removeprefix('drops.'): int(str(n))
                        for key, n in self.status().values.items() if key.startswith('drops.')})


@pytest.fixture
def told() -> Told:
    return Told()


Connect = Callable[..., MavlinkLink]


@pytest.fixture
def connect(told: Told) -> Iterator[Connect]:
    links: list[MavlinkLink] = []

    def start(url: str, stall: float = 0.5, **more: Any) -> MavlinkLink:
        made = MavlinkLink(replace(MavlinkConfig(url=url), **more), stall, told)
        links.append(made)
        made.start()
        return made
    yield start
    for made in links:
        made.close()
        assert not made._thread.is_alive()


PEERS = [UdpAutopilot, TcpAutopilot, SerialAutopilot]


@pytest.fixture(params=PEERS, ids=['udp', 'tcp', 'serial'])
def autopilot(request: pytest.FixtureRequest) -> Iterator[Autopilot]:
    if request.param is SerialAutopilot:
        pytest.importorskip('serial')
    with closing(request.param()) as peer:
        yield peer


def sent(autopilot: Autopilot, link: MavlinkLink, found: ObstacleSectors) -> Any:
    """What the autopilot gets of sectors."""
    autopilot.wait('HEARTBEAT')
    before = len(autopilot.of('OBSTACLE_DISTANCE'))
    link.send(found)
    return autopilot.wait('OBSTACLE_DISTANCE', before + 1)[before]


# OBSTACLE_DISTANCE, field by field

def test_obstacle_distance_on_the_wire(autopilot: Autopilot, connect: Connect,
                                       told: Told) -> None:
    link = connect(autopilot.url)
    message = sent(autopilot, link, sectors(
        {LEFT: 5.0, FORWARD: 7.25, 0: 20.0}, free=[RIGHT], too_close=[40]))
    assert message.get_msgId() == 330
    assert message.get_header().mlen > 158  # with MAVLink 2's fields
    assert (message.get_srcSystem(), message.get_srcComponent()) == (1, 196)
    assert len(message.distances) == 72
    assert (message.increment, message.increment_f, message.angle_offset) == (5, 5.0, -20.0)
    assert (message.frame, message.min_distance, message.max_distance) == (12, 30, 2000)

    def towards(degrees: float) -> int:
        """The distance in a direction, clockwise from forward, as both autopilots read it."""
        return message.distances[round((degrees - message.angle_offset)
                                       / message.increment_f) % 72]
    assert towards(-90) == 500  # on the left
    assert towards(0) == 725
    assert towards(90) == 2001  # free: maximum + 1
    assert towards(180) == 30  # too close: the minimum, not 0
    assert towards(-20) == 1999  # at the maximum: less, not free
    assert towards(45) == 65535
    assert Counter(message.distances)[65535] == SECTORS - 5
    assert message.time_usec == STAMP // 1000  # the autopilot's clock is not known
    assert autopilot.damaged == 0
    until(lambda: told.status().values['frames_out'] == 1, 'the count')
    assert told.status().level == OK


def test_points_come_before_the_sectors_and_belong_together(autopilot: Autopilot,
                                                            connect: Connect) -> None:
    """ArduPilot forgets all it knows at the first point of a new time."""
    link = connect(autopilot.url, send_3d=True, points_3d=3)
    found = sectors({LEFT: 5.0, FORWARD: 7.0, 40: 9.0, 41: 8.0}, too_close=[RIGHT])
    sent(autopilot, link, found)
    of_obstacles = [m for m in autopilot.messages if m.get_type().startswith('OBSTACLE')]
    assert [m.get_type() for m in of_obstacles] == [*['OBSTACLE_DISTANCE_3D'] * 3,
                                                    'OBSTACLE_DISTANCE']
    points = of_obstacles[:3]
    np.testing.assert_allclose([(p.x, p.y, p.z) for p in points],
                               [[0, 0.3, 0], [0, -5, 0], [7, 0, 0]], atol=1e-5)
    for point in points:
        assert (point.frame, point.obstacle_id) == (12, 65535)
        length = math.hypot(point.x, point.y, point.z)
        assert point.min_distance <= length <= point.max_distance  # else ArduPilot ignores it
    assert len({p.time_boot_ms for p in points}) == 1
    assert points[0].time_boot_ms == STAMP // 10**6 % 2**32


def test_it_is_numbered_without_gaps(connect: Connect) -> None:
    with closing(UdpAutopilot()) as autopilot:
        link = connect(autopilot.url)
        for i in range(5):
            sent(autopilot, link, sectors({i: 5.0}))
        numbers = [m.get_seq() for m in autopilot.messages]
        assert numbers == [(numbers[0] + i) % 256 for i in range(len(numbers))]


def test_other_identities(connect: Connect) -> None:
    with closing(UdpAutopilot()) as autopilot:
        connect(autopilot.url, system_id=7, component_id=158)
        beat, *_ = autopilot.wait('HEARTBEAT')
        assert (beat.get_srcSystem(), beat.get_srcComponent()) == (7, 158)


# Heartbeat, silence

def test_heartbeat_of_an_onboard_computer_once_a_second(autopilot: Autopilot,
                                                        connect: Connect) -> None:
    link = connect(autopilot.url, stall=5.0)
    first, *_ = autopilot.wait('HEARTBEAT')
    begin = time.monotonic()
    assert (first.type, first.autopilot) == (18, 8)  # ONBOARD_CONTROLLER, INVALID
    assert first.system_status == mavlink.MAV_STATE_STANDBY
    sent(autopilot, link, sectors())
    second = autopilot.wait('HEARTBEAT', 2)[1]
    assert 0.5 < time.monotonic() - begin < 3.0
    assert second.system_status == mavlink.MAV_STATE_ACTIVE


def test_silence_when_nothing_new_comes(connect: Connect) -> None:
    """A heartbeat goes on, and tells that no obstacles are sent; nothing is repeated."""
    with closing(UdpAutopilot()) as autopilot:
        link = connect(autopilot.url, stall=0.2)
        sent(autopilot, link, sectors({LEFT: 5.0}))
        beats = len(autopilot.of('HEARTBEAT'))
        last = autopilot.wait('HEARTBEAT', beats + 2)[-1]
        assert last.system_status == mavlink.MAV_STATE_STANDBY
        assert len(autopilot.of('OBSTACLE_DISTANCE')) == 1


# Clocks

def test_questions_for_our_time_are_answered(autopilot: Autopilot, connect: Connect) -> None:
    connect(autopilot.url)
    autopilot.wait('HEARTBEAT')
    before = time.time_ns()
    autopilot.say(mavlink.MAVLink_timesync_message(0, 4711))
    answer = until(lambda: [m for m in autopilot.of('TIMESYNC') if m.ts1 == 4711], 'an answer')[0]
    assert before <= answer.tc1 <= time.time_ns()


def test_time_is_the_autopilots_once_it_answers(connect: Connect) -> None:
    with closing(UdpAutopilot()) as autopilot:
        link = connect(autopilot.url)
        question, *_ = autopilot.wait('TIMESYNC')
        assert question.tc1 == 0
        assert sent(autopilot, link, sectors()).time_usec == STAMP // 1000
        autopilot.say(mavlink.MAVLink_timesync_message(question.ts1 - OFFSET, question.ts1))
        until(lambda: link._sync.offset is not None, 'the answer to arrive')
        told = sent(autopilot, link, sectors()).time_usec
        # Half of the way there and back is not known.
        assert abs(told - (STAMP - OFFSET) // 1000) < 0.25e6


def timesync(answer: int, asked: int, component: int = 1) -> Any:
    message = mavlink.MAVLink_timesync_message(answer, asked)
    message._header = mavlink.MAVLink_header(111, srcSystem=1, srcComponent=component)
    return message


def test_the_quickest_answer_tells_the_time() -> None:
    sync = TimeSync()
    for sent_at, back_at, wrong in ((10**9, 10**9 + 4_000_000, 70_000), (2 * 10**9,
                                    2 * 10**9 + 1_000_000, 0), (3 * 10**9, 3 * 10**9 + 9_000_000,
                                                                -50_000)):
        asked = sync.ask(sent_at)
        middle = (sent_at + back_at) // 2
        assert not sync.take(timesync(middle + 5 * 10**9 + wrong, asked), back_at)
    assert sync.offset == 5 * 10**9
    assert sync.time_usec(10**9) == 6 * 10**6


def test_answers_of_others_and_late_ones_tell_nothing() -> None:
    sync = TimeSync()
    asked = sync.ask(10**9)
    sync.take(timesync(5, asked, component=190), asked + 1000)
    sync.take(timesync(5, asked + 1), asked + 1000)
    sync.take(timesync(5, asked), asked + 10**9)
    assert sync.offset is None
    assert sync.time_usec(STAMP) == STAMP // 1000


def test_recorded_stamps_stay_as_they_are() -> None:
    """Before the autopilot's start there is no time of its clock."""
    sync = TimeSync()
    sync.take(timesync(10**9, sync.ask(STAMP)), STAMP)
    assert sync.time_usec(STAMP - 2 * 10**9) == (STAMP - 2 * 10**9) // 1000
    assert sync.time_usec(STAMP) == 10**6


# What goes wrong

def test_it_connects_again_when_the_other_side_closes(connect: Connect, told: Told) -> None:
    autopilot = TcpAutopilot()
    link = connect(autopilot.url)
    sent(autopilot, link, sectors({LEFT: 5.0}))
    autopilot.close()
    until(lambda: told.drops()['mavlink_lost'], 'the loss')
    link.send(sectors({LEFT: 1.0}))
    until(lambda: told.drops()['mavlink_not_connected'] == 1, 'a drop')
    status = told.status()
    assert status.level == ERROR
    assert str(autopilot.port) in status.message
    with closing(TcpAutopilot(autopilot.port)) as again:
        message = sent(again, link, sectors({LEFT: 3.0}))
        assert message.distances[LEFT] == 300  # and not what could not be sent
        assert len(again.of('OBSTACLE_DISTANCE')) == 1
    assert told.drops()['internal_error'] == 0


def test_it_waits_for_whoever_is_not_there_yet(connect: Connect, told: Told) -> None:
    with socket.create_server(('127.0.0.1', 0)) as server:
        port = server.getsockname()[1]
    link = connect(f'tcp:127.0.0.1:{port}')
    until(lambda: told.drops()['mavlink_no_connection'] >= 2, 'attempts')
    with closing(TcpAutopilot(port)) as autopilot:
        assert sent(autopilot, link, sectors({LEFT: 5.0})).distances[LEFT] == 500
    assert told.status().values['frames_out'] == 1


def test_an_absent_port_is_tried_again_and_again(connect: Connect, told: Told) -> None:
    pytest.importorskip('serial')
    connect('/dev/no_such_port,57600')
    until(lambda: told.drops()['mavlink_no_connection'] >= 2, 'attempts')
    assert told.status().level == ERROR
    assert '/dev/no_such_port' in told.status().message


def test_listening_waits_for_somebody_to_send(connect: Connect, told: Told) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(('127.0.0.1', 0))
        port = probe.getsockname()[1]
    link = connect(f'udpin:127.0.0.1:{port}')
    link.send(sectors())
    until(lambda: told.drops()['mavlink_not_connected'] == 1, 'a drop')
    with closing(UdpAutopilot()) as autopilot:
        autopilot.sender = ('127.0.0.1', port)
        autopilot.say(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
        assert sent(autopilot, link, sectors({LEFT: 5.0})).distances[LEFT] == 500
        until(lambda: told.status().values.get('autopilot_heard_s', 'never') != 'never', 'it')


def test_nobody_there_is_a_warning(connect: Connect, told: Told,
                                   monkeypatch: pytest.MonkeyPatch) -> None:
    """By UDP nothing else tells that nobody listens."""
    monkeypatch.setattr(link_module, 'DEAF', 0.05)
    with closing(UdpAutopilot()) as autopilot:
        connect(autopilot.url)
        until(lambda: 'no autopilot heard' in told.status().message, 'the warning')
        assert told.status().level == WARN
        monkeypatch.setattr(link_module, 'DEAF', 60.0)
        until(lambda: told.status().level == OK, 'its end')


def test_noise_does_no_harm(autopilot: Autopilot, connect: Connect, told: Told) -> None:
    link = connect(autopilot.url)
    autopilot.wait('HEARTBEAT')
    autopilot._write(bytes(range(256)) * 4)
    autopilot.say(mavlink.MAVLink_timesync_message(0, 12))
    autopilot.say(mavlink.MAVLink_timesync_message(0, 13))
    until(lambda: [m for m in autopilot.of('TIMESYNC') if m.ts1 == 13], 'an answer')
    assert sent(autopilot, link, sectors({LEFT: 5.0})).distances[LEFT] == 500
    assert told.drops()['internal_error'] == 0


def test_who_takes_nothing_gets_nothing_old(connect: Connect, told: Told) -> None:
    """A peer that does not read is left, and what waited meanwhile is not sent to the next."""
    with socket.socket() as server:
        server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        server.bind(('127.0.0.1', 0))
        server.listen()
        link = connect(f'tcp:127.0.0.1:{server.getsockname()[1]}', send_3d=True,
                       points_3d=72)
        deaf, _ = server.accept()
        with deaf:
            everywhere = sectors(dict.fromkeys(range(SECTORS), 5.0))

            def gives_up() -> int:
                link.send(everywhere)
                return told.drops()['mavlink_lost'] + told.drops()['mavlink_late']
            until(gives_up, 'an end')
            assert told.drops()['mavlink_superseded'] > 0


def test_only_the_newest_waits(connect: Connect, told: Told,
                               monkeypatch: pytest.MonkeyPatch) -> None:
    may_open = threading.Event()
    really = link_module.open_transport

    def slowly(address: Address) -> Any:
        assert may_open.wait(PATIENCE)
        return really(address)
    monkeypatch.setattr(link_module, 'open_transport', slowly)
    with closing(UdpAutopilot()) as autopilot:
        link = connect(autopilot.url, stall=10.0)
        for metres in (3.0, 4.0, 5.0):
            link.send(sectors({LEFT: metres}))
        may_open.set()
        assert autopilot.wait('OBSTACLE_DISTANCE')[0].distances[LEFT] == 500
        assert told.drops()['mavlink_superseded'] == 2


def test_what_waited_too_long_is_not_sent(connect: Connect, told: Told,
                                          monkeypatch: pytest.MonkeyPatch) -> None:
    may_open = threading.Event()
    really = link_module.open_transport

    def slowly(address: Address) -> Any:
        assert may_open.wait(PATIENCE)
        return really(address)
    monkeypatch.setattr(link_module, 'open_transport', slowly)
    with closing(UdpAutopilot()) as autopilot:
        link = connect(autopilot.url, stall=0.05)
        link.send(sectors({LEFT: 3.0}))
        begin = time.monotonic()
        until(lambda: time.monotonic() - begin > 0.1, 'it to grow old')
        may_open.set()
        until(lambda: told.drops()['mavlink_late'] == 1, 'a drop')
        assert sent(autopilot, link, sectors({LEFT: 4.0})).distances[LEFT] == 400


# Words

@pytest.mark.parametrize(('url', 'address'), [
    ('udpout:192.168.1.2:14550', Address('udpout', '192.168.1.2', 14550)),
    ('udpin:0.0.0.0:14540', Address('udpin', '0.0.0.0', 14540)),
    ('tcp:autopilot.local:5760', Address('tcp', 'autopilot.local', 5760)),
    ('tcp:[::1]:5760', Address('tcp', '::1', 5760)),
    ('/dev/ttyAMA0,115200', Address('serial', '/dev/ttyAMA0', 115200)),
    ('/dev/ttyACM0', Address('serial', '/dev/ttyACM0', 921600))])
def test_urls(url: str, address: Address) -> None:
    assert parse_url(url) == address


@pytest.mark.parametrize('url', ['autopilot', 'udp:1.2.3.4:14550', 'udpout:14550', 'tcp::5760',
                                 'tcp:host:', 'tcp:host:0', 'tcp:host:70000', 'udpin:host:٣',
                                 'http://host:80', '/dev/ttyACM0,fast', '/dev/ttyACM0,0'])
def test_wrong_urls(url: str) -> None:
    with pytest.raises(ValueError, match=re.escape(url)) as refused:
        parse_url(url)
    assert '\n' not in str(refused.value)


def test_without_pymavlink_it_says_so(monkeypatch: pytest.MonkeyPatch, told: Told) -> None:
    monkeypatch.setitem(__import__('sys').modules, 'pymavlink.dialects.v20.ardupilotmega', None)
    with pytest.raises(MissingLibraryError, match='pip install pymavlink'):
        MavlinkLink(MavlinkConfig(url='udpout:127.0.0.1:14550'), 0.5, told)
    with pytest.raises(MissingLibraryError):
        Decoder()
