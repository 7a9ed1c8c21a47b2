"""What moves with the camera: the vehicle's mask from a recording.

While the camera turns, everything in the world changes its place in the picture, however far away
it is; what stays where it is belongs to the vehicle. Only structure can stay or move: a region
without any belongs to whatever its border belongs to.
"""
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from . import rotations
from .camera import Equirectangular
from .config import PoseConfig
from .frames import Drop, Image8
from .relative_pose import Correspondences, parallax, rotation_between
from .stabilisation import estimate, reduced
from .tracking import track
from .warp import resample, rotation_map, with_border

Floats = NDArray[np.float64]
Plane = NDArray[np.float32]
Mask = NDArray[np.bool_]

WORKING_HEIGHT = 480
LEAST_FRAMES = 8

# An edge in one frame, and in the mean of all: grey levels per pixel.
_GRADIENT, _SLOPE = 2.5, 1.0
# Edges of the vehicle are there in so many frames, point the same way, and fit better as they are
# than turned with the world.
_PRESENT, _COHERENT, _STAYS = 0.7, 0.8, 0.4
# Those of the world are there now and then, and point anywhere.
_RARE, _INCOHERENT = 0.1, 0.5
# Standard deviation over time, in grey levels and as a share of the grey level, that only the
# world has.
_VARIATION, _RELATIVE_VARIATION = 2.0, 0.005
_NOISE = 4.0  # grey levels: two differences of pictures that are alike
# How far the world must move in the picture (px, root mean square), and on how much of the sphere.
_LEAST_MOTION, _LEAST_SHARE = 2.0, 0.6
# Solid angle, as a share of the sphere: less is a speck; a hole that is smaller is filled.
_SPECK, _HOLE = 2e-4, 3e-3
_KEY_TURN = 4.0  # px: frames that are compared are turned by that much
_STILL = 0.3  # px: what moves less between frames tells nothing of the camera's motion
_CLOSED = 3  # px
# A plain region is surrounded where so much of its border lies beside edges that stay, at most so
# much beside what turns with the world; and how near that is, px.
_SURROUNDED, _OPEN, _REACH = 0.3, 0.2, 3
_WRAP = 32


@dataclass(frozen=True)
class VehicleMask:
    """mask : (H, 2H) uint8, 255 = vehicle; share : of the sphere that it covers, 0 … 1

    The mask reaches a pixel or two beyond the vehicle, as far as its edges blur.
    """

    mask: Image8
    share: float


