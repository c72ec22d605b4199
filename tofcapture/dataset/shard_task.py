"""One scene's shard: what it is made of, whether it is there already, and making it.

A task reads view files and writes one shard, nothing else: any process on any machine that sees the files can do it, twice or
at the same time as another, and the bytes are the same.
"""

from __future__ import annotations

import hashlib
import os
import resource
import shutil
import socket
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture import __version__
from tofcapture.dataset.sample import SampleConfig, calibrated, make_sample
from tofcapture.dataset.truth import TruthError, ViewError, pooled, view_error
from tofcapture.errors import DataError, TofError
from tofcapture.files.hdf import dumps
from tofcapture.files.layout import SHARD, MaskBit
from tofcapture.files.seal import digest_path, sealed_digest
from tofcapture.files.shard import Sample, ShardReader
from tofcapture.files.shard_writer import ShardWriter
from tofcapture.files.view import read_depth_view
from tofcapture.frames import View
from tofcapture.pool import Pool, one_thread
from tofcapture.rig import Rig, dumps_rig

Made = tuple[Sample, ViewError | None]
ViewsDone = Callable[[int], None]
"""Called with the number of views of the scene that are finished."""
WORK = ".work-"  # folders beside the shards in which they are made


@dataclass(frozen=True)
class SceneTask:
    """What one shard is made of, and where it goes.

    Attributes
    ----------
    scene
        Name.
    views
        View files in order.
    rig
        To build with.
    config
        Constants of the ground truth.
    path
        Of the shard.
    """

    scene: str
    views: tuple[Path, ...]
    rig: Rig
    config: SampleConfig
    path: Path

    def digest(self, inputs: tuple[str, ...]) -> str:
        """Digest of everything that the shard's bytes depend on, given those of the view files."""
        parts = {
            "scene": self.scene,
            "inputs": inputs,
            "rig": dumps_rig(self.rig),
            "config": self.config.table(),
            "layout": [SHARD.format, SHARD.version],
            "versions": versions(),
        }
        return hashlib.sha256(dumps(parts).encode()).hexdigest()


@dataclass(frozen=True)
class SceneOutcome:
    """What became of a task.

    Attributes
    ----------
    sha256
        Of the shard; ``None`` when there is none.
    skipped
        It was there already.
    error
        Why there is none.
    peak_memory
        Largest resident size of the process that made it, bytes.
    """

    sha256: str | None
    skipped: bool = False
    error: TofError | None = None
    peak_memory: int = 0


