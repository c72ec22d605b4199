"""From recordings to a dataset: one shard per scene, then the manifest and the card.

Every shard is a function of its views, the rig, the config and this package's version; their digest is stored in it. A run
skips shards whose digest is right, so a run that was killed goes on where it was, and ends with the same bytes.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from tofcapture import __version__
from tofcapture.dataset.card import write_card
from tofcapture.dataset.recordings import find_scenes, rig_for
from tofcapture.dataset.sample import SampleConfig, calibrated, make_sample
from tofcapture.dataset.split import assign_splits
from tofcapture.dataset.truth import TruthError, ViewError, pool, pooled_error, view_error
from tofcapture.errors import TofError
from tofcapture.files.hdf import dumps
from tofcapture.files.layout import SHARD
from tofcapture.files.manifest import Manifest, SceneEntry, write_manifest
from tofcapture.files.seal import PARTIAL, sealed_digest
from tofcapture.files.shard import Sample, ShardReader
from tofcapture.files.shard_writer import ShardWriter
from tofcapture.files.view import read_view
from tofcapture.rig import Rig, dumps_rig

Progress = Callable[[str, int, int], None]
"""Called with what is being done, views finished, views in all."""


@dataclass(frozen=True)
class SceneJob:
    """What one shard is made of: scene, view files in order, rig, config, digest of each view file."""

    scene: str
    views: tuple[Path, ...]
    rig: Rig
    config: SampleConfig
    inputs: tuple[str, ...]

    @property
    def digest(self) -> str:
        """Digest of everything that the shard's bytes depend on."""
        parts = {
            "scene": self.scene,
            "inputs": self.inputs,
            "rig": dumps_rig(self.rig),
            "config": asdict(self.config),
            "layout": [SHARD.format, SHARD.version],
            "versions": versions(),
        }
        return hashlib.sha256(dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class BuildResult:
    """What a build did.

    Attributes
    ----------
    dataset
        The folder.
    scenes
        Entry by scene, as in the manifest.
    skipped
        Scenes whose shard was already right.
    failures
        Error by scene that has no shard.
    gt
        Error of the ground truth, pooled over all views; ``None`` when no view carries truth.
    """

    dataset: Path
    scenes: Mapping[str, SceneEntry]
    skipped: tuple[str, ...]
    failures: Mapping[str, TofError]
    gt: TruthError | None


def versions() -> dict[str, str]:
    """Versions that a shard's bytes depend on."""
    out = {"tofcapture": __version__}
    for name in ("numpy", "h5py"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:  # pragma: no cover  vendored
            out[name] = "unknown"
    return out


def sample_of(path: Path, rig: Rig, config: SampleConfig) -> tuple[Sample, ViewError | None]:
    """Read a view and make its sample, with its error where the truth is known."""
    view = read_view(path)
    sample = make_sample(view, rig, config, np.random.default_rng(view.index))
    return sample, view_error(sample, view)


@contextmanager
def _workers(jobs: int) -> Iterator[Executor | None]:
    if jobs <= 1:
        yield None
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool_:
        yield pool_


def _samples(job: SceneJob, workers: Executor | None) -> Iterator[tuple[Sample, ViewError | None]]:
    if workers is None:
        yield from (sample_of(path, job.rig, job.config) for path in job.views)
        return
    futures = [workers.submit(sample_of, path, job.rig, job.config) for path in job.views]
    try:
        while futures:
            yield futures.pop(0).result()
    except BrokenProcessPool as err:
        raise TofError(
            f"{job.scene}: a worker process died", hint="run again; out of memory: --jobs 1"
        ) from err
    finally:
        for future in futures:
            future.cancel()


def build_shard(
    job: SceneJob, path: Path, workers: Executor | None = None, progress: Progress | None = None
) -> tuple[str, TruthError | None]:
    """Write one shard.

    Parameters
    ----------
    job
        What it is made of.
    path
        Of the shard.
    workers
        Makes samples in parallel; ``None``: here.
    progress
        Told after each view.

    Returns
    -------
    SHA-256 of the shard, and the ground truth's error where it is known.

    Raises
    ------
    DataError
        A view is damaged or is of another camera than the rig; nothing is left behind.
    """
    first = read_view(job.views[0])
    info = calibrated(first.tof.info, job.rig)
    errors: list[ViewError] = []
    good: list[int] = []
    with ShardWriter(path, job.scene, job.rig, info, first.stereo.info, len(job.views)) as shard:
        for done, (sample, error) in enumerate(_samples(job, workers), start=1):
            shard.add(sample)
            good.append(int((sample.ground_truth[2].mask == 0).sum()))
            errors += [] if error is None else [error]
            if progress:
                progress(job.scene, done, len(job.views))
        gt = pool(errors) if errors else None
        provenance = {
            "digest": job.digest,
            "config": asdict(job.config),
            "versions": versions(),
            "views": [
                {"name": path.name, "sha256": digest, "good_pixels": pixels}
                for path, digest, pixels in zip(job.views, job.inputs, good, strict=True)
            ],
            "gt": None if gt is None else gt.table(),
        }
        return shard.seal(provenance), gt


def finished(job: SceneJob, path: Path) -> str | None:
    """Digest of a shard that is already what the job would make; ``None`` when it has to be built."""
    if not path.is_file():
        return None
    try:
        with ShardReader(path) as shard:
            same = shard.provenance.get("digest") == job.digest
        return sealed_digest(path) if same else None
    except TofError:
        return None


def _job(scene: str, found: tuple[Path, tuple[Path, ...]], rig: Rig, config: SampleConfig) -> SceneJob:
    _, views = found
    return SceneJob(scene, views, rig, config, tuple(sealed_digest(p) for p in views))


def build_dataset(
    recordings: Sequence[Path],
    out: Path,
    rig_path: Path | None = None,
    *,
    true_rig: bool = False,
    config: SampleConfig | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
) -> BuildResult:
    """Build or complete a dataset.

    Parameters
    ----------
    recordings
        Folders that ``record`` filled; views of the board are left out.
    out
        The dataset's folder.
    rig_path
        Rig to use instead of each recording's ``rig.toml``.
    true_rig
        Use the rig that the simulator knows.
    config
        Constants of the ground truth.
    jobs
        Processes; by default one per core, at most four; each takes 0.6 GB.
    progress
        Told after each view.

    Returns
    -------
    BuildResult
        A scene with a damaged view is a failure there; the others are built.

    Raises
    ------
    ConfigError
        No rig, or a scene that is in two recordings.
    DataError
        No scenes.
    """
    config = config or SampleConfig()
    found = find_scenes([Path(r) for r in recordings])
    rigs = {
        scene: rig_for(rec, views[0], rig_path, true_rig=true_rig) for scene, (rec, views) in found.items()
    }
    entries: dict[str, SceneEntry] = {}
    failures: dict[str, TofError] = {}
    skipped: list[str] = []
    splits = assign_splits(found)
    out = Path(out)
    with _workers(jobs if jobs is not None else min(4, os.cpu_count() or 1)) as workers:
        for scene in found:
            path = out / "shards" / f"{scene}.h5"
            try:
                job = _job(scene, found[scene], rigs[scene], config)
                digest = finished(job, path)
                if digest is None:
                    digest, _ = build_shard(job, path, workers, progress)
                else:
                    skipped.append(scene)
            except TofError as err:
                failures[scene] = err
                continue
            entries[scene] = SceneEntry(f"shards/{scene}.h5", digest, len(job.views), splits[scene])
    _remove_partials(out)
    gt = pooled_error(out / e.path for e in entries.values())
    _finish(out, entries, config, gt)
    return BuildResult(out, entries, tuple(skipped), failures, gt)


def _remove_partials(out: Path) -> None:
    for stray in out.glob(f"**/*{PARTIAL}"):
        stray.unlink(missing_ok=True)


def _finish(
    out: Path, entries: Mapping[str, SceneEntry], config: SampleConfig, gt: TruthError | None
) -> None:
    """Write the manifest last but for the card: a dataset with a manifest is whole."""
    out.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(entries, asdict(config), versions())
    write_manifest(out, manifest)
    write_card(out, manifest, None if gt is None else gt.table())
