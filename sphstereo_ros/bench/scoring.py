"""How far a range image is from the truth, by range band and solid angle."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

BANDS = ((0.0, 10.0), (10.0, 30.0), (30.0, 100.0))

Range = NDArray[np.floating]


def solid_angle(height: int) -> NDArray[np.float64]:
    """Weight of each row of an equirectangular image, (height, 1): cosine of its latitude."""
    return np.asarray(np.cos((0.5 - (np.arange(height) + 0.5) / height) * np.pi)[:, None])


def compare(measured: Range, truth: Range, sigma: Range | None = None,
            mask: NDArray[np.uint8] | None = None) -> dict[str, Any]:
    """Score a range image (H, W) against the true range (any size; the nearest pixel counts).

    Parameters
    ----------
    measured : metres; NaN unknown, ±Inf as published
    truth : metres; +Inf is sky
    sigma : standard deviation of `measured`, for its calibration
    mask : (H, W), non-zero = not counted

    Returns
    -------
    For each band `'lo-hi'`: `coverage` (% of its solid angle with a finite range), `median`
    (relative error, %), `bad` (% with an error over 10 %), and `within_1_sigma`, `within_2_sigma`
    (%). `danger`: % of the solid angle nearer than 10 m that is reported over 1.5 times too far,
    or +Inf. `ghost`: % of the sky reported nearer than 10 m.

    """
    height, width = measured.shape
    if truth.shape != measured.shape:
        truth = cv2.resize(truth.astype(np.float32), (width, height),
                           interpolation=cv2.INTER_NEAREST)
    weight = np.broadcast_to(solid_angle(height), truth.shape) * (
        1.0 if mask is None else mask == 0)
    found = np.isfinite(measured) & (measured > 0) & (weight > 0)
    with np.errstate(invalid='ignore'):
        error = np.abs(measured - truth)
    scores: dict[str, Any] = {}
    for low, high in BANDS:
        band = (truth > low) & (truth <= high)
        scores[f'{low:g}-{high:g}'] = _band_scores(band, found & band, error, truth, weight, sigma)
    near, sky = truth < 10, np.isposinf(truth)
    too_far = near & ((found & (measured > 1.5 * truth)) | np.isposinf(measured))
    scores['danger'] = _share(too_far, near, weight)
    scores['ghost'] = _share(sky & found & (measured < 10), sky, weight)
    return scores


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_], weight: Range) -> float:
    return 100 * float(weight[part].sum()) / max(float(weight[whole].sum()), 1e-9)


def _band_scores(band: NDArray[np.bool_], found: NDArray[np.bool_], error: Range, truth: Range,
                 weight: Range, sigma: Range | None) -> dict[str, float | None]:
    scores: dict[str, float | None] = {'coverage': _share(found, band, weight),
                                       'median': None, 'bad': None}
    if found.any():
        relative = error[found] / truth[found]
        scores['median'] = 100 * float(np.median(relative))
        scores['bad'] = 100 * float((relative > 0.1).mean())
        if sigma is not None:
            deviation = error[found] / sigma[found]
            scores['within_1_sigma'] = 100 * float((deviation < 1).mean())
            scores['within_2_sigma'] = 100 * float((deviation < 2).mean())
    return scores


def average(scores: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Mean of each figure over scores that have it; None where none has."""
    out: dict[str, Any] = {}
    for name in scores[0]:
        values = [s[name] for s in scores]
        if isinstance(values[0], Mapping):
            out[name] = average(values)
        else:
            known = [v for v in values if v is not None]
            out[name] = float(np.mean(known)) if known else None
    return out
