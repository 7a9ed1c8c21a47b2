"""Stage 3, motion alignment: refine each pose on a reduced aligned copy of the pair.

In the aligned pair every still point moves along its own meridian. What is left of motion across
the meridians is the error of rotation and direction, and it is solved for over the whole sphere.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import relative_pose
from .camera import Equirectangular
from .config import AlignmentConfig, Config
from .frames import (
    AlignedWindow,
    Drop,
    Frame,
    FrameKey,
    Image8,
    Reference,
    RelativePose,
    StabilisedWindow,
)
from .history import PoseHistory, with_baseline
from .paper import window_ratio_direction
from .relative_pose import Correspondences, PoseEstimate, epipolar_residuals, refine
from .relief import nearness_map, reference_in_relief, sampled
from .sphere import polar_axes, polar_bearings
from .stabilisation import reduced, with_length
from .tracking import Points, features, follow_both_ways, spacing_for
from .warp import Map, PolarGrid, polar_map, resample, with_border

Floats = NDArray[np.float64]

_MARGIN, _WRAP = 8, 8
_POLE = 0.1  # rad round both poles, where the grid is too stretched to track
# A farther reference sees a point at another distance and from another side; still to be followed.
_STRETCH, _FARTHEST = 1.4, 0.45
_LEVELS = 1


@dataclass(frozen=True)
class CurrentView:
    """The current frame on the polar grid about one direction of motion, and its features.

    axes : (3, 3) of the grid; image : (rows, columns) uint8; points : (N, 2) float32 pixels;
    sigma : (N,) px, expected error of following each; bearings : (N, 3), current optical frame;
    nearness : (N,) 1/m, the inverse range of each, as far as it is known (else NaN)
    """

    grid: PolarGrid
    axes: Floats
    image: Image8
    points: Points
    sigma: Floats
    bearings: Floats
    nearness: Floats

    def bearings_of(self, pixels: Points) -> Floats:
        """Pixels (N, 2) of the grid → bearings (N, 3) along the current camera's axes."""
        offset = np.array([self.grid.margin, self.grid.wrap]) - 0.5
        theta, azimuth = ((pixels - offset) * self.grid.pixel).T
        return polar_bearings(theta, azimuth, self.axes)


def current_view(current: Image8, direction: Floats, grid: PolarGrid, count: int) -> CurrentView:
    """Resample the current frame about `direction` and choose its features, at most about `count`.
    """
    axes = polar_axes(direction)
    image = resample(with_border(current), polar_map(grid, axes, current.shape))
    inside = np.zeros(grid.shape, bool)
    inside[grid.wrap:-grid.wrap, np.sin(grid.theta()) > np.sin(_POLE)] = True
    points, sigma = features(image, spacing_for(count, grid.height), inside)
    view = CurrentView(grid, axes, image, points, sigma, np.zeros((0, 3)),
                       np.full(len(points), np.nan))
    return replace(view, bearings=view.bearings_of(points))


def followed(view: CurrentView, reference: Image8, pose: RelativePose,
             ) -> tuple[Correspondences, NDArray[np.intp]]:
    """Features of `view` found in the reference image, and which they are.

    The reference is resampled as if all were at infinity or, where `view` knows ranges, by them:
    then what would look too different from there is left out.
    """
    if not np.isfinite(view.nearness).any():
        image = resample(with_border(reference), polar_map(
            view.grid, pose.rotation.T @ view.axes, reference.shape))
        moved, found = follow_both_ways(view.image, image, view.points)
        chosen = np.nonzero(found)[0]
        seen = view.bearings_of(moved[found])
    else:
        relief = nearness_map(view.grid, view.points, view.nearness)
        image = reference_in_relief(reference, pose, view.grid, view.axes, relief)
        chosen = np.nonzero(_alike(_seen(view.bearings, relief, view.points, pose),
                                   view.bearings))[0]
        moved, found = follow_both_ways(view.image, image, view.points[chosen], levels=_LEVELS)
        moved, chosen = moved[found], chosen[found]
        seen = _seen(view.bearings_of(moved), relief, moved, pose)
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return Correspondences(seen @ pose.rotation, view.bearings[chosen],
                           view.sigma[chosen] * view.grid.pixel), chosen


def _seen(bearings: Floats, relief: Map, pixels: Points, pose: RelativePose) -> Floats:
    """Where the reference camera sees what the relief has at `pixels`: vectors (N, 3), current
    axes, in units of the range from the current camera.
    """
    return np.asarray(bearings - sampled(relief, pixels)[:, None] * pose.position)


def _alike(seen: Floats, bearings: Floats) -> NDArray[np.bool_]:
    """Which points (N,) both cameras see from about the same side and distance."""
    length = np.linalg.norm(seen, axis=1)
    turned = np.einsum('na,na->n', seen, bearings) / length
    return np.asarray((np.abs(np.log(length)) < np.log(_STRETCH)) & (turned > np.cos(_FARTHEST)))


def nearness(points: Correspondences, pose: RelativePose) -> Floats:
    """Inverse range (N,) of each point from the current camera, 1/m; negative behind it."""
    seen = points.reference @ pose.rotation.T
    lever = np.cross(seen, pose.position)
    return np.asarray(np.einsum('na,na->n', np.cross(seen, points.current), lever)
                      / np.maximum(np.einsum('na,na->n', lever, lever), 1e-300))


