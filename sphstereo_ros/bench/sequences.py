"""The sequences that accuracy is measured on: folders, or scenes that are rendered."""
from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sphstereo_ros.replay.records import BadInput
from sphstereo_ros.scenes.sequence import (
    TruthFrame,
    load_sequence,
    render_sequence,
    save_sequence,
)

# Folders that do not exist here are looked for in the one that this variable names.
GROUND_TRUTH = 'SPHSTEREO_GROUND_TRUTH'


@dataclass(frozen=True)
class Scenes:
    """Scenes to be rendered: by name, once for each seed.

    cache : folder in which rendered sequences are kept, and found the next time
    """

    name: str
    seeds: Sequence[int]
    frames: int
    height: int
    nuisance: str | None = None
    cache: Path | None = None

    def sequences(self) -> Iterator[Sequence[TruthFrame]]:
        """One after the other.

        Raises
        ------
        BadInput
            for a scene or nuisance that there is not, or where nothing can be rendered

        """
        try:
            for seed in self.seeds:
                yield self._cached(seed) if self.cache is not None else self._rendered(seed)
        except ImportError as error:
            raise BadInput(f"rendering needs the extra 'scenes': {error}") from error
        except ValueError as error:
            raise BadInput(str(error)) from error

    def _rendered(self, seed: int) -> Sequence[TruthFrame]:
        extra: dict[str, Any] = {} if self.nuisance is None else {'nuisance': self.nuisance}
        return render_sequence(self.name, seed, self.frames, self.height, **extra)

    def _cached(self, seed: int) -> Sequence[TruthFrame]:
        assert self.cache is not None
        parts = [self.name, *([self.nuisance] if self.nuisance else []), seed]
        folder = self.cache / f'{"_".join(map(str, parts))}_{self.frames}x{self.height}'
        if not (folder / 'meta.json').is_file():  # written last
            save_sequence(self._rendered(seed), folder, self.name,
                          progress=lambda frames: iter(tqdm(
                              frames, total=self.frames, unit='frame', desc=f'render {seed}',
                              disable=None)))
        return load_sequence(folder)


def saved(folders: Sequence[Path]) -> Iterator[Sequence[TruthFrame]]:
    """Sequences from folders, as given or in the folder that GROUND_TRUTH names.

    Raises
    ------
    BadInput
        for a folder that holds none

    """
    for folder in folders:
        elsewhere = Path(os.environ.get(GROUND_TRUTH, '')) / folder
        try:
            yield load_sequence(elsewhere if elsewhere.exists() and not folder.exists()
                                else folder)
        except (OSError, ValueError) as error:
            raise BadInput(f'{folder}: {error}') from error
