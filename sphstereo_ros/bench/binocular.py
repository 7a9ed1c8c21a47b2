"""Accuracy of two cameras: alignment and range of each pair against exact truth, by method.

Pairs come from folders that `save_binocular` or another renderer of the same format wrote, or are
rendered with a top camera that is turned by a few degrees. Nothing is told but the baseline's
length: the alignment is estimated from the first pairs, as config/binocular.yaml has it.
"""
from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sphstereo_ros.core import rotations
from sphstereo_ros.core.chain import Chain, StageResults
from sphstereo_ros.core.config import resolve
from sphstereo_ros.core.frames import Drop, Frame, FrameKey
from sphstereo_ros.replay.parameter_files import load_values
from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.binocular import TopCamera, render_binocular
from sphstereo_ros.scenes.sequence import TruthFrame, load_sequence, true_pose

from .accuracy import as_frame
from .processes import shipped
from .scoring import BANDS, average, compare
from .tables import markdown

Pair = tuple[TruthFrame, TruthFrame]  # top, bottom
_PERIOD = 66_666_667  # ns, where the folder's frames are not a recording
_MISALIGNED = 4.0  # degrees about each axis at most, of scenes that are rendered
_GAIN, _WHITE = 1.2, (1.1, 1.0, 0.9)  # of the top camera, as no two cameras are alike


def parameters(name: str, given: Mapping[str, object]) -> dict[str, object]:
    """Of a method: config/binocular.yaml with another matcher; `given` for `default` alone."""
    if name == 'live':
        return dict(load_values([shipped('config/binocular_live.yaml')]))
    own = dict(load_values([shipped('config/binocular.yaml')]))
    return {**own, **given} if name == 'default' else {**own, 'stereo.matcher': name}


def saved_pairs(folder: Path) -> list[Pair]:
    """The pairs of a folder with `pairs` in its meta.json.

    Raises
    ------
    BadInput
        for a folder that has none

    """
    try:
        sequence = load_sequence(folder)
        return [(sequence[p['top']], sequence[p['bottom']]) for p in sequence.meta['pairs']]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(f'{folder}: no pairs of frames with truth: {error}') from error


def rendered_pairs(scene: str, seed: int, count: int, height: int) -> Iterator[Pair]:
    """Pairs of a scene along its way; the top camera is turned by angles that `seed` decides."""
    roll, pitch, yaw = np.radians(np.random.default_rng([seed, 8]).uniform(
        -_MISALIGNED, _MISALIGNED, 3))
    rig = TopCamera((float(roll), float(pitch), float(yaw)), gain=_GAIN, white_balance=_WHITE)
    return render_binocular(scene, seed, count, height, rig).pairs()


@dataclass
class PairScore:
    """What one method made of all pairs."""

    rotations: list[float] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    drops: Counter[str] = field(default_factory=Counter)

    def summary(self) -> dict[str, Any]:
        """Median error of the alignment (degrees), means of the range scores, drops by cause."""
        told = {'frames': len(self.scores), 'drops': dict(self.drops)}
        if not self.scores:
            return told
        return {**told, 'alignment_deg': float(np.median(self.rotations)),
                **average(self.scores)}


class PairContest:
    """Runs every method on the same pairs."""

    def __init__(self, methods: Mapping[str, Mapping[str, object]]) -> None:
        self._methods = methods
        self._results = {name: PairScore() for name in methods}

    def add(self, pairs: Iterator[Pair] | Sequence[Pair],
            advance: Callable[[], object] = lambda: None) -> None:
        """All methods over the pairs of one rig, in order."""
        chains: dict[str, Chain] = {}
        for number, (top, bottom) in enumerate(pairs):
            length = float(np.linalg.norm(top.position - bottom.position))
            for name, given in self._methods.items():
                if name not in chains:
                    chains[name] = Chain(resolve({**given, 'baseline.length': length}))
                self._take(chains[name], (top, bottom), number, self._results[name])
            advance()

    def summaries(self) -> dict[str, dict[str, Any]]:
        """By method."""
        return {name: result.summary() for name, result in self._results.items()}

    @staticmethod
    def _take(chain: Chain, pair: Pair, number: int, score: PairScore) -> None:
        stamp = (number + 1) * _PERIOD
        outcome: StageResults | Drop = Drop('no_pairs')
        for side, view in zip(('top', 'bottom'), pair, strict=True):
            grey = as_frame(view, chain.config.stereo.working_height)
            for outcome in chain.add_view(side,  # type: ignore[arg-type]
                                          Frame(FrameKey(stamp, side), grey.image)):
                if isinstance(outcome, Drop):
                    score.drops[outcome.cause] += 1
        if isinstance(outcome, Drop):
            return
        truth = true_pose(*pair)
        found = outcome.aligned.references[0].pose
        score.rotations.append(float(np.degrees(rotations.angle(
            found.rotation.T @ truth.rotation))))
        measured = outcome.range_image
        score.scores.append(compare(measured.range, pair[1].range, measured.sigma,
                                    direction=truth.direction, moving=pair[1].moving))


def table(summaries: Mapping[str, Mapping[str, Any]]) -> str:
    """The figures for people."""
    def number(value: float | None) -> str:
        return '–' if value is None else f'{value:.3g}'

    bands = [f'{low:g}-{high:g}' for low, high in BANDS]
    rows = [[name, *(' / '.join(number(s[b].get(key)) for key in ('coverage', 'median', 'bad'))
                     for b in bands), number(s['danger']), number(s['alignment_deg']),
             str(s['frames'])] for name, s in summaries.items() if s['frames']]
    if not rows:
        return 'no pair was scored: ' + str({n: s['drops'] for n, s in summaries.items()})
    return 'Coverage / median error / over 10 % error, in %; alignment error in degrees\n\n' \
        + markdown(['method', *(f'{b} m' for b in bands), 'danger', 'alignment', 'pairs'], rows)
