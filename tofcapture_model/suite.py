"""The paper's tables by one command: several methods, several runs of each, on one dataset; see docs/network.md.

``results.json`` holds every number; ``tables.md``, ``tables.tex`` and ``tables.html`` beside it hold what the suite prints.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture_model.baselines import lf2, sensor
from tofcapture_model.baselines.protocol import Baseline
from tofcapture_model.checkpoint import find_model, load_model
from tofcapture_model.data import FrameDataset, batched
from tofcapture_model.evaluate import write_results
from tofcapture_model.frame import Frame, Target, frame_to, target_to
from tofcapture_model.measures import Precision, Uncertainty, regions
from tofcapture_model.metrics import Score
from tofcapture_model.tables import SUITES, write_tables

FREE = {"sensor": sensor.estimate, "lf2": lf2.estimate}
"""Methods without parameters; they take part in every suite."""


class Answer(NamedTuple):
    """Depth, normals, where the method answers by itself, and what it says of its error; ``scaled``: that is in metres."""

    depth: Tensor
    normals: Tensor
    measured: Tensor
    sigma: Tensor
    scaled: bool


class Measured:
    """All that is measured of one run of one method."""

    def __init__(self) -> None:
        self.scores: dict[str, Score] = {}
        self.uncertainty, self.precision, self.scaled = Uncertainty(), Precision(), False

    def add(self, answer: Answer, target: Target, where: Mapping[str, Tensor]) -> None:
        """Add one frame."""
        for name, mask in where.items():
            self.scores.setdefault(name, Score()).add(
                answer.depth, answer.normals, target.depth, target.normals, mask, answer.measured
            )
        good, self.scaled = target.good, answer.scaled
        self.precision.add(answer.depth[good])
        self.uncertainty.add((answer.depth - target.depth)[good].abs(), answer.sigma[good])

    def table(self) -> dict[str, Any]:
        """Both poolings of depth and normals of all pixels, the regions, repeatability and uncertainty."""
        named = {name: score.table() for name, score in self.scores.items()}
        whole = named.pop("all")
        extra = self.precision.row() | self.uncertainty.row(scale=self.scaled)
        return {**whole, "regions": named, "extra": extra}


def read_weights(pairs: Sequence[str]) -> dict[str, list[Path]]:
    """Read ``NAME=PATH`` pairs; a name that comes twice is one method with two runs."""
    out: dict[str, list[Path]] = {}
    for pair in pairs:
        name, equals, path = pair.partition("=")
        if not (name and equals and path) or name in FREE:
            raise ConfigError(
                f"--weights: expected NAME=PATH with a name other than {', '.join(FREE)}, got {pair!r}"
            )
        out.setdefault(name, []).append(Path(path))
    return out


def _free(name: str) -> Callable[[Frame], Answer]:
    def answer(frame: Frame) -> Answer:
        depth, normals, measured = FREE[name](frame)
        amplitude = torch.nn.functional.interpolate(frame.confidence, scale_factor=2, mode="nearest")
        return Answer(depth, normals, measured, -amplitude, scaled=False)

    return answer


def _learned(path: Path, device: torch.device) -> Callable[[Frame], Answer]:
    model = load_model(path)[0].to(device)
    own = not isinstance(model, Baseline)

    def answer(frame: Frame) -> Answer:
        found = model(frame)
        amplitude = torch.nn.functional.interpolate(frame.confidence, scale_factor=2, mode="nearest")
        everywhere = torch.isfinite(found.depth)
        return Answer(found.depth, found.normals, everywhere, found.error if own else -amplitude, scaled=own)

    return answer


@torch.no_grad()
def measure(
    data: FrameDataset,
    methods: Mapping[str, Callable[[Frame], Answer]],
    device: torch.device,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Run methods over all frames of a dataset, view by view."""
    found = {name: Measured() for name in methods}
    view = None
    for i, sample in enumerate(data.samples):
        frame = frame_to(batched(data.frame(sample)), device)
        target = target_to(Target(*(x[None] for x in data.target(sample))), device)
        where = regions(frame, target)
        if view != (view := (sample.scene, sample.view)):
            for one in found.values():
                one.precision.close()
        for name, method in methods.items():
            found[name].add(method(frame), target, where)
        if progress:
            progress(i + 1, len(data.samples))
    for one in found.values():
        one.precision.close()
    return {name: one.table() for name, one in found.items()}


def averaged(runs: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Mean and standard deviation (0 of a single run) of every number of equal nested tables; keys that a run lacks are left out."""
    mean: dict[str, Any] = {}
    spread: dict[str, Any] = {}
    for key in [k for k in runs[0] if all(k in r for r in runs)]:
        values = [r[key] for r in runs]
        if isinstance(values[0], Mapping):
            mean[key], spread[key] = averaged(values)
        else:
            mean[key], spread[key] = (
                statistics.fmean(values),
                statistics.stdev(values) if len(values) > 1 else 0.0,
            )
    return mean, spread


def run_suite(
    dataset: Path,
    suite: str,
    weights: Mapping[str, Sequence[Path]],
    out: Path,
    *,
    split: str = "test",
    frames: int = 0,
    scenes: str = "",
    device: str = "cpu",
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure methods and write ``results.json`` and the suite's tables beside it.

    Parameters
    ----------
    dataset
        Folder with ``manifest.json``.
    suite
        One of ``SUITES``, or ``all``.
    weights
        Checkpoints or run folders by name; several of one name are runs that are averaged, their spread is told.
    out
        ``results.json``.
    split
        ``train``, ``val`` or ``test``.
    frames
        Of every view; 0: all. Repeatability needs two.
    scenes
        Only scenes whose name begins so.
    device
        Torch device.
    progress
        Called with (done, all).

    Returns
    -------
    What was written; lengths in metres.
    """
    place = torch.device(device)
    methods: dict[str, Callable[[Frame], Answer]] = {name: _free(name) for name in FREE}
    trained: dict[str, Any] = {}
    for name, paths in weights.items():
        for i, path in enumerate(paths):
            methods[f"{name}#{i}"] = _learned(path, place)
            trained[f"{name}#{i}"] = {"weights": str(find_model(path)), "training": load_model(path)[2]}
    data = FrameDataset(dataset, split, frames=frames, cache_bytes=0)
    data.samples = [s for s in data.samples if s.scene.startswith(scenes)]
    if not data.samples:
        raise ConfigError(
            f"--scenes {scenes}: no scene of the split {split} begins so", hint=", ".join(data.readers)
        )
    rows = measure(data, methods, place, progress)
    table = {name: averaged([rows[name]]) for name in FREE}
    table |= {n: averaged([rows[f"{n}#{i}"] for i in range(len(p))]) for n, p in weights.items()}
    results = {
        "format": "tofcapture-results",
        "version": 1,
        "dataset": str(dataset),
        "split": split,
        "suite": suite,
        "scenes": sorted({s.scene for s in data.samples}),
        "views": len({(s.scene, s.view) for s in data.samples}),
        "frames": len(data.samples),
        "units": "m",
        "runs": trained,
        "methods": {name: mean for name, (mean, _) in table.items()},
        "spread": {name: spread for name, (_, spread) in table.items() if len(weights.get(name, ())) > 1},
    }
    data.close()
    write_results(Path(out), _finite(results))
    write_tables(Path(out), results, list(SUITES) if suite == "all" else [suite])
    return results


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {
            k: _finite(v) for k, v in value.items() if not (isinstance(v, float) and not math.isfinite(v))
        }
    return value