class Aligner:
    """Refines rotation and direction of every reference."""

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config: AlignmentConfig = config.alignment
        self._mask = mask
        self._history = PoseHistory()

    def warm_up(self) -> None:
        """Compile what `process` needs."""
        noise = np.random.default_rng(0).integers(0, 255, (64, 128), np.uint8)
        pose = RelativePose(np.eye(3), np.array([0.0, 0.0, -1.0]))
        view = current_view(noise, pose.direction, PolarGrid(64, _MARGIN, _WRAP), 500)
        followed(view, noise, pose)
        relative_pose.warm_up()

    def process(self, window: StabilisedWindow) -> AlignedWindow | Drop:
        """Refine every reference's pose; those that fail are left out.

        The nearest starts from where stage 2 put it. Farther ones start at the end of the poses
        found for earlier windows, where these lead there.

        If none is left, the nearest one's failure is returned: `alignment_failed`.
        """
        if self.config.method == 'paper':
            done = [self._by_window_ratio(window.current, r) for r in window.references]
        else:
            done = self._refined_window(window)
        good = tuple(r for r in done if isinstance(r, Reference))
        if good:
            return AlignedWindow(window.current, good)
        return next(d for d in done if isinstance(d, Drop))

    def _reduced(self, image: Image8) -> Image8:
        """The image at working height; the grid samples the frame itself where it is little more.
        """
        height = self.config.working_height
        return image if image.shape[0] < 1.3 * height else reduced(image, height)

    def _by_window_ratio(self, current: Frame, reference: Reference) -> Reference | Drop:
        pose = window_ratio_direction(self._reduced(reference.frame.image),
                                      self._reduced(current.image), reference.pose)
        return pose if isinstance(pose, Drop) else replace(reference, pose=pose)

    def _refined_window(self, window: StabilisedWindow) -> list[Reference | Drop]:
        key = window.current.key
        self._history.begin(key)
        image = self._reduced(window.current.image)
        grid = PolarGrid(min(self.config.working_height, image.shape[0]), _MARGIN, _WRAP)
        view: CurrentView | None = None
        done: list[Reference | Drop] = []
        for reference in window.references:
            found = self._nearest(image, reference, grid) if view is None \
                else self._farther(view, key, reference)
            if isinstance(found, Drop):
                done.append(found)
                continue
            view, pose = found
            pose = self._with_floor(pose)
            self._history.add(key, reference.frame.key, pose)
            done.append(replace(reference, pose=pose))
        return done

    def _nearest(self, current: Image8, reference: Reference,
                 grid: PolarGrid) -> tuple[CurrentView, RelativePose] | Drop:
        """Refine on the grid about the reference's own direction."""
        pose = reference.pose
        view = current_view(current, pose.direction, grid, self.config.max_points)
        for iteration in range(self.config.iterations):
            if iteration:
                view = current_view(current, pose.direction, grid, self.config.max_points)
            found = self._step(view, reference, pose)
            if isinstance(found, Drop):
                return found
            view, pose = found
        return view, pose

    def _farther(self, view: CurrentView, current: FrameKey,
                 reference: Reference) -> tuple[CurrentView, RelativePose] | Drop:
        """Refine from the end of a chain, with the features of the nearest reference's view."""
        pose = reference.pose
        chained = self._history.between(reference.frame.key, current)
        if chained is not None and chained.baseline > 0.5 * pose.baseline:
            pose = with_baseline(chained, pose.baseline)
        return self._step(view, reference, pose) if self.config.iterations else (view, pose)

    def _step(self, view: CurrentView, reference: Reference,
              pose: RelativePose) -> tuple[CurrentView, RelativePose] | Drop:
        """One refinement, and the view with the ranges that it told."""
        points, index = followed(view, self._reduced(reference.frame.image), pose)
        keep = self._beside_mask(points)
        points, index = points[keep], index[keep]
        refined = self._refined(points, pose, view.grid.pixel)
        if isinstance(refined, Drop):
            return refined
        pose = with_length(refined, reference.pose)
        known = view.nearness.copy()
        known[index[refined.inliers]] = nearness(points[refined.inliers], pose)
        return replace(view, nearness=known), pose

    def _beside_mask(self, points: Correspondences) -> NDArray[np.bool_]:
        """Which neither view sees on the vehicle, (N,)."""
        keep = np.ones(len(points), bool)
        if self._mask is None:
            return keep
        height, width = self._mask.shape
        for bearings in (points.reference, points.current):
            u, v = np.rint(Equirectangular(height, width).project(bearings)).astype(np.intp).T
            keep &= self._mask[v.clip(0, height - 1), u % width] == 0
        return keep

    @staticmethod
    def _refined(points: Correspondences, pose: RelativePose,
                 threshold: float) -> PoseEstimate | Drop:
        if len(points) < 100:
            return Drop('alignment_failed', f'{len(points)} points with texture')
        refined = refine(pose.rotation, -pose.direction, points)
        if refined is None:
            return Drop('alignment_failed', 'the aligned pair fixes no motion')
        # The robust loss adapts to any residuals, so inliers are counted by the threshold.
        residual = np.abs(epipolar_residuals(refined.rotation, refined.direction, points))
        if (refined.inliers & (residual < threshold)).sum() < 0.3 * len(points):
            return Drop('alignment_failed', 'the aligned pair does not fit one motion')
        return refined

    def _with_floor(self, pose: RelativePose) -> RelativePose:
        """Add to the covariance the systematic part, which residuals do not show."""
        if pose.covariance is None:
            return pose
        across = np.eye(3) - np.outer(pose.direction, pose.direction)
        floor = np.zeros((6, 6))
        floor[:3, :3] = self.config.rotation_sigma**2 * np.eye(3)
        floor[3:, 3:] = (pose.baseline * self.config.direction_sigma)**2 * across
        return replace(pose, covariance=pose.covariance + floor)
