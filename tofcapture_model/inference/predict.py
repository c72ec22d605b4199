"""Predict depth, normals and error map: of one frame, of all views of a folder, or frame after frame with :class:`Predictor`."""

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

from tofcapture import open_dataset
from tofcapture.camera import Camera
from tofcapture.cli.kit import Report
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.disk import check_writable
from tofcapture.files.layout import BOARD_SCENE
from tofcapture.files.manifest import manifest_path
from tofcapture.files.shard import ShardReader, is_shard
from tofcapture.files.view import find_views, view_number
from tofcapture.frames import TofInfo, View
from tofcapture.importing.rules import expect_finite
from tofcapture_model.config import BASELINES
from tofcapture_model.data import batched, ends_of, frame_decoder, make_frame, with_cues
from tofcapture_model.data.conditions import Seen, outside
from tofcapture_model.data.raw_input import IMPORTED, RawInput, from_arrays, read_input, taken
from tofcapture_model.frame import MAX_RANGE, MIN_RANGE, Frame
from tofcapture_model.geometry.decoder import Taps, TorchDecoder
from tofcapture_model.inference.export import Flat, ask_onnx, config_of, open_onnx
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
    """Hold what is ready for a camera: from taps and temperature to inputs on the device, from these to an answer of :data:`Ask` and more."""

    prepare: Callable[[NDArray[Any], float], Any]
    ask: Callable[[Any], tuple[Tensor, ...]]


