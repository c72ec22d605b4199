"""Measure the sensor and a model against ground truth; writes ``results.json``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import PARTIAL, write_text
from tofcapture_model.data import FrameDataset, SampleId, batched
from tofcapture_model.evaluation.metrics import Score, regions
from tofcapture_model.evaluation.objects import Objects, classes, find_support, told
from tofcapture_model.frame import Frame, Target, frame_to, target_to
from tofcapture_model.networks import Model
from tofcapture_model.networks.baselines import sensor_estimate
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint, not_new, origin, sentence
from tofcapture_model.networks.joint import JointModel

FORMAT, VERSION = "tofcapture-results", 2  # 2: over the pixels of objects
_EVERY = 7  # of how many good pixels a calibration looks at one

Method = Callable[[Frame], tuple[Tensor, ...]]
"""Depth (B, 1, 2H, 2W), normals (B, 3, 2H, 2W), where the method answers by itself, and what it says of its error, if it does."""


def model_method(model: Model, *, sigma: bool = False) -> Method:
    """Wrap a model as a method that answers everywhere; ``sigma``: what it says of its error is one standard deviation."""

    def answer(frame: Frame) -> tuple[Tensor, ...]:
        estimate = model(frame)
        error = (estimate.error,) if sigma else ()
        return estimate.depth, estimate.normals, torch.isfinite(estimate.depth), *error

    return answer


@torch.no_grad()
def score(
    methods: dict[str, Method],
    dataset: FrameDataset,
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
    objects: Objects | None = None,
) -> tuple[dict[str, Score], int]:
    """Run methods over all frames of a dataset: over the whole crop or, where ``objects`` are to be filled, over the pixels of objects.

    Returns scores by method, and how many frames were left out because no pixel of their ground truth is
    good.
    """
    scores = {name: Score() for name in methods}
    empty = 0
    for i, sample in enumerate(dataset.samples):
        frame = frame_to(batched(dataset.frame(sample)), device)
        target = target_to(Target(*(x[None] for x in dataset.target(sample))), device)
        where = {"crop": target.good}
        if objects:
            kinds = classes(target, frame.intrinsics, find_support(target, frame.intrinsics))
            where = kinds | {"edge": kinds["object"] & regions(frame, target)["edge"]} | where
        empty += int(not target.good.any())
        for name, method in methods.items():
            depth, normals, measured, *error = method(frame)
            mask = where["object" if objects else "crop"]
            scores[name].add(depth, normals, target.depth, target.normals, mask, measured)
            if objects:
                answer = depth, normals, error[0] if error else None
                objects.add(sample.scene, name, answer, target, where)
        if progress:
            progress(i + 1, len(dataset.samples))
    return scores, empty


ONE_SIGMA = 0.6827  # share of errors within one sigma
LAPLACE_SIGMA = -math.log(1 - ONE_SIGMA)  # in units of the scale of a Laplace distribution


@torch.no_grad()
def calibrate(model: JointModel, dataset: Path, device: torch.device) -> dict[str, Any]:
    """Scale the error map of a model so that it holds 68 % of the errors on the first frames of the ``val`` split.

    Without such a split the factor is that of an exact Laplace distribution. The factor is a buffer and goes into checkpoints.

    Returns ``factor``, and ``views`` that it was fitted on.
    """
    if not load_manifest(dataset).split("val"):
        model.error_map.calibration.mul_(LAPLACE_SIGMA)
        return {"factor": float(model.error_map.calibration), "views": 0}
    data = FrameDataset(dataset, "val", frames=1)
    model.eval()
    # Twice: the refinement weighs by the error map, so that the depth moves a little with the factor.
    for _ in range(2):
        ratios = torch.cat([_ratios(model, data, sample, device) for sample in data.samples])
        if len(ratios):
            model.error_map.calibration.mul_(
                float(ratios.kthvalue(max(int(ONE_SIGMA * len(ratios)), 1)).values)
            )
    model.train()
    data.close()
    return {"factor": float(model.error_map.calibration), "views": len(data.samples)}


def _ratios(model: JointModel, data: FrameDataset, sample: SampleId, device: torch.device) -> Tensor:
    """Errors in units of the predicted ones at some good pixels of a frame, on the CPU."""
    found, target = (
        model(frame_to(batched(data.frame(sample)), device)),
        target_to(data.target(sample), device),
    )
    ratio = (found.depth - target.depth[None]).abs() / found.error.clamp_min(1e-9)
    kept: Tensor = ratio[target.good[None]][::_EVERY].cpu()
    return kept


def evaluate(
    dataset: str | Path,
    weights: str | Path | None,
    out: str | Path,
    *,
    split: str | None = None,
    frames: int = 1,
    scenes: str = "",
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Evaluate the sensor's own single frame and a model on a split, at twice the sensor's resolution, over the pixels of objects.

    Those have good ground truth (mask == 0), 4 mm and more above what the objects stand on. Returns what was written; lengths in metres.

    Raises :class:`ConfigError`: ``out`` cannot be written, or no scene of the split begins so.

    Parameters
    ----------
    dataset
        Folder with ``manifest.json``.
    weights
        Checkpoint; ``None`` or ``bundled``: the bundled one.
    out
        ``results.json``, written atomically.
    split
        ``train``, ``val`` or ``test``; ``None``: ``test`` or, where a small dataset has none, the next best.
    frames
        Frames of every view that are evaluated; 0: all.
    scenes
        Only scenes whose name begins so.
    device
        Torch device.
    progress
        Called with (done, all).
    """
    dataset, split = Path(dataset), split or usual_split(Path(dataset))
    expect_writable(Path(out))
    model, config, provenance = load_checkpoint(weights)
    model.to(device)
    data = FrameDataset(dataset, split, frames=frames)
    measured = take_scenes(data, split, scenes)
    sigma = isinstance(model, JointModel) and config.losses.uncertainty == "laplace"
    methods: dict[str, Method] = {"sensor": sensor_estimate, "model": model_method(model, sigma=sigma)}
    objects = Objects({name: reader.info.serial for name, reader in data.readers.items()})
    scores, empty = score(methods, data, torch.device(device), progress, objects)
    reader = next(iter(data.readers.values()))
    results = {
        "format": FORMAT,
        "version": VERSION,
        "dataset": str(dataset),
        "split": split,
        "scenes": measured,
        "views": len({(s.scene, s.view) for s in data.samples}),
        "frames": len(data.samples),
        "frames_without_ground_truth": empty,
        "resolution": [2 * reader.camera.height, 2 * reader.camera.width],
        "units": "m",
        "weights": str(find_model(weights)),
        "network": config.network.kind,
        "training": origin(provenance),
        "not_new": not_new_of(provenance, dataset, split, measured),
        "methods": {name: s.table() for name, s in scores.items()},
        **objects.table(),
    }
    data.close()
    write_results(Path(out), results)
    return results


