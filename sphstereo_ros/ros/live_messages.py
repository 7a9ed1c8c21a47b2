"""Makes messages of the classes that the running ROS 2 brings."""
from __future__ import annotations

import array
import importlib
from functools import cache
from typing import Any

import numpy as np


@cache
def message_class(name: str) -> Any:
    """Return the class of 'package/msg/Type'."""
    package, _, kind = name.split('/')
    return getattr(importlib.import_module(f'{package}.msg'), kind)


def make(name: str, /, **fields: Any) -> Any:
    """Make a message (`sphstereo_ros.ros.messages.MessageFactory`)."""
    message = message_class(name)()
    for key, value in fields.items():
        setattr(message, key, _assignable(value, message.get_fields_and_field_types()[key]))
    return message


def _assignable(value: Any, kind: str) -> Any:
    if kind == 'sequence<uint8>':
        # Anything else than array.array is checked and copied element by element.
        data = array.array('B')
        data.frombytes(np.ascontiguousarray(value, np.uint8).data)
        return data
    if kind in ('octet', 'byte'):
        return bytes([value])
    return value
