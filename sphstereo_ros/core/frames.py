"""The types that travel along the chain: frames, frame windows, and named failures.

    Frame → PairedWindow → StabilisedWindow → AlignedWindow → RangeImage → PointCloud

A window is one current frame, one or more reference frames, and the pose of each reference camera
in the current camera's optical frame: X_current = R · X_reference + p. A camera that moves forward
by b has its reference at p = (0, 0, −b). A pair of cameras is a window too: the top camera is
the reference, the bottom one is current.
"""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image8 = NDArray[np.uint8]

# Distance between consecutive frames that stands for "direction known, length unknown", in metres:
# far under any real baseline, so that range computed from it by mistake is absurdly near, never
# far. A reference k frames back is k times as far away; so far back they still are unscaled.
UNSCALED = 1e-6
_LEAST_METRIC = 1000 * UNSCALED


@dataclass(frozen=True, order=True)
class FrameKey:
    """What names a frame: its exposure time in nanoseconds and the camera's frame_id."""

    stamp: int
    frame_id: str


@dataclass(frozen=True)
class Frame:
    """An equirectangular frame at working resolution.

    image : (H, 2H) uint8 grey; colour : (H, 2H, 3) uint8 BGR, where it was asked for.
    """

    key: FrameKey
    image: Image8
    colour: Image8 | None = None


@dataclass(frozen=True)
class RelativePose:
    """Pose of a reference camera in the current camera's optical frame.

    rotation : (3, 3), X_current = rotation · X_reference + position
    position : (3,), metres; in units of UNSCALED when the length of a step is not known
    covariance : (6, 6) of a small rotation (rad, about the current axes), then of the position
        (m); None where nothing is known of it
    """

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    covariance: NDArray[np.float64] | None = None

    @property
    def baseline(self) -> float:
        """Distance of the two camera centres, metres."""
        return float(np.linalg.norm(self.position))

    @property
    def is_metric(self) -> bool:
        """Whether the length of `position` is in metres (else it is only a direction)."""
        return self.baseline > _LEAST_METRIC

    @property
    def direction(self) -> NDArray[np.float64]:
        """Unit vector t of motion from the reference to the current camera, current frame."""
        return -self.position / max(self.baseline, 1e-300)


@dataclass(frozen=True)
class Reference:
    """An earlier frame (or the other camera's) and where it was taken."""

    frame: Frame
    pose: RelativePose

    def is_beside(self, current: Frame) -> bool:
        """Whether it is of another camera than `current`: two on one rig, whose relative pose is
        calibrated.
        """
        return self.frame.key.frame_id != current.key.frame_id


@dataclass(frozen=True)
class FrameWindow:
    """One current frame and its references, nearest first; another camera's before all others."""

    current: Frame
    references: tuple[Reference, ...]

    @property
    def is_metric(self) -> bool:
        """Whether all baselines are in metres."""
        return all(r.pose.is_metric for r in self.references)


class PairedWindow(FrameWindow):
    """Out of pairing: poses are priors."""


class StabilisedWindow(FrameWindow):
    """Out of pose stabilisation: rotations and directions of motion are estimated."""


class AlignedWindow(FrameWindow):
    """Out of motion alignment: rotations and translations are refined."""


@dataclass(frozen=True)
class Drop:
    """A named failure: what was not computed, and why. Counted by `cause`."""

    cause: str
    detail: str = ''


@dataclass(frozen=True)
class RangeImage:
    """Radial range on the current frame's equirectangular grid (H, 2H).

    range : float32 metres (steps between frames, if not `is_metric`): NaN unknown, +Inf
        confidently beyond the maximum, −Inf nearer than the minimum (REP-117)
    sigma : float32, one standard deviation of it, same unit; NaN where range is not finite
    moving : uint8, 255 = moves by itself; None where the matcher cannot tell
    camera : pose of the camera in the frame of the one that `camera.mount` is for: of a top camera
        that went on alone; None where it is not known which camera it is
    """

    key: FrameKey
    range: NDArray[np.float32]
    sigma: NDArray[np.float32]
    is_metric: bool
    quality: dict[str, Any] = field(default_factory=dict)
    moving: Image8 | None = None
    camera: RelativePose | None = field(default_factory=RelativePose)

    @property
    def is_placed(self) -> bool:
        """Whether its points have a place on the vehicle: metres, and a camera that is known."""
        return self.is_metric and self.camera is not None


@dataclass(frozen=True)
class PointCloud:
    """Points in `base_link`: xyz (N, 3) float32 metres, sigma (N,) float32 metres, and either
    intensity (N,) uint8 or bgr (N, 3) uint8.
    """

    key: FrameKey
    xyz: NDArray[np.float32]
    sigma: NDArray[np.float32]
    intensity: Image8 | None = None
    bgr: Image8 | None = None
