"""Exported models in onnxruntime, on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture_model.frame import Frame

OUTPUTS = ("depth_2x", "normals_2x", "error_2x")


def open_onnx(path: Path) -> Any:
    """Open an exported model."""
    try:
        import onnxruntime
    except ImportError as err:
        raise ConfigError(f"cannot run ONNX: {err}", hint="pip install tofcapture[onnx]") from err
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def ask_onnx(session: Any, frame: Frame) -> list[NDArray[np.float32]]:
    """Run an opened model on a frame; inputs that the export found unused are not asked for."""
    wanted = {i.name for i in session.get_inputs()}
    feed = {k: np.ascontiguousarray(v.numpy()) for k, v in frame._asdict().items() if k in wanted}
    found: list[NDArray[np.float32]] = session.run(list(OUTPUTS), feed)
    return found
