"""Stage 1: frames become windows of one current frame and its references, with prior poses."""
from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from sphstereo_ros.core.baseline import SECOND, MotionPriors
from sphstereo_ros.core.config import Config, PairingConfig
from sphstereo_ros.core.frames import Drop, Frame, PairedWindow, Reference, RelativePose
from sphstereo_ros.core.motion import ImuSample, OdometrySample, TwistSample

MAX_WAITING = 10
_EARLY = 0.9  # of the least time between windows: stamps jitter
# Memory for the frames among which a wanted baseline is looked for.
MAX_BYTES = 512 * 2**20

Outcome = PairedWindow | Drop


def by_distance(config: PairingConfig) -> bool:
    """Whether references are chosen by `baselines`, not by `intervals`."""
    return config.baselines != (0.0,)


def farthest_reference(config: PairingConfig, frame_bytes: int) -> int:
    """How many frames back a reference may be: so many frames are kept.

    frame_bytes : of one frame's images
    """
    if not by_distance(config):
        return max(config.intervals)
    return max(1, min(config.max_frames, MAX_BYTES // max(frame_bytes, 1)))


def frame_bytes(frame: Frame) -> int:
    """Memory of a frame's images."""
    return frame.image.nbytes + (0 if frame.colour is None else frame.colour.nbytes)


class Pairer:
    """Makes windows of the frames that come in.

    Every frame has exactly one outcome: a window, or a Drop that says why there is none. A frame
    whose odometry (or twist) is not there yet waits for it, and its outcome comes with a later
    message. Drops of sensor messages come on top; their causes begin with the sensor's name.
    """

    max_waiting = MAX_WAITING

    def __init__(self, config: Config) -> None:
        self._priors = MotionPriors(config)
        self._waiting: deque[Frame] = deque()
        self._frames: deque[Frame] = deque()
        self._last: Frame | None = None
        self._paired: int | None = None
        self.configure(config)

    def configure(self, config: Config) -> None:
        """Take new parameters; frames and sensor samples stay."""
        self._config = config.pairing
        self._priors.configure(config)
        self._trim()

    @property
    def values(self) -> dict[str, object]:
        """What /diagnostics tells of it."""
        return {}

    @property
    def warning(self) -> str:
        """What is amiss, empty if nothing is."""
        return ''

    def warm_up(self) -> None:
        """Compile what pairing needs."""

    def add_frame(self, frame: Frame) -> list[Outcome]:
        """Take the next frame of the camera."""
        drop = self._discontinuity(frame)
        if drop is not None and drop.cause == 'duplicate_stamp':
            return [drop]
        out: list[Outcome] = []
        if drop is not None:
            out = self.flush()
            self._frames.clear()
            self._priors.time_jumped(frame.key.stamp)
            out.append(drop)
            self._keep(frame)
        else:
            self._waiting.append(frame)
            out = self._release()
        self._last = frame
        return out

    def add_odometry(self, sample: OdometrySample) -> list[Outcome]:
        """Take a sample of odometry; gives the frames that waited for it."""
        return self._after(self._priors.add_odometry(sample))

    def add_twist(self, sample: TwistSample) -> list[Outcome]:
        """Take a sample of velocity; gives the frames that waited for it."""
        return self._after(self._priors.add_twist(sample))

    def add_imu(self, sample: ImuSample) -> list[Outcome]:
        """Take a sample of an IMU."""
        return self._after(self._priors.add_imu(sample))

    def share_samples(self, pairer: Pairer) -> None:
        """Know what `pairer` is told by sensors, from now on and so far."""
        self._priors.share_samples(pairer._priors)

    def samples_came(self) -> list[Outcome]:
        """Go on after a sample that was shared; gives the frames that waited for it."""
        self._priors.samples_came()
        return self._release()

    def flush(self) -> list[Outcome]:
        """Nothing more is to come for now: what still waits is dropped."""
        out: list[Outcome] = []
        while self._waiting:
            frame = self._waiting.popleft()
            sensor = self._priors.waits_for(self._needed(frame))
            out.append(Drop(f'{sensor}_missing', 'none came while the frame waited') if sensor
                       else self._window(frame))
            self._keep(frame)
        return out

    def _keep(self, frame: Frame) -> None:
        self._frames.append(frame)
        self._trim()

    def _trim(self) -> None:
        if self._frames:
            size = farthest_reference(self._config, frame_bytes(self._frames[-1]))
            while len(self._frames) > size:
                self._frames.popleft()

    def _after(self, drop: Drop | None) -> list[Outcome]:
        return [*([] if drop is None else [drop]), *self._release()]

    def _release(self) -> list[Outcome]:
        out: list[Outcome] = []
        while self._waiting and (len(self._waiting) > self.max_waiting
                                 or not self._priors.waits_for(self._needed(self._waiting[0]))):
            frame = self._waiting.popleft()
            out.append(self._window(frame))
            self._keep(frame)
        return out

    def _needed(self, frame: Frame) -> int:
        """Until when sensors must have told, before `frame` is paired."""
        return frame.key.stamp

    def _discontinuity(self, frame: Frame) -> Drop | None:
        """Why `frame` does not continue what came before it, if it does not."""
        last = self._last
        if last is None:
            return Drop('first_frame')
        if frame.key.frame_id != last.key.frame_id:
            return Drop('frame_id_changed', f'{last.key.frame_id!r} to {frame.key.frame_id!r}')
        if frame.key.stamp == last.key.stamp:
            return Drop('duplicate_stamp', f'{frame.key.stamp} ns')
        seconds = (frame.key.stamp - last.key.stamp) / SECOND
        if seconds < 0:
            return Drop('stamp_backward', f'by {-seconds:.3f} s')
        if seconds > self._config.max_gap:
            return Drop('stamp_gap', f'{seconds:.3f} s')
        if frame.image.shape != last.image.shape:
            return Drop('size_changed', f'{last.image.shape} to {frame.image.shape}')
        return None

    def _window(self, frame: Frame) -> Outcome:
        """Pair `frame` with earlier ones, nearest first, unless the last window is too recent."""
        if self._is_early(frame):
            return Drop('rate_limit', 'kept as a reference')
        found = self._earlier(frame)
        drops = [pose for _, pose in found if isinstance(pose, Drop)]
        references = [Reference(reference, pose) for reference, pose in found
                      if isinstance(pose, RelativePose)]
        if references:
            references.sort(key=lambda r: (r.pose.baseline, -r.frame.key.stamp))
            self._paired = frame.key.stamp
            return PairedWindow(frame, tuple(references))
        return drops[0] if drops else Drop('no_reference', 'no earlier frame is far enough back')

    def _earlier(self, frame: Frame) -> list[tuple[Frame, RelativePose | Drop]]:
        return self._by_distance(frame) if by_distance(self._config) else self._by_interval(frame)

    def _is_early(self, frame: Frame) -> bool:
        rate, last = self._config.max_rate, self._paired
        return (rate > 0 and last is not None
                and 0 < frame.key.stamp - last < _EARLY * SECOND / rate)

    def _by_interval(self, frame: Frame) -> list[tuple[Frame, RelativePose | Drop]]:
        return [self._prior(frame, back) for back in sorted(set(self._config.intervals))
                if back <= len(self._frames)]

    def _prior(self, frame: Frame, back: int) -> tuple[Frame, RelativePose | Drop]:
        reference = self._frames[-back]
        return reference, self._priors.between(reference.key.stamp, frame.key.stamp, back)

    def _by_distance(self, frame: Frame) -> list[tuple[Frame, RelativePose | Drop]]:
        """The earlier frames whose distances are nearest to the wanted ones."""
        wanted = self._config.baselines
        backs: list[int] = []
        distances: list[float] = []
        stamps = [earlier.key.stamp for earlier in reversed(self._frames)]
        for back, distance in enumerate(self._priors.distances(frame.key.stamp, stamps), start=1):
            if np.isfinite(distance):
                backs.append(back)
                distances.append(distance)
                if distance > 2 * max(wanted):
                    break
        if not backs:  # the sensor tells of none, or of a hover
            return [self._prior(frame, 1)] if self._frames else []
        return [self._prior(frame, backs[i]) for i in nearest_matches(distances, wanted)]


def nearest_matches(distances: list[float], wanted: Iterable[float]) -> list[int]:
    """Indices into `distances` of the nearest match to each wanted distance, without repeats.

    A wanted distance that `distances` have not reached is left out, unless the farthest one comes
    within half of the mean step between them: a nearer match will not come.
    """
    if not distances:
        return []
    reach = max(distances)
    half_step = reach / len(distances) / 2
    chosen = {min(range(len(distances)), key=lambda i: abs(distances[i] - distance))
              for distance in wanted if distance <= reach + half_step}
    return sorted(chosen)