class Predictor:
    """A network that answers frame after frame: loaded once, and on a GPU recorded once per camera.

    Call it with a view, or what :func:`tofcapture_model.data.raw_input.read_input` reads: the path of a view, shard or array; then
    ``frame`` is that of the burst, or ``None``: the mean. A running camera calls it with ``raw``, (K, H, W) taps of one frame, and
    ``info``, the channels, saturation, light source and range errors; ``camera``, intrinsics (``None``: those of ``info``);
    ``celsius``, NaN: unknown. Raw taps without ``info``, (K, H, W) or (F, K, H, W), are checked as an array's file is. It answers with
    a :class:`Prediction` without times, in arrays of its own. Tables and recordings of the last four cameras are kept.

    Parameters
    ----------
    weights
        Checkpoint or folder of a run; ``None`` or ``bundled``: the bundled one.
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

    def __init__(
        self, weights: str | Path | None = None, device: str = "cpu", backend: str = "torch"
    ) -> None:
        self.weights = find_model(weights)
        model = _onnx_model(weights) if backend == "onnx" else torch_model(weights, device)
        self._ask, self.network, self._seen = model
        self._device = torch.device("cpu" if backend == "onnx" else device)
        self._prepared: dict[Hashable, _Prepared] = {}
        if self._on_gpu:
            torch.cuda.set_device(self._device)  # streams, graphs and waiting are the current one's

    def __call__(
        self,
        raw: View | str | Path | NDArray[Any],
        info: TofInfo | None = None,
        camera: Camera | None = None,
        celsius: float = math.nan,
        *,
        frame: int | None = 0,
    ) -> Prediction:
        """Answer for one frame."""
        if info is None or not isinstance(raw, np.ndarray):
            return self.answer(_input_of(raw, frame), frame)
        return self._answer(raw, info, camera or info.camera, celsius, "raw frame", _untimed)

    def __repr__(self) -> str:
        return f"Predictor({self.network}, {str(self.weights)!r}, on {self._device})"

    def answer(self, data: RawInput, frame: int | None = 0, *, timed: bool = False) -> Prediction:
        """Answer for one frame of a burst that was read, or with ``None`` for its mean; ``timed`` tells how long that takes."""
        raw, celsius = taken(data.raw, frame, data.info, data.celsius)
        watch = _timed if timed else _untimed
        return self._answer(raw, data.info, data.camera, celsius, data.named(frame) or "raw frame", watch)

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
            (depth, normals, error, trust, *mine), inference_ms = watch(lambda: prepared.ask(inputs), wait)
        valid, sensor, confidence = (_image(x)[0] for x in mine)
        measured = valid > 0
        if not measured.any():
            raise _nothing(raw, info, where)
        knows = self.network not in BASELINES
        return Prediction(
            depth=_image(depth)[0],
            error=_image(error)[0] if knows else None,
            trust=_image(trust)[0] if knows else None,
            normals=np.ascontiguousarray(_image(normals).transpose(1, 2, 0)),
            measured=measured.repeat(2, axis=0).repeat(2, axis=1),
            camera=camera.scaled(2),
            network=self.network,
            sensor=np.where(measured, sensor, np.float32(np.nan)),
            outside=outside(
                self._seen, tuple(info.modulation_hz), camera, float(np.median(confidence[measured]))
            ),
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
            return *self._ask(frame), frame.valid, frame.depth, frame.confidence

        return _Prepared(lambda raw, celsius: batched(make_frame(raw, info, camera, celsius, decoder)), ask)

    def _on_the_device(self, info: TofInfo, camera: Camera) -> _Prepared:
        """Copy the taps, and launch all the rest at once."""
        decoder, hz = TorchDecoder(info, camera, self._device), ends_of(info)

        def ask(taps: Taps) -> tuple[Tensor, ...]:
            frame = with_cues(decoder(taps), hz)
            return *self._ask(frame), frame.valid, frame.depth, frame.confidence

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
    return Predictor(weights, device, backend).answer(data, frame, timed=timed)


def _input_of(source: View | str | Path | NDArray[Any], frame: int | None) -> RawInput:
    """Make a burst of whatever one calls a network with."""
    if isinstance(source, View):
        name = f"{source.scene} {source.index}"
        return RawInput(source.tof.raw, source.tof.celsius, source.tof.info, source.rig.tof, name)
    if isinstance(source, np.ndarray):
        return from_arrays({"raw": source}, Path("array"), frame=frame)
    return read_input(Path(source), frame=frame)


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


Ask = Callable[[Frame], tuple[Tensor, Tensor, Tensor, Tensor]]
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


def torch_model(weights: str | Path | None, device: str) -> tuple[Ask, str, Seen | None]:
    """Load a network to compute as it was trained: in bfloat16 if that is how it learned, and where the device has it.

    With its kind, and what its checkpoint says that it has seen.
    """
    model, config, provenance = load_checkpoint(weights)
    model = model.to(device)
    kind = torch.device(device).type
    half = config.training.precision == "bfloat16" and has_bfloat16(kind)
    if half and isinstance(model, JointModel):  # baselines have layers that stay in float32
        _halve_convolutions(model)

    flat = Flat(model)

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        # weights that are cast and kept would be lost to a graph that was recorded with them
        with torch.autocast(kind, torch.bfloat16, enabled=half, cache_enabled=kind != "cuda"):
            found: tuple[Tensor, Tensor, Tensor, Tensor] = flat(*frame)
        return found

    return ask, config.network.kind, provenance.get("seen")


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


def _onnx_model(weights: str | Path | None) -> tuple[Ask, str, Seen | None]:
    named = find_model(weights)  # a checkpoint, or the export itself
    path = named.with_suffix(".onnx")
    if not path.exists():
        raise ConfigError(
            f"{path}: no such file", hint="tofcapture export --out DIR/model.onnx, then predict --weights DIR"
        )
    session = open_onnx(path)
    config = config_of(session, path, named if named != path else path.with_suffix(".safetensors"))
    size = tuple(session.get_inputs()[0].shape[-2:])

    def ask(frame: Frame) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        got = tuple(frame.depth.shape[-2:])
        if size != got:
            raise ConfigError(
                f"{path}: exported for frames of {size}, got {got}", hint="tofcapture export --size"
            )
        depth, normals, error, trust = (torch.from_numpy(x) for x in ask_onnx(session, frame))
        return depth, normals, error, trust

    return ask, config.network.kind, None


def _expect_folder(out: Path) -> None:
    """Refuse, before anything is computed, a folder that cannot be made."""
    there = next((p for p in (out, *out.parents) if p.exists()), None)
    if there is not None and not there.is_dir():
        raise ConfigError(
            f"--out {out}: expected a folder, but {there} is a file", hint="name another folder"
        )
    check_writable(out, "name another folder: --out")


class Source(NamedTuple):
    """Name of a burst among others, its file, and its view where that is a shard."""

    name: str
    path: Path
    view: int = 0


def sources_of(path: Path, view: int | None = None) -> list[Source]:
    """List the bursts that a path stands for.

    Parameters
    ----------
    path
        View, shard, array, recording (without the board's views), dataset, or a folder of views, shards and arrays.
    view
        Of every scene only the one of this number; of a shard the one at this place.

    Raises
    ------
    DataError
        Nothing is there to predict from.
    """
    if path.is_dir():
        found = [source for file in _files_in(path) for source in _of_file(file, view)]
    else:
        found = _of_file(path, view)
    if not found:
        raise DataError(
            f"{path}: expected views, shards or arrays, found none"
            + ("" if view is None else f" of view {view}"),
            hint=f"a recording, a dataset, a folder of .npy, .npz or .h5 files, or one such file; {IMPORTED}",
        )
    stems = [source.name for source in found]
    return [
        source if stems.count(source.name) == 1 else source._replace(name=f"{source.path.name}-{i}")
        for i, source in enumerate(found)
    ]


def _files_in(folder: Path) -> list[Path]:
    if manifest_path(folder).exists():
        return [shard.path for shard in open_dataset(folder).shards.values()]
    if (folder / "views").is_dir():
        scenes = find_views(folder)
        return [path for scene, paths in scenes.items() if scene != BOARD_SCENE for path in paths]
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in {".npy", ".npz", ".h5"} and p.is_file())


def _of_file(path: Path, view: int | None) -> list[Source]:
    if path.suffix.lower() != ".h5" or not is_shard(path):
        number = view_number(path)
        fits = view is None or number is None or number == view
        return (
            [Source(path.stem if number is None else f"{path.parent.name}-{number:03d}", path)]
            if fits
            else []
        )
    with ShardReader(path) as shard:
        if view is not None and not 0 <= view < len(shard):
            raise ConfigError(f"{path}: expected a view of 0 to {len(shard) - 1}, got {view}")
        views = range(len(shard)) if view is None else [view]
        return [Source(f"{shard.scene}-{shard.index(i):03d}", path, i) for i in views]


def predict(
    path: str | Path,
    out: str | Path,
    *,
    weights: str | Path | None = None,
    view: int | None = None,
    frame: int | None = 0,
    rig: Path | None = None,
    device: str = "cpu",
    backend: str = "torch",
    saturation: float | None = None,
    benchmark: bool = False,
    report: Report = lambda _what, _done, _total, _text="": None,
) -> dict[str, Any]:
    """Predict from one burst into ``out``, or from many into a folder of it each; returns what ``--json`` prints.

    Parameters
    ----------
    path, view
        As for :func:`sources_of`.
    out
        Folder, made when missing.
    weights, device, backend
        As for :class:`Predictor`.
    frame
        Of each burst, or ``None``: the mean.
    rig, saturation
        Of arrays.
    benchmark
        Answer ten times and tell the median time.
    report
        Told how far it is.

    Raises
    ------
    DataError, ConfigError
        As :func:`tofcapture_model.data.raw_input.read_input` does. Of many bursts one that cannot be read stops no other: it stands
        under ``failed``.
    """
    _expect_folder(Path(out))
    sources = sources_of(Path(path), view)
    many = len(sources) > 1
    report("load the network", 0, 0)
    predictor = Predictor(weights, device, backend)
    rows: dict[str, dict[str, Any]] = {}
    failed: dict[str, dict[str, str]] = {}
    for done, source in enumerate(sources):
        report("predict", done, len(sources) if many else 0, source.name)
        try:
            data = read_input(source.path, source.view, rig, saturation=saturation, frame=frame)
            prediction = predictor.answer(data, frame, timed=benchmark)
        except DataError as err:
            if not many:
                raise
            failed[source.name] = {"message": err.message, "hint": err.hint}
            continue
        written = write_prediction(prediction, Path(out) / source.name if many else Path(out))
        rows[source.name] = _row(data, prediction, written)
    if many:
        report("predict", len(sources), len(sources))
    weights_used = predictor.weights.with_suffix(".onnx") if backend == "onnx" else predictor.weights
    about = {"input": str(path), "network": predictor.network, "weights": str(weights_used), "units": "m"}
    return about | ({"predictions": rows, "failed": failed} if many else next(iter(rows.values())))


def _row(data: RawInput, prediction: Prediction, written: dict[str, str]) -> dict[str, Any]:
    """Say of a prediction what it rests on, and its main numbers."""
    share, error = float(prediction.measured.mean()), prediction.error
    times = {"inference_ms": prediction.inference_ms, "decode_ms": prediction.decode_ms}
    return {
        "assumed": data.assumed,
        "warning": data.warning,
        "outside": prediction.outside,
        "measured": round(share, 4),
        "filled": round(1 - share, 4),
        **{name: None if math.isnan(ms) else round(ms, 2) for name, ms in times.items()},
        "shape": list(prediction.depth.shape),
        "median_depth": float(np.median(prediction.depth)),
        "median_sensor_depth": float(np.nanmedian(prediction.sensor)),
        "trusted": None if prediction.trust is None else round(float(prediction.trust.mean()), 4),
        "median_expected_error": None if error is None else float(np.median(error)),
        "files": written,
    }
