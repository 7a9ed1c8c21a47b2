"""Figures of a report: what was recorded, how fast, what was dropped, how exact."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from sphstereo_ros.bench.scoring import BANDS, average
from sphstereo_ros.report.contents import (
    DEPTH,
    IMAGES,
    RELATIVE,
    TRUTH,
    Contents,
    TopicSeen,
)
from sphstereo_ros.report.tracks import track_error

Row = dict[str, Any]
_COUNTS, _RATES = ('frames_in', 'frames_out'), ('rate_in', 'rate_out')
_LAST = ('latency_p50_ms', 'latency_p95_ms', 'memory_mb')


def summarise(contents: Contents) -> dict[str, Any]:
    """All figures, as they are written into report.json; None is unknown."""
    return {'overview': overview(contents), 'topics': topics(contents),
            'stages': stages(contents.diagnostics), 'drops': drops(contents.diagnostics),
            'latency': latency(contents), 'accuracy': accuracy(contents),
            'tracks': tracks(contents), 'unreadable': dict(contents.unreadable),
            'problems': contents.problems}


def overview(contents: Contents) -> Row:
    """The main figures."""
    seen = contents.topics
    depth = seen.get(DEPTH) or seen.get(RELATIVE)
    stamps = sorted(depth.stamps) if depth else []
    images = max((len(seen[name].stamps) for name in IMAGES if name in seen), default=None)
    shares = contents.shares
    return {'images': images, 'depth_images': len(stamps) if depth else None,
            'metric': contents.is_metric if depth else None,
            'seconds': (stamps[-1] - stamps[0]) / 1e9 if len(stamps) > 1 else None,
            'known': _mean([s.known for s in shares]), 'beyond': _mean([s.beyond for s in shares]),
            'points': len(contents.cloud.xyz) if contents.cloud is not None else None,
            'cloud_source': contents.cloud_source,
            'distance': contents.tracks[0].length if contents.tracks else None}


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def topics(contents: Contents) -> list[Row]:
    """Messages of each topic, their rate by their stamps, and the longest gap between two."""
    return [{'topic': name, 'type': seen.kind, 'messages': len(seen.times), **_pace(seen)}
            for name, seen in sorted(contents.topics.items())]


def _pace(seen: TopicSeen) -> Row:
    stamps = sorted(set(seen.stamps))
    if len(stamps) < 2:
        return {'rate': None, 'gap': None}
    gaps = np.diff(np.array(stamps, np.int64)) / 1e9
    return {'rate': float(len(gaps) / gaps.sum()), 'gap': float(gaps.max())}


def stages(diagnostics: Sequence[Any]) -> list[Row]:
    """What each stage told: rates while something came (median), the rest at the end."""
    rates: dict[str, dict[str, list[float]]] = {}
    last: dict[str, dict[str, str]] = {}
    for message in diagnostics:
        for status in message.status:
            name, values = str(status.name), {v.key: v.value for v in status.values}
            last[name] = values
            for key in _RATES:
                rate = _number(values.get(key))
                if rate:
                    rates.setdefault(name, {}).setdefault(key, []).append(rate)
    return [{'stage': name,
             **{key: _number(values.get(key)) for key in (*_COUNTS, *_LAST)},
             **{key: _median(rates.get(name, {}).get(key, [])) for key in _RATES}}
            for name, values in last.items() if 'frames_in' in values or 'rate_in' in values]


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _number(value: str | None) -> float | None:
    try:
        number = float(str(value))
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def drops(diagnostics: Sequence[Any]) -> list[Row]:
    """Drops by stage and cause, most frequent first; those before a restart are counted too."""
    totals: Counter[tuple[str, str]] = Counter()
    last: dict[tuple[str, str], int] = {}
    for message in diagnostics:
        for status in message.status:
            for value in status.values:
                cause = str(value.key).removeprefix('drops.')
                count = _number(value.value)
                if cause == value.key or count is None:
                    continue
                key = (str(status.name), cause)
                before = last.get(key, 0)
                totals[key] += int(count) - before if count >= before else int(count)
                last[key] = int(count)
    return [{'stage': stage, 'cause': cause, 'count': count}
            for (stage, cause), count in totals.most_common() if count]


def latency(contents: Contents) -> Row | None:
    """From the recording of an image to that of its depth, ms; None where the bag cannot tell.

    Offline results are recorded at their stamps: there both times are the same.
    """
    depth = contents.topics.get(DEPTH) or contents.topics.get(RELATIVE)
    image = next((contents.topics[name] for name in IMAGES if name in contents.topics), None)
    if depth is None or image is None or depth.bag != image.bag:
        return None
    came = dict(zip(image.stamps, image.times, strict=False))
    took = [(time - came[stamp]) / 1e6 for stamp, time in zip(depth.stamps, depth.times,
                                                             strict=False) if stamp in came]
    if not took or not np.any(took):
        return None
    return {'p50': float(np.percentile(took, 50)), 'p95': float(np.percentile(took, 95)),
            'frames': len(took)}


def accuracy(contents: Contents) -> Row | None:
    """Mean scores against the truth, by band of range; None without truth."""
    if not contents.scores:
        return None
    scores = average(contents.scores)
    bands = [{'band': f'{low:g}–{high:g} m', **scores[f'{low:g}-{high:g}']}
             for low, high in BANDS]
    return {'frames': len(contents.scores), 'bands': bands, 'danger': scores['danger'],
            'ghost': scores['ghost'], 'of': len(contents.topics[TRUTH].stamps)}


def tracks(contents: Contents) -> list[Row]:
    """Length of each track, and its error against the first (rotation and shift fitted)."""
    rows = []
    for track in contents.tracks:
        error = None if track is contents.tracks[0] else track_error(track, contents.tracks[0])
        rows.append({'track': track.name, 'poses': len(track.stamps), 'length': track.length,
                     'rmse': error and error.rmse, 'greatest': error and error.greatest,
                     'percent': error and 100 * error.rmse / max(error.distance, 1e-9)})
    return rows
