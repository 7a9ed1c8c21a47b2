"""What an autopilot gets by MAVLink, and when."""
from __future__ import annotations

import socket
import threading
import time

from sphstereo_ros.mavlink.encoding import Decoder


class Autopilot:
    """Listens on a UDP port of this machine in a thread of its own; a context manager.

    It says nothing, so stamps come as they are.

    Raises
    ------
    MissingLibraryError
        without pymavlink

    """

    def __init__(self) -> None:
        self._decoder = Decoder()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(('127.0.0.1', 0))
        self._socket.settimeout(0.5)
        self._stopped = False
        # Stamp and monotonic time of arrival of each OBSTACLE_DISTANCE, nanoseconds.
        self.arrivals: list[tuple[int, int]] = []
        self._thread = threading.Thread(target=self._run, name='autopilot', daemon=True)

    @property
    def url(self) -> str:
        """Where a node sends to."""
        return f'udpout:127.0.0.1:{self._socket.getsockname()[1]}'

    def __enter__(self) -> Autopilot:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped = True
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._stopped:
            try:
                data = self._socket.recv(65536)
            except TimeoutError:
                continue
            now = time.monotonic_ns()
            self.arrivals += [(1000 * message.time_usec, now)
                              for message in self._decoder.messages(data)
                              if message.get_type() == 'OBSTACLE_DISTANCE']
