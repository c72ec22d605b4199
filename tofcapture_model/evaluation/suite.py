"""The paper's tables by one command: several methods, several runs of each, on one dataset; see docs/network.md.

``results.json`` holds every number; ``tables.md``, ``tables.tex`` and ``tables.html`` beside it hold what the suite prints;
``results.runs.json`` holds each run as soon as it is measured, for the next call.
"""

from __future__ import annotations

import hashlib
import json
import math
import statistics
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tofcapture.errors import ConfigError
from tofcapture.files.manifest import manifest_path
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Losses
from tofcapture_model.data import FrameDataset, batched, spare_memory
from tofcapture_model.evaluation.evaluate import (
    FORMAT,
    VERSION,
    expect_writable,
    not_new_of,
    take_scenes,
    write_results,
)
from tofcapture_model.evaluation.metrics import Precision, Score, Uncertainty, regions
from tofcapture_model.evaluation.objects import classes, find_support
from tofcapture_model.evaluation.tables import SUITES, write_tables
from tofcapture_model.frame import Frame, Target, frame_to, target_to
from tofcapture_model.networks import Model
from tofcapture_model.networks.baselines import Baseline, lf2, sensor_estimate
from tofcapture_model.networks.checkpoint import budget, find_model, load_checkpoint, origin, sentence

FREE = {"sensor": sensor_estimate, "lf2": lf2.estimate}
"""Methods without parameters; they take part in every suite."""


class Answer(NamedTuple):
    """Depth, normals, where the method answers by itself, and what it says of its error; ``scaled``: that is one sigma in metres, not another measure of it."""

    depth: Tensor
    normals: Tensor
    measured: Tensor
    sigma: Tensor
    scaled: bool


Rows = dict[str, dict[str, Any]]
"""What is measured, by method or by what tells a run from others."""


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
        good, self.scaled = where["all"], answer.scaled
        self.precision.add(answer.depth[good])
        self.uncertainty.add((answer.depth - target.depth)[good].abs(), answer.sigma[good])

    def table(self) -> dict[str, Any]:
        """Both poolings of depth and normals of all objects' pixels, of regions of them and of other classes, repeatability and uncertainty."""
        named = {name: score.table() for name, score in self.scores.items()}
        whole = named.pop("all")
        extra = self.precision.row() | self.uncertainty.row(scale=self.scaled)
        return {**whole, "regions": named, "extra": extra}


class RunFile:
    """Rows of measured runs in a file, for the next call under the same conditions.

    ``path`` is JSON; what it holds of other conditions is dropped by the first row that is added, ``None`` keeps nothing. ``conditions``
    is all that a row depends on but its network.
    """

    def __init__(self, path: Path | None, conditions: Mapping[str, Any]) -> None:
        self.path = path
        self._head = {"format": "tofcapture-runs", "version": 1, "conditions": dict(conditions)}
        self.rows = self._read()

    def _read(self) -> Rows:
        try:
            table = json.loads(self.path.read_text(encoding="utf-8")) if self.path else {}
        except (OSError, ValueError):  # none yet, or not ours
            return {}
        rows = table.pop("rows", {}) if isinstance(table, dict) else {}
        return rows if table == self._head else {}

    def add(self, rows: Rows) -> None:
        """Keep rows, by the network's digest or the method's name."""
        self.rows |= rows
        if self.path:
            write_results(self.path, {**self._head, "rows": self.rows})


def _conditions(dataset: Path, split: str, frames: int, scenes: str, device: str) -> dict[str, Any]:
    return {
        "manifest_sha256": sha256_of(manifest_path(dataset)),
        "split": split,
        "frames": frames,
        "scenes": scenes,
        "device": device,
        "code_sha256": _code_digest(),
        "torch": str(torch.__version__),
    }


def _code_digest() -> str:
    """SHA-256 of all sources that numbers may depend on."""
    folders = [Path(str(files(package))) for package in ("tofcapture", "tofcapture_model")]
    sources = [path.read_bytes() for folder in folders for path in sorted(folder.rglob("*.py"))]
    return hashlib.sha256(b"".join(sources)).hexdigest()


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
        return Answer(*FREE[name](frame), -_amplitude(frame), scaled=False)

    return answer


def _learned(model: Model, losses: Losses) -> Callable[[Frame], Answer]:
    own = not isinstance(model, Baseline)
    sigma = own and losses.uncertainty == "laplace"  # the paper's is an expected absolute error

    def answer(frame: Frame) -> Answer:
        found = model(frame)
        expected = found.error if own else -_amplitude(frame)
        return Answer(found.depth, found.normals, torch.isfinite(found.depth), expected, scaled=sigma)

    return answer


