"""What a process sets before it starts ROS, so that large messages arrive, and cheaply."""
from __future__ import annotations

import os
import re
from collections.abc import MutableMapping
from pathlib import Path

from sphstereo_ros.allocation import keep_buffers

PROFILE = Path(__file__).with_name('fastdds.xml')
SMALL_PROFILE = Path(__file__).with_name('fastdds_small.xml')
SHARED_MEMORY = Path('/dev/shm')
# Whoever sets one of these has chosen a transport.
CHOSEN_BY = ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE',
             'FASTDDS_BUILTIN_TRANSPORTS')

_MIB = 1 << 20


def prepare_process(profile: Path = PROFILE,
                    environment: MutableMapping[str, str] = os.environ) -> str:
    """Load a shared-memory profile unless the user chose one, and keep large buffers.

    Has its effect only before `rclpy.init`. Returns what the user should know, or ''.
    """
    keep_buffers()
    if any(environment.get(name) for name in CHOSEN_BY):
        return ''
    environment['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile)
    needed = segment_size(profile)
    try:
        room = os.statvfs(SHARED_MEMORY)
    except OSError:
        return ''
    free = room.f_bavail * room.f_frsize
    if free >= needed:
        return ''
    return (f'{SHARED_MEMORY} has {free / _MIB:.0f} MiB free, {needed / _MIB:.0f} are needed: '
            'large messages travel by UDP, and those of best-effort topics may be lost')


def segment_size(profile: Path) -> int:
    """Bytes of shared memory that a process with this profile takes."""
    found = re.search(r'<segment_size>(\d+)<', profile.read_text(encoding='utf-8'))
    return int(found.group(1)) if found else 0
