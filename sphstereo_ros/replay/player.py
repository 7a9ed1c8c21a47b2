"""Replay without ROS: what is published when, and what the clock says meanwhile."""
from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from sphstereo_ros.replay.records import COMPRESSED, IMAGE, Source
from sphstereo_ros.ros.messages import SECOND

# Real seconds between two messages on /clock.
TICK = 0.01
# A replay that is this late (seconds) goes on from there, instead of hurrying after.
LATE = 0.5
# Real seconds that are not worth a sleep.
SOON = 1e-6
DEFAULT_PERIOD = SECOND // 10


@dataclass(frozen=True)
class Due:
    """A message to be published.

    at : real seconds after the start; clock : what /clock says then, nanoseconds;
    topic : relative name; cdr : the message, serialised, its stamp shifted by whole passes
    """

    at: float
    clock: int
    topic: str
    kind: str
    cdr: bytes


def _stamp_format(cdr: bytes) -> str:
    return '<iI' if cdr[1] & 1 else '>iI'


def stamp_of(cdr: bytes) -> int:
    """Stamp (nanoseconds) of a serialised message that begins with a std_msgs/Header."""
    sec, nanosec = struct.unpack_from(_stamp_format(cdr), cdr, 4)
    return int(sec) * SECOND + int(nanosec)


def with_stamp(cdr: bytes, stamp: int) -> bytes:
    """Return the serialised message with another stamp in its std_msgs/Header."""
    changed = bytearray(cdr)
    struct.pack_into(_stamp_format(cdr), changed, 4, *divmod(stamp, SECOND))
    return bytes(changed)


class _Pass:
    """How long one pass lasts, so that the next follows at the same pace."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._stamps: list[int] = []
        self._images = 0

    def add(self, time: int, stamp: int, is_image: bool) -> None:
        self._times = [min([time, *self._times]), max([time, *self._times])]
        self._stamps = [min([stamp, *self._stamps]), max([stamp, *self._stamps])]
        self._images += is_image

    @property
    def length(self) -> int:
        """Nanoseconds from the first message to that of the next pass; 0 if there was none."""
        if not self._times:
            return 0
        span = max(self._times[1] - self._times[0], self._stamps[1] - self._stamps[0])
        return span + (span // (self._images - 1) if self._images > 1 and span else DEFAULT_PERIOD)


def schedule(source: Source, names: Mapping[str, str], rate: float = 1.0, loop: bool = False,
             start_offset: float = 0.0) -> Iterator[Due]:
    """Plan the replay.

    names : topic in the source → relative name to publish by; rate : times real time; loop :
    without end; start_offset : seconds of the beginning to leave out, in each pass
    """
    begin = None
    shift = 0
    while True:
        this_pass = _Pass()
        first = None
        for record in source.records(names):
            first = record.time if first is None else first
            cdr = record.serialised()
            if record.time - first < round(start_offset * SECOND) or len(cdr) < 12:
                continue
            begin = record.time if begin is None else begin
            stamp = stamp_of(cdr)
            this_pass.add(record.time, stamp, record.kind in (IMAGE, COMPRESSED))
            clock = record.time + shift
            yield Due((clock - begin) / SECOND / rate, clock, names[record.topic], record.kind,
                      with_stamp(cdr, stamp + shift) if shift else cdr)
        shift += this_pass.length
        if not loop or this_pass.length == 0:
            return


@dataclass
class Player:
    """Publishes a schedule in its time.

    publish, publish_clock : what to call; rate : that of the schedule; stopped : asked all the
    time; monotonic, sleep : of real time, seconds
    """

    publish: Callable[[Due], None]
    publish_clock: Callable[[int], None]
    rate: float = 1.0
    stopped: Callable[[], bool] = lambda: False
    monotonic: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep

    def play(self, plan: Iterator[Due]) -> int:
        """Play to the end, or until stopped; returns how many messages were published."""
        start = self.monotonic()
        done = 0
        for due in plan:
            start += self._wait(due, start)
            if self.stopped():
                break
            self.publish_clock(due.clock)
            self.publish(due)
            done += 1
        return done

    def _wait(self, due: Due, start: float) -> float:
        """Wait until `due`, with the clock going on; returns by how much to delay the rest."""
        while not self.stopped():
            left = due.at - (self.monotonic() - start)
            if left <= SOON:
                return -left if -left > LATE else 0.0
            if left > TICK:
                self.publish_clock(due.clock - round(left * self.rate * SECOND))
            self.sleep(min(left, TICK))
        return 0.0
