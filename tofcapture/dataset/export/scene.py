"""Say what every format is told of a scene, and turn its maps into what formats have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofcapture.colours import percentile
from tofcapture.files.shard import ShardReader
from tofcapture.poses import Float64


@dataclass(frozen=True)
class SceneExport:
    """A scene and its place in the export."""

    name: str
    shard: ShardReader
    out: Path  #: The export's folder.
    unit: float  #: Metres per step of PNG depth.
    sha256: str  #: Of the shard.
    split: str = "train"  #: train, val or test.
    place: int = 0  #: Number of the scene in its split, by name.
    number: int = 0  #: Number of the scene in the dataset, by split and name.
    first: int = 0  #: Number of the scene's first view in the dataset.
    views: int = 0

    @property
    def folder(self) -> Path:
        """The scene's own folder."""
        return self.out / self.name


def grey(amplitude: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Show amplitude (H, W) in 8 bits, brightest at its 99.5th percentile."""
    top = max(percentile([amplitude], 99.5, 1.0), 1e-9)
    out: NDArray[np.uint8] = np.rint(np.nan_to_num(np.clip(amplitude / top, 0, 1)) * 255).astype(np.uint8)
    return out


def quaternion(T: Float64) -> list[float]:
    """Return the rotation of (4, 4) as x, y, z, w with w >= 0."""
    from scipy.spatial.transform import Rotation

    out: list[float] = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
    return out
