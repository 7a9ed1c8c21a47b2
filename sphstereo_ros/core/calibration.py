"""Alignment of two cameras, one above the other, from ordinary pictures.

The top camera is the reference view, the bottom one the current view. What is known of the rig is
the direction from one to the other (`baseline.direction`), so only the rotation is estimated; with
`estimate_direction` the direction too.

Each still point lies on one epipolar plane in both views. With the direction known it tells of one
axis of the rotation, that along its meridian: points near the horizon tell yaw, points above and
below it tell roll and pitch. That is why much of the sphere must be seen.
"""
from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from . import rotations
from .aligned_view import CurrentView, current_view, followed
from .camera import Equirectangular
from .config import Config
from .frames import Drop, Frame, Image8, RelativePose
from .photometric import normalised
from .relative_pose import (
    Correspondences,
    PoseEstimate,
    best_rotation,
    epipolar_residuals,
    in_front,
    linearised,
    parallax,
    ransac,
    refine,
    rotation_between,
    tangent,
    tukey_weights,
)
from .stabilisation import reduced
from .tracking import match, track
from .warp import PolarGrid

Floats = NDArray[np.float64]

_MARGIN, _WRAP = 8, 8
_ROUNDS = 2  # refinements of a pair on its aligned copy: the second one knows ranges

# Rotations about the prior that are tried first: up to 6° about each axis, in steps of a degree.
_STEP = math.radians(1)
_STEPS = _STEP * np.stack(np.meshgrid(*3 * [np.arange(-6, 7)]), axis=-1).reshape(-1, 3)

# Contrast and its floor for the first, coarse search: even faint structure counts.
_STRONG, _FAINT = 40.0, 12.0

# Cells of equal area that tell how much of the sphere is seen: azimuths × latitudes; one is seen
# where so many points lie in it. Errors are taken as alike within blocks of 2 × 2 cells.
_CELLS = (24, 12)
_SEEN = 3
# Least information about the weakest axis that points spread evenly over the cells seen would
# give, as a share of one cell's for each cell there is. The full sphere has 1/6, half of it 1/12.
_STRENGTH = 0.02

_DISAGREES = 0.05 * math.pi / 180  # rad by which a pair may differ from the others, or 5 sigma
_MAX_DIRECTION_SIGMA = 0.3 * math.pi / 180
_TILT = 0.15  # of an error of the direction that roll and pitch take over
# A direction that the pictures tell, so many sigma from the one given, is wrong where it changes
# the rotation by so many times what may be uncertain.
_SIGNIFICANT, _SHIFTED = 4, 2
_TELLING = ('wrong_direction', 'cameras_swapped')  # causes that say what to do
_BEHIND = 0.5  # share of points behind the cameras from which on top and bottom are swapped


@dataclass(frozen=True)
class PairFit:
    """One pair's own estimate, and its correspondences, outliers among them.

    rotation : (3, 3), X_bottom = rotation · X_top; sigma : rad, of the whole of it
    """

    rotation: Floats
    points: Correspondences
    sigma: float


