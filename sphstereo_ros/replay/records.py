"""What all inputs have in common: recorded messages in time order."""
from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from sphstereo_ros.core.frames import Drop
from sphstereo_ros.replay.bag_messages import TYPESTORE

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED = 'sensor_msgs/msg/CompressedImage'

# Stamp of the first frame of what has no stamps: zero would mean "no time" to ROS.
FIRST_STAMP = 10**9


class BadInput(ValueError):
    """The input cannot be used; the message is one clear line for the user."""


@dataclass(frozen=True)
class Record:
    """One message as it was recorded.

    time : when it was received, nanoseconds; kind : package/msg/Type; either `cdr` (serialised)
    or `given` (the message itself) is there
    """

    topic: str
    kind: str
    time: int
    cdr: bytes | memoryview | None = None
    given: Any = None

    def message(self) -> Any | Drop:
        """Return the message, or a Drop where its bytes do not make one."""
        if self.cdr is None:
            return self.given
        try:
            return TYPESTORE.deserialize_cdr(self.cdr, self.kind)
        except Exception as error:  # damaged bytes fail in many ways
            return Drop('undecodable_message', f'{self.topic}: {type(error).__name__} {error}')

    def serialised(self) -> bytes:
        """Return the message as CDR."""
        if self.cdr is None:
            return bytes(TYPESTORE.serialize_cdr(self.given, self.kind))
        return bytes(self.cdr)


class Source(Protocol):
    """A bag, a video or a folder of frames."""

    @property
    def topics(self) -> Mapping[str, str]:
        """Type of the messages of each topic."""

    @property
    def problem(self) -> str:
        """What broke the reading off, empty if nothing did; known after `records` ended."""

    def count(self, topics: Collection[str]) -> int:
        """How many records of these topics there are, as far as known."""

    def records(self, topics: Collection[str]) -> Iterator[Record]:
        """Read the records of these topics in time order; ends where the input is broken."""
