"""Results into one mcap file that rosbags, rosbag2, mcap and Foxglove read."""
from __future__ import annotations

from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.writer import CompressionType, Writer

from sphstereo_ros.interrupts import uninterrupted
from sphstereo_ros.replay.bag_messages import TYPESTORE
from sphstereo_ros.replay.records import BadInput


@cache
def schema_text(kind: str) -> bytes:
    """Definition of a message type as ROS 2 writes it (ros2msg)."""
    return TYPESTORE.generate_msgdef(kind, ros_version=2)[0].encode()


class McapOutput:
    """An mcap file being written; a context manager.

    Chunks go to the file as they fill up, so what was computed survives an interruption; leaving
    the context, even by an exception, completes the file.
    """

    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open('wb')
        except OSError as error:
            raise BadInput(f'cannot write {path}: {error.strerror}') from error
        self._writer = Writer(self._file, compression=CompressionType.ZSTD)
        self._writer.start(profile='ros2', library='sphstereo_ros')
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequences: dict[str, int] = {}
        self.written = 0

    def __enter__(self) -> McapOutput:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        self.close()

    def write(self, topic: str, stamp: int, message: Any) -> None:
        """Write a message; `stamp` (nanoseconds) orders the file."""
        kind = message.__msgtype__
        self.write_serialised(topic, kind, stamp, bytes(TYPESTORE.serialize_cdr(message, kind)))

    def write_serialised(self, topic: str, kind: str, stamp: int, data: bytes) -> None:
        """Write a message that is serialised as CDR."""
        time = max(stamp, 0)
        with uninterrupted():  # a chunk that is interrupted on its way to the file is lost
            self._sequences[topic] = self._sequences.get(topic, 0) + 1
            self._writer.add_message(self._channel(topic, kind), time, data, time,
                                     self._sequences[topic])
            self.written += 1

    def _channel(self, topic: str, kind: str) -> int:
        if topic not in self._channels:
            if kind not in self._schemas:
                self._schemas[kind] = self._writer.register_schema(kind, 'ros2msg',
                                                                   schema_text(kind))
            self._channels[topic] = self._writer.register_channel(topic, 'cdr',
                                                                  self._schemas[kind])
        return self._channels[topic]

    def close(self) -> None:
        """Complete the file."""
        if not self._file.closed:
            with uninterrupted():
                try:
                    self._writer.finish()  # type: ignore[no-untyped-call]
                finally:
                    self._file.close()
