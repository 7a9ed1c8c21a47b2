"""Slow drift of a calibrated rotation: followed within bounds, never by a jump."""
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from . import rotations
from .config import CalibrationConfig
from .frames import Drop

Floats = NDArray[np.float64]

_SECOND = 1e9
_LONGEST_STEP = 1.0  # s that count at most between two measurements
# So many measurements in a row that lie a jump away are no outliers: the camera was knocked.
_KNOCKED = 5


class DriftTracker:
    """Follows the rotation between two cameras as it drifts with temperature and vibration.

    A first-order low-pass filter (`calibration.time_constant`), slower than `calibration.max_rate`
    and never farther than `calibration.max_drift` from where it began. What differs by more than
    `calibration.jump` is not drift: it is reported and left out.

    rotation : (3, 3) as calibrated, X_bottom = rotation · X_top
    """

    def __init__(self, rotation: Floats, config: CalibrationConfig) -> None:
        self.config = config
        self._calibrated = np.asarray(rotation, np.float64)
        self._rotation = self._calibrated
        self._stamp: int | None = None
        self._away = 0

    @property
    def rotation(self) -> Floats:
        """(3, 3), where the top camera is believed to be turned now."""
        return self._rotation

    @property
    def drift(self) -> float:
        """Angle from the calibrated rotation, rad."""
        return rotations.angle(self._rotation @ self._calibrated.T)

    @property
    def knocked(self) -> bool:
        """Whether the latest measurements all lie a jump away: the calibration no longer holds."""
        return self._away >= _KNOCKED

    def add(self, stamp: int, rotation: Floats, sigma: float) -> Drop | None:
        """Take what a pair of frames tells.

        Parameters
        ----------
        stamp : nanoseconds; time that runs backward counts as none
        rotation : (3, 3), the pair's own
        sigma : its standard deviation, rad

        Returns
        -------
        None where it was used, else why not: `calibration_jump`, `calibration_uncertain`,
        `calibration_drift` (it was used as far as the bound allows).

        """
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) / _SECOND
        self._stamp = stamp
        if not sigma <= self.config.max_sigma or not np.isfinite(rotation).all():
            return Drop('calibration_uncertain', f'standard deviation {_degrees(sigma)}')
        step = rotations.log(np.asarray(rotation, np.float64) @ self._rotation.T)
        away = float(np.linalg.norm(step))
        if away > self.config.jump:
            self._away += 1
            return Drop('calibration_jump', f'the pair differs by {_degrees(away)}: '
                        + ('the cameras were moved, calibrate anew' if self.knocked
                           else 'left out'))
        self._away = 0
        return self._follow(step, float(np.clip(seconds, 0.0, _LONGEST_STEP)))

    def _follow(self, step: Floats, seconds: float) -> Drop | None:
        step = step * -math.expm1(-seconds / self.config.time_constant)
        step = _limited(step, self.config.max_rate * seconds)
        total = rotations.log(rotations.exp(step) @ self._rotation @ self._calibrated.T)
        bounded = _limited(total, self.config.max_drift)
        self._rotation = rotations.exp(bounded) @ self._calibrated
        if bounded is total:
            return None
        return Drop('calibration_drift', f'more than {_degrees(self.config.max_drift)} from where '
                    'it was calibrated')


def _limited(vector: Floats, length: float) -> Floats:
    """The vector, shortened to `length` if it is longer."""
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.3f}°'
