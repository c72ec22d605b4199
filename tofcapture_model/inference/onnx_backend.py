"""Exported models in onnxruntime, on the CPU."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.errors import ConfigError
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config, loads_config
from tofcapture_model.frame import Frame
from tofcapture_model.geometry.maps import LENS, with_lens

OUTPUTS = ("depth_2x", "normals_2x", "error_2x")
DIGEST, CONFIG = "weights_sha256", "config.toml"
"""What an export carries beside the network: SHA-256 of the checkpoint's file, and its configuration. Metadata of ``.onnx``, extra files
of ``.pt2``."""


def open_onnx(path: Path) -> Any:
    """Open an exported model."""
    try:
        import onnxruntime
    except ImportError as err:
        raise ConfigError(f"cannot run ONNX: {err}", hint="pip install tofcapture[onnx]") from err
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def config_of(session: Any, path: Path, weights: Path) -> Config:
    """Configuration of an opened export, once it is certain that the export is one of these weights.

    Parameters
    ----------
    session
        What :func:`open_onnx` opened.
    path
        The export, for messages.
    weights
        The checkpoint beside it; where there is none, the export stands for itself.

    Raises
    ------
    ConfigError
        The export is of other weights, or too old to tell.
    """
    told = session.get_modelmeta().custom_metadata_map
    again = f"run tofcapture export again: tofcapture export --weights {weights} --out {path}"
    if DIGEST not in told or CONFIG not in told:
        raise ConfigError(
            f"{path}: expected an export that says of which weights it is, got none", hint=again
        )
    if weights.exists() and (found := sha256_of(weights)) != told[DIGEST]:
        raise ConfigError(
            f"{path}: expected an export of {weights} (sha256 {found[:12]}...), got one of other weights ({told[DIGEST][:12]}...)",
            hint=again,
        )
    return loads_config(told[CONFIG], str(path))


def ask_onnx(session: Any, frame: Frame) -> list[NDArray[np.float32]]:
    """Run an opened model on a frame; inputs that the export found unused are not asked for.

    Raises
    ------
    ConfigError
        The camera has a lens, and the export was made before they took one.
    """
    wanted = {i.name: i.shape for i in session.get_inputs()}
    numbers = wanted.get("intrinsics", (0, LENS))[1]
    if frame.intrinsics.shape[1] > numbers:
        raise ConfigError(
            "expected an export for cameras with lens distortion, got one that takes none",
            hint="run tofcapture export again: it takes any lens now",
        )
    asked = frame._replace(intrinsics=with_lens(frame.intrinsics)[:, :numbers])
    feed = {k: np.ascontiguousarray(v.numpy()) for k, v in asked._asdict().items() if k in wanted}
    found: list[NDArray[np.float32]] = session.run(list(OUTPUTS), feed)
    return found
