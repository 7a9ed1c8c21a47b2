"""What is common to all conversions: how messages are made, stamps and headers.

Messages are read by their field names alone, so those of rclpy and those read from a bag serve
alike; they are made through a `MessageFactory`, of which there is one for either world.
"""
from __future__ import annotations

from typing import Any, Protocol

from sphstereo_ros.core.frames import Drop, FrameKey

SECOND = 10**9


class MessageFactory(Protocol):
    """Makes messages: `make('std_msgs/msg/Header', frame_id='camera')`.

    Fields that are not given have their default. Numbers of an array field are given as a
    one-dimensional NumPy array of the field's type, messages of one as a list, `byte` as int.
    """

    def __call__(self, name: str, /, **fields: Any) -> Any:
        """Make a message of type `name` (package/msg/Type)."""


def nanoseconds(stamp: Any) -> int:
    """builtin_interfaces/Time → nanoseconds."""
    return int(stamp.sec) * SECOND + int(stamp.nanosec)


def time_message(make: MessageFactory, nanoseconds: int) -> Any:
    """Nanoseconds → builtin_interfaces/Time."""
    sec, nanosec = divmod(nanoseconds, SECOND)
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def frame_key(header: Any) -> FrameKey:
    """std_msgs/Header → what names the frame."""
    return FrameKey(nanoseconds(header.stamp), str(header.frame_id))


def header(make: MessageFactory, key: FrameKey) -> Any:
    """What names the frame → std_msgs/Header."""
    return make('std_msgs/msg/Header', stamp=time_message(make, key.stamp), frame_id=key.frame_id)


def bad_stamp(header: Any) -> Drop | None:
    """Drop where the stamp is not a time (a second has no more than 10⁹ nanoseconds)."""
    if int(header.stamp.nanosec) >= SECOND:
        return Drop('invalid_stamp', f'{header.stamp.nanosec} nanoseconds')
    return None
