"""True distances of the sectors from an exact range image, and how far what was found is off.

Plain NumPy from the definition, sharing no code with the detection: points of all pixels, turned
level; those in the band and above the ground; per sector the nearest that are together as large
as an obstacle is.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.core.config import ObstaclesConfig
from sphstereo_ros.core.sectors import SECTORS, ObstacleSectors, SectorState
from sphstereo_ros.scenes.trajectory import BODY_FROM_OPTICAL

Floats = NDArray[np.float64]

# m² of one sector's surfaces that face the camera: less is no obstacle. The first is 20 cm of a
# pole 15 cm wide; the second, some scattered leaves, is told besides.
LEAST_AREA, FINE_AREA = 0.03, 0.01
# Degrees beyond its edges from which a sector may rightly have its distance.
EDGE = 1.0
NEAR, ACCURATE = 10.0, 15.0  # m: nearer must never be free; to there the error counts
FARTHER = 1.5  # times the true distance: missed; as much nearer: false


def level_points(distance: Floats, rotation: Floats) -> Floats:
    """Points (N, 3) of a true range image (H, 2H), metres: x ahead, y left, z up, yaw kept.

    rotation : (3, 3) world ← camera_optical; the vehicle's axes are the camera's
    """
    height, width = distance.shape
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    lon = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)[None, :]
    rays = np.stack([np.cos(lat) * np.sin(lon), -np.sin(lat) + 0 * lon,
                     np.cos(lat) * np.cos(lon)], axis=-1)
    world = (distance[..., None] * rays).reshape(-1, 3) @ rotation.T
    ahead = (rotation @ BODY_FROM_OPTICAL.T)[:, 0]
    yaw = np.arctan2(ahead[1], ahead[0])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.asarray(world @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]))


def true_sectors(distance: Floats, rotation: Floats, height_over_ground: float,
                 limits: ObstaclesConfig, widened: float = 0.0,
                 least: float = LEAST_AREA) -> Floats:
    """Horizontal distance (72,) of the nearest obstacle, inf where there is none, metres.

    distance : (H, 2H) exact range, inf = sky; height_over_ground : of the camera, metres
    widened : degrees that a sector reaches beyond its edges; least : m²
    """
    rows, columns = distance.shape
    lat = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    solid_angle = np.cos(lat) * (np.pi / rows) * (2 * np.pi / columns)
    finite = np.where(np.isfinite(distance), distance, 0.0)
    area = (finite**2 * solid_angle).ravel()
    x, y, z = level_points(finite, rotation).T
    counts = ((area > 0) & (z >= -limits.height_below) & (z <= limits.height_above)
              & (z > limits.ground_clearance - height_over_ground))
    x, y, area = x[counts], y[counts], area[counts]
    # Clockwise from the edge of the first sector, sorted, and what comes before and after a turn.
    turned = (np.degrees(np.arctan2(-y, x)) + 22.5) % 360
    order = np.argsort(turned)
    flat, area = (np.tile(a[order], 3) for a in (np.hypot(x, y), area))
    turned = np.concatenate([turned[order] + turn for turn in (-360, 0, 360)])
    out = np.full(SECTORS, np.inf)
    for sector in range(SECTORS):
        first = np.searchsorted(turned, 5 * sector - widened, 'left')
        last = np.searchsorted(turned, 5 * sector + 5 + widened, 'right')
        rising = first + np.argsort(flat[first:last])
        enough = np.cumsum(area[rising]) >= least
        if enough.any():
            out[sector] = flat[rising][np.argmax(enough)]
    return out


@dataclass
class Score:
    """Of all frames: counts of sectors, and the errors of the distances."""

    counts: Counter[str] = field(default_factory=Counter)
    errors: list[float] = field(default_factory=list)

    def add(self, found: ObstacleSectors, truth: Floats, wide: Floats, fine: Floats) -> None:
        """Take a frame; `truth` is of the sectors, `wide` of the sectors with what is beside,
        `fine` counts what is smaller, too.
        """
        measured, free = (found.state == s for s in (SectorState.MEASURED, SectorState.FREE))
        near = truth < NEAR
        d = np.where(measured, found.distance, np.inf)
        told = np.maximum(truth, found.minimum)
        self.counts.update({
            'frames': 1, 'sectors': SECTORS, 'measured': int(measured.sum()),
            'free': int(free.sum()), 'unknown': int((~measured & ~free).sum()),
            'near': int(near.sum()), 'near_free': int((near & free).sum()),
            'fine_free': int(((fine < NEAR) & free).sum()),
            'near_unknown': int((near & ~free & ~measured).sum()),
            'near_missed': int((near & measured & (d > FARTHER * told)).sum()),
            'truly_free': int((wide > found.maximum).sum()),
            'truly_free_free': int(((wide > found.maximum) & free).sum()),
            'false': int((measured & (d < np.maximum(wide, found.minimum) / FARTHER)).sum())})
        judged = measured & (truth <= ACCURATE)
        self.errors += (np.abs(d[judged] - told[judged]) / told[judged]).tolist()

    def drop(self, cause: str) -> None:
        """Count a frame without a result."""
        self.counts[f'drops.{cause}'] += 1

    def include(self, other: Score) -> None:
        """Add all that `other` has taken."""
        self.counts.update(other.counts)
        self.errors += other.errors

    def summary(self) -> Mapping[str, Any]:
        """Shares in percent; `near_…` are counts of sectors with something nearer than 10 m."""
        c, total = self.counts, max(self.counts['sectors'], 1)
        return {'frames': c['frames'],
                'median_error': 100 * float(np.median(self.errors)) if self.errors else None,
                **{name: 100 * c[name] / total for name in ('measured', 'free', 'unknown')},
                **{name: c[name] for name in (
                    'near', 'near_free', 'fine_free', 'near_unknown', 'near_missed', 'false',
                    'truly_free', 'truly_free_free')},
                'drops': {name[6:]: n for name, n in c.items() if name.startswith('drops.')}}
