"""Predict depth, normals and error map of one frame, from a view file, a shard or a plain ``.npy``."""

from __future__ import annotations

import statistics
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.seal import write_text
from tofcapture.frames import TofInfo
from tofcapture.rig import load_rig
from tofcapture_model.checkpoint import find_model, load_model
from tofcapture_model.data import batched, make_frame
from tofcapture_model.frame import Frame, frame_to

Float32 = NDArray[np.float32]
RUNS = 3  # timed inferences, of which the median is told

NOMINAL_CAMERA = Camera(width=240, height=180, fx=190.6186, fy=200.7526, cx=116.8406, cy=101.4767)
"""A real 240 x 180 sensor of 20/100 MHz; used for a plain array when no rig is given."""


@dataclass(frozen=True)
class RawInput:
    """A burst and what is needed to decode it: raw (F, 8, H, W), sensor temperatures (F,), camera, intrinsics."""

    raw: NDArray[Any]
    celsius: NDArray[np.float64]
    info: TofInfo
    camera: Camera


@dataclass(frozen=True)
class Prediction:
    """What a prediction is, at twice the sensor's resolution.

    Attributes
    ----------
    depth, error
        (2H, 2W) float32 metres: z, and its expected absolute error.
    normals
        (2H, 2W, 3) float32, unit, ToF frame, facing the camera.
    camera
        Intrinsics of the (2H, 2W) grid.
    inference_ms
        Median time of the network, after loading and decoding.
    decode_ms
        Time of decoding the raw frame and of the physical cues, once.
    """

    depth: Float32
    error: Float32
    normals: Float32
    camera: Camera
    inference_ms: float
    decode_ms: float


def _from_npy(path: Path, rig_path: Path | None) -> RawInput:
    try:
        raw = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as err:
        raise DataError(f"{path}: cannot read the array: {err}") from err
    raw = raw[None] if raw.ndim == 3 else raw
    rig = load_rig(rig_path) if rig_path else None
    camera = rig.tof if rig else NOMINAL_CAMERA
    if raw.ndim != 4 or raw.shape[1:] != (8, *camera.shape) or len(raw) == 0 or raw.dtype.kind not in "uif":
        expected = f"(8, {camera.height}, {camera.width}) or (F, 8, {camera.height}, {camera.width})"
        raise DataError(
            f"{path}: expected numbers of shape {expected}, got {raw.dtype} {raw.shape}",
            hint="--rig names a camera of another size",
        )
    info = TofInfo(
        model="array",
        serial="",
        camera=camera,
        illuminator=rig.illuminator if rig else np.zeros(3),
        range_errors=rig.range_errors if rig else (),
    )
    return RawInput(raw, np.full(len(raw), np.nan), info, camera)


def _from_h5(path: Path, view: int) -> RawInput:
    import h5py

    from tofcapture.files.shard import ShardReader
    from tofcapture.files.view import read_view

    try:
        with h5py.File(path, "r") as file:
            kind = str(file.attrs.get("format", ""))
    except OSError as err:
        raise DataError(f"{path}: cannot read the file: {err}", hint=f"tofcapture check {path}") from err
    if kind != "tofcapture-shard":
        found = read_view(path)
        return RawInput(found.tof.raw, found.tof.celsius, found.tof.info, found.rig.tof)
    with ShardReader(path) as shard:
        if not 0 <= view < shard.views:
            raise ConfigError(f"{path}: expected a view of 0 to {shard.views - 1}, got {view}")
        raw = np.stack([shard.raw(view, f) for f in range(shard.frames)])
        celsius = np.array([shard.celsius(view, f) for f in range(shard.frames)])
        return RawInput(raw, celsius, shard.info, shard.camera)


def read_input(path: Path, view: int = 0, rig: Path | None = None) -> RawInput:
    """Read a burst.

    Parameters
    ----------
    path
        View file or shard (``.h5``), or an array (8, H, W) or (F, 8, H, W) (``.npy``).
    view
        Of a shard.
    rig
        ``rig.toml`` for an array; without it, nominal intrinsics and no range correction.

    Raises
    ------
    DataError
        Missing, damaged, or of a wrong shape.
    """
    if not path.exists():
        raise DataError(f"{path}: no such file")
    return _from_npy(path, rig) if path.suffix == ".npy" else _from_h5(path, view)


def predict_raw(
    data: RawInput, frame: int | None, weights: Path | None, device: str = "cpu", backend: str = "torch"
) -> Prediction:
    """Run a model on one frame of a burst, or with ``frame = None`` on the burst's mean (taps are linear, so it may be taken).

    Parameters
    ----------
    data
        The burst.
    frame
        Number of the frame.
    weights
        Checkpoint; ``None``: the bundled one.
    device
        Torch device.
    backend
        ``torch``, or ``onnx`` for the ``model.onnx`` that lies beside the checkpoint.
    """
    if frame is not None and not 0 <= frame < len(data.raw):
        raise ConfigError(f"expected a frame of 0 to {len(data.raw) - 1}, got {frame}")
    taken = slice(None) if frame is None else slice(frame, frame + 1)
    raw, celsius = data.raw[taken].mean(axis=0, dtype=np.float64), float(data.celsius[taken].mean())
    ask = _onnx_model(weights, data.camera) if backend == "onnx" else _torch_model(weights, device)
    started = time.perf_counter()
    inputs = frame_to(batched(make_frame(raw, data.info, data.camera, celsius)), torch.device(device))
    decode_ms = 1000 * (time.perf_counter() - started)
    times: list[float] = []
    with torch.inference_mode():
        depth, normals, error = ask(inputs)  # the first run allocates
        for _ in range(RUNS):
            started = time.perf_counter()
            depth, normals, error = ask(inputs)
            if device.startswith("cuda"):
                torch.cuda.synchronize()
            times.append(1000 * (time.perf_counter() - started))
    return Prediction(
        depth=depth[0, 0].cpu().numpy(),
        error=error[0, 0].cpu().numpy(),
        normals=np.ascontiguousarray(normals[0].permute(1, 2, 0).cpu().numpy()),
        camera=data.camera.scaled(2),
        inference_ms=statistics.median(times),
        decode_ms=decode_ms,
    )