def expect_writable(path: Path) -> None:
    """Say before anything is measured that results cannot be written.

    Raises :class:`ConfigError`: it names a folder, or there is no right or no room to write.
    """
    if path.is_dir():
        raise ConfigError(f"--out {path}: is a folder", hint=f"--out {path / 'results.json'}")
    partial = path.with_name(path.name + PARTIAL)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.open("wb").close()
        partial.unlink()
    except OSError as err:
        raise ConfigError(
            f"--out {path}: cannot be written: {err.strerror}", hint="name a file where you may write"
        ) from err


def usual_split(dataset: Path) -> str:
    """Choose ``test``, or where a small dataset has none, the next best; say so then."""
    manifest = load_manifest(dataset)
    split = next((name for name in reversed(SPLITS) if manifest.split(name)), "test")
    if split != "test":
        print(
            f"tofcapture: {dataset}: no scene is in the split test, {split} is measured instead",
            file=sys.stderr,
        )
    return split


def take_scenes(data: FrameDataset, split: str, prefix: str) -> list[str]:
    """Leave only frames of scenes whose name begins so; return the scenes' names, sorted.

    Raises :class:`ConfigError`: there is none.
    """
    data.samples = [s for s in data.samples if s.scene.startswith(prefix)]
    if not data.samples:
        raise ConfigError(
            f"--scenes {prefix}: no scene of the split {split} begins so", hint=", ".join(data.readers)
        )
    return sorted({s.scene for s in data.samples})


def not_new_of(
    provenance: Mapping[str, Any], dataset: Path, split: str, scenes: Collection[str]
) -> dict[str, str] | None:
    """Of these scenes of a split those that a network has learned from, as :func:`tofcapture_model.networks.checkpoint.not_new` says."""
    found = not_new(provenance, dataset, split)
    return None if found is None else {name: why for name, why in found.items() if name in scenes}


def write_results(path: Path, results: dict[str, Any]) -> None:
    """Write ``results.json`` atomically."""
    write_text(path, json.dumps(results, indent=1, allow_nan=False))


def comparison(results: dict[str, Any]) -> str:
    """Tables for people, millimetres and degrees: the main columns, classes of pixels, the spread over objects, cameras."""
    rows = [
        f"{'method':8} {'MAE mm':>8} {'median':>8} {'RMSE':>8} {'ABS %':>7} {'normal deg':>11} {'>20 deg %':>10} {'coverage':>9}"
    ]
    for name, table in results["methods"].items():
        d, n = table["depth"]["pixel"], table["normal"]["pixel"]
        if not d["pixels"]:
            rows.append(f"{name:8} no pixel with good ground truth")
            continue
        rows.append(
            f"{name:8} {1000 * d['mae']:8.2f} {1000 * d['median']:8.2f} {1000 * d['rmse']:8.2f} {100 * d['abs']:7.2f}"
            f" {n['mean_deg']:11.2f} {n['paper_bad20_pct']:10.2f} {100 * d['coverage']:8.1f}%"
        )
    said = sentence("model", results["not_new"], len(results["scenes"])) if "not_new" in results else ""
    rows += told(results) if "classes" in results else []
    return "\n".join([*rows, said] if said else rows)
