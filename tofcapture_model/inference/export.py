"""Export a trained model to ONNX or ``torch.export``, checked against torch before it is kept, and run exports in onnxruntime."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config, dumps_config, loads_config
from tofcapture_model.frame import Estimate, Frame
from tofcapture_model.geometry.maps import with_lens
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint

OUTPUTS = ("depth_2x", "normals_2x", "error_2x", "trust")
DIGEST, CONFIG = "weights_sha256", "config.toml"
"""What an export carries beside the network: SHA-256 of the checkpoint's file, and its configuration. Metadata of ``.onnx``, extra files
of ``.pt2``."""
SUFFIX = {"onnx": ".onnx", "torch": ".pt2"}
SIZE = (180, 240)  # px, sensor rows and columns
OPSET = 17
TOLERANCE = 1e-4  # m, and of a unit normal; refinement compares with thresholds, which rounding may cross in few pixels
_CROSSING = 1e-3  # share of pixels that may differ by more


class Flat(nn.Module):
    """A model whose inputs are the fields of a frame in their order, and whose outputs are depth, normals, error and trust."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, *fields: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """See :class:`tofcapture_model.frame.Frame` and :class:`tofcapture_model.frame.Estimate`."""
        frame = Frame(*fields)
        found: Estimate = self.model(frame)
        trust = torch.ones_like(frame.depth) if found.trust is None else found.trust
        return found.depth, found.normals, found.error, trust


def example(batch: int, size: tuple[int, int] = SIZE, seed: int = 0) -> Frame:
    """Make a plausible frame of random numbers, for tracing and for checks; its camera has a lens, so what is traced takes any."""
    g = torch.Generator().manual_seed(seed)
    h, w = size

    def noise(channels: int) -> Tensor:
        return torch.randn(batch, channels, h, w, generator=g)

    ramp = torch.linspace(0, 0.2, w).expand(batch, 1, h, w)
    camera = torch.tensor(
        [0.8 * w, 0.8 * w, (w - 1) / 2, (h - 1) / 2, -0.15, 0.03, 1e-3, -1e-3, 0.0, 0.01, 0.0, 0.0]
    )
    return Frame(
        raw=0.3 + 0.05 * noise(8),
        phasor=0.1 * noise(4),
        depth=0.8 + ramp + 0.002 * noise(1),
        valid=torch.ones(batch, 1, h, w),
        confidence=(0.1 + 0.02 * noise(1)).clamp_min(0.01),
        gap=0.02 * noise(1),
        cues=0.005 * noise(5),
        modulation=torch.tensor([[20e6, 100e6]]).repeat(batch, 1),
        intrinsics=camera.repeat(batch, 1),
        demodulation=torch.zeros(batch, 4, 8),
        light=torch.tensor([[0.055, 0.04]]).repeat(batch, 1),
        noise=torch.zeros(batch, 5),
    )


def export(
    weights: Path | None, out: Path, *, kind: str = "onnx", size: tuple[int, int] = SIZE
) -> dict[str, Any]:
    """Export a model and hold the result against torch on two batch sizes.

    The export carries its configuration and the SHA-256 of the checkpoint
    (:data:`DIGEST`). Nothing but ``out`` is written.

    Parameters
    ----------
    weights
        Checkpoint or run folder; ``None``: the bundled weights.
    out
        ``.onnx`` (kind ``onnx``) or ``.pt2`` (kind ``torch``); an export that was there is replaced.
    kind
        ``onnx`` or ``torch``.
    size
        (height, width) of the sensor: fixed in the export, the batch is free.

    Returns
    -------
    ``out``, ``kind``, ``size`` and the largest differences by output, metres.

    Raises
    ------
    ConfigError
        ``out`` has another suffix, is a folder, or lies in what is none.
    DataError
        The exported model answers differently.
    """
    _expect_file(out, kind)
    model, config, _ = load_checkpoint(weights)
    told = {DIGEST: sha256_of(find_model(weights)), CONFIG: dumps_config(config)}
    flat = Flat(model).eval()
    for parameter in flat.parameters():
        parameter.requires_grad_(False)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=out.parent) as folder:
        partial = Path(folder) / out.name  # torch wants its suffix
        (_onnx if kind == "onnx" else _program)(flat, partial, size, told)
        differences = _differences(flat, partial, kind, size)
        partial.replace(out)
    return {
        "out": str(out),
        "kind": kind,
        "size": list(size),
        "differences": differences,
        "bytes": out.stat().st_size,
    }


def _expect_file(out: Path, kind: str) -> None:
    if out.suffix != SUFFIX[kind]:
        raise ConfigError(
            f"--out {out}: expected a name that ends in {SUFFIX[kind]}, got {out.suffix or 'no suffix'}",
            hint="--format onnx writes .onnx, --format torch writes .pt2",
        )
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise ConfigError(f"--out {out}: {err.strerror}: {err.filename}", hint="name another folder") from err
    if out.is_dir():
        raise ConfigError(
            f"--out {out}: expected a file, got a folder", hint=f"--out {out / 'model'}{SUFFIX[kind]}"
        )


def _onnx(flat: nn.Module, path: Path, size: tuple[int, int], told: dict[str, str]) -> None:
    try:
        import onnx
        import onnxruntime  # noqa: F401
    except ImportError as err:
        raise ConfigError(f"cannot export to ONNX: {err}", hint="pip install tofcapture[onnx]") from err
    names = [*Frame._fields, *OUTPUTS]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what tracing may get wrong: the differences tell
        torch.onnx.export(
            flat,
            tuple(example(2, size)),
            str(path),
            input_names=list(Frame._fields),
            output_names=list(OUTPUTS),
            dynamic_axes={name: {0: "batch"} for name in names},
            opset_version=OPSET,
            dynamo=False,
        )
    made = onnx.load(str(path))
    onnx.helper.set_model_props(made, told)
    onnx.save(made, str(path))


def _program(flat: nn.Module, path: Path, size: tuple[int, int], told: dict[str, str]) -> None:
    batch = torch.export.Dim("batch", min=1, max=1024)
    shapes = (tuple({0: batch} for _ in Frame._fields),)
    program = torch.export.export(flat, tuple(example(2, size)), dynamic_shapes=shapes, strict=False)
    with path.open("wb") as file:
        torch.export.save(program, file, extra_files=told)


def _differences(flat: nn.Module, path: Path, kind: str, size: tuple[int, int]) -> dict[str, float]:
    worst = dict.fromkeys(OUTPUTS, 0.0)
    for batch in (1, 3):
        frame = example(batch, size, seed=batch)
        with torch.no_grad():
            expected = flat(*frame)
            found = (
                ask_onnx(open_onnx(path), frame)
                if kind == "onnx"
                else torch.export.load(str(path)).module()(*frame)
            )
        for name, a, b in zip(OUTPUTS, expected, found, strict=True):
            apart = (a - torch.as_tensor(b)).abs().nan_to_num(nan=torch.inf)
            if float((apart > TOLERANCE).float().mean()) > _CROSSING:
                raise DataError(f"the export's {name} differs from torch's by up to {float(apart.max()):.2g}")
            worst[name] = max(worst[name], float(apart.max()))
    return worst


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
    if lacks := set(OUTPUTS) - {o.name for o in session.get_outputs()}:
        raise ConfigError(
            f"{path}: expected an export that answers {', '.join(sorted(lacks))}, got an older one",
            hint=again,
        )
    if weights.exists() and (found := sha256_of(weights)) != told[DIGEST]:
        raise ConfigError(
            f"{path}: expected an export of {weights} (sha256 {found[:12]}...), got one of other weights ({told[DIGEST][:12]}...)",
            hint=again,
        )
    return loads_config(told[CONFIG], str(path))


def ask_onnx(session: Any, frame: Frame) -> list[NDArray[np.float32]]:
    """Run an opened model on a frame; inputs that the export found unused are not asked for."""
    wanted = {i.name for i in session.get_inputs()}
    ends = frame.modulation[:, :2]  # the lowest and the highest: no network reads others
    asked = frame._replace(intrinsics=with_lens(frame.intrinsics), modulation=ends)
    feed = {k: np.ascontiguousarray(v.numpy()) for k, v in asked._asdict().items() if k in wanted}
    found: list[NDArray[np.float32]] = session.run(list(OUTPUTS), feed)
    return found
