"""SIGINT and SIGTERM end a command by KeyboardInterrupt, but never in the middle of a write."""
from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class _State:
    """held : how many blocks must not be interrupted; pending : a signal came meanwhile."""

    held = 0
    pending = False


def _interrupt(number: int, frame: object) -> None:
    if _State.held:
        _State.pending = True
    else:
        raise KeyboardInterrupt


def interrupt_on_signals() -> None:
    """End by KeyboardInterrupt on SIGINT and on SIGTERM, so that files are completed."""
    signal.signal(signal.SIGINT, _interrupt)
    signal.signal(signal.SIGTERM, _interrupt)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let a signal that comes in this block wait for its end."""
    _State.held += 1
    try:
        yield
    finally:
        _State.held -= 1
        if _State.pending and not _State.held:
            _State.pending = False
            raise KeyboardInterrupt