@dataclass(frozen=True)
class CalibrationResult:
    """The alignment of the top camera and how well it is known.

    rotation : (3, 3), X_bottom = rotation · X_top + …, both camera_optical
    direction : (3,) unit, from the bottom to the top camera, bottom camera_optical
    covariance : (6, 6) of a small rotation about the bottom camera's optical axes (rad), then of
        the direction; the latter is zero where the direction was given
    direction_estimated : whether the direction was estimated
    lean : rad by which the direction that the pictures tell differs from the one given, and its
        standard deviation; NaN where they do not tell
    pairs, points : used; share : of the sphere seen; residual : rad, robust standard deviation of
        the points; parallax : rad, median
    """

    rotation: Floats
    direction: Floats
    covariance: Floats
    direction_estimated: bool
    lean: float
    lean_sigma: float
    pairs: int
    points: int
    share: float
    residual: float
    parallax: float

    @property
    def rpy(self) -> Floats:
        """`camera.top.{roll,pitch,yaw}`, rad."""
        return rotations.top_rpy(self.rotation)

    @property
    def rpy_sigma(self) -> Floats:
        """One standard deviation of each of `rpy`, rad."""
        jacobian = np.empty((3, 3))
        for axis, step in enumerate(1e-6 * np.eye(3)):
            turned = rotations.top_rpy(rotations.exp(step) @ self.rotation)
            jacobian[:, axis] = (turned - self.rpy) / 1e-6
        return np.asarray(np.sqrt(np.diag(jacobian @ self.covariance[:3, :3] @ jacobian.T)))

    @property
    def link_direction(self) -> Floats:
        """`baseline.direction`: (3,) unit, along the axes of the bottom camera_link."""
        return np.asarray(rotations.OPTICAL_FROM_LINK.T @ self.direction)

    @property
    def sigma(self) -> float:
        """Standard deviation about the weakest axis, rad."""
        return math.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3]).max())

    @property
    def direction_sigma(self) -> float:
        """Standard deviation of the direction, rad."""
        return math.sqrt(max(0.0, np.linalg.eigvalsh(self.covariance[3:, 3:]).max()))

    def pose(self, length: float) -> RelativePose:
        """Pose of the top camera in the bottom one's optical frame, `length` metres away."""
        stretch = np.diag([1.0, 1.0, 1.0, length, length, length])
        return RelativePose(self.rotation, length * self.direction,
                            stretch @ self.covariance @ stretch)


def configured_pose(config: Config, length: float) -> RelativePose:
    """Pose of the top camera in the bottom one's optical frame, as the parameters `camera.top.*`
    and `baseline.direction` tell, `length` metres away; without covariance.
    """
    return RelativePose(rotations.top_rotation(config.camera),
                        length * rotations.top_direction(config.baseline))


def estimate_alignment(pairs: Iterable[tuple[Frame, Frame]], config: Config,
                       mask: Image8 | None = None) -> CalibrationResult | Drop:
    """The alignment from the first pair or pairs (top, bottom) of frames."""
    calibration = AlignmentCalibration(config, mask)
    for top, bottom in pairs:
        calibration.add(top, bottom)
    return calibration.result()


