"""The current frame's view in motion alignment: its features, and where references have them.

Features are chosen once, on the polar grid about the nearest reference's direction. What that
reference tells of their ranges says where, and in which shape, farther references see them.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .frames import Image8, RelativePose
from .photometric import like
from .relative_pose import Correspondences
from .relief import nearness_map, reference_in_relief, sampled
from .sphere import polar_axes, polar_bearings
from .tracking import Points, features, follow_both_ways, spacing_for
from .warp import Map, PolarGrid, polar_map, resample, with_border

Floats = NDArray[np.float64]

_POLE = 0.1  # rad round both poles, where the grid is too stretched to track
# A farther reference sees a point at another distance and from another side: still to be followed.
_STRETCH, _FARTHEST = 1.4, 0.45
_LEVELS = 1  # of the pyramid, where ranges say where to look
# Parallax (rad) under which the nearest reference tells no range, and how many points must tell.
_TELLING, _ENOUGH = 0.01, 50


@dataclass(frozen=True)
class CurrentView:
    """The current frame on the polar grid about one direction of motion, and its features.

    axes : (3, 3) of the grid; image : (rows, columns) uint8; points : (N, 2) float32 pixels;
    sigma : (N,) px, expected error of following each; bearings : (N, 3), current optical frame;
    nearness : (N,) 1/m, the inverse range of each, as far as it is known (else NaN);
    baseline : metres, of the first reference that told ranges; 0 where none has
    """

    grid: PolarGrid
    axes: Floats
    image: Image8
    points: Points
    sigma: Floats
    bearings: Floats
    nearness: Floats
    baseline: float = 0.0

    def bearings_of(self, pixels: Points) -> Floats:
        """Pixels (N, 2) of the grid → bearings (N, 3) along the current camera's axes."""
        offset = np.array([self.grid.margin, self.grid.wrap]) - 0.5
        theta, azimuth = ((pixels - offset) * self.grid.pixel).T
        return polar_bearings(theta, azimuth, self.axes)


    @property
    def knows_ranges(self) -> bool:
        """Whether a reference has told the range of any feature."""
        return bool(np.isfinite(self.nearness).any())

    def taught(self, points: Correspondences, index: NDArray[np.intp],
               pose: RelativePose) -> CurrentView:
        """The view with the ranges that `points`, its features number `index`, tell."""
        known = self.nearness.copy()
        known[index] = nearness(points, pose)
        return replace(self, nearness=known, baseline=self.baseline or pose.baseline)


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
    if not view.knows_ranges:
        image = resample(with_border(reference), polar_map(
            view.grid, pose.rotation.T @ view.axes, reference.shape))
        moved, found = follow_both_ways(view.image, like(image, view.image), view.points)
        chosen = np.nonzero(found)[0]
        seen = view.bearings_of(moved[found])
    else:
        relief = nearness_map(view.grid, view.points, view.nearness)
        image = reference_in_relief(reference, pose, view.grid, view.axes, relief)
        chosen = np.nonzero(_alike(_seen(view.bearings, relief, view.points, pose),
                                   view.bearings))[0]
        moved, found = follow_both_ways(view.image, like(image, view.image),
                                        view.points[chosen], levels=_LEVELS)
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


def length_by_ranges(view: CurrentView, points: Correspondences, index: NDArray[np.intp],
                     pose: RelativePose) -> tuple[float, float] | None:
    """Baseline and its standard deviation, metres, from points whose range `view` knows already.

    Parameters
    ----------
    view : has ranges by another reference
    points : (N,) still points
    index : which features of `view` they are
    pose : rotation and direction; its length is not used

    Returns
    -------
    None where too few points tell

    """
    known = view.nearness[index]
    seen = nearness(points, replace(pose, position=-pose.direction))
    beside = np.linalg.norm(np.cross(points.current, pose.direction), axis=1)
    told = (known * view.baseline * beside > _TELLING) & (seen > 0)
    if told.sum() < _ENOUGH:
        return None
    lengths = seen[told] / known[told]
    length = float(np.median(lengths))
    spread = 1.4826 * float(np.median(np.abs(lengths - length)))
    return length, spread / float(np.sqrt(told.sum()))
