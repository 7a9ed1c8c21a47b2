"""Ways for bytes to an autopilot: UDP, TCP, serial; never blocking once they are open.

pymavlink has such connections too, but they print, sleep, and hide that sending failed.
"""
from __future__ import annotations

import fcntl
import os
import socket
import struct
import termios
from dataclasses import dataclass
from typing import Any, Protocol

from sphstereo_ros.mavlink.encoding import MissingLibraryError

FORMS = ('udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT or /dev/DEVICE,BAUD')
DEFAULT_BAUD = 921600
CONNECT_TIMEOUT = 1.0
_AT_ONCE = 4096
# Small, so that nothing grows old in it.
_SEND_BUFFER = 4096


@dataclass(frozen=True)
class Address:
    """Where to; kind: udpout, udpin, tcp or serial, number: port or baud rate."""

    kind: str
    target: str
    number: int


def parse_url(url: str) -> Address:
    """Read a pymavlink connection string.

    Raises
    ------
    ValueError
        where it is none of FORMS

    """
    if url.startswith('/'):
        device, _, baud = url.partition(',')
        return Address('serial', device, _number(url, baud or str(DEFAULT_BAUD), 4_000_000))
    kind, _, rest = url.partition(':')
    if kind == 'udp':
        raise ValueError(f'{url!r}: udp may mean either: udpout sends there, udpin listens here')
    host, _, port = rest.rpartition(':')
    if kind not in ('udpout', 'udpin', 'tcp') or not host:
        raise ValueError(f'{url!r}: needs {FORMS}')
    return Address(kind, host.strip('[]'), _number(url, port, 65535))


def _number(url: str, text: str, high: int) -> int:
    number = int(text) if text.isascii() and text.isdigit() else 0
    if not 1 <= number <= high:
        raise ValueError(f'{url!r}: {text!r} is not a number from 1 to {high}')
    return number


class Transport(Protocol):
    """An open way. Errors are OSError, the peer's end is ConnectionError.

    datagrams : whether each message is sent by itself
    ready : whether there is somebody to send to
    """

    datagrams: bool

    @property
    def ready(self) -> bool:
        """See above."""

    def fileno(self) -> int:
        """For select."""

    def receive(self) -> bytes:
        """What is there, b'' for nothing."""

    def send(self, data: bytes) -> int:
        """Send; returns how many bytes were taken."""

    def backlog(self) -> int:
        """Bytes that were taken but have not left."""

    def close(self) -> None:
        """Close it."""


class Datagrams:
    """UDP to a host, or to whoever sent here last."""

    datagrams = True

    def __init__(self, address: Address) -> None:
        listen = address.kind == 'udpin'
        family, kind, protocol, _, where = socket.getaddrinfo(
            address.target, address.number, type=socket.SOCK_DGRAM)[0]
        self._socket = socket.socket(family, kind, protocol)
        self._peer = None if listen else where
        try:
            self._socket.setblocking(False)
            if listen:
                self._socket.bind(where)
        except OSError:
            self._socket.close()
            raise
        self._follow = listen

    @property
    def ready(self) -> bool:
        """Whether somebody has sent here, or it is known where to."""
        return self._peer is not None

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def receive(self) -> bytes:
        """What is there."""
        try:
            data, sender = self._socket.recvfrom(65536)
        except BlockingIOError:
            return b''
        if self._follow:
            self._peer = sender
        return data

    def send(self, data: bytes) -> int:
        """Send one datagram."""
        if self._peer is None:
            return 0
        try:
            return self._socket.sendto(data, self._peer)
        except BlockingIOError:
            return 0

    def backlog(self) -> int:
        """Datagrams leave at once."""
        return 0

    def close(self) -> None:
        """Close it."""
        self._socket.close()


class Stream:
    """Bytes in order through a file descriptor that does not block."""

    datagrams = False
    ready = True

    def __init__(self, owner: Any) -> None:
        self._owner = owner

    def fileno(self) -> int:
        """For select."""
        return int(self._owner.fileno())

    def receive(self) -> bytes:
        """What is there; to be called where select says that there is something."""
        try:
            data = os.read(self.fileno(), _AT_ONCE)
        except BlockingIOError:
            return b''
        if not data:
            raise ConnectionResetError('the other side closed the connection')
        return data

    def send(self, data: bytes) -> int:
        """Send as much as it takes now."""
        try:
            return os.write(self.fileno(), data)
        except BlockingIOError:
            return 0

    def backlog(self) -> int:
        """Bytes that have not left, or were not acknowledged."""
        waiting: tuple[int] = struct.unpack('i', fcntl.ioctl(self.fileno(), termios.TIOCOUTQ,
                                                             bytes(4)))
        return waiting[0]

    def close(self) -> None:
        """Close it."""
        self._owner.close()


def _tcp(address: Address) -> Stream:
    connection = socket.create_connection((address.target, address.number), CONNECT_TIMEOUT)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
    except OSError:
        connection.close()
        raise
    return Stream(connection)


def _serial(address: Address) -> Stream:
    try:
        import serial
    except ImportError as error:
        raise MissingLibraryError('a serial port needs pyserial: pip install pyserial') from error
    # An OSError where it is absent. Its descriptor does not block.
    return Stream(serial.Serial(address.target, address.number, timeout=0, write_timeout=0,
                                exclusive=True))


def open_transport(address: Address) -> Transport:
    """Open a way; takes CONNECT_TIMEOUT at most, a host's name apart.

    Raises
    ------
    OSError
        where it is not there (yet)
    MissingLibraryError
        for a serial port without pyserial

    """
    if address.kind == 'tcp':
        return _tcp(address)
    return _serial(address) if address.kind == 'serial' else Datagrams(address)
