"""What is viewed: topics and their types."""
from __future__ import annotations

from collections.abc import Collection

from sphstereo_ros.replay.records import COMPRESSED, IMAGE

ODOMETRY, CLOUD = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/PointCloud2'
DIAGNOSTICS = '/diagnostics'
PICTURES = {f'/{side}image{kind}': COMPRESSED if kind else IMAGE
            for side in ('', 'bottom/', 'top/') for kind in ('', '/compressed')}
VIEWED = {
    **PICTURES,
    '/depth/preview': IMAGE,
    '/depth/moving': IMAGE,
    '/points': CLOUD,
    '/map': CLOUD,
    '/odometry': ODOMETRY,
    '/odometry/visual': ODOMETRY,
    '/obstacles/scan': 'sensor_msgs/msg/LaserScan',
    '/obstacles/nearest': 'sensor_msgs/msg/Range',
    DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray',
}
# Shown as a preview where the bag has none.
DEPTHS = {'/depth/image': IMAGE, '/depth/relative': IMAGE}


def viewed(there: Collection[tuple[str, str]], namespace: str = '') -> dict[str, str]:
    """Which of these topics (and types) are viewed, and what each is called without namespace."""
    found: dict[str, str] = {}
    for topic, kind in there:
        name = topic if topic == DIAGNOSTICS else topic.removeprefix(namespace)
        if {**VIEWED, **DEPTHS}.get(name) == kind and (name == DIAGNOSTICS
                                                       or topic.startswith(f'{namespace}/')):
            found[topic] = name
    if '/depth/preview' in found.values():
        found = {topic: name for topic, name in found.items() if name not in DEPTHS}
    return found
