"""Speed of the chain, as a ratio to one StereoBM call on the same data in the same process."""
from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Frame, FrameKey, Image8
from sphstereo_ros.core.matching import stereo_grid
from sphstereo_ros.core.warp import aligned_pair

# Frames (H, 2H) of a moving camera, or one array (N, H, 2H) of them.
Images = Sequence[Image8] | Image8


def to_and_fro(images: Images, count: int) -> list[Image8]:
    """`count` images, forward then backward and so on, so that motion stays continuous."""
    cycle = [*images, *images[-2:0:-1]] if len(images) > 2 else list(images)
    return [cycle[i % len(cycle)] for i in range(count)]


def one_reference(parameters: Mapping[str, object]) -> dict[str, object]:
    """The same parameters, but with the frame before as the only reference."""
    return {**{name: value for name, value in parameters.items() if name != 'pairing.baselines'},
            'pairing.intervals': [1]}


def measure(images: Images, parameters: dict[str, object], pairs: int,
            ) -> dict[str, Any]:
    """Time the whole chain for each new frame, and StereoBM(96, 15) on the pair it aligned.

    Parameters
    ----------
    images : (H, 2H) uint8 frames of a moving camera
    parameters : over the defaults
    pairs : how many pairs are timed, after a warm-up of five

    Returns
    -------
    `chain_ms`, `bm_ms` (medians) and their `ratio`, and medians by stage

    """
    chain = Chain(resolve({'baseline.length': 0.28, **parameters}))
    chain.warm_up()
    block_matcher = cv2.StereoBM_create(96, 15)
    times: dict[str, list[float]] = {'chain_ms': [], 'bm_ms': []}
    dropped = 0
    for index, image in enumerate(to_and_fro(images, pairs + 6)):
        start = time.perf_counter()
        outcome = chain.add_frame(Frame(FrameKey(index * 33_333_333, 'camera'), image))[0]
        taken = time.perf_counter() - start
        if not isinstance(outcome, StageResults):
            dropped += index > 0
            continue
        reference = outcome.aligned.references[0]
        views = aligned_pair(reference.frame.image, image, reference.pose,
                             stereo_grid(image.shape[0]))
        start = time.perf_counter()
        block_matcher.compute(views[1], views[0])
        if index > 5:
            times['bm_ms'].append(1e3 * (time.perf_counter() - start))
            times['chain_ms'].append(1e3 * taken)
    medians = {name: float(np.median(values)) for name, values in times.items()}
    return {**medians, 'ratio': medians['chain_ms'] / medians['bm_ms'],
            'pairs': len(times['chain_ms']), 'dropped': dropped}


def window_cost(images: Images, parameters: dict[str, object], pairs: int) -> dict[str, Any]:
    """Time of the full window over that of one reference, frame by frame in turn.

    Parameters
    ----------
    images : (H, 2H) uint8 frames of a moving camera, more than the window reaches back
    parameters : over the defaults
    pairs : how many windows are timed, at least

    Returns
    -------
    `window_ms`, `single_ms` (medians) and their quotient `window_ratio`; None where no window
    was whole

    """
    given = {'baseline.length': 0.28, **parameters}
    chains = {'window_ms': Chain(resolve(given)),
              'single_ms': Chain(resolve(one_reference(given)))}
    pairing = chains['window_ms'].config.pairing
    whole = len(set(pairing.intervals if pairing.baselines == (0.0,) else pairing.baselines))
    times: dict[str, list[float]] = {name: [] for name in chains}
    for turn in range(1 + pairs):  # backward, a far reference would be where the camera is
        for index, image in enumerate(images):
            frame = Frame(FrameKey(turn * 3600 * 10**9 + index * 33_333_333, 'camera'), image)
            taken, outcome = _timed(chains, frame)
            if (turn and isinstance(outcome, StageResults)
                    and len(outcome.aligned.references) == whole):
                for name in chains:
                    times[name].append(taken[name])
        if turn and (len(times['window_ms']) >= pairs or not times['window_ms']):
            break
    if not times['window_ms']:
        return {'window_ms': None, 'single_ms': None, 'window_ratio': None}
    window, one = (float(np.median(times[name])) for name in ('window_ms', 'single_ms'))
    return {'window_ms': window, 'single_ms': one, 'window_ratio': window / one}


def _timed(chains: dict[str, Chain], frame: Frame) -> tuple[dict[str, float], object]:
    """Milliseconds of each chain, and what the first made of the frame."""
    taken, outcomes = {}, []
    for name, chain in chains.items():
        start = time.perf_counter()
        outcomes.append(chain.add_frame(frame)[-1])
        taken[name] = 1e3 * (time.perf_counter() - start)
    return taken, outcomes[0]


def stage_times(images: Images, parameters: dict[str, object],
                pairs: int = 20) -> dict[str, float]:
    """Median milliseconds of each stage."""
    chain = Chain(resolve({'baseline.length': 0.28, **parameters}))
    chain.warm_up()
    times: dict[str, list[float]] = {}
    for index, image in enumerate(to_and_fro(images, pairs + 6)):
        window: Any = chain.pairer.add_frame(
            Frame(FrameKey(index * 33_333_333, 'camera'), image))[0]
        for stage in (chain.stabiliser, chain.aligner, chain.stereo):
            if not hasattr(window, 'references'):
                break
            start = time.perf_counter()
            window = stage.process(window)
            if index > 5:
                times.setdefault(type(stage).__name__, []).append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(values)) for name, values in times.items()}
