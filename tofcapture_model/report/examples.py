"""Read example views: one frame, the ground truth, and what the sensor and the network make of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tofcapture.files.layout import MaskBit
from tofcapture.files.manifest import Manifest
from tofcapture.files.shard import GroundTruth, ShardReader
from tofcapture.viz.figures.scenes import Maps, Row
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

    Raises
    ------
    DataError, FormatError
        A shard is missing or damaged.
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
