"""Estimate 480x360 depth and normals jointly from ToF raw data.

What people call is ``load_model``, ``FrameDataset``, ``train`` and ``evaluate``. Importing this package does not import torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tofcapture_model.data import FrameDataset
    from tofcapture_model.evaluation.evaluate import evaluate
    from tofcapture_model.networks.checkpoint import load_model
    from tofcapture_model.training.train import train

__all__ = ["FrameDataset", "evaluate", "load_model", "train"]

_HOMES = {
    "FrameDataset": "data",
    "evaluate": "evaluation.evaluate",
    "load_model": "networks.checkpoint",
    "train": "training.train",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