class VehicleMaskFinder:
    """Takes the frames of a recording one by one, and says what of the picture is vehicle."""

    def __init__(self, config: PoseConfig) -> None:
        self._config = config
        self._previous: Image8 | None = None
        self._attitude = np.eye(3)  # of the camera, in the first camera of its stretch
        self._stretches: list[list[Floats]] = []
        self._gain = 1.0
        self._sums: NDArray[np.float64] | None = None
        self._key: tuple[Image8, Floats, float] | None = None  # frame, attitude, gain
        self._fits: NDArray[np.float64] | None = None
        self.frames = 0

    def add(self, image: Image8, continues: bool = True) -> None:
        """Take the next frame, (H, 2H) uint8; `continues`: it follows soon after the last one.

        Frames of another size than the first are left out.
        """
        small = reduced(image, WORKING_HEIGHT)
        previous = self._previous
        if previous is not None and previous.shape != small.shape:
            return
        turn = None
        if previous is not None:
            change = _gain(previous, small)
            self._gain *= change
            alike = np.asarray(cv2.convertScaleAbs(previous, alpha=change), np.uint8)
            turn = self._turn(alike, small) if continues else None
        if turn is None:
            self._attitude = np.eye(3)
            self._stretches.append([])
            self._key = None
        else:
            self._attitude = self._attitude @ turn.T
        self._stretches[-1].append(self._attitude)
        self._add_structure(small)
        self._add_fit(small)
        self._previous = small
        self.frames += 1

    def result(self) -> VehicleMask | Drop:
        """The mask, at the working height.

        Drops: `too_few_frames`; `too_little_turn`, where the camera hardly turned.
        """
        if self._sums is None or self.frames < LEAST_FRAMES:
            return Drop('too_few_frames', f'{self.frames} usable frames; it takes {LEAST_FRAMES}')
        moved = self._world_motion()
        weight = _solid_angle(moved.shape)
        if self._fits is None or weight[moved >= _LEAST_MOTION].sum() < _LEAST_SHARE:
            pixel = 180 / len(moved)
            spread = float(np.sqrt(np.sum(weight * moved**2)))
            return Drop('too_little_turn', f'the camera turned by {spread * pixel:.2f}° (root '
                        f'mean square) where {_LEAST_MOTION * pixel:.2g}° and more tell the '
                        'vehicle from the world; record a drive with turns')
        mask = _segmented(_Evidence.of(self._sums, self._fits, self.frames), weight)
        return VehicleMask(np.where(mask, np.uint8(255), np.uint8(0)), float(weight[mask].sum()))

    def _turn(self, previous: Image8, current: Image8) -> Floats | None:
        """Rotation X_current ← X_previous, or None where it is not known."""
        points = track(previous, current, np.eye(3), self._config.max_points)
        still = parallax(np.eye(3), points) < _STILL * np.pi / len(current)
        moving = points[~still]
        if len(moving) < self._config.min_inliers:  # nearly nothing moves: then nothing turned
            return np.eye(3) if still.sum() >= self._config.min_inliers else None
        pose = estimate(moving, self._config)
        return _rotation(moving, self._config) if isinstance(pose, Drop) else pose.rotation

    def _add_structure(self, image: Image8) -> None:
        grey = np.asarray(image, np.float32) / np.float32(self._gain)
        smooth = cv2.GaussianBlur(_wrapped(grey), (0, 0), 0.7)
        gu, gv = (cv2.Scharr(smooth, cv2.CV_32F, *order, scale=1 / 32)[_WRAP:-_WRAP, _WRAP:-_WRAP]
                  for order in ((1, 0), (0, 1)))
        size = cv2.magnitude(gu, gv)
        planes = (grey, grey * grey, gu, gv, size, size > _GRADIENT)
        if self._sums is None:
            self._sums = np.zeros((len(planes), *image.shape))
        for total, plane in zip(self._sums, planes, strict=True):
            total += plane

    def _add_fit(self, image: Image8) -> None:
        """Compare with an earlier frame: as it is, and as the infinitely far world has turned."""
        if self._key is None:
            self._key = image, self._attitude, self._gain
            return
        earlier, attitude, gain = self._key
        turn = self._attitude.T @ attitude
        if rotations.angle(turn) < _KEY_TURN * np.pi / len(image):
            return
        self._key = image, self._attitude, self._gain
        turned = resample(with_border(earlier), rotation_map(turn.T, image.shape))
        grey = np.asarray(image, np.float32)
        change = np.float32(self._gain / gain)
        fits = [cv2.blur(_wrapped(np.abs(grey - change * other)), (3, 3))[
            _WRAP:-_WRAP, _WRAP:-_WRAP] for other in (earlier, turned)]
        added = np.array([*fits, np.ones(image.shape)])
        self._fits = added if self._fits is None else self._fits + added

    def _world_motion(self) -> Plane:
        """How far the infinitely far world moved in each pixel (H, W): root mean square, px."""
        assert self._sums is not None
        height, width = self._sums.shape[1:]
        bearings = Equirectangular(height, width).bearings()
        square = np.zeros((height, width))
        for stretch in self._stretches:
            mean = np.linalg.norm(bearings @ np.mean(stretch, axis=0).T, axis=-1)
            square += len(stretch) / self.frames * np.clip(1 - mean**2, 0, None)
        return np.asarray(np.sqrt(square) * height / np.pi, np.float32)


def _gain(previous: Image8, current: Image8) -> float:
    """Change of the exposure, from what most pixels do."""
    usable = (previous > 20) & (previous < 230)
    if usable.sum() < 100:
        return 1.0
    return float(np.median(current[usable] / previous[usable].astype(np.float32)))


def _rotation(points: Correspondences, config: PoseConfig) -> Floats | None:
    """The rotation that most points agree with, where parallax tells no more."""
    kept = points
    for _ in range(5):
        turn = rotation_between(kept)
        residual = parallax(turn, points)
        kept = points[residual < max(2 * float(np.median(residual)), config.inlier_threshold)]
    enough = config.min_inlier_ratio * len(points)
    return turn if (residual < 3 * config.inlier_threshold).sum() >= enough else None


def _solid_angle(shape: tuple[int, ...]) -> Floats:
    """Share of the sphere of each pixel of an equirectangular image (H, W)."""
    rows = np.cos((0.5 - (np.arange(shape[0]) + 0.5) / shape[0]) * np.pi)
    weight = np.broadcast_to(rows[:, None], shape)
    return np.asarray(weight / weight.sum())


