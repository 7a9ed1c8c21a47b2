"""What a process sets before it starts ROS, so that large messages arrive, and cheaply."""
from __future__ import annotations

import ctypes
import os
from collections.abc import MutableMapping
from pathlib import Path

PROFILE = Path(__file__).with_name('fastdds.xml')
# Whoever sets one of these has chosen a transport.
CHOSEN_BY = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE',
             'FASTDDS_BUILTIN_TRANSPORTS')

# mallopt(3): fresh pages for every large message cost more than the message.
_M_MMAP_THRESHOLD, _M_TRIM_THRESHOLD, _M_TOP_PAD = -3, -1, -2
_MIB = 1 << 20


def prepare_process(environment: MutableMapping[str, str] = os.environ) -> None:
    """Load the shared-memory profile unless the user chose one, and keep large buffers.

    Has its effect only before `rclpy.init`.
    """
    if not any(environment.get(name) for name in CHOSEN_BY):
        environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(PROFILE)
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not glibc
        return
    mallopt(_M_MMAP_THRESHOLD, 32 * _MIB)
    mallopt(_M_TRIM_THRESHOLD, 256 * _MIB)
    mallopt(_M_TOP_PAD, 16 * _MIB)
