"""The autopilot's clock against ours, by TIMESYNC."""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

# Answers kept; the quickest of them tells the time best.
_KEPT = 10
# An answer that took longer tells nothing, nanoseconds.
SLOWEST = 500_000_000
AUTOPILOT = 1  # MAV_COMP_ID_AUTOPILOT1


@dataclass(frozen=True)
class _Sample:
    offset: int
    round_trip: int


class TimeSync:
    """Asks for the autopilot's time and keeps the difference; nanoseconds throughout.

    Of the stamps on our side it is only known that they count from 1970, as ROS time does.
    """

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque(maxlen=_KEPT)
        self._asked = 0

    @property
    def offset(self) -> int | None:
        """The autopilot's clock less ours; None while it has not answered."""
        return min(self._samples, key=lambda s: s.round_trip).offset if self._samples else None

    def ask(self, now: int) -> int:
        """What to put into the question that is sent now."""
        self._asked = now
        return now

    def take(self, message: Any, now: int) -> bool:
        """Take a TIMESYNC; returns whether it is a question, which wants an answer."""
        if message.tc1 == 0:
            return True
        if message.ts1 == self._asked and message.get_srcComponent() == AUTOPILOT:
            self._asked = 0
            round_trip = now - message.ts1
            if 0 <= round_trip <= SLOWEST:
                middle = message.ts1 + round_trip // 2
                self._samples.append(_Sample(message.tc1 - middle, round_trip))
        return False

    def time_usec(self, stamp: int) -> int:
        """A stamp in microseconds of the autopilot's clock.

        Where that is not known, or is before the autopilot's start (recorded data), the stamp as
        it is: both autopilots tell by its size that it counts from 1970.
        """
        there = stamp + (self.offset or 0)
        return max(there if there > 0 else stamp, 0) // 1000
