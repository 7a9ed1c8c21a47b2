"""What a file of results holds, as far as a report shows it; memory is bounded."""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphstereo_ros.bench.scoring import compare, solid_angle
from sphstereo_ros.core import rotations
from sphstereo_ros.core.frames import Drop, FrameKey, Image8, PointCloud, RangeImage
from sphstereo_ros.core.preview import colour_map
from sphstereo_ros.replay.player import stamp_of
from sphstereo_ros.replay.records import COMPRESSED, IMAGE, BadInput, Record, Source
from sphstereo_ros.report.clouds import (
    GREATEST_RANGE,
    GREATEST_SIGMA,
    certain,
    joined,
    moved,
    read_points,
    thinned,
)
from sphstereo_ros.report.tracks import Track, odometry_track, path_track, visual_track
from sphstereo_ros.ros.conversions import decode_frame, read_depth

DEPTH, SIGMA, RELATIVE, PREVIEW = ('/depth/image', '/depth/sigma', '/depth/relative',
                                   '/depth/preview')
POINTS, MAP, SCAN, NEAREST = '/points', '/map', '/obstacles/scan', '/obstacles/nearest'
TIME_TO_CONTACT, DIAGNOSTICS, ALIGNED = ('/obstacles/time_to_contact', '/diagnostics',
                                         '/pairs/aligned')
VISUAL, ODOMETRY, TRUTH = '/odometry/visual', '/odometry', '/ground_truth/range'
RESULTS = (DEPTH, RELATIVE, PREVIEW, POINTS, MAP, SCAN)
IMAGES = ('/image', '/image/compressed', '/bottom/image', '/bottom/image/compressed')
KINDS = {DEPTH: IMAGE, SIGMA: IMAGE, RELATIVE: IMAGE, PREVIEW: IMAGE, TRUTH: IMAGE,
         POINTS: 'sensor_msgs/msg/PointCloud2', MAP: 'sensor_msgs/msg/PointCloud2',
         SCAN: 'sensor_msgs/msg/LaserScan', NEAREST: 'sensor_msgs/msg/Range',
         TIME_TO_CONTACT: 'std_msgs/msg/Float32', ALIGNED: 'nav_msgs/msg/Path',
         DIAGNOSTICS: 'diagnostic_msgs/msg/DiagnosticArray',
         **{topic: COMPRESSED if topic.endswith('compressed') else IMAGE for topic in IMAGES}}
_ODOMETRY, _PATH = 'nav_msgs/msg/Odometry', 'nav_msgs/msg/Path'
# So many frames are shown, scored and accumulated, at most; spread evenly.
SHOWN, SCORED, ACCUMULATED = 24, 20, 80
# Points of all clouds together: kept while reading.
GREATEST_CLOUD = 1_000_000
# Each so many rows and columns of a depth image are looked at for its shares.
_STRIDE = 4
_SHOWN_HEIGHT = 320
# Rows of a range image that are scored, and as many pairs of columns: a larger one is thinned.
_SCORED_HEIGHT = 480


@dataclass(frozen=True)
class Shares:
    """Of a depth image's solid angle, in %: what it says; and its median range (m, or steps)."""

    stamp: int
    known: float
    beyond: float
    too_near: float
    median: float


@dataclass
class TopicSeen:
    """Messages of a topic: stamp (0 where it has none) and time of recording, nanoseconds.

    bag : which one they are in, 0 = that of the results
    """

    kind: str
    bag: int = 0
    stamps: list[int] = field(default_factory=list)
    times: list[int] = field(default_factory=list)


@dataclass
class ShownFrame:
    """Pictures (320, 640, 3) BGR of a frame: range in colours, and what the camera saw."""

    stamp: int
    depth: Image8
    image: Image8 | None = None


@dataclass
class Judged:
    """The range image that is compared with the truth in a picture, metres; its error in %."""

    stamp: int
    measured: NDArray[np.float32]
    truth: NDArray[np.float32]


