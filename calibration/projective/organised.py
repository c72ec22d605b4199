"""A cloud that has kept the stereo image it came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.clouds import Cloud
from tofcapture.camera import Camera


@dataclass(frozen=True)
class OrganisedCloud(Cloud):
    """What every backend takes as a cloud, and ours also as the image.

    Attributes
    ----------
    depth
        (H, W) float32, metres, NaN where nothing was measured.
    camera
        Intrinsics of the stereo camera, at the origin of the points' frame.
    """

    depth: NDArray[np.float32]
    camera: Camera