class AlignmentCalibration:
    """Collects pairs and estimates one rotation (and direction) from all of them.

    config : `camera.top.*` is where the search begins (any misalignment is found, one of a few
        degrees quickest), `baseline.direction` is taken as exact
    mask : (H, W) uint8 of any size, non-zero = vehicle, in either view
    estimate_direction : estimate the direction too, starting from the one given
    """

    def __init__(self, config: Config, mask: Image8 | None = None, *,
                 estimate_direction: bool = False) -> None:
        self.config = config
        self.estimate_direction = estimate_direction
        self.drops: list[Drop] = []
        self.fits: list[PairFit] = []
        self._mask = mask
        self._direction = rotations.top_direction(config.baseline)
        self._prior = rotations.top_rotation(config.camera)

    def add(self, top: Frame, bottom: Frame) -> PairFit | Drop:
        """Take a pair of frames; returns what it tells by itself, or why it tells nothing.

        Drops: `size_changed`, `too_few_points`, `too_few_inliers`, `wrong_direction`,
        `cameras_swapped`.
        """
        fit = self.fit(top.image, bottom.image)
        if isinstance(fit, Drop):
            self.drops.append(fit)
        else:
            self.fits.append(fit)
            self._prior = fit.rotation
        return fit

    def fit(self, top: Image8, bottom: Image8) -> PairFit | Drop:
        """What a pair of images (H, 2H) tells by itself; it is not kept. Drops as for `add`."""
        if top.shape != bottom.shape:
            return Drop('size_changed', f'{top.shape} and {bottom.shape}')
        coarse = self._coarse(top, bottom)
        if isinstance(coarse, Drop):
            return coarse
        height = self.config.alignment.working_height
        images = [normalised(im if im.shape[0] < 1.3 * height else reduced(im, height))
                  for im in (top, bottom)]
        grid = PolarGrid(min(height, images[1].shape[0]), _MARGIN, _WRAP)
        pose = RelativePose(coarse.rotation, coarse.direction)
        view = current_view(images[1], pose.direction, grid, self.config.alignment.max_points)
        return self._refined(images[0], view, pose)

    def result(self) -> CalibrationResult | Drop:
        """What all pairs tell together, or why that is not enough.

        Drops: `no_pairs`; the most frequent failure of `add`, where no pair was of use;
        `pairs_disagree`; `too_little_of_sphere`; `calibration_uncertain`; `wrong_direction` (the
        one given); `no_parallax` (only where the direction was to be estimated).
        """
        if not self.fits:
            return _most_frequent(self.drops)
        good = _agreeing(self.fits)
        if 2 * len(good) <= len(self.fits):
            return Drop('pairs_disagree', f'only {len(good)} of {len(self.fits)} pairs agree on '
                        'one rotation')
        points = _joined([fit.points for fit in good])
        start = good[len(good) // 2].rotation
        pose = refine(start, self._direction, points, iterations=20, free_direction=False)
        free = refine(start, self._direction, points, iterations=20)
        chosen = free if self.estimate_direction else pose
        if chosen is None:
            return Drop('too_little_of_sphere', 'the points fix no rotation')
        return self._judged(chosen, free, points, len(good))

    # One pair

    def _refined(self, top: Image8, view: CurrentView, pose: RelativePose,
                 rounds: int = _ROUNDS) -> PairFit | Drop:
        """Follow features on the aligned copy and fit; each round after the first knows ranges."""
        while True:
            points, index = followed(view, top, pose)
            keep = self._beside_mask(points)
            points, index = points[keep], index[keep]
            if len(points) < self.config.pose.min_inliers:
                return Drop('too_few_points', f'{len(points)} points with texture')
            fit = refine(pose.rotation, pose.position, points,
                         free_direction=self.estimate_direction)
            if fit is None:
                return Drop('too_few_inliers', 'the points fix no rotation')
            residual = np.abs(epipolar_residuals(fit.rotation, fit.direction, points))
            good = fit.inliers & (residual < view.grid.pixel)
            if good.sum() < 0.3 * len(points):
                return Drop('too_few_inliers', f'{good.sum()} of {len(points)} fit one rotation')
            rounds -= 1
            if not rounds:
                covariance = _covariance(fit, points, self.estimate_direction)
                return PairFit(fit.rotation, points, math.sqrt(np.trace(covariance[:3, :3])))
            pose = RelativePose(fit.rotation, fit.direction)
            view = view.taught(points[fit.inliers], index[fit.inliers], pose)

    def _coarse(self, top: Image8, bottom: Image8) -> PoseEstimate | Drop:
        """Rotation to a few tenths of a degree, from features followed or, failing that, matched.
        """
        config = self.config.pose
        plain = [reduced(im, config.working_height) for im in (top, bottom)]
        before, now = (normalised(im, _STRONG, _FAINT) for im in plain)
        mask = None if self._mask is None else _resized(self._mask, now.shape)

        def tracked(rotation: Floats) -> PoseEstimate | Drop:
            points = track(before, now, rotation, config.max_points, mask)
            return self.from_points(points, rotation)

        found = tracked(self._prior)
        if isinstance(found, PoseEstimate):
            return found
        points = match(plain[0], plain[1], config.max_points, mask)
        wide = self.from_points(points, self._prior, config.min_inlier_ratio / 2)
        if isinstance(wide, Drop):
            return wide if wide.cause in _TELLING or found.cause == 'too_few_points' else found
        return tracked(wide.rotation)

    def from_points(self, points: Correspondences, prior: Floats | None = None,
                    share: float | None = None) -> PoseEstimate | Drop:
        """The rotation that most correspondences (reference: top) fit, however large it is.

        prior : (3, 3), where it is looked for first
        share : of the points that must fit; None = `pose.min_inlier_ratio`
        """
        config = self.config.pose
        if len(points) < config.min_inliers:
            return Drop('too_few_points', f'{len(points)} points with texture')
        least = max(config.min_inliers, (config.min_inlier_ratio if share is None else share)
                    * len(points))
        starts = self._candidates(points, self._prior if prior is None else prior)
        best, most = self._best_fit(starts, points, self.estimate_direction)
        if best is None or most < least:
            free = None if self.estimate_direction else self._best_fit(starts, points, True)
            if free is not None and free[0] is not None and free[1] >= least:
                return self._leaning(free[0])
            return Drop('too_few_inliers', f'{most} of {len(points)} fit one rotation')
        return self._sided(best, points)

    def _best_fit(self, starts: list[tuple[Floats, Floats]], points: Correspondences,
                  free_direction: bool) -> tuple[PoseEstimate | None, int]:
        """The fit with the most inliers, and how many these are."""
        best, most = None, 0
        for rotation, direction in starts:
            fit = refine(rotation, direction if free_direction else self._direction, points,
                         iterations=30, free_direction=free_direction)
            if fit is None:
                continue
            residual = np.abs(epipolar_residuals(fit.rotation, fit.direction, points))
            count = int((residual < self.config.pose.inlier_threshold).sum())
            if count > most:
                best, most = fit, count
        return best, most

    def _leaning(self, free: PoseEstimate, more: str = '') -> Drop:
        # The twin's direction may point the other way.
        cosine = min(1.0, abs(float(free.direction @ self._direction)))
        return Drop('wrong_direction', 'what fits is not baseline.direction as given, but one '
                    f'that leans by {math.degrees(math.acos(cosine)):.1f}° from it{more}; give or '
                    'estimate it (or the frames of a pair are not of one time)')

    def _candidates(self, points: Correspondences,
                    prior: Floats) -> list[tuple[Floats, Floats]]:
        """Where to start from: what fits best near the prior and near the rotation that would
        explain all if all was far, and what samples of five points tell.
        """
        far = points
        for _ in range(5):
            turn = rotation_between(far)
            moved = parallax(turn, points)
            far = points[moved <= max(float(np.median(moved)), 1e-6)]
        out = []
        for centre in (prior, turn):
            near = _turns() @ centre
            out.append((best_rotation(near, self._direction, points, _STEP), self._direction))
        found = ransac(points, self.config.pose.inlier_threshold,
                       np.random.default_rng(self.config.pose.seed))
        if found is not None:
            out.append(found)
        return out

    def _sided(self, fit: PoseEstimate, points: Correspondences) -> PoseEstimate | Drop:
        """The fit, or that of its twin that has points in front of both cameras.

        Half a turn about the baseline leaves all epipolar planes where they are.
        """
        twin = replace(fit, rotation=rotations.exp(np.pi * fit.direction) @ fit.rotation)
        for pose in (fit, twin):
            if self._behind(pose, points) <= _BEHIND:
                return pose
        return Drop('cameras_swapped', 'near points move the wrong way: are top and bottom '
                    'swapped?')

    def _behind(self, fit: PoseEstimate, points: Correspondences) -> float:
        """Share of the points that moved which lie behind the cameras."""
        threshold = self.config.pose.inlier_threshold
        residual = np.abs(epipolar_residuals(fit.rotation, fit.direction, points))
        moved = points[(residual < threshold) & (parallax(fit.rotation, points) > threshold)]
        if len(moved) < self.config.pose.min_inliers:
            return 0.0
        return float((~in_front(fit.rotation, fit.direction, moved)).mean())

    def _beside_mask(self, points: Correspondences) -> NDArray[np.bool_]:
        keep = np.ones(len(points), bool)
        if self._mask is None:
            return keep
        height, width = self._mask.shape
        for bearings in (points.reference, points.current):
            u, v = np.rint(Equirectangular(height, width).project(bearings)).astype(np.intp).T
            keep &= self._mask[v.clip(0, height - 1), u % width] == 0
        return keep

    # All pairs

    def _judged(self, pose: PoseEstimate, free: PoseEstimate | None, points: Correspondences,
                pairs: int) -> CalibrationResult | Drop:
        used = points[pose.inliers]
        moved = float(np.median(parallax(pose.rotation, used)))
        covariance = self._with_floor(_covariance(pose, points, self.estimate_direction), pose,
                                      moved)
        lean, lean_sigma = self._lean(free, points, moved)
        result = CalibrationResult(
            pose.rotation, pose.direction, covariance, self.estimate_direction, lean, lean_sigma,
            pairs, len(used), _share_seen(used.current), pose.residual, moved)
        strength = _strength(pose, used)
        if strength < _STRENGTH:
            return Drop('too_little_of_sphere', f'points in {100 * result.share:.0f} % of the '
                        'sphere do not fix roll, pitch and yaw')
        limit = self.config.calibration.max_sigma
        if not self.estimate_direction and free is not None and lean > _SIGNIFICANT * lean_sigma:
            turn = rotations.angle(pose.rotation @ free.rotation.T)
            if turn > _SHIFTED * limit:
                return self._leaning(free, f', and turns the cameras by {_degrees(turn)}')
        if self.estimate_direction and result.direction_sigma > _MAX_DIRECTION_SIGMA:
            return Drop('no_parallax', 'the scene is too far away to tell the direction of the '
                        f'baseline (median parallax {_degrees(result.parallax)}); the rotation '
                        'alone would be known')
        if result.sigma > limit:
            return Drop('calibration_uncertain', f'standard deviation {_degrees(result.sigma)} is '
                        f'over {_degrees(limit)}: too little texture, or things that move')
        return result

    def _lean(self, free: PoseEstimate | None, points: Correspondences,
              moved: float) -> tuple[float, float]:
        """Angle between the direction found and the one given, and its standard deviation."""
        if free is None:
            return math.nan, math.nan
        cross = np.linalg.norm(np.cross(free.direction, self._direction))
        sigma = math.hypot(self._direction_floor(moved), math.sqrt(
            np.linalg.eigvalsh(_covariance(free, points, True)[3:, 3:]).max()))
        if sigma > _MAX_DIRECTION_SIGMA:
            return math.nan, math.nan
        return math.atan2(cross, float(free.direction @ self._direction)), sigma

    def _direction_floor(self, moved: float) -> float:
        """What a systematic error of all points makes of a direction, rad.

        moved : median parallax, rad: an error of the points counts as a share of it
        """
        config = self.config.alignment
        return math.hypot(config.direction_sigma, config.rotation_sigma / max(moved, 1e-9))

    def _with_floor(self, covariance: Floats, pose: PoseEstimate, moved: float) -> Floats:
        """Add what is systematic, which residuals do not show."""
        turn = self.config.alignment.rotation_sigma**2
        floor = np.zeros((6, 6))
        if self.estimate_direction:
            across = np.eye(3) - np.outer(pose.direction, pose.direction)
            lean = self._direction_floor(moved)**2
            floor[3:, 3:] = lean * across
            floor[:3, :3] = _TILT**2 * lean * across
        floor[:3, :3] += turn * np.eye(3)
        return covariance + floor


@cache
def _turns() -> Floats:
    """The rotations of `_STEPS`, (N, 3, 3)."""
    return np.array([rotations.exp(step) for step in _STEPS])


def _most_frequent(drops: list[Drop]) -> Drop:
    if not drops:
        return Drop('no_pairs', 'no pair of frames')
    causes = [drop.cause for drop in drops]
    return next(d for d in drops if d.cause == max(causes, key=causes.count))


def _degrees(angle: float) -> str:
    return f'{math.degrees(angle):.3f}°'


def _joined(parts: list[Correspondences]) -> Correspondences:
    return Correspondences(np.concatenate([p.reference for p in parts]),
                           np.concatenate([p.current for p in parts]),
                           np.concatenate([p.sigma for p in parts]))


def _agreeing(fits: list[PairFit]) -> list[PairFit]:
    """Pairs whose own rotation is near what most tell."""
    first = fits[0].rotation
    turns = np.array([rotations.log(fit.rotation @ first.T) for fit in fits])
    away = np.linalg.norm(turns - np.median(turns, axis=0), axis=1)
    return [fit for fit, angle in zip(fits, away, strict=True)
            if angle < max(_DISAGREES, 5 * fit.sigma)]


def _cells(bearings: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Azimuth and latitude index of the cell of equal area that each bearing (N, 3) lies in."""
    around, up = _CELLS
    azimuth = (np.arctan2(bearings[:, 0], bearings[:, 2]) / (2 * np.pi) + 0.5) * around
    latitude = (bearings[:, 1] + 1) / 2 * up
    return (azimuth.astype(np.intp).clip(0, around - 1),
            latitude.astype(np.intp).clip(0, up - 1))


def _share_seen(bearings: Floats) -> float:
    """Share of the sphere with points in it."""
    around, up = _CELLS
    column, row = _cells(bearings)
    counts = np.bincount(row * around + column, minlength=around * up)
    return float((counts >= _SEEN).mean())


def _strength(pose: PoseEstimate, points: Correspondences) -> float:
    """Least eigenvalue of the rotation's information, were all cells that are seen alike."""
    around, up = _CELLS
    _, derivatives = linearised(pose.rotation, pose.direction, points)
    column, row = _cells(points.current)
    cell = row * around + column
    counts = np.bincount(cell, minlength=around * up)
    weight = np.where(counts >= _SEEN, 1 / np.maximum(counts, 1), 0)[cell]
    turn = derivatives[:, :3]
    return float(np.linalg.eigvalsh((turn * weight[:, None]).T @ turn)[0] / (around * up))


def _covariance(pose: PoseEstimate, points: Correspondences, free_direction: bool) -> Floats:
    """Covariance (6, 6) of a small rotation and of the unit direction.

    Points near each other, and the same place in all pairs, err alike: gradients are summed by
    block before they are squared (cluster-robust sandwich estimator), so that the same picture
    twice does not count twice. To it comes what independent points would have.
    """
    residual, derivatives = linearised(pose.rotation, pose.direction, points)
    spread = np.zeros((6, 5))
    spread[:3, :3], spread[3:, 3:] = np.eye(3), tangent(pose.direction)
    spread = spread[:, :5 if free_direction else 3]
    scale = max(pose.residual / float(np.median(points.sigma)), 1e-9)
    weight = tukey_weights(residual, points.sigma, scale)
    jacobian = derivatives @ spread
    inverse = np.linalg.inv((jacobian * weight[:, None]).T @ jacobian)
    column, row = _cells(points.current)
    block = row // 2 * (_CELLS[0] // 2) + column // 2
    blocks = np.zeros((_CELLS[0] * _CELLS[1] // 4, spread.shape[1]))
    np.add.at(blocks, block, jacobian * (weight * residual)[:, None])
    inner = blocks.T @ blocks
    covariance = inverse @ inner @ inverse + inverse * scale**2
    return np.asarray(spread @ covariance @ spread.T)


def _resized(mask: Image8, shape: tuple[int, ...]) -> Image8:
    rows, columns = (np.arange(n) * m // n for n, m in zip(shape, mask.shape, strict=True))
    return np.asarray(mask[np.ix_(rows, columns)])