@dataclass
class Contents:
    """All that a report shows.

    topics : by name, without the namespace; diagnostics : messages in order;
    cloud : in the frame that `cloud_source` tells of; scores : of `bench.scoring.compare`
    """

    topics: dict[str, TopicSeen] = field(default_factory=dict)
    diagnostics: list[Any] = field(default_factory=list)
    shares: list[Shares] = field(default_factory=list)
    frames: list[ShownFrame] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    judged: Judged | None = None
    tracks: list[Track] = field(default_factory=list)
    cloud: PointCloud | None = None
    cloud_source: str = ''
    scans: list[Any] = field(default_factory=list)
    nearest: list[tuple[int, float]] = field(default_factory=list)
    unreadable: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    @property
    def is_metric(self) -> bool:
        """Whether ranges are in metres."""
        return DEPTH in self.topics or RELATIVE not in self.topics


def namespace_of(source: Source) -> str | None:
    """What comes before the names of the results, as in '/robot'; None without results."""
    held = [topic for topic in source.topics if source.count([topic])]
    for result in RESULTS:
        for topic in sorted(held, key=len):
            if topic.endswith(result) and source.topics[topic] == KINDS[result]:
                return topic.removesuffix(result)
    return None


def spread(items: Sequence[int], most: int) -> list[int]:
    """At most so many of them, evenly, first and last among them."""
    if len(items) <= most:
        return list(items)
    places = np.linspace(0, len(items) - 1, most).round().astype(int)
    return [items[place] for place in places]


