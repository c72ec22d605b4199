"""Checkpoints: weights in safetensors with the configuration (TOML) in the header; resume state the same way. No pickle.

``OUT/model.safetensors`` is the model, ``OUT/model.toml`` the same configuration for people, ``OUT/resume.safetensors`` what
:func:`tofcapture_model.training.train.train` needs to go on bit by bit.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.seal import replacing
from tofcapture_model.config import Config, dumps_config, loads_config
from tofcapture_model.networks.zoo import Model, build_model

FORMAT, VERSION = "tofcapture-model", 1
_BUNDLED = Path("bundled")  # what a user may write where a path is asked for


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a safetensors file atomically: temporary name, fsync, rename."""
    from safetensors.torch import save

    data = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, dict(header))
    with replacing(path) as partial:
        partial.write_bytes(data)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file and its header.

    Raises
    ------
    FormatError
        Missing, damaged, or not safetensors.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            return {k: file.get_tensor(k) for k in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, SafetensorError) as err:
        raise FormatError(
            f"{path}: cannot read the checkpoint: {err}", hint="tofcapture train DATASET --out DIR"
        ) from err


def save_model(
    path: Path,
    model: Model,
    config: Config,
    provenance: Mapping[str, Any],
    *,
    precision: Literal["float32", "float16"] = "float32",
) -> Path:
    """Write weights and configuration.

    Parameters
    ----------
    path
        ``.safetensors``; the configuration is written beside it as ``.toml``.
    model, config
        What was trained, and as what.
    provenance
        Any JSON object (dataset digests, steps, metrics).
    precision
        ``float16`` halves the file and rounds every weight to 11 bits; :func:`load_model` computes in float32 all the same.

    Raises
    ------
    DataError
        A weight that float16 cannot hold.
    """
    text = dumps_config(config)
    header = {
        "format": FORMAT,
        "version": str(VERSION),
        "config": text,
        "provenance": json.dumps(provenance, sort_keys=True),
    }
    weights = model.state_dict()
    write_tensors(path, weights if precision == "float32" else _halved(weights), header)
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    return path


def _halved(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Round floats to float16; what it cannot hold is an error."""
    half = {k: v.half() if v.is_floating_point() else v for k, v in weights.items()}
    lost = [k for k, v in half.items() if not torch.isfinite(v).all()]
    if lost:
        raise DataError(f"{lost[0]}: expected weights within +-65504 for float16", hint="save it in float32")
    return half


def names_bundled(path: Path | None) -> bool:
    """Whether a user means the bundled weights: nothing, or ``bundled`` where no file or folder of that name lies."""
    return path is None or (Path(path) == _BUNDLED and not _BUNDLED.exists())


def find_model(path: Path | None) -> Path:
    """Resolve what a user calls a model: a file, the folder of a run, or, by :func:`names_bundled`, the bundled weights."""
    if path is None or names_bundled(path):
        bundled = Path(str(files("tofcapture_model") / "weights" / "model.safetensors"))
        if not bundled.exists():
            raise ConfigError(
                "no weights are bundled with this installation", hint="name a checkpoint with --weights"
            )
        return bundled
    return Path(path) / "model.safetensors" if Path(path).is_dir() else Path(path)


def load_model(path: Path | None) -> tuple[Model, Config, dict[str, Any]]:
    """Load a model, strictly: a missing or an additional weight is an error. It computes in float32, however it was stored.

    Parameters
    ----------
    path
        File, run folder, or ``None`` or ``bundled`` for the bundled weights.

    Returns
    -------
    model (in evaluation mode), its configuration, its provenance

    Raises
    ------
    FormatError
        Not a checkpoint of this version, or its weights do not fit its configuration.
    """
    path = find_model(path)
    tensors, header = read_tensors(path)
    if header.get("format") != FORMAT or header.get("version") != str(VERSION):
        raise FormatError(
            f"{path}: expected {FORMAT} version {VERSION}, got {header.get('format')} {header.get('version')}"
        )
    config = loads_config(header.get("config", ""), str(path))
    model = build_model(config)
    load_strictly(model, tensors, path)
    return model.eval(), config, json.loads(header.get("provenance", "{}"))


def load_strictly(model: Model, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy tensors into a model, whatever their precision; names and shapes must agree exactly."""
    try:
        model.load_state_dict(dict(tensors), strict=True)
    except RuntimeError as err:
        raise FormatError(f"{path}: the weights do not fit the configuration: {err}") from err


def save_resume(
    path: Path,
    model: Model,
    optimizer: torch.optim.Optimizer,
    names: Mapping[int, str],
    state: Mapping[str, Any],
) -> None:
    """Write everything that the next step depends on.

    Parameters
    ----------
    path
        ``OUT/resume.safetensors``.
    model, optimizer
        As they are after a step.
    names
        ``id`` of a parameter to its name.
    state
        Plain JSON: configuration digest, stage, epoch, batch, step, elapsed seconds.
    """
    tensors = {f"model/{k}": v for k, v in model.state_dict().items()}
    for parameter, values in optimizer.state.items():
        tensors |= {f"adam/{names[id(parameter)]}/{k}": v for k, v in values.items()}
    write_tensors(path, tensors, {"state": json.dumps(state)})


def load_resume(path: Path) -> tuple[dict[str, Tensor], dict[str, dict[str, Tensor]], dict[str, Any]]:
    """Read what :func:`save_resume` wrote: weights, Adam's moments by parameter name, state."""
    tensors, header = read_tensors(path)
    weights = {k.removeprefix("model/"): v for k, v in tensors.items() if k.startswith("model/")}
    moments: dict[str, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("adam/"):
            name, kind = key.removeprefix("adam/").rsplit("/", 1)
            moments.setdefault(name, {})[kind] = value
    return weights, moments, json.loads(header.get("state", "{}"))
