"""Example views: one frame of a view, the ground truth, and what the sensor and the network make of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import Manifest
from tofcapture.files.shard import GroundTruth, ShardReader
from tofcapture.poses import Float64
from tofcapture_model.data.frame import Frame
from tofcapture_model.data.frames import batched, make_frame
from tofcapture_model.networks.baselines import sensor
from tofcapture_model.networks.zoo import Model

Float32 = NDArray[np.float32]
FRAME = 0  # of the burst; evaluate takes the same one
_ROOM = 1.6  # of a window about the object, relative to the object
_LEAST_SHARE = 0.3  # of the image's sides that a window shows at least


@dataclass(frozen=True)
class Answer:
    """What a method says of a view.

    Attributes
    ----------
    depth
        (2H, 2W) float32 metres.
    normals
        (2H, 2W, 3) float32 unit, ToF frame, facing the camera.
    expected_error
        (2H, 2W) float32 metres, where the method tells how wrong it expects its depth to be.
    """

    depth: Float32
    normals: Float32
    expected_error: Float32 | None = None


@dataclass(frozen=True)
class Example:
    """One view as the page shows it.

    Attributes
    ----------
    scene, index
        Name of the scene, number of the view in its recording.
    camera
        Intrinsics of the (2H, 2W) grid.
    amplitude
        (H, W) raw units, lowest modulation frequency, one frame.
    confidence
        (H, W) raw units, highest modulation frequency, mean of the burst.
    tof_depth
        (H, W) metres, one frame; NaN: none.
    ground_truth
        At 2x.
    sensor, model
        Answers at 2x; ``model`` None without weights.
    T_base_tof
        (4, 4).
    """

    scene: str
    index: int
    camera: Camera
    amplitude: Float32
    confidence: Float32
    tof_depth: Float32
    ground_truth: GroundTruth
    sensor: Answer
    model: Answer | None
    T_base_tof: Float64

    @property
    def answers(self) -> dict[str, Answer]:
        """Answers by name of the method."""
        return {"sensor": self.sensor} | ({} if self.model is None else {"model": self.model})

    @property
    def good(self) -> NDArray[np.bool_]:
        """(2H, 2W) where metrics are taken."""
        out: NDArray[np.bool_] = self.ground_truth.mask == 0
        return out

    @property
    def surface(self) -> NDArray[np.bool_]:
        """(2H, 2W) where the ground truth is sound, on the object or around it."""
        out: NDArray[np.bool_] = (self.ground_truth.mask & ~np.uint8(MaskBit.OUTSIDE)) == 0
        return out

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the (2H, 2W) grid about the good pixels, in the image's proportions; all of it without any."""
        rows, columns = np.nonzero(self.good)
        height, width = self.good.shape
        if len(rows) == 0:
            return slice(0, height), slice(0, width)
        spans = [np.ptp(rows) / height, np.ptp(columns) / width]
        share = min(1.0, max(_LEAST_SHARE, _ROOM * float(max(spans))))
        middles = [(int(x.min()) + int(x.max())) // 2 for x in (rows, columns)]
        return _span(middles[0], share, height), _span(middles[1], share, width)

    def depth_error(self, answer: Answer, where: NDArray[np.bool_]) -> Float32:
        """Answer minus ground truth (2H, 2W), metres; NaN outside ``where``."""
        return np.where(where, answer.depth - self.ground_truth.depth, np.nan).astype(np.float32)


def _span(middle: int, share: float, size: int) -> slice:
    length = 2 * round(share * size / 2)  # even, as the start: whole pixels of the sensor
    start = min(max(middle - length // 2, 0), size - length) // 2 * 2
    return slice(start, start + length)


def choose(manifest: Manifest, split: str, count: int) -> list[tuple[str, int]]:
    """Pick (scene, view) evenly from the views of a split in order of their names: nobody chooses the pretty ones."""
    every = [(name, view) for name, entry in manifest.split(split).items() for view in range(entry.views)]
    step = np.linspace(0, len(every), min(count, len(every)), endpoint=False)
    return [every[int(i)] for i in step]


def load_examples(
    dataset: Path, manifest: Manifest, chosen: list[tuple[str, int]], model: Model | None
) -> list[Example]:
    """Read views and let the sensor and the model answer.

    Raises
    ------
    DataError, FormatError
        A shard is missing or damaged.
    """
    out = []
    with _one_thread():
        for scene, view in chosen:
            with ShardReader(
                Path(dataset) / manifest.scenes[scene].path, manifest.scenes[scene].sha256
            ) as shard:
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
    info, camera = shard.info, shard.camera
    frame = batched(make_frame(shard.raw(view, FRAME), info, camera, shard.celsius(view, FRAME)))
    depth, normals, _ = sensor.estimate(frame)
    low_i, low_q = (info.saturation * frame.phasor[0, i].numpy() for i in (0, 1))
    return Example(
        scene=shard.scene,
        index=shard.index(view),
        camera=camera.scaled(2),
        amplitude=np.hypot(low_i, low_q),
        confidence=shard.tof(view).confidence,
        tof_depth=np.where(frame.valid[0, 0].numpy() > 0, frame.depth[0, 0].numpy(), np.nan),
        ground_truth=shard.ground_truth(view, 2),
        sensor=Answer(_map(depth), _vectors(normals)),
        model=None if model is None else _ask(model, frame),
        T_base_tof=shard.T_base_tof(view),
    )


def _ask(model: Model, frame: Frame) -> Answer:
    estimate = model(frame)
    return Answer(_map(estimate.depth), _vectors(estimate.normals), _map(estimate.error))


def _map(tensor: torch.Tensor) -> Float32:
    return np.asarray(tensor[0, 0].numpy(), dtype=np.float32)


def _vectors(tensor: torch.Tensor) -> Float32:
    return np.ascontiguousarray(tensor[0].permute(1, 2, 0).numpy(), dtype=np.float32)


def describe_shard(dataset: Path, manifest: Manifest, scene: str) -> Mapping[str, Any]:
    """Rig, cameras and error of the ground truth of one shard, for the page."""
    with ShardReader(Path(dataset) / manifest.scenes[scene].path, manifest.scenes[scene].sha256) as shard:
        return {
            "scene": scene,
            "rig": shard.rig,
            "tof": shard.info,
            "stereo": shard.stereo_info,
            "gt": shard.provenance.get("gt"),
            "simulated": shard.truth(0) is not None,
            "frames": shard.frames,
        }
