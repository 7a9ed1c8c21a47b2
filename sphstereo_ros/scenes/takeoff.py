"""The scene `takeoff`."""
from __future__ import annotations

from .scene import Scene


def takeoff(seed: int) -> Scene:
    """Not there yet."""
    raise NotImplementedError