def versions() -> dict[str, str]:
    """Versions that a shard's bytes depend on."""
    out = {"tofcapture": __version__, "zlib": zlib.ZLIB_RUNTIME_VERSION}
    for name in ("numpy", "h5py", "numba"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:  # pragma: no cover  vendored
            out[name] = "unknown"
    return out


def peak_memory() -> int:
    """Largest resident size of this process so far, bytes."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def sample_of(path: Path, rig: Rig, config: SampleConfig) -> Made:
    """Read a view and make its sample, with its error where the truth is known."""
    return _made(*read_depth_view(path), rig, config)


def _made(view: View, depth: NDArray[np.float32], rig: Rig, config: SampleConfig) -> Made:
    sample = make_sample(view, rig, config, np.random.default_rng(view.index), depth)
    return sample, view_error(sample, view)


def _samples(task: SceneTask, first: tuple[View, NDArray[np.float32]], pool: Pool | None) -> Iterator[Made]:
    """Samples in the order of the views, made here or by a pool of processes."""
    if pool is None:
        yield _made(*first, task.rig, task.config)
        yield from (sample_of(path, task.rig, task.config) for path in task.views[1:])
        return
    early: dict[int, Made] = {}
    expected = 0
    for index, made in pool.run(sample_of, [(path, task.rig, task.config) for path in task.views]):
        if isinstance(made, TofError):
            raise made
        early[index] = made
        while expected in early:
            yield early.pop(expected)
            expected += 1


@contextmanager
def _work_folder(path: Path) -> Iterator[Path]:
    """Folder beside a shard that nobody else writes to; gone afterwards."""
    work = path.with_name(f"{WORK}{socket.gethostname()}-{os.getpid()}-{path.stem}")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _provenance(
    task: SceneTask, inputs: tuple[str, ...], first: View, good: list[int], gt: TruthError | None
) -> dict[str, Any]:
    # Simulated scenes know their objects; check looks for them in other splits.
    objects = first.provenance.get("objects")
    return {
        **({} if objects is None else {"objects": list(objects)}),
        "digest": task.digest(inputs),
        "config": task.config.table(),
        "versions": versions(),
        "views": [
            {"name": path.name, "sha256": digest, "good_pixels": pixels}
            for path, digest, pixels in zip(task.views, inputs, good, strict=True)
        ],
        "gt": None if gt is None else gt.table(),
    }


def build_shard(
    task: SceneTask, inputs: tuple[str, ...], pool: Pool | None = None, progress: ViewsDone | None = None
) -> str:
    """Make one shard, whole or not at all.

    Parameters
    ----------
    task
        What it is made of.
    inputs
        SHA-256 of each view file.
    pool
        Makes samples in parallel; ``None``: here.
    progress
        Told after each view.

    Returns
    -------
    SHA-256 of the shard.

    Raises
    ------
    DataError
        A view is damaged or is of another camera than the rig, or stereo measured nothing in the ToF camera's image in any view;
        nothing is left behind.
    """
    first, depth = read_depth_view(task.views[0])
    info = calibrated(first.tof.info, task.rig)
    errors: list[ViewError] = []
    good: list[int] = []
    seen = False
    with _work_folder(task.path) as work:
        made = work / task.path.name
        with ShardWriter(made, task.scene, task.rig, info, first.stereo.info, len(task.views)) as shard:
            for path, (sample, error) in zip(task.views, _samples(task, (first, depth), pool), strict=True):
                shard.add(sample, path)
                good.append(int((sample.ground_truth[2].mask == 0).sum()))
                seen = seen or not (sample.ground_truth[2].mask & MaskBit.NOT_HIT).all()
                errors += [] if error is None else [error]
                if progress:
                    progress(len(good))
            if not seen:
                raise DataError(
                    f"{task.scene}: stereo measured nothing in the ToF camera's image in any of {len(good)} views",
                    hint="is it the rig of these cameras? tofcapture view shows both",
                )
            digest = shard.seal(_provenance(task, inputs, first, good, pooled(errors) if errors else None))
        digest_path(made).replace(digest_path(task.path))  # first: a shard always has its digest
        made.replace(task.path)
    return digest


def finished(task: SceneTask, inputs: tuple[str, ...]) -> str | None:
    """SHA-256 of a shard that is already what the task would make; ``None`` when it has to be built."""
    if not task.path.is_file():
        return None
    try:
        with ShardReader(task.path) as shard:
            same = shard.provenance.get("digest") == task.digest(inputs)
        return sealed_digest(task.path) if same else None
    except TofError:
        return None


def build_scene(
    task: SceneTask, pool: Pool | None = None, progress: ViewsDone | None = None, *, only_look: bool = False
) -> SceneOutcome:
    """Do a task unless its shard is there already; a view that cannot be used is an outcome, not an exception.

    Parameters
    ----------
    task
        What to do.
    pool, progress
        As for :func:`build_shard`.
    only_look
        Say whether it is there, build nothing.
    """
    with one_thread():
        try:
            inputs = tuple(sealed_digest(p) for p in task.views)
            found = finished(task, inputs)
            if found is not None or only_look:
                return SceneOutcome(found, skipped=found is not None, peak_memory=peak_memory())
            return SceneOutcome(build_shard(task, inputs, pool, progress), peak_memory=peak_memory())
        except TofError as err:
            return SceneOutcome(None, error=err, peak_memory=peak_memory())


look = partial(build_scene, only_look=True)