def _amplitude(frame: Frame) -> Tensor:
    """Amplitude (B, 1, 2H, 2W): what orders the errors of a method that predicts none."""
    return torch.nn.functional.interpolate(frame.confidence, scale_factor=2, mode="nearest")


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
        kinds = classes(target, frame.intrinsics, find_support(target, frame.intrinsics))
        where = {name: mask & kinds["object"] for name, mask in regions(frame, target).items()}
        where |= {"crop": target.good, "sheet": kinds["sheet"], "support": kinds["support"]}
        if view != (view := (sample.scene, sample.view)):
            for one in found.values():
                one.precision.close()
        for name, method in methods.items():
            found[name].add(method(frame), target, where)
        if progress:
            progress(i + 1, len(data.samples))
    for one in found.values():
        one.precision.close()
    return {name: _finite(one.table()) for name, one in found.items()}


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
    """Measure methods and write ``results.json`` and the suite's tables; called again, it takes the runs that are measured.

    ``suite`` is one of ``SUITES`` or ``all``, ``out`` is ``results.json``, all else is as of :func:`measure_runs`. Returns what was
    written; lengths in metres.
    """
    out = Path(out)
    expect_writable(out)
    results = measure_runs(
        dataset,
        weights,
        split=split,
        frames=frames,
        scenes=scenes,
        device=device,
        kept=out.with_name(f"{out.stem}.runs.json"),
        progress=progress,
    )
    return write_suite(results, suite, out)


def measure_runs(
    dataset: Path,
    weights: Mapping[str, Sequence[Path]],
    *,
    split: str = "test",
    frames: int = 0,
    scenes: str = "",
    device: str = "cpu",
    kept: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Measure the methods without parameters and all runs, one network in memory at a time.

    Returns results; lengths in metres.

    Raises :class:`ConfigError`: no scene of the split begins so; :class:`FormatError`: weights that are damaged or not there.

    Parameters
    ----------
    dataset
        Folder with ``manifest.json``.
    weights
        Checkpoints or run folders by name; several of one name are runs that are averaged, their spread is told.
    split
        ``train``, ``val`` or ``test``.
    frames
        Of every view; 0: all. Repeatability needs two.
    scenes
        Only scenes whose name begins so.
    device
        Torch device.
    kept
        File that holds every run as soon as it is measured, and gives it back to the next call (:class:`RunFile`); ``None``: none.
    progress
        Called with (done, all).
    """
    target_device = torch.device(device)
    runs = [(name, i, find_model(path)) for name, paths in weights.items() for i, path in enumerate(paths)]
    for _, _, path in runs:  # so that what is wrong with one is said before hours of measuring
        load_checkpoint(path)
    data = FrameDataset(dataset, split, frames=frames, cache_bytes=spare_memory())  # every run asks again
    measured = take_scenes(data, split, scenes)
    count = len(data.samples)
    known = RunFile(kept, _conditions(dataset, split, frames, scenes, device))

    def part(nth: int) -> Callable[[int, int], None]:
        return lambda done, _all: progress(nth * count + done, (len(runs) + 1) * count) if progress else None

    def rows(nth: int, keys: Mapping[str, str], methods: Mapping[str, Callable[[Frame], Answer]]) -> Rows:
        if all(key in known.rows for key in keys.values()):
            where = known.path or "an equal run"
            print(f"{', '.join(keys)}: measured before, taken from {where}", file=sys.stderr, flush=True)
            part(nth)(count, count)
        else:
            found = measure(data, methods, target_device, part(nth))
            known.add({keys[name]: row for name, row in found.items()})
        return {name: known.rows[key] for name, key in keys.items()}

    free = rows(0, {name: name for name in FREE}, {name: _free(name) for name in FREE})
    table = {name: averaged([row]) for name, row in free.items()}
    trained: dict[str, Any] = {}
    by_name: dict[str, list[dict[str, Any]]] = {}
    for nth, (name, i, path) in enumerate(runs, 1):
        model, config, provenance = load_checkpoint(path)
        digest = sha256_of(path)
        trained[f"{name}#{i}"] = {
            "weights": str(path),
            "sha256": digest,
            "training": origin(provenance),
            "not_new": not_new_of(provenance, dataset, split, measured),
        }
        row = rows(nth, {name: digest}, {name: _learned(model.to(target_device), config.losses)})[name]
        by_name.setdefault(name, []).append({**row, "budget": budget(provenance)})
    data.close()
    table |= {name: averaged(found) for name, found in by_name.items()}
    return {
        "format": FORMAT,
        "version": VERSION,
        "dataset": str(dataset),
        "split": split,
        "scenes": measured,
        "views": len({(s.scene, s.view) for s in data.samples}),
        "frames": count,
        "units": "m",
        "runs": trained,
        "methods": {name: mean for name, (mean, _) in table.items()},
        "spread": {name: spread for name, (_, spread) in table.items() if len(weights.get(name, ())) > 1},
    }


def seen_before(results: Mapping[str, Any]) -> str:
    """A line for every run that has learned from some of the scenes, or does not tell."""
    said = [sentence(name, run["not_new"], len(results["scenes"])) for name, run in results["runs"].items()]
    return "".join(f"{line}\n" for line in said if line)


def write_suite(
    results: Mapping[str, Any], suite: str, out: Path, names: Collection[str] | None = None
) -> dict[str, Any]:
    """Write ``results.json`` and, beside it, tables of what :func:`measure_runs` found; of these methods only, ``None``: of all."""
    named = {**results, "suite": suite}
    if names is not None:
        for key in ("methods", "spread", "runs"):
            named[key] = {n: row for n, row in results[key].items() if n.partition("#")[0] in names}
    write_results(Path(out), _finite(named))
    write_tables(Path(out), named, list(SUITES) if suite == "all" else [suite])
    return named


def _finite(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {
            k: _finite(v) for k, v in value.items() if not (isinstance(v, float) and not math.isfinite(v))
        }
    return value
