"""Frames of two cameras become pairs, by their stamps alone."""
from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Literal

from .frames import Drop, Frame

Side = Literal['top', 'bottom']
SIDES: tuple[Side, Side] = ('top', 'bottom')

SECOND = 1_000_000_000
# So many frames wait for the other camera before it counts as silent.
PATIENCE = 3
# Frames that went on alone and are remembered: what comes for them later is late.
_REMEMBERED = 20


@dataclass(frozen=True)
class FramePair:
    """What both cameras saw at about the same time."""

    top: Frame
    bottom: Frame


@dataclass(frozen=True)
class LoneFrame:
    """A frame of `side` while the other camera is silent."""

    side: Side
    frame: Frame


Met = FramePair | LoneFrame | Drop


def other(side: Side) -> Side:
    """The other camera."""
    return 'bottom' if side == 'top' else 'top'


class _Stream:
    """One camera: what waits, and what it has sent so far."""

    def __init__(self) -> None:
        self.waiting: deque[Frame] = deque()
        self.newest: int | None = None
        self.silent = False
        self.alone: deque[int] = deque(maxlen=_REMEMBERED)


class Synchroniser:
    """Pairs the frames of two cameras.

    Every frame comes out exactly once: in a pair, alone while the other camera is silent, or as a
    Drop. Its causes: `SIDE_duplicate`, `SIDE_out_of_order`, `SIDE_late` (its partner went on
    alone), `SIDE_missing` (the partner of a frame of the other camera has not come), and
    `sizes_differ`. A jump backward by more than `max_gap` begins anew: `stamp_backward`.

    Pairs are those of the nearest stamps, whatever the order in which the cameras' frames come
    in, as long as the tolerance is less than half the time between frames. At most PATIENCE
    frames wait.

    tolerance, max_gap : seconds
    """

    def __init__(self, tolerance: float, max_gap: float) -> None:
        self.configure(tolerance, max_gap)
        self._streams: dict[Side, _Stream] = {side: _Stream() for side in SIDES}

    def configure(self, tolerance: float, max_gap: float) -> None:
        """Take new limits; what waits stays."""
        self._tolerance = round(tolerance * SECOND)
        self._max_gap = round(max_gap * SECOND)

    @property
    def silent(self) -> list[Side]:
        """Cameras that have sent nothing while several frames of the other came."""
        return [side for side in SIDES if self._streams[side].silent]

    def add(self, side: Side, frame: Frame) -> list[Met]:
        """Take the next frame of a camera."""
        stream, stamp = self._streams[side], frame.key.stamp
        out: list[Met] = []
        if stream.newest is not None and stamp <= stream.newest:
            if stamp == stream.newest:
                return [Drop(f'{side}_duplicate', f'{stamp} ns')]
            if stream.newest - stamp <= self._max_gap:
                return [Drop(f'{side}_out_of_order', f'by {(stream.newest - stamp) / SECOND} s')]
            out = self._restarted()
        stream = self._streams[side]
        stream.newest, stream.silent = stamp, False
        if any(abs(stamp - gone) <= self._tolerance for gone in self._streams[other(side)].alone):
            return [*out, Drop(f'{side}_late', 'its partner went on alone')]
        stream.waiting.append(frame)
        return out + self._settled()

    def flush(self) -> list[Met]:
        """Nothing more is to come for now: what still waits has no partner."""
        out: list[Met] = []
        for side, stream in self._streams.items():
            out += [self._unmet(side, frame, 'none came while it waited')
                    for frame in stream.waiting]
            stream.waiting.clear()
        return out

    def _restarted(self) -> list[Met]:
        drops: list[Met] = [Drop('stamp_backward', 'time began anew')
                            for stream in self._streams.values() for _ in stream.waiting]
        self._streams = {side: _Stream() for side in SIDES}
        return drops

    def _settled(self) -> list[Met]:
        """All that is decided now."""
        out: list[Met] = []
        top, bottom = (self._streams[side].waiting for side in SIDES)
        while top and bottom:
            out += self._heads(top, bottom)
        for side in SIDES:
            out += self._waited(side)
        return out

    def _heads(self, top: deque[Frame], bottom: deque[Frame]) -> list[Met]:
        """Pair the oldest frames of both, or give up the older one of them."""
        apart = top[0].key.stamp - bottom[0].key.stamp
        side: Side = 'bottom' if apart > 0 else 'top'
        older, newer = (bottom, top) if apart > 0 else (top, bottom)
        nearer = len(older) > 1 and abs(older[1].key.stamp - newer[0].key.stamp) < abs(apart)
        if abs(apart) > self._tolerance or nearer:
            return [self._unmet(side, older.popleft(), f'the next is {abs(apart) / SECOND:.3f} s '
                                'later')]
        pair = FramePair(top.popleft(), bottom.popleft())
        if pair.top.image.shape == pair.bottom.image.shape:
            return [pair]
        return [Drop('sizes_differ', f'{pair.top.image.shape} and {pair.bottom.image.shape}: set '
                     'stereo.working_height')] * 2

    def _waited(self, side: Side) -> list[Met]:
        """Frames whose partner cannot come any more, or has not come for too long."""
        stream, partner = self._streams[side], self._streams[other(side)]
        out: list[Met] = []
        while stream.waiting:
            stamp = stream.waiting[0].key.stamp
            if partner.newest is not None and partner.newest > stamp + self._tolerance:
                out.append(self._unmet(side, stream.waiting.popleft(), 'a later one is there'))
                continue
            if len(stream.waiting) > PATIENCE:
                partner.silent = True
            if not partner.silent:
                break
            stream.alone.append(stamp)
            out.append(LoneFrame(side, stream.waiting.popleft()))
        return out

    @staticmethod
    def _unmet(side: Side, frame: Frame, why: str) -> Drop:
        return Drop(f'{other(side)}_missing', f'for {frame.key.stamp} ns: {why}')
