"""Estimate 480x360 depth and normals jointly from ToF raw data.

::

    model = tofcapture_model.load_model("bundled")
    depth = model("recording/views/mug/view-000.h5").depth

What people call is named here. Importing this package does not import torch.
"""

from typing import TYPE_CHECKING

from tofcapture.libraries import face as _face

if TYPE_CHECKING:
    from tofcapture_model.data import FrameDataset
    from tofcapture_model.evaluation.evaluate import evaluate
    from tofcapture_model.inference.predict import Predictor
    from tofcapture_model.training.train import train

    load_model = Predictor

__all__ = ["FrameDataset", "evaluate", "load_model", "train"]
_HOMES = {
    "FrameDataset": "data",
    "evaluate": "evaluation.evaluate",
    "load_model": "inference.predict:Predictor",
    "train": "training.train",
}
__getattr__, __dir__ = _face(__name__, _HOMES)
