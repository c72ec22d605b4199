"""Predict depth, normals and error map of one frame, from a view file, a shard or a plain ``.npy``."""

from __future__ import annotations

import statistics
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.files.seal import write_text
from tofcapture.ops.phase import frequencies
from tofcapture_model.checkpoint import find_model, load_model
from tofcapture_model.data import batched, decode_frame, frame_decoder, make_frame, with_cues
from tofcapture_model.frame import Frame, frame_to
from tofcapture_model.raw_input import RawInput, read_input

Float32 = NDArray[np.float32]
T = TypeVar("T")
WARM, RUNS = (
    3,
    7,
)  # runs before the timed ones, which allocate and wake threads; timed runs, whose median is told


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
        Median time of the network, after loading and decoding; on a GPU with that of the physical cues.
    decode_ms
        Median time of decoding the raw frame, after the camera's tables are built, and of the physical cues; on a GPU of decoding and
        of the way there.
    """

    depth: Float32
    error: Float32
    normals: Float32
    camera: Camera
    inference_ms: float
    decode_ms: float


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
    parts = (raw, data.info, data.camera, celsius, frame_decoder(data.info, data.camera))
    place = torch.device("cpu" if backend == "onnx" else device)
    on_gpu = place.type == "cuda"
    wait: Callable[[], None] = torch.cuda.synchronize if on_gpu else lambda: None
    with torch.inference_mode():
        if on_gpu:
            hz = frequencies(data.info.modulation_hz)[1]
            inputs, decode_ms = _timed(lambda: frame_to(batched(decode_frame(*parts)), place), wait)
            launch = recorded(lambda frame: ask(with_cues(frame, hz)), inputs)
        else:
            decoded, decode_ms = _timed(lambda: make_frame(*parts), wait)
            inputs, launch = frame_to(batched(decoded), place), ask
        (depth, normals, error), inference_ms = _timed(lambda: launch(inputs), wait)
    return Prediction(
        depth=depth[0, 0].cpu().numpy(),
        error=error[0, 0].cpu().numpy(),
        normals=np.ascontiguousarray(normals[0].permute(1, 2, 0).cpu().numpy()),
        camera=data.camera.scaled(2),
        inference_ms=inference_ms,
        decode_ms=decode_ms,
    )


def _timed(work: Callable[[], T], wait: Callable[[], None]) -> tuple[T, float]:
    """Answer of some work and its median time in milliseconds."""
    times: list[float] = []
    for _ in range(WARM + RUNS):
        started = time.perf_counter()
        answer = work()
        wait()
        times.append(1000 * (time.perf_counter() - started))
    return answer, statistics.median(times[WARM:])


Ask = Callable[[Frame], tuple[Tensor, Tensor, Tensor]]


def recorded(ask: Ask, like: Frame) -> Ask:
    """Record what a GPU does for a frame as a CUDA graph, so that every further one takes a single launch.

    A prediction is about a thousand small kernels; launching them one by one takes longer than running them.

    Parameters
    ----------
    ask
        Depth, normals and error of a batch, without a look at any value on the way and without copies from the host.
    like
        Of the shapes and on the device of all frames to come.

    Returns
    -------
    The same question; an answer lasts until the next one.
    """
    held = Frame(*(x.clone() for x in like))
    beside = torch.cuda.Stream(like.raw.device)  # type: ignore[no-untyped-call]
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):  # libraries choose and allocate on first use, which cannot be recorded
        for _ in range(WARM):
            ask(held)
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        answer = ask(held)

    def replay(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        for place, new in zip(held, frame, strict=True):
            place.copy_(new)
        graph.replay()
        return answer

    return replay


def _torch_model(weights: Path | None, device: str) -> Ask:
    """Compute as it was trained: in bfloat16 if that is how it learned, and where the processor has it."""
    model, config, _ = load_model(weights)
    model = model.to(device)
    kind = torch.device(device).type
    half = config.training.precision == "bfloat16" and has_bfloat16(kind)

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        # weights that are cast and kept would be lost to a graph that was recorded with them
        with torch.autocast(kind, torch.bfloat16, enabled=half, cache_enabled=kind != "cuda"):
            found = model(frame)
        return found.depth, found.normals, found.error

    return ask


def has_bfloat16(kind: str) -> bool:
    """Whether a device multiplies in bfloat16 by itself; emulated it would be slower than float32."""
    if kind == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    return kind == "cpu" and any(
        bool(able.get(name)) for name in ("avx512_bf16", "amx_bf16", "arm_bf16", "bf16")
    )


def _onnx_model(weights: Path | None, camera: Camera) -> Ask:
    from tofcapture_model.onnx_backend import ask_onnx, open_onnx

    path = find_model(weights).with_suffix(".onnx")
    if not path.exists():
        raise ConfigError(
            f"{path}: no such file", hint="tofcapture export --out DIR/model.onnx, then predict --weights DIR"
        )
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
    used = find_model(weights)
    return {
        "input": str(path),
        "assumed": data.assumed,
        "weights": str(used.with_suffix(".onnx") if backend == "onnx" else used),
        "inference_ms": round(prediction.inference_ms, 2),
        "decode_ms": round(prediction.decode_ms, 2),
        "shape": list(prediction.depth.shape),
        "median_depth": float(np.median(prediction.depth)),
        "median_expected_error": float(np.median(prediction.error)),
        "units": "m",
        "files": written,
    }
