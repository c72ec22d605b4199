"""Predict depth, normals and error map of one frame, from a view file, a shard or a plain array; or of many, with :class:`Predictor`."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.disk import check_writable
from tofcapture.frames import TofInfo
from tofcapture.importing.rules import expect_finite
from tofcapture_model.config import BASELINES
from tofcapture_model.data import batched, frame_decoder, make_frame, with_cues
from tofcapture_model.data.raw_input import RawInput, read_input, taken
from tofcapture_model.frame import MAX_RANGE, MIN_RANGE, Frame
from tofcapture_model.geometry.decoder import Taps, TorchDecoder
from tofcapture_model.inference.prediction import Prediction, write_prediction
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint
from tofcapture_model.networks.joint import JointModel

Float32 = NDArray[np.float32]
T = TypeVar("T")
WARM, RUNS = 3, 7  # runs before the timed ones, which allocate and wake threads; timed ones
CAMERAS = 4  # whose tables and graphs are kept


class _Watch(Protocol):
    """Do some work, wait for the device, and say how many milliseconds it took."""

    def __call__(self, work: Callable[[], T], wait: Callable[[], None], /) -> tuple[T, float]: ...


class _Prepared(NamedTuple):
    """Hold what is ready for a camera: from taps and temperature to inputs on the device, from these to depth, normals, error, validity."""

    prepare: Callable[[NDArray[Any], float], Any]
    ask: Callable[[Any], tuple[Tensor, ...]]


class Predictor:
    """A network that answers frame after frame: loaded once, and on a GPU recorded once per camera.

    Call it with ``raw``, (K, H, W) taps of one frame or a mean that :func:`tofcapture_model.data.raw_input.taken` took; ``info``, the
    channels, saturation, light source and range errors; ``camera``, intrinsics (``None``: those of ``info``); ``celsius``, NaN: unknown.
    It answers with a :class:`Prediction` without times, in arrays of its own. Tables and recordings of the last four cameras are kept.

    Parameters
    ----------
    weights
        Checkpoint or folder of a run; ``None``: the bundled one.
    device
        Torch device.
    backend
        ``torch``, or ``onnx`` for the ``model.onnx`` that lies beside the checkpoint; that runs on the CPU.

    Raises
    ------
    ConfigError
        No such weights or export, or one of other weights; when called: a size or lens that the export does not know.
    DataError
        When called: taps that are not finite, or of a frame in which no pixel measured anything.
    """

    def __init__(self, weights: Path | None = None, device: str = "cpu", backend: str = "torch") -> None:
        self._ask, self.network = _onnx_model(weights) if backend == "onnx" else torch_model(weights, device)
        self._device = torch.device("cpu" if backend == "onnx" else device)
        self._prepared: dict[Hashable, _Prepared] = {}
        if self._on_gpu:
            torch.cuda.set_device(self._device)  # streams, graphs and waiting are the current one's

    def __call__(
        self, raw: NDArray[Any], info: TofInfo, camera: Camera | None = None, celsius: float = math.nan
    ) -> Prediction:
        """Answer for one frame."""
        return self._answer(raw, info, camera or info.camera, celsius, "raw frame", _untimed)

    @property
    def _on_gpu(self) -> bool:
        return self._device.type == "cuda"

    def _answer(
        self, raw: NDArray[Any], info: TofInfo, camera: Camera, celsius: float, where: str, watch: _Watch
    ) -> Prediction:
        expect_finite(raw, where)
        wait: Callable[[], None] = torch.cuda.synchronize if self._on_gpu else lambda: None
        with torch.inference_mode():
            prepared = self._prepare(info, camera)
            inputs, decode_ms = watch(lambda: prepared.prepare(raw, celsius), wait)
            (depth, normals, error, valid), inference_ms = watch(lambda: prepared.ask(inputs), wait)
        measured = _image(valid)[0] > 0
        if not measured.any():
            raise _nothing(raw, info, where)
        return Prediction(
            depth=_image(depth)[0],
            error=None if self.network in BASELINES else _image(error)[0],
            normals=np.ascontiguousarray(_image(normals).transpose(1, 2, 0)),
            measured=measured.repeat(2, axis=0).repeat(2, axis=1),
            camera=camera.scaled(2),
            network=self.network,
            inference_ms=inference_ms,
            decode_ms=decode_ms,
        )

    def _prepare(self, info: TofInfo, camera: Camera) -> _Prepared:
        key = (
            camera, tuple(info.modulation_hz), tuple(info.phase_rad), tuple(map(float, info.illuminator)),
            info.saturation, tuple(info.range_errors), info.offset, info.reach,
        )  # fmt: skip
        prepared = self._prepared.pop(key, None)
        if prepared is None:
            if len(self._prepared) == CAMERAS:  # before another one is made: a graph holds memory of its own
                self._prepared.pop(next(iter(self._prepared)))
            prepared = (self._on_the_device if self._on_gpu else self._on_the_host)(info, camera)
        self._prepared[key] = prepared  # the last one used stands last
        return prepared

    def _on_the_host(self, info: TofInfo, camera: Camera) -> _Prepared:
        """Decode by the tables of numpy; what is asked is a frame."""
        decoder = frame_decoder(info, camera)

        def ask(frame: Frame) -> tuple[Tensor, ...]:
            return *self._ask(frame), frame.valid

        return _Prepared(lambda raw, celsius: batched(make_frame(raw, info, camera, celsius, decoder)), ask)

    def _on_the_device(self, info: TofInfo, camera: Camera) -> _Prepared:
        """Copy the taps, and launch all the rest at once."""
        decoder, high = TorchDecoder(info, camera, self._device), max(info.modulation_hz)

        def ask(taps: Taps) -> tuple[Tensor, ...]:
            frame = with_cues(decoder(taps), high)
            return *self._ask(frame), frame.valid

        dark = np.zeros((len(info.modulation_hz), *camera.shape), np.float32)
        return _Prepared(decoder.taps, recorded(ask, decoder.taps(dark, math.nan)))


def _image(tensor: Tensor) -> Float32:
    """(C, H, W) array of its own: what a graph answers lasts only until its next launch."""
    return np.array(tensor[0].float().cpu().numpy())


def _nothing(raw: NDArray[Any], info: TofInfo, where: str) -> DataError:
    """Say of a frame that has no depth anywhere why that may be."""
    share = float(info.saturated(raw).any(axis=0).mean())
    what = f"{share:.0%} of them are saturated" if share else "no light, or none that was modulated"
    return DataError(
        f"{where}: expected pixels that measure a depth between {MIN_RANGE:g} and {MAX_RANGE:g} m, got none of {raw[0].size}: {what}",
        hint="choose another --frame, or record again with another exposure",
    )


def predict_raw(
    data: RawInput,
    frame: int | None,
    weights: Path | None,
    device: str = "cpu",
    backend: str = "torch",
    *,
    timed: bool = False,
) -> Prediction:
    """Run a model on one frame of a burst, or with ``frame = None`` on its mean; arguments as of :class:`Predictor`.

    ``timed`` decodes and asks ten times, and tells how long it takes.
    """
    raw, celsius = taken(data.raw, frame, data.info, data.celsius)
    predictor = Predictor(weights, device, backend)
    watch = _timed if timed else _untimed
    return predictor._answer(raw, data.info, data.camera, celsius, data.named(frame) or "raw frame", watch)  # noqa: SLF001


def _untimed(work: Callable[[], T], _wait: Callable[[], None]) -> tuple[T, float]:
    """Answer of some work, once."""
    return work(), math.nan


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
Inputs = TypeVar("Inputs", Frame, Taps)


def recorded(
    ask: Callable[[Inputs], tuple[Tensor, ...]], like: Inputs
) -> Callable[[Inputs], tuple[Tensor, ...]]:
    """Record what a GPU does for a frame as a CUDA graph: a thousand small kernels then take a single launch.

    Parameters
    ----------
    ask
        Tensors of a frame or of taps, without a look at any value on the way and without copies from the host.
    like
        Of the shapes and on the device of all that will be asked.

    Returns
    -------
    function
        The same question; an answer lasts until the next one.
    """
    held = type(like)(*(x.clone() for x in like))
    beside = torch.cuda.Stream(like.raw.device)  # type: ignore[no-untyped-call]
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):  # libraries choose and allocate on first use, which cannot be recorded
        for _ in range(WARM):
            ask(held)
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        answer = ask(held)

    def replay(inputs: Inputs) -> tuple[Tensor, ...]:
        for buffer, new in zip(held, inputs, strict=True):
            buffer.copy_(new)
        graph.replay()
        return answer

    return replay


def torch_model(weights: Path | None, device: str) -> tuple[Ask, str]:
    """Load a network to compute as it was trained: in bfloat16 if that is how it learned, and where the device has it. With its kind."""
    model, config, _ = load_checkpoint(weights)
    model = model.to(device)
    kind = torch.device(device).type
    half = config.training.precision == "bfloat16" and has_bfloat16(kind)
    if half and isinstance(model, JointModel):  # baselines have layers that stay in float32
        _halve_convolutions(model)

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        # weights that are cast and kept would be lost to a graph that was recorded with them
        with torch.autocast(kind, torch.bfloat16, enabled=half, cache_enabled=kind != "cuda"):
            found = model(frame)
        return found.depth, found.normals, found.error

    return ask, config.network.kind


def _halve_convolutions(model: JointModel) -> None:
    """Round their weights once, to what autocast would round them to for every frame."""
    for module in model.modules():
        if isinstance(module, torch.nn.Conv2d | torch.nn.ConvTranspose2d):
            module.to(torch.bfloat16)


def has_bfloat16(kind: str) -> bool:
    """Whether a device multiplies in bfloat16 by itself; emulated it would be slower than float32."""
    if kind == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    able = torch.cpu.get_capabilities()
    return kind == "cpu" and any(
        bool(able.get(name)) for name in ("avx512_bf16", "amx_bf16", "arm_bf16", "bf16")
    )


def _onnx_model(weights: Path | None) -> tuple[Ask, str]:
    from tofcapture_model.inference.export import ask_onnx, config_of, open_onnx

    named = find_model(weights)  # a checkpoint, or the export itself
    path = named.with_suffix(".onnx")
    if not path.exists():
        raise ConfigError(
            f"{path}: no such file", hint="tofcapture export --out DIR/model.onnx, then predict --weights DIR"
        )
    session = open_onnx(path)
    config = config_of(session, path, named if named != path else path.with_suffix(".safetensors"))
    size = tuple(session.get_inputs()[0].shape[-2:])

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        got = tuple(frame.depth.shape[-2:])
        if size != got:
            raise ConfigError(
                f"{path}: exported for frames of {size}, got {got}", hint="tofcapture export --size"
            )
        depth, normals, error = (torch.from_numpy(x) for x in ask_onnx(session, frame))
        return depth, normals, error

    return ask, config.network.kind


def _expect_folder(out: Path) -> None:
    """Refuse, before anything is computed, a folder that cannot be made."""
    there = next((p for p in (out, *out.parents) if p.exists()), None)
    if there is not None and not there.is_dir():
        raise ConfigError(
            f"--out {out}: expected a folder, but {there} is a file", hint="name another folder"
        )
    check_writable(out, "name another folder: --out")


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
    saturation: float | None = None,
) -> dict[str, Any]:
    """Predict from a file and write the result; returns what ``--json`` prints."""
    _expect_folder(Path(out))
    data = read_input(Path(path), view, rig, saturation=saturation, frame=frame)
    prediction = predict_raw(data, frame, weights, device, backend, timed=True)
    written = write_prediction(prediction, Path(out))
    used = find_model(weights)
    share = float(prediction.measured.mean())
    error = prediction.error
    return {
        "input": str(path),
        "assumed": data.assumed,
        "warning": data.warning,
        "measured": round(share, 4),
        "filled": round(1 - share, 4),
        "network": prediction.network,
        "weights": str(used.with_suffix(".onnx") if backend == "onnx" else used),
        "inference_ms": round(prediction.inference_ms, 2),
        "decode_ms": round(prediction.decode_ms, 2),
        "shape": list(prediction.depth.shape),
        "median_depth": float(np.median(prediction.depth)),
        "median_expected_error": None if error is None else float(np.median(error)),
        "units": "m",
        "files": written,
    }
