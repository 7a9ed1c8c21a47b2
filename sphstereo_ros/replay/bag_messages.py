"""Makes messages of the types that rosbags brings, to be written into bags."""
from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

_NUMBERS = {'octet': np.uint8, 'byte': np.uint8, 'char': np.uint8}


def make(name: str, /, **fields: Any) -> Any:
    """Make a message (`sphstereo_ros.ros.messages.MessageFactory`)."""
    known = _kinds(name)
    unknown = fields.keys() - known.keys()
    if unknown:
        raise AttributeError(f'{name} has no {", ".join(sorted(unknown))}')
    missing = {key: _default(kind) for key, kind in known.items() if key not in fields}
    return TYPESTORE.types[name](**fields, **missing)


@cache
def _kinds(name: str) -> dict[str, Any]:
    return dict(TYPESTORE.fielddefs[name][1])


def _default(kind: Any) -> Any:
    node, detail = kind
    if node == Nodetype.NAME:
        # Identity, as the ROS definition says; rosbags drops default values.
        return make(detail, w=1.0) if detail == 'geometry_msgs/msg/Quaternion' else make(detail)
    if node == Nodetype.BASE:
        return {'string': '', 'wstring': '', 'bool': False, 'float32': 0.0,
                'float64': 0.0}.get(detail[0], 0)
    (element, of), count = detail
    size = count if node == Nodetype.ARRAY else 0
    if element == Nodetype.BASE and of[0] not in ('string', 'wstring'):
        return np.zeros(size, _NUMBERS.get(of[0], of[0]))
    return [_default((element, of)) for _ in range(size)]
