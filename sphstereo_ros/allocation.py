"""How this process gets memory for images and messages."""
from __future__ import annotations

import ctypes

# mallopt(3)
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD, _M_TOP_PAD = -3, -1, -2
_MIB = 1 << 20


def keep_buffers() -> None:
    """Let the allocator keep large buffers for the next image instead of giving them back.

    Fresh pages for every image cost more than the work on it. Without glibc nothing changes.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_M_MMAP_THRESHOLD, 32 * _MIB)
    mallopt(_M_TRIM_THRESHOLD, 256 * _MIB)
    mallopt(_M_TOP_PAD, 16 * _MIB)
