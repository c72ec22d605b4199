"""Read example views and draw them: one frame, the ground truth, and what the sensor and the network make of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.colours import NORMAL_WORDS, Scale, percentile, scale_for
from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import Manifest
from tofcapture.files.shard import GroundTruth, ShardReader
from tofcapture.poses import Float64
from tofcapture.viz.figures.scenes import Maps, Row
from tofcapture.viz.page import Picture, map_picture, mask_legend, mask_picture, normal_picture, picture
from tofcapture.viz.shots import eye_for, splat
from tofcapture_model.data import batched, make_frame
from tofcapture_model.networks import Model
from tofcapture_model.networks.baselines import sensor_estimate

Float32 = NDArray[np.float32]
FRAME = 0  # of the burst; evaluate takes the same one


@dataclass(frozen=True)
class Example(Row):
    """One view as the page shows it: a frame's amplitude at the lowest frequency, answers of ``sensor`` and ``model`` at 2x.

    ``confidence`` (H, W) is the burst's amplitude at the highest frequency, ``tof_depth`` (H, W) the frame's depth in metres,
    NaN: none, ``expected_error`` (2H, 2W) metres, where the model tells how wrong it expects its depth to be.
    """

    confidence: Float32
    tof_depth: Float32
    expected_error: Float32 | None

    @property
    def surface(self) -> NDArray[np.bool_]:
        """(2H, 2W) where the ground truth is sound, on the object or around it."""
        out: NDArray[np.bool_] = (self.truth.mask & ~np.uint8(MaskBit.OUTSIDE)) == 0
        return out


def choose(manifest: Manifest, split: str, count: int) -> list[tuple[str, int]]:
    """Pick (scene, view) evenly from the views of a split in order of their names: nobody chooses the pretty ones."""
    every = [(name, view) for name, entry in manifest.split(split).items() for view in range(entry.views)]
    step = np.linspace(0, len(every), min(count, len(every)), endpoint=False)
    return [every[int(i)] for i in step]


def load_examples(
    dataset: Path, manifest: Manifest, chosen: list[tuple[str, int]], model: Model | None
) -> list[Example]:
    """Read views and let the sensor and the model answer.

    Raises :class:`DataError`, :class:`FormatError`: a shard is missing or damaged.
    """
    out = []
    with _one_thread():
        for scene, view in chosen:
            entry = manifest.scenes[scene]
            with ShardReader(Path(dataset) / entry.path, entry.sha256) as shard:
                out.append(_example(shard, view, model))
    return out


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sum in one order whatever the number of cores: the same inputs give the same bytes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.inference_mode()
def _example(shard: ShardReader, view: int, model: Model | None) -> Example:
    info = shard.info
    frame = batched(make_frame(shard.raw(view, FRAME), info, shard.camera, shard.celsius(view, FRAME)))
    truth = shard.ground_truth(view, 2)
    depth, normals, _ = sensor_estimate(frame)
    answers, expected = {"sensor": _maps(depth, normals, truth)}, None
    if model is not None:
        estimate = model(frame)
        answers["model"] = _maps(estimate.depth, estimate.normals, truth)
        expected = None if estimate.error is None else _map(estimate.error)
    low_i, low_q = (info.saturation * frame.phasor[0, i].numpy() for i in (0, 1))
    return Example(
        name=f"{shard.scene}, view {shard.index(view)}",
        camera=shard.camera,
        amplitude=np.hypot(low_i, low_q),
        confidence=shard.tof(view).confidence,
        tof_depth=np.where(frame.valid[0, 0].numpy() > 0, frame.depth[0, 0].numpy(), np.nan),
        truth=truth,
        methods=answers,
        expected_error=expected,
        T_base_tof=shard.T_base_tof(view),
    )


def _maps(depth: torch.Tensor, normals: torch.Tensor, truth: GroundTruth) -> Maps:
    vectors: Any = np.ascontiguousarray(normals[0].permute(1, 2, 0).numpy(), dtype=np.float32)
    return Maps(_map(depth), vectors, truth)


def _map(tensor: torch.Tensor) -> Float32:
    return np.asarray(tensor[0, 0].numpy(), dtype=np.float32)


METHOD_TITLES = {"sensor": "ToF sensor", "model": "network"}
_MARGIN = 1.25  # of the object's radius: what of its surroundings a point cloud shows
_WIDTH, _GROUND = 480, 28  # pixels of a cloud's picture; its grey


@dataclass(frozen=True)
class Group:
    """Pictures side by side, with the scales they share as (words, scale)."""

    title: str
    note: str
    pictures: list[Picture]
    scales: list[tuple[str, Scale]]


@dataclass(frozen=True)
class Panel:
    """One example view: its title, its groups, and the legend of its mask as (colour, words, share of pixels)."""

    title: str
    groups: list[Group]
    legend: list[tuple[str, str, str]]


def panels(examples: Sequence[Example]) -> list[Panel]:
    """Draw all examples; errors of all of them are on one scale."""
    error = scale_for("error", [e.methods["sensor"].error_mm for e in examples])
    return [
        Panel(
            e.name,
            [_seen(e), _depths(e), _errors(e, error), _normals(e), _clouds(e, error)],
            mask_legend(e.truth.mask),
        )
        for e in examples
    ]


def _seen(e: Example) -> Group:
    amplitude, confidence = (scale_for("amplitude", [image]) for image in (e.amplitude, e.confidence))
    title, note = "ground-truth mask", "frame: what is shown below"
    pictures = [
        map_picture("amplitude, one frame", e.amplitude, amplitude, "amplitude image of the ToF camera"),
        map_picture("confidence, burst", e.confidence, confidence, "confidence map of the ToF camera"),
        mask_picture(title, e.truth.mask, "mask of the ground truth", note, e.window),
    ]
    scales = [("amplitude, lowest frequency", amplitude), ("confidence, highest frequency", confidence)]
    return Group("What the ToF camera saw, and where ground truth is sound", "", pictures, scales)


def _depths(e: Example) -> Group:
    scale = scale_for("depth", [1e3 * e.truth.depth], [e.good], "mm")
    pictures = [
        map_picture("ToF depth, one frame", e.shown(1e3 * e.tof_depth), scale, "depth of the ToF sensor")
    ]
    if "model" in e.methods:
        depth = e.shown(1e3 * e.methods["model"].depth)
        pictures.append(map_picture("depth, network, same frame", depth, scale, "depth of the network"))
    truth = e.shown(1e3 * e.truth.depth)
    pictures.append(map_picture("depth, ground truth", truth, scale, "depth of the ground truth"))
    return Group("Depth", "Grey: no value.", pictures, [("depth", scale)])


def _errors(e: Example, scale: Scale) -> Group:
    pictures, scales = [], [("answer minus ground truth", scale)]
    for name, maps in e.methods.items():
        method = METHOD_TITLES[name]
        shown = e.shown(maps.error_where(e.surface))
        note = _mean("MAE {:.1f} mm on the object", np.abs(maps.error_mm))
        pictures.append(
            map_picture(f"error, {method}", shown, scale, f"signed depth error of the {method}", note)
        )
    if e.expected_error is not None:
        values = 1e3 * e.expected_error
        expected = scale_for("expected", [e.shown(values)])
        note = _mean("mean {:.1f} mm on the object", values[e.good])
        title = "error that the network expects"
        pictures.append(map_picture(title, e.shown(values), expected, "expected error", note))
        scales.append(("expected absolute error", expected))
    words = "Red: too far, blue: too near, grey: no sound ground truth."
    return Group("Depth error", words, pictures, scales)


def _mean(form: str, values: NDArray[np.floating]) -> str:
    finite = values[np.isfinite(values)].astype(np.float64)
    return form.format(finite.mean()) if finite.size else "no good pixel"


def _normals(e: Example) -> Group:
    pictures: list[Picture] = []
    for name, maps in e.methods.items():
        note = _mean("mean angle {:.1f} degrees on the object", maps.angle_deg)
        method = METHOD_TITLES[name]
        title, alt = f"normals, {method}", f"normals of the {method}"
        pictures.append(normal_picture(title, e.shown(maps.normals), alt, note))
    truth = e.shown(e.truth.normals)
    pictures.append(normal_picture("normals, ground truth", truth, "normals of the ground truth"))
    return Group("Normals", f"{NORMAL_WORDS.capitalize()}.", pictures, [])


def _clouds(e: Example, scale: Scale) -> Group:
    """Draw sensor, network and ground truth from the side: the object and what is near it."""
    title, fine = "Points from the side", e.camera.scaled(2)
    truth = fine.unproject(e.truth.depth)
    if not e.good.any():
        return Group(title, "No good pixel in this view.", [], [])
    centre = np.median(truth[e.good], axis=0)
    radius = _MARGIN * percentile([np.linalg.norm(truth[e.good] - centre, axis=1)], 99, 0.0)
    drawn: list[tuple[str, Float64, NDArray[Any]]] = [
        (
            METHOD_TITLES[name],
            fine.unproject(maps.depth),
            maps.error_where(e.surface),
        )
        for name, maps in e.methods.items()
    ]
    drawn.append(("ground truth", truth, np.zeros(e.truth.depth.shape)))
    eye = eye_for(truth[_near(truth, centre, radius)], e.T_base_tof, e.camera.width / e.camera.height)
    spacing = float(centre[2]) / fine.fx / float(eye.high[0] - eye.low[0]) * _WIDTH
    size = int(np.clip(np.ceil(1.4 * spacing) + 1, 2, 7))
    pictures = []
    for name, points, error in drawn:
        near = _near(points, centre, radius)
        image = splat([(points[near], scale.paint(error)[near])], eye, _WIDTH, size, _GROUND)
        pictures.append(picture(f"points, {name}", image, f"points of the {name} from the side"))
    note = "All points near the object, from the side and above; colours of the error maps, grey without ground truth."
    return Group(title, note, pictures, [])


def _near(points: Float64, centre: Float64, radius: float) -> NDArray[np.bool_]:
    with np.errstate(invalid="ignore"):
        out: NDArray[np.bool_] = np.linalg.norm(points - centre, axis=-1) < radius
    return out
