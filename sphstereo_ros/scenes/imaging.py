"""From radiance to pictures: exposure, tone curve, noise, JPEG. Each step optional and seeded."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Image8 = NDArray[np.uint8]


@dataclass(frozen=True)
class Noise:
    """Noise at 8 bits: `read` grey levels everywhere, `shot` at full scale (grows as the root)."""

    read: float = 0.6
    shot: float = 1.2


NOISE = Noise()
NO_NOISE = Noise(0.0, 0.0)


def develop(radiance: Array, exposure: float = 1.0) -> NDArray[np.float32]:
    """Linear RGB (H, W, 3) → BGR (H, W, 3) float32, 0 … 255, not yet rounded.

    A soft shoulder keeps highlights from clipping hard; then the sRGB curve.
    """
    light = np.maximum(np.asarray(radiance, np.float32) * np.float32(exposure), 0)
    light = np.minimum(light * (1 + light / 9.0) / (1 + 0.8 * light), 1)
    value = np.where(light < 0.0031308, 12.92 * light,
                     1.055 * np.maximum(light, 1e-6) ** (1 / 2.4) - 0.055)
    return np.ascontiguousarray(255 * value[..., ::-1], np.float32)


def with_noise(image: Array, noise: Noise, rng: np.random.Generator) -> NDArray[np.float32]:
    """`image` (H, W, 3) 0 … 255 with Gaussian read noise and shot noise."""
    if noise == NO_NOISE:
        return np.asarray(image, np.float32)
    sigma = np.sqrt(noise.read**2 + noise.shot**2 * np.maximum(image, 0) / 255)
    noisy: NDArray[np.float32] = image + sigma * rng.standard_normal(image.shape, np.float32)
    return noisy


def to_bytes(image: Array) -> Image8:
    """Rounded and clipped to 8 bits."""
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def encode_jpeg(image: Image8, quality: int) -> Image8:
    """JPEG bytes (n,) of a BGR image (H, W, 3)."""
    done, data = cv2.imencode('.jpg', image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f'no JPEG of an image of shape {image.shape}')
    return np.asarray(data, np.uint8).reshape(-1)


def through_jpeg(image: Image8, quality: int) -> Image8:
    """What a decoder makes of the image's JPEG."""
    decoded = cv2.imdecode(encode_jpeg(image, quality), cv2.IMREAD_COLOR)
    return np.asarray(decoded, np.uint8)


def weak_texture(image: Array, range_image: Array, window: int = 9,
                 threshold: float = 2.0) -> float:
    """Share of the solid angle that is not sky with next to no texture.

    image : noise-free BGR (H, W, 3) or grey (H, W), 0 … 255; weak where the standard deviation
    in `window`² pixels is under `threshold` grey levels.
    """
    grey = np.asarray(image, np.float64)
    if grey.ndim == 3:
        grey = grey @ np.array([0.114, 0.587, 0.299])
    border = window // 2
    wrapped = np.pad(grey, ((0, 0), (border, border)), mode='wrap')
    mean = cv2.blur(wrapped, (window, window))[:, border:-border]
    square = cv2.blur(wrapped**2, (window, window))[:, border:-border]
    deviation = np.sqrt(np.maximum(square - mean**2, 0))
    height = len(grey)
    latitude = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    weight = np.broadcast_to(np.cos(latitude)[:, None], grey.shape)
    surface = np.isfinite(range_image)
    weak = surface & (deviation < threshold)
    return float(weight[weak].sum() / weight[surface].sum())
