"""Stage 1 for two cameras: frames of both become windows with the top camera as a reference.

The bottom camera's frame is current. Where the rig moves, earlier frames of the bottom camera are
references, too: what the vertical pair cannot see, straight up and down, motion does, and the
other way round. Their poses are found by the later stages; the top camera's is calibrated.
"""
from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from . import rotations
from .baseline import SECOND
from .calibration import AlignmentCalibration, configured_pose, estimate_alignment
from .config import Config
from .drift import DriftTracker
from .frames import UNSCALED, Drop, Frame, FrameKey, Image8, PairedWindow, Reference, RelativePose
from .history import compose
from .motion import ImuSample, OdometrySample, TwistSample
from .pairing import Outcome, Pairer
from .synchronisation import FramePair, LoneFrame, Met, Side, Synchroniser

Job = Callable[[], None]
Floats = NDArray[np.float64]

# What one sensor message may hold up: the vertical pair does not need it.
_MAX_WAITING = 2
_DRIFT_EVERY = 2 * SECOND
# A standard deviation that needs no more pairs, rad.
_SURE = 0.01 * math.pi / 180
# So many pairs, as a multiple of those asked for, until a calibration that fails begins anew.
_ATTEMPTS = 10


class TopPose:
    """Where the top camera is believed to be: as configured, or estimated from the pictures.

    run : does a job that takes long, now or later
    """

    def __init__(self, config: Config, mask: Image8 | None, run: Callable[[Job], None]) -> None:
        self._run = run
        self._mask = mask
        self._results: deque[tuple[int, Floats, float]] = deque()
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take new parameters; a calibration from pictures is kept while nothing about it changed.
        """
        wanted = (config.camera, config.baseline.direction, config.calibration)
        self._config = config
        self._length = config.baseline.length or UNSCALED
        if getattr(self, '_wanted', None) == wanted:
            return
        self._wanted = wanted
        self._calibration = AlignmentCalibration(config, self._mask)
        self._tries = 0
        self._measured: int | None = None
        self._tracker: DriftTracker | None = None
        if not config.calibration.pairs:
            self._start(rotations.top_rotation(config.camera), None)

    def _start(self, rotation: Floats, covariance: Floats | None) -> None:
        self._tracker = DriftTracker(rotation, self._config.calibration)
        sigma = self._config.alignment
        if covariance is None:
            covariance = np.zeros((6, 6))
            covariance[:3, :3] = sigma.rotation_sigma**2 * np.eye(3)
            covariance[3:, 3:] = sigma.direction_sigma**2 * np.eye(3)
        self._covariance = covariance

    @property
    def values(self) -> dict[str, object]:
        """What /diagnostics tells of it."""
        if self._tracker is None:
            return {'alignment': 'being estimated'}
        rpy = np.degrees(rotations.top_rpy(self._tracker.rotation))
        told: dict[str, object] = {'alignment_deg': ' '.join(f'{a:.3f}' for a in rpy)}
        if self._config.calibration.online:
            told['alignment_drift_deg'] = f'{np.degrees(self._tracker.drift):.3f}'
        return told

    def of(self, pair: FramePair) -> tuple[RelativePose | Drop, list[Drop]]:
        """Pose of the top camera in the bottom one's frame, and what was amiss on the way.

        Drops in place of the pose: `calibrating`, `calibration_lost`.
        """
        if self._tracker is None:
            failed = self._calibrate(pair)
            if failed is not None:
                return failed, []
        amiss = self._followed(pair)
        assert self._tracker is not None
        if self._tracker.knocked:
            return Drop('calibration_lost', 'the top camera was moved: calibrate anew'), amiss
        stretch = np.diag([1.0, 1.0, 1.0, *[self._length] * 3])
        pose = configured_pose(self._config, self._length)
        return replace(pose, rotation=self._tracker.rotation,
                       covariance=stretch @ self._covariance @ stretch), amiss

    def _calibrate(self, pair: FramePair) -> Drop | None:
        wanted, self._tries = self._config.calibration.pairs, self._tries + 1
        if self._tries > _ATTEMPTS * wanted:
            self._calibration, self._tries = AlignmentCalibration(self._config, self._mask), 1
        self._calibration.add(pair.top, pair.bottom)
        count = len(self._calibration.fits)
        result = self._calibration.result()
        if isinstance(result, Drop):
            return Drop('calibrating', f'{result.cause}: {result.detail}')
        if count < wanted and result.sigma > _SURE:
            return Drop('calibrating', f'{count} of {wanted} pairs, '
                        f'sigma {math.degrees(result.sigma):.3f}°')
        self._start(result.rotation, result.covariance)
        return None

    def _followed(self, pair: FramePair) -> list[Drop]:
        """Take what was measured of drift, and measure anew when it is time."""
        if not self._config.calibration.online or self._tracker is None:
            return []
        amiss = []
        while self._results:
            amiss.append(self._tracker.add(*self._results.popleft()))
        stamp = pair.bottom.key.stamp
        if self._measured is None or not 0 <= stamp - self._measured < _DRIFT_EVERY:
            self._measured = stamp
            self._run(lambda: self._measure(stamp, pair))
        return [drop for drop in amiss if drop is not None]

    def _measure(self, stamp: int, pair: FramePair) -> None:
        assert self._tracker is not None
        now = rotations.top_rpy(self._tracker.rotation)
        start = replace(self._config.camera, top_roll=float(now[0]), top_pitch=float(now[1]),
                        top_yaw=float(now[2]))
        fit = AlignmentCalibration(replace(self._config, camera=start), self._mask).fit(
            pair.top.image, pair.bottom.image)
        if not isinstance(fit, Drop):
            self._results.append((stamp, fit.rotation, fit.sigma))


class BinocularPairer(Pairer):
    """Makes windows of the frames of two cameras.

    Every pair of frames has one outcome, and so has every frame that finds no partner. Without
    `baseline.length` the poses are without scale, and the top camera is the only reference.

    mask : of the vehicle, in either view
    run : does a job that takes long (following drift), now or later
    """

    max_waiting = _MAX_WAITING

    def __init__(self, config: Config, mask: Image8 | None = None,
                 run: Callable[[Job], None] = lambda job: job()) -> None:
        self._full = config
        self._synchroniser = Synchroniser(config.pairing.tolerance, config.pairing.max_gap)
        self._top = TopPose(config, mask, run)
        self._tops: dict[FrameKey, tuple[Frame, RelativePose]] = {}
        self._frame_ids: dict[Side, str] = {}
        self._alone: tuple[Side, Pairer] | None = None
        super().__init__(config)

    def configure(self, config: Config) -> None:
        """Take new parameters; frames and sensor samples stay."""
        self._full = config
        self._synchroniser.configure(config.pairing.tolerance, config.pairing.max_gap)
        self._top.configure(config)
        if self._alone is not None:
            self._alone[1].configure(self._lone_config(self._alone[0]))
        super().configure(config)

    @property
    def values(self) -> dict[str, object]:
        """What /diagnostics tells."""
        return {'cameras': self.warning or 'binocular', **self._top.values}

    @property
    def warning(self) -> str:
        """Which camera is silent, and what is done about it."""
        silent = self._synchroniser.silent
        if not silent:
            return ''
        return f'{silent[0]} camera silent' + (
            ', the other continues as monocular' if self._full.pairing.fallback else '')

    def warm_up(self) -> None:
        """Compile what the alignment of the cameras needs."""
        calibration = self._full.calibration
        if calibration.pairs or calibration.online:
            noise = np.random.default_rng(0).integers(0, 255, (60, 120), np.uint8)
            image = cv2.resize(noise, (480, 240), interpolation=cv2.INTER_CUBIC)
            still = Frame(FrameKey(0, ''), np.asarray(image, np.uint8))
            estimate_alignment([(still, still)], self._full)

    def named(self, side: Side, frame: Frame) -> Frame:
        """The frame under a name of its own: both cameras may come with one frame_id."""
        key = frame.key
        self._frame_ids[side] = key.frame_id
        if side == 'top' and key.frame_id == self._frame_ids.get('bottom'):
            return replace(frame, key=FrameKey(key.stamp, f'{key.frame_id}_top'))
        return frame

    def add_view(self, side: Side, frame: Frame) -> list[Outcome]:
        """Take the next frame of a camera."""
        return self._met(self._synchroniser.add(side, self.named(side, frame)))

    def flush(self) -> list[Outcome]:
        """Nothing more is to come for now: what still waits is a window, or dropped."""
        out = self._met(self._synchroniser.flush())
        return out + self._left_alone() + self._drained()

    def add_odometry(self, sample: OdometrySample) -> list[Outcome]:
        """Take a sample of odometry; gives the frames that waited for it."""
        return super().add_odometry(sample) + self._told()

    def add_twist(self, sample: TwistSample) -> list[Outcome]:
        """Take a sample of velocity; gives the frames that waited for it."""
        return super().add_twist(sample) + self._told()

    def add_imu(self, sample: ImuSample) -> list[Outcome]:
        """Take a sample of an IMU."""
        return super().add_imu(sample) + self._told()

    def _met(self, met: list[Met]) -> list[Outcome]:
        out: list[Outcome] = []
        for one in met:
            if isinstance(one, FramePair):
                out += self._left_alone() + self._add_pair(one)
            elif isinstance(one, LoneFrame):
                out += self._add_lone(one)
            else:
                out.append(one)
        return out

    # Two cameras

    def _add_pair(self, pair: FramePair) -> list[Outcome]:
        bottom, top = pair.bottom, self.named('top', pair.top)
        pose, amiss = self._top.of(pair)
        out: list[Outcome] = list(amiss)
        if self._discontinuity(bottom) is not None:
            out += self._drained()
            self._frames.clear()
            self._priors.time_jumped(bottom.key.stamp)
        self._last = bottom
        if isinstance(pose, Drop):
            self._keep(bottom)
            return [*out, pose]
        self._tops[bottom.key] = top, pose
        self._waiting.append(bottom)
        return out + self._release()

    def _drained(self) -> list[Outcome]:
        out: list[Outcome] = []
        while self._waiting:
            frame = self._waiting.popleft()
            out.append(self._window(frame))
            self._keep(frame)
        return out

    def _needed(self, frame: Frame) -> int:
        """Until when sensors must have told: both cameras' stamps."""
        return max(frame.key.stamp, self._tops[frame.key][0].key.stamp)

    def _window(self, frame: Frame) -> Outcome:
        top, pose = self._tops.pop(frame.key)
        if self._is_early(frame):
            return Drop('rate_limit', 'kept as a reference')
        self._paired = frame.key.stamp
        moved = self._priors.moved(top.key.stamp, frame.key.stamp) if pose.is_metric else None
        if moved is not None:
            pose = replace(compose(moved, replace(pose, covariance=None)),
                           covariance=pose.covariance)
        references = [Reference(top, pose)]
        if self._full.pairing.motion and pose.is_metric:
            references += self._moved(frame)
        return PairedWindow(frame, tuple(references))

    def _moved(self, frame: Frame) -> list[Reference]:
        """Earlier frames of the bottom camera, nearest first."""
        found = [Reference(earlier, pose) for earlier, pose in self._earlier(frame)
                 if isinstance(pose, RelativePose) and pose.is_metric]
        return sorted(found, key=lambda r: (r.pose.baseline, -r.frame.key.stamp))

    # One camera

    def _add_lone(self, lone: LoneFrame) -> list[Outcome]:
        if not self._full.pairing.fallback:
            silent = 'bottom' if lone.side == 'top' else 'top'
            return [Drop(f'{silent}_missing', 'the camera is silent')]
        out: list[Outcome] = []
        if self._alone is None or self._alone[0] != lone.side:
            out = self._left_alone() + self._drained()
            pairer = Pairer(self._lone_config(lone.side))
            pairer.share_samples(self)
            self._alone = lone.side, pairer
        return out + self._alone[1].add_frame(lone.frame)

    def _left_alone(self) -> list[Outcome]:
        """The end of a time with one camera."""
        alone, self._alone = self._alone, None
        return [] if alone is None else alone[1].flush()

    def _lone_config(self, side: Side) -> Config:
        """One camera's own: its mount, and no length, which is that between the cameras."""
        config = self._full
        if config.baseline.source == 'fixed':
            config = replace(config, baseline=replace(config.baseline, length=0.0))
        if side == 'bottom':
            return config
        pose = configured_pose(config, self._full.baseline.length)
        camera = rotations.mounted_on(config.camera, pose.rotation, pose.position)
        return replace(config, camera=camera)

    def _told(self) -> list[Outcome]:
        """What a new sample decides for one camera by itself."""
        return [] if self._alone is None else self._alone[1].samples_came()
