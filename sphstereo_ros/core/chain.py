"""The whole way from a frame to a point cloud, as one list of steps.

The offline command and the benchmarks call this; live, each step is a node.
"""
from __future__ import annotations

from dataclasses import dataclass

from .alignment import Aligner
from .binocular import BinocularPairer
from .cloud import point_cloud
from .config import Config
from .frames import (
    AlignedWindow,
    Drop,
    Frame,
    Image8,
    PairedWindow,
    PointCloud,
    RangeImage,
    StabilisedWindow,
)
from .motion import ImuSample, OdometrySample, TwistSample
from .pairing import Pairer
from .stabilisation import Stabiliser
from .stereo import SphericalStereo
from .synchronisation import Side


@dataclass(frozen=True)
class StageResults:
    """What every stage made of one window. `cloud` is None without metric scale."""

    paired: PairedWindow
    stabilised: StabilisedWindow
    aligned: AlignedWindow
    range_image: RangeImage
    cloud: PointCloud | None


class Chain:
    """All stages in one process, deterministic: nothing depends on timing.

    config : all parameters
    mask : (H, W) uint8 of any size, non-zero = vehicle
    """

    def __init__(self, config: Config, mask: Image8 | None = None) -> None:
        self.config = config
        self.pairer = BinocularPairer(config, mask) if config.pairing.mode == 'binocular' \
            else Pairer(config)
        self.stabiliser = Stabiliser(config, mask)
        self.aligner = Aligner(config, mask)
        self.stereo = SphericalStereo(config, mask)

    def warm_up(self) -> None:
        """Compile what all stages need."""
        for stage in (self.pairer, self.stabiliser, self.aligner, self.stereo):
            stage.warm_up()

    def add_frame(self, frame: Frame) -> list[StageResults | Drop]:
        """Take the next frame; returns what became of every window that is complete now."""
        return self._process(self.pairer.add_frame(frame))

    def add_view(self, side: Side, frame: Frame) -> list[StageResults | Drop]:
        """Take the next frame of one of two cameras (`pairing.mode` binocular)."""
        if not isinstance(self.pairer, BinocularPairer):
            raise ValueError('pairing.mode is monocular')
        return self._process(self.pairer.add_view(side, frame))

    def add_odometry(self, sample: OdometrySample) -> list[StageResults | Drop]:
        """Take a sample; frames may have waited for it."""
        return self._process(self.pairer.add_odometry(sample))

    def add_twist(self, sample: TwistSample) -> list[StageResults | Drop]:
        """Take a sample; frames may have waited for it."""
        return self._process(self.pairer.add_twist(sample))

    def add_imu(self, sample: ImuSample) -> list[StageResults | Drop]:
        """Take a sample; frames may have waited for it."""
        return self._process(self.pairer.add_imu(sample))

    def flush(self) -> list[StageResults | Drop]:
        """The input has ended: what still waits is processed or dropped."""
        return self._process(self.pairer.flush())

    def process(self, paired: PairedWindow) -> StageResults | Drop:
        """One window through all stages after pairing."""
        stabilised = self.stabiliser.process(paired)
        if isinstance(stabilised, Drop):
            return stabilised
        aligned = self.aligner.process(stabilised)
        if isinstance(aligned, Drop):
            return aligned
        measured = self.stereo.process(aligned)
        if isinstance(measured, Drop):
            return measured
        cloud = point_cloud(measured, aligned.current, self.config) if measured.is_placed else None
        return StageResults(paired, stabilised, aligned, measured, cloud)

    def _process(self, windows: list[PairedWindow | Drop]) -> list[StageResults | Drop]:
        return [w if isinstance(w, Drop) else self.process(w) for w in windows]
