"""What makes matching hard, each by name: what it does to a scene or to its pictures."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .imaging import NOISE, Noise
from .trajectory import FRAME_RATE

NUISANCES = ('occlusion', 'repetition', 'exposure', 'low_light', 'rolling_exposure', 'traffic',
             'wall')
# Those that are built into the scene; only the street has them. The others come after rendering.
STREETS = ('occlusion', 'repetition', 'traffic', 'wall')

STEP_AT = 0.8  # share of the frames before the step of the exposure
MAINS_FLICKER = 100.0  # Hz: lamps at 50 Hz mains flicker at twice that
READOUT = 0.025  # s from the first to the last row

# The wall: across the course, whose distance is 40 m at frame 12 at the default spacing.
WALL_SIZE = (8.0, 5.0)
WALL_SPACING = 8.0 / FRAME_RATE
WALL_AT = 40.0 + 12 * WALL_SPACING


@dataclass(frozen=True)
class ImageEffects:
    """What happens to the light after the lens.

    gain : of the exposure, for the scene; exposure : largest relative change of it from frame to
    frame; step : factor of the exposure from STEP_AT of the frames on; flicker : relative
    amplitude of the lamps' flicker, which a rolling shutter turns into bands; jpeg : quality,
    None = no JPEG; white_balance : gains of red, green and blue
    """

    gain: float = 1.0
    exposure: float = 0.05
    noise: Noise = NOISE
    jpeg: int | None = 92
    step: float = 1.0
    flicker: float = 0.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def exposures(self, seed: int, frames: int) -> NDArray[np.float64]:
        """The exposure of each frame (frames,), relative to the first, which is nominal."""
        change = np.random.default_rng([seed, 2]).uniform(-1, 1, frames)
        index = np.arange(frames)
        stepped = np.where(index >= max(1, round(STEP_AT * frames)), self.step, 1.0)
        varied: NDArray[np.float64] = np.exp(self.exposure * np.where(index == 0, 0, change))
        return varied * stepped

    def row_exposures(self, seed: int, index: int, height: int) -> NDArray[np.float64]:
        """The exposure of each row (height,) of frame `index`, relative to the frame's.

        Row r is read out READOUT · r / height after the frame's stamp, and sees the lamps as
        bright as they are then.
        """
        phase = np.random.default_rng([seed, 6]).uniform()
        seconds = index / FRAME_RATE + READOUT * (np.arange(height) + 0.5) / height
        return 1 + self.flicker * np.sin(2 * np.pi * (MAINS_FLICKER * seconds + phase))


def with_nuisance(effects: ImageEffects, nuisance: str | None) -> ImageEffects:
    """`effects` with what the nuisance does to pictures; unchanged where it does nothing."""
    if nuisance == 'exposure':
        return replace(effects, exposure=0.4, step=0.5)
    if nuisance == 'low_light':
        return replace(effects, gain=0.2 * effects.gain, noise=Noise(read=4.0, shot=8.0))
    if nuisance == 'rolling_exposure':
        return replace(effects, flicker=0.2)
    return effects


def check(name: str, nuisance: str | None) -> None:
    """Raise ValueError if there is no such nuisance or the scene `name` does not have it."""
    if nuisance is not None and nuisance not in NUISANCES:
        raise ValueError(f'{nuisance!r} is none of {", ".join(NUISANCES)}')
    if nuisance in STREETS and name != 'street':
        raise ValueError(f'only the street has the nuisance {nuisance!r}, {name!r} has not')