Ask = Callable[[Frame], tuple[Tensor, Tensor, Tensor]]


def _torch_model(weights: Path | None, device: str) -> Ask:
    model = load_model(weights)[0].to(device)

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        found = model(frame)
        return found.depth, found.normals, found.error

    return ask


def _onnx_model(weights: Path | None, camera: Camera) -> Ask:
    from tofcapture_model.onnx_backend import ask_onnx, open_onnx

    path = find_model(weights).with_suffix(".onnx")
    if not path.exists():
        raise ConfigError(f"{path}: no such file", hint="tofcapture export --weights ... writes it")
    session = open_onnx(path)
    size = tuple(session.get_inputs()[0].shape[-2:])
    if size != camera.shape:
        raise ConfigError(
            f"{path}: exported for frames of {size}, got {camera.shape}", hint="tofcapture export --size"
        )

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        depth, normals, error = (torch.from_numpy(x) for x in ask_onnx(session, frame))
        return depth, normals, error

    return ask


def png_bytes(image: NDArray[Any]) -> bytes:
    """Encode (H, W) uint16 grey or (H, W, 3) uint8 colour as PNG."""
    grey = image.ndim == 2
    rows = image.astype(">u2" if grey else np.uint8).reshape(len(image), -1).view(np.uint8)
    packed = zlib.compress(np.hstack([np.zeros((len(image), 1), np.uint8), rows]).tobytes(), 6)
    header = struct.pack(
        ">IIBBBBB", image.shape[1], image.shape[0], 16 if grey else 8, 0 if grey else 2, 0, 0, 0
    )
    chunks = ((b"IHDR", header), (b"IDAT", packed), (b"IEND", b""))
    body = b"".join(
        struct.pack(">I", len(d)) + t + d + struct.pack(">I", zlib.crc32(t + d)) for t, d in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + body


def ply_bytes(prediction: Prediction) -> bytes:
    """Encode points, normals and expected error as binary PLY, metres, ToF frame."""
    points = prediction.camera.unproject(prediction.depth)
    rows = np.concatenate([points, prediction.normals, prediction.error[..., None]], axis=-1).reshape(-1, 7)
    names = ("x", "y", "z", "nx", "ny", "nz", "expected_error")
    header = ["ply", "format binary_little_endian 1.0", "comment units m", f"element vertex {len(rows)}"]
    header += [*(f"property float {n}" for n in names), "end_header", ""]
    return "\n".join(header).encode() + rows.astype("<f4").tobytes()


def write_prediction(prediction: Prediction, out: Path) -> dict[str, str]:
    """Write a prediction into a folder.

    ``depth.npy``, ``error.npy`` (float32 metres), ``normals.npy``, ``cloud.ply``, ``depth.png`` (16 bit, unit 0.1 mm, so up to
    6.5535 m), ``normals.png`` (8 bit, ``(n + 1) / 2`` with y and z towards the viewer), ``units.txt``.

    Returns
    -------
    Path of every file by its name.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in ("depth", "error", "normals"):
        np.save(out / f"{name}.npy", getattr(prediction, name))
    tenth_mm = np.clip(np.rint(prediction.depth * 1e4), 0, 65535).astype(np.uint16)
    colours = ((prediction.normals * [1, -1, -1] + 1) * 127.5).clip(0, 255).astype(np.uint8)
    (out / "depth.png").write_bytes(png_bytes(tenth_mm))
    (out / "normals.png").write_bytes(png_bytes(colours))
    (out / "cloud.ply").write_bytes(ply_bytes(prediction))
    write_text(
        out / "units.txt",
        "npy, ply: metres, ToF frame (x right, y down, z forward)\ndepth.png: 0.1 mm per count\n",
    )
    names = ("depth.npy", "normals.npy", "error.npy", "depth.png", "normals.png", "cloud.ply", "units.txt")
    return {name: str(out / name) for name in names}


def predict(
    path: Path,
    out: Path,
    *,
    weights: Path | None = None,
    view: int = 0,
    frame: int | None = 0,
    rig: Path | None = None,
    device: str = "cpu",
    backend: str = "torch",
) -> dict[str, Any]:
    """Predict from a file and write the result; returns what ``--json`` prints."""
    data = read_input(Path(path), view, rig)
    prediction = predict_raw(data, frame, weights, device, backend)
    written = write_prediction(prediction, Path(out))
    return {
        "input": str(path),
        "weights": str(find_model(weights)),
        "inference_ms": round(prediction.inference_ms, 2),
        "decode_ms": round(prediction.decode_ms, 2),
        "shape": list(prediction.depth.shape),
        "median_depth": float(np.median(prediction.depth)),
        "median_expected_error": float(np.median(prediction.error)),
        "units": "m",
        "files": written,
    }