class Reading:
    """Reads the bags of a report.

    results : the bag of results; inputs : more bags, with images, odometry and true ranges

    Raises
    ------
    BadInput
        where there are no results

    """

    def __init__(self, results: Source, inputs: Sequence[Source] = ()) -> None:
        namespace = namespace_of(results)
        if namespace is None:
            raise BadInput('holds no results (depth, clouds, obstacles or a map): '
                           'sphstereo run makes them')
        # The first that has a topic is asked for it.
        self._parts = [(results, namespace), *((source, '') for source in inputs)]
        self._wanted: list[dict[str, str]] = []
        taken: set[str] = set()
        for source, prefix in self._parts:
            names = {topic: topic[len(prefix):] for topic in source.topics
                     if topic.startswith(f'{prefix}/') and source.count([topic])}
            if f'{prefix}{DIAGNOSTICS}' not in names and DIAGNOSTICS in source.topics:
                names[DIAGNOSTICS] = DIAGNOSTICS  # it has no namespace
            mine = {topic: name for topic, name in names.items()
                    if name not in taken and _reads(name, source.topics[topic])}
            self._wanted.append(mine)
            taken |= set(mine.values())
        self.contents = Contents()
        self._bag = 0
        self._paths: list[Any] = []
        self._steps: list[Any] = []
        self._odometry: dict[str, list[Any]] = {}
        self._last_path: dict[str, Any] = {}

    @property
    def total(self) -> int:
        """Records that are read, both passes together."""
        return 2 * sum(source.count(names) for (source, _), names in zip(
            self._parts, self._wanted, strict=True))

    def read(self, advance: Callable[[], object] = lambda: None) -> Contents:
        """Read all; `advance` is called after each record."""
        self._pass(self._survey, advance)
        self.contents.problems = [source.problem for source, _ in self._parts if source.problem]
        self._find_tracks()
        pictures = Pictures(self.contents)
        self._pass(pictures.take, advance)
        pictures.finish()
        return self.contents

    def _pass(self, take: Callable[[str, Record], None], advance: Callable[[], object]) -> None:
        # Inputs first: the truth is there when the depth comes.
        for bag, ((source, _), names) in reversed(list(enumerate(zip(
                self._parts, self._wanted, strict=True)))):
            self._bag = bag
            for record in source.records(list(names)):
                take(names[record.topic], record)
                advance()

    def _survey(self, name: str, record: Record) -> None:
        contents = self.contents
        stamped = record.kind != 'std_msgs/msg/Float32'
        seen = contents.topics.setdefault(name, TopicSeen(record.kind, self._bag))
        try:
            seen.stamps.append(stamp_of(record.serialised()) if stamped else 0)
        except Exception:  # bytes that are no message
            contents.unreadable[name] += 1
            return
        seen.times.append(record.time)
        if name in (DEPTH, RELATIVE):
            self._add_shares(name, record)
        elif name in (DIAGNOSTICS, SCAN, NEAREST) or record.kind in (_ODOMETRY, _PATH):
            message = record.message()
            if isinstance(message, Drop):
                contents.unreadable[name] += 1
            else:
                self._keep(name, record, message)

    def _keep(self, name: str, record: Record, message: Any) -> None:
        if name == DIAGNOSTICS:
            self.contents.diagnostics.append(message)
        elif name == SCAN:
            self.contents.scans.append(message)
        elif name == NEAREST:
            self.contents.nearest.append((self.contents.topics[name].stamps[-1],
                                          float(message.range)))
        elif name == VISUAL:
            self._steps.append(message)
        elif name == ALIGNED:
            self._paths.append(message)
        elif record.kind == _ODOMETRY:
            self._odometry.setdefault(name, []).append(message)
        else:
            self._last_path[name] = message

    def _add_shares(self, name: str, record: Record) -> None:
        depth = _depth(record)
        if isinstance(depth, Drop):
            self.contents.unreadable[name] += 1
            return
        r = depth[_STRIDE // 2::_STRIDE, _STRIDE // 2::_STRIDE]
        weight = np.broadcast_to(solid_angle(len(r)), r.shape)

        def share(part: NDArray[np.bool_]) -> float:
            return 100 * float(weight[part].sum() / weight.sum())
        known = np.isfinite(r)
        self.contents.shares.append(Shares(
            self.contents.topics[name].stamps[-1], share(known), share(np.isposinf(r)),
            share(np.isneginf(r)), float(np.median(r[known])) if known.any() else float('nan')))

    def _find_tracks(self) -> None:
        """All tracks there are; the one that the cloud is in, or is placed by, first.

        A map is in the frame of a track that was made with it, not of the odometry it was made
        from.
        """
        found = [odometry_track(name, messages) for name, messages in self._odometry.items()]
        found += [path_track(name, path) for name, path in self._last_path.items()]
        found.append(visual_track(f'{VISUAL}, chained', self._paths, self._steps))
        known = [track for track in found if track is not None]
        if MAP in self.contents.topics:
            rank = {ODOMETRY: 1, f'{VISUAL}, chained': 2}
        else:
            rank = {ODOMETRY: -1, f'{VISUAL}, chained': 2}
        self.contents.tracks = sorted(known, key=lambda track: (rank.get(track.name, 0),
                                                                track.name))


def _reads(name: str, kind: str) -> bool:
    if name in KINDS:
        return KINDS[name] == kind
    return kind in (_ODOMETRY, _PATH) and not name.startswith('/pairs')


def _depth(record: Record) -> NDArray[np.float32] | Drop:
    message = record.message()
    return message if isinstance(message, Drop) else read_depth(message)


class Pictures:
    """The second pass: pictures, scores and clouds of chosen frames."""

    def __init__(self, contents: Contents) -> None:
        self._contents = contents
        stamps = {name: seen.stamps for name, seen in contents.topics.items()}
        base = next((stamps[name] for name in (DEPTH, RELATIVE, PREVIEW) if name in stamps), [])
        self._shown = set(spread(base, SHOWN))
        true = set(stamps.get(TRUTH, ()))
        self._scored = set(spread([s for s in stamps.get(DEPTH, ()) if s in true], SCORED))
        self._image = next((name for name in IMAGES if name in stamps), '')
        self._track = next(iter(contents.tracks), None)
        clouds = stamps.get(POINTS, []) if self._track else stamps.get(POINTS, [])[-1:]
        self._clouds = set() if MAP in stamps else set(spread(clouds, ACCUMULATED))
        self._each = 3 * GREATEST_CLOUD // max(1, len(self._clouds))
        self._frames: dict[int, dict[str, Image8]] = {}
        self._parts: dict[int, dict[str, NDArray[np.float32]]] = {}
        self._complete = {TRUTH, DEPTH} | ({SIGMA} if SIGMA in stamps else set())
        self._collected: list[PointCloud] = []
        self._last_map: Record | None = None

    def take(self, name: str, record: Record) -> None:
        """Take a record of the topic `name`."""
        try:
            stamp = stamp_of(record.serialised())
        except Exception:  # counted in the first pass
            return
        if stamp in self._scored and name in self._complete:
            self._take_range(stamp, name, record)
        if stamp in self._shown and name in (DEPTH, RELATIVE, PREVIEW, self._image):
            self._take_picture(stamp, name, record)
        if name == POINTS and stamp in self._clouds:
            self._take_cloud(record)
        elif name == MAP:
            self._last_map = record

    def _take_range(self, stamp: int, name: str, record: Record) -> None:
        image = _depth(record)
        if isinstance(image, Drop):
            return
        parts = self._parts.setdefault(stamp, {})
        parts[name] = image
        if self._complete <= parts.keys():
            self._score(stamp, self._parts.pop(stamp))

    def _score(self, stamp: int, parts: dict[str, NDArray[np.float32]]) -> None:
        measured, truth = parts[DEPTH], parts[TRUTH]
        step = max(1, len(measured) // _SCORED_HEIGHT)
        sigma = parts[SIGMA][::step, ::step] if SIGMA in parts else None
        measured = measured[::step, ::step]
        self._contents.scores.append(compare(measured, truth, sigma,
                                             direction=self._direction(stamp)))
        judged = self._contents.judged
        if judged is None or stamp > judged.stamp:
            self._contents.judged = Judged(stamp, measured, truth)

    def _direction(self, stamp: int) -> NDArray[np.float64] | None:
        """Unit vector of the motion in the camera's optical frame, by its own track."""
        visual = [t for t in self._contents.tracks if t.name.startswith(VISUAL)]
        if not visual:
            return None
        place = int(np.searchsorted(visual[0].stamps, stamp))
        if not 0 < place < len(visual[0].stamps) or visual[0].stamps[place] != stamp:
            return None
        step = visual[0].positions[place] - visual[0].positions[place - 1]
        along = rotations.OPTICAL_FROM_LINK @ visual[0].orientations[place].T @ step
        length = float(np.linalg.norm(along))
        return along / length if length > 1e-9 else None

    def _take_picture(self, stamp: int, name: str, record: Record) -> None:
        pictures = self._frames.setdefault(stamp, {})
        if name in (DEPTH, RELATIVE):
            depth = _depth(record)
            if not isinstance(depth, Drop):
                step = max(1, len(depth) // _SHOWN_HEIGHT)
                small = np.ascontiguousarray(depth[::step, ::step])
                pictures[name] = colour_map(RangeImage(
                    FrameKey(stamp, ''), small, np.full_like(small, np.nan), name == DEPTH))
            return
        message = record.message()
        frame = message if isinstance(message, Drop) else decode_frame(
            message, _SHOWN_HEIGHT, True)
        if isinstance(frame, Drop):
            self._contents.unreadable[name] += 1
        elif frame.colour is not None:
            pictures[name] = frame.colour

    def _take_cloud(self, record: Record) -> None:
        cloud = self._read(record, POINTS)
        if cloud is None:
            return
        near = certain(cloud)
        placed = near if self._track is None else moved(near, self._track)
        if placed is not None and len(placed.xyz):
            self._collected.append(thinned(placed, self._each))

    def _read(self, record: Record, name: str) -> PointCloud | None:
        message = record.message()
        cloud = message if isinstance(message, Drop) else read_points(message)
        if isinstance(cloud, Drop):
            self._contents.unreadable[name] += 1
            return None
        return cloud

    def finish(self) -> None:
        """What is known only at the end."""
        contents = self._contents
        for stamp, pictures in sorted(self._frames.items()):
            depth = next((pictures[n] for n in (DEPTH, RELATIVE, PREVIEW) if n in pictures), None)
            if depth is not None:
                contents.frames.append(ShownFrame(stamp, depth, pictures.get(self._image)))
        for stamp, parts in sorted(self._parts.items()):
            if {DEPTH, TRUTH} <= parts.keys():  # its sigma is missing
                self._score(stamp, parts)
        if self._last_map is not None:
            cloud = self._read(self._last_map, MAP)
            if cloud is not None and len(cloud.xyz):
                contents.cloud, contents.cloud_source = thinned(cloud, GREATEST_CLOUD), 'the map'
        elif self._collected:
            contents.cloud = thinned(joined(self._collected), GREATEST_CLOUD)
            what = (f'the clouds of {len(self._collected)} frames, placed by {self._track.name}'
                    if self._track else 'the cloud of the last frame')
            contents.cloud_source = (f'{what}; what is nearer than {GREATEST_RANGE:g} m, with a '
                                     f'sigma below {100 * GREATEST_SIGMA:g} % of the range')
