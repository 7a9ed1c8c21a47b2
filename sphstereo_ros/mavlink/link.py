"""The connection to an autopilot: its own thread, which connects again whenever it must."""
from __future__ import annotations

import contextlib
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from sphstereo_ros.core.config import MavlinkConfig
from sphstereo_ros.core.frames import Drop
from sphstereo_ros.core.sectors import ObstacleSectors
from sphstereo_ros.mavlink.encoding import Decoder, Encoder
from sphstereo_ros.mavlink.timesync import AUTOPILOT, TimeSync
from sphstereo_ros.mavlink.transports import Transport, open_transport, parse_url

# Of diagnostic_msgs/DiagnosticStatus.
WARN, ERROR = 1, 2
PERIOD = 1.0  # seconds between heartbeats, and between questions for the time
FIRST_WAIT, LONGEST_WAIT = 0.2, 5.0  # seconds between attempts to connect
DEAF = 5.0  # seconds without a message of an autopilot
# A stream that takes nothing for so long is dead, seconds.
STUCK = 1.0
# Bytes under way beside which a message may be sent: with more of them it would grow old.
BACKLOG = 256
BACKLOG_CHECK = 0.005


class Told(Protocol):
    """Who is told what becomes of messages (`sphstereo_ros.ros.monitor.Monitor`)."""

    clock: Callable[[], float]

    def arrived(self) -> float:
        """Obstacles are to be sent; returns the time."""

    def published(self, arrival: float, values: dict[str, object] | None = None) -> None:
        """They were sent."""

    def dropped(self, drop: Drop) -> None:
        """They, or something else, failed."""

    def fault(self, text: str, level: int = ERROR) -> None:
        """What keeps all of them from being sent, or from being heard; '' = nothing."""


@dataclass(frozen=True)
class _Pending:
    sectors: ObstacleSectors
    arrival: float
    queued: float


