"""Convolutional networks as files, run by OpenCV."""
from __future__ import annotations

import threading
from importlib.resources import files

import cv2
import numpy as np
from numpy.typing import NDArray


class Convolutions:
    """A network that is shipped in this folder; any thread may run it."""

    def __init__(self, name: str) -> None:
        data = (files('sphstereo_ros.core') / name).read_bytes()
        self._net = cv2.dnn.readNetFromONNX(np.frombuffer(data, np.uint8))
        self._lock = threading.Lock()

    def __call__(self, x: NDArray[np.float32]) -> NDArray[np.float32]:
        """Outputs (1, outputs, rows, columns) of x (1, channels, rows, columns)."""
        with self._lock:  # a network of OpenCV holds what it computes
            self._net.setInput(x)
            return np.asarray(self._net.forward())


def of_each_pixel(found: NDArray[np.float32], kinds: int) -> NDArray[np.float32]:
    """Outputs at half size (1, 4 · kinds, rows, columns), of four pixels each, at full size:
    (kinds, 2 rows, 2 columns).
    """
    rows, columns = found.shape[2:]
    parts = found.reshape(kinds, 2, 2, rows, columns).transpose(0, 3, 1, 4, 2)
    return np.ascontiguousarray(parts).reshape(kinds, 2 * rows, 2 * columns)
