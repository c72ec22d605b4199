"""What the bundled network answers for one made-up frame, as it was when it was measured: ``python -m tests.bundled_answer`` writes it anew.

Only after new weights, or a change of the code that is meant to change answers; benchmarks/RESULTS.md is to be measured again then.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from tests.test_model_predict import table_top
from tofcapture.frames import TofInfo
from tofcapture_model.data import batched, make_frame
from tofcapture_model.data.raw_input import NOMINAL_CAMERA
from tofcapture_model.networks.checkpoint import load_checkpoint

KEPT = Path(__file__).with_suffix(".npz")
EVERY = 20  # pixels


def answer():
    """Depth, normals and error map, every twentieth pixel of every twentieth row."""
    raw = table_top(NOMINAL_CAMERA)[0]
    frame = batched(make_frame(raw, TofInfo("", "", NOMINAL_CAMERA, np.zeros(3)), NOMINAL_CAMERA))
    with torch.no_grad():
        found = load_checkpoint(None)[0](frame)
    names = ("depth", "normals", "error")
    return {name: getattr(found, name)[0, ..., ::EVERY, ::EVERY].numpy() for name in names}


if __name__ == "__main__":
    np.savez_compressed(KEPT, **answer())