class MavlinkLink:
    """Sends the newest obstacles, and a heartbeat; answers and asks for the time.

    config : its url is not empty
    stall : seconds after which obstacles are too old to be sent
    told : counts what is sent and what is not

    Raises
    ------
    ValueError
        for a url that is none
    MissingLibraryError
        without pymavlink

    """

    def __init__(self, config: MavlinkConfig, stall: float, told: Told) -> None:
        self._address = parse_url(config.url)
        self._config = config
        self._stall = stall
        self._told = told
        self._encoder = Encoder(config.system_id, config.component_id)
        self._lock = threading.Lock()
        self._pending: _Pending | None = None
        self._last_sent = -1e9
        self._stopped = False
        self._transport: Transport | None = None
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._wait, self._next_attempt = FIRST_WAIT, 0.0
        self._reset()
        self._thread = threading.Thread(target=self._run, name='mavlink', daemon=True)

    def start(self) -> None:
        """Connect, and go on connecting."""
        self._thread.start()

    def send(self, sectors: ObstacleSectors, arrival: float | None = None) -> None:
        """Send soon, without waiting; what still waits is replaced.

        arrival : when the frame came (monotonic seconds), for the latency that is told
        """
        now = self._told.arrived()
        with self._lock:
            replaced = self._pending is not None
            self._pending = _Pending(sectors, now if arrival is None else arrival, now)
        if replaced:
            self._told.dropped(Drop('mavlink_superseded', 'a newer one came before it was sent'))
        self._wake_up()

    def close(self) -> None:
        """End the thread and the connection."""
        self._stopped = True
        self._wake_up()
        if self._thread.is_alive():
            self._thread.join(5.0)

    def _wake_up(self) -> None:
        with contextlib.suppress(OSError):  # enough of them are there, or it is closed
            self._wake.send(b'.')

    # All below runs in the link's thread.

    def _reset(self) -> None:
        """A connection begins: nothing of the last one holds."""
        self._decoder = Decoder()
        self._sync = TimeSync()
        self._out = bytearray()
        self._next_beat = 0.0
        self._waiting, self._moved_at = 0, self._told.clock()
        self._opened_at = self._told.clock()
        self._heard_at: float | None = None
        self._answers: list[int] = []

    def _run(self) -> None:
        while not self._stopped:
            try:
                self._step()
            except OSError as error:
                self._lose(error)
            except Exception as error:
                self._told.dropped(Drop('internal_error', f'{type(error).__name__}: {error}'))
                self._lose(OSError(str(error)))
        if self._transport is not None:
            self._transport.close()
        self._wake.close()
        self._woken.close()

    def _step(self) -> None:
        if self._transport is None and self._told.clock() >= self._next_attempt:
            self._connect()
        if self._transport is not None and self._transport.ready:
            self._tell_whether_heard()
            self._write(self._transport)
        else:
            if self._transport is not None:
                self._told.fault(f'{self._config.url}: nobody has sent there yet')
            self._refuse_pending()
        self._rest()

    def _tell_whether_heard(self) -> None:
        last = self._opened_at if self._heard_at is None else self._heard_at
        silent = self._told.clock() - last
        self._told.fault('' if silent <= DEAF else f'{self._config.url}: no autopilot heard for '
                         f'{silent:.0f} s', WARN)

    def _connect(self) -> None:
        self._reset()
        self._transport = open_transport(self._address)
        self._wait = FIRST_WAIT

    def _lose(self, error: OSError) -> None:
        connected = self._transport is not None
        if self._transport is not None:
            self._transport.close()
            self._transport = None
        cause = 'mavlink_lost' if connected else 'mavlink_no_connection'
        self._told.fault(f'{self._config.url}: {error}')
        self._told.dropped(Drop(cause, str(error)))
        self._next_attempt = self._told.clock() + self._wait
        self._wait = min(2 * self._wait, LONGEST_WAIT)

    def _refuse_pending(self) -> None:
        with self._lock:
            pending, self._pending = self._pending, None
        if pending is not None:
            self._told.dropped(Drop('mavlink_not_connected', self._config.url))

    def _write(self, transport: Transport) -> None:
        self._flush(transport)
        self._check_flow(transport)
        if self._out:
            return
        for asked in self._answers:
            self._put(transport, self._encoder.timesync(time.time_ns(), asked))
        self._answers.clear()
        now = self._told.clock()
        if now >= self._next_beat:
            self._next_beat = now + PERIOD
            self._put(transport, self._encoder.heartbeat(
                now - self._last_sent <= self._stall))
            self._put(transport, self._encoder.timesync(0, self._sync.ask(time.time_ns())))
        self._send_pending(transport)

    def _check_flow(self, transport: Transport) -> None:
        waiting = len(self._out) + transport.backlog()
        if waiting <= BACKLOG or waiting < self._waiting:
            self._moved_at = self._told.clock()
        elif self._told.clock() - self._moved_at > STUCK:
            raise ConnectionAbortedError('the other side takes nothing')
        self._waiting = waiting

    def _send_pending(self, transport: Transport) -> None:
        if self._pending is None or self._out or transport.backlog() > BACKLOG:
            return
        with self._lock:
            pending, self._pending = self._pending, None
        now = self._told.clock()
        if now - pending.queued > self._stall:
            self._told.dropped(Drop('mavlink_late', f'waited {now - pending.queued:.2f} s'))
            return
        for message in self._messages(pending.sectors):
            self._put(transport, message)
        self._last_sent = now
        self._told.published(pending.arrival, self._values(transport, now))

    def _messages(self, sectors: ObstacleSectors) -> list[bytes]:
        time_usec = self._sync.time_usec(sectors.key.stamp)
        points = [] if not self._config.send_3d else self._encoder.obstacle_points(
            sectors, time_usec, self._config.points_3d)
        # The points first: ArduPilot forgets all sectors at the first of them.
        return [*points, self._encoder.obstacle_distance(sectors, time_usec)]

    def _values(self, transport: Transport, now: float) -> dict[str, object]:
        offset = self._sync.offset
        return {'url': self._config.url,
                'autopilot_heard_s': 'never' if self._heard_at is None
                else f'{now - self._heard_at:.1f}',
                'clock_offset_s': 'unknown' if offset is None else f'{offset / 1e9:.4f}'}

    def _put(self, transport: Transport, message: bytes) -> None:
        if transport.datagrams:
            if transport.send(message) != len(message):
                self._told.dropped(Drop('mavlink_not_sent', 'the network takes no datagram'))
            return
        self._out += message
        self._flush(transport)

    def _flush(self, transport: Transport) -> None:
        if self._out:
            del self._out[:transport.send(bytes(self._out))]

    def _rest(self) -> None:
        """Wait for something to do, and take what was received."""
        readers: list[Any] = [self._woken]
        now, transport = self._told.clock(), self._transport
        if transport is None:
            due = self._next_attempt
        else:
            readers.append(transport)
            due = self._next_beat if transport.ready else now + PERIOD
            if self._pending is not None and not self._out:
                due = now + BACKLOG_CHECK
        writers = [transport] if self._out and transport is not None else []
        timeout = STUCK / 2 if writers else max(0.0, min(due - now, PERIOD))
        readable, _, _ = select.select(readers, writers, [], timeout)
        if self._woken in readable:
            self._woken.recv(4096)
        if transport is not None and transport in readable:
            for message in self._decoder.messages(transport.receive()):
                self._take(message)

    def _take(self, message: Any) -> None:
        if message.get_srcComponent() == AUTOPILOT:
            self._heard_at = self._told.clock()
        if message.get_type() == 'TIMESYNC' and self._sync.take(message, time.time_ns()):
            self._answers.append(message.ts1)
            del self._answers[:-4]
