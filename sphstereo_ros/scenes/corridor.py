"""The scene `corridor`."""
from __future__ import annotations

from .scene import Scene


def corridor(seed: int) -> Scene:
    """Not there yet."""
    raise NotImplementedError