def _wrapped(image: NDArray[np.generic]) -> NDArray[np.generic]:
    """With a border that continues round the seam; at the poles the last row again."""
    inner = cv2.copyMakeBorder(image, 0, 0, _WRAP, _WRAP, cv2.BORDER_WRAP)
    return np.asarray(cv2.copyMakeBorder(inner, _WRAP, _WRAP, 0, 0, cv2.BORDER_REPLICATE))


@dataclass(frozen=True)
class _Evidence:
    """What the pixels (H, W) showed over time.

    slope : of the mean picture, grey levels per pixel; present : share of the frames with an edge;
    coherence : 1 where the gradient is always the same, near 0 where it is any; varies : whether
    the grey level does; stays : from 1, where the picture stays as it is, to −1, where it turns
    with the world
    """

    slope: Plane
    present: Plane
    coherence: Plane
    varies: Mask
    stays: Plane

    @classmethod
    def of(cls, sums: NDArray[np.float64], fits: NDArray[np.float64], frames: int) -> _Evidence:
        grey, square, gu, gv, size, present = sums / frames
        variance = np.clip(square - grey * grey, 0, None)
        variation = np.sqrt(cv2.blur(variance, (3, 3), borderType=cv2.BORDER_REPLICATE))
        slope = np.hypot(gu, gv)
        still, turned, pairs = fits
        return cls(np.asarray(slope, np.float32), np.asarray(present, np.float32),
                   np.asarray(slope / np.maximum(size, 1e-6), np.float32),
                   variation > _VARIATION + _RELATIVE_VARIATION * grey,
                   np.asarray((turned - still) / (turned + still + _NOISE * pairs), np.float32))


def _segmented(evidence: _Evidence, weight: Floats) -> Mask:
    """The vehicle: structure that stays, and the plain regions that it surrounds."""
    stays = ((evidence.slope > _SLOPE) & (evidence.coherence > _COHERENT)
             & (evidence.stays > _STAYS))
    moves = ~stays & (evidence.varies | (evidence.stays < -_STAYS / 2) | (
        (evidence.present > _RARE) & (evidence.coherence < _INCOHERENT)))
    edges = stays | ((evidence.present > _PRESENT) & (evidence.stays > 0))
    vehicle = stays | _surrounded(~stays & ~moves, edges, evidence.stays < -_STAYS / 2)
    vehicle = _closed(vehicle, _CLOSED)
    vehicle = _without_specks(vehicle, weight, _SPECK)
    return ~_without_specks(~vehicle, weight, _HOLE)


def _surrounded(plain: Mask, edges: Mask, world: Mask) -> Mask:
    """Those components of `plain` with enough `edges` beside their border, and little `world`."""
    labels, count = _components(plain)
    border = plain & _dilated(~plain, 1)
    near_edges = _dilated(edges, _REACH)
    near_world = _dilated(world & ~plain, _REACH) & ~near_edges
    length, fixed, turning = (np.bincount(labels[border & near], minlength=count)
                              for near in (border, near_edges, near_world))
    chosen = (fixed > _SURROUNDED * length) & (turning < _OPEN * length)
    chosen[0] = False
    return np.asarray(chosen[labels])


def _components(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """Labels (H, W) of connected components, the seam included, and their number; 0 is outside."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    joined = np.arange(count)
    across = mask[:, 0] & mask[:, -1]
    for left, right in zip(labels[across, 0], labels[across, -1], strict=True):
        low, high = sorted((joined[left], joined[right]))
        joined[joined == high] = low
    return np.asarray(joined[labels], np.int32), count


def _without_specks(mask: Mask, weight: Floats, least: float) -> Mask:
    labels, count = _components(mask)
    area = np.bincount(labels.ravel(), weights=weight.ravel(), minlength=count)
    area[0] = 0
    return np.asarray((area >= least)[labels])


def _disc(radius: int) -> Image8:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2))


def _dilated(mask: Mask, radius: int) -> Mask:
    grown = cv2.dilate(_wrapped(mask.astype(np.uint8)), _disc(radius))
    return np.asarray(grown[_WRAP:-_WRAP, _WRAP:-_WRAP] != 0)


def _closed(mask: Mask, radius: int) -> Mask:
    closed = cv2.morphologyEx(_wrapped(mask.astype(np.uint8)), cv2.MORPH_CLOSE, _disc(radius))
    return np.asarray(closed[_WRAP:-_WRAP, _WRAP:-_WRAP] != 0)
