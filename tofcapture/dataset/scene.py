"""One scene's shard: what it is made of, whether it is there already, and making it.

A task reads view files and writes one shard, nothing else. Any process on any machine that sees the files can do it, twice or
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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture import __version__
from tofcapture.dataset.sample import (
    SampleConfig,
    TruthError,
    ViewError,
    calibrated,
    decoder_for,
    make_sample,
    pooled,
    view_error,
)
from tofcapture.dataset.surface import Surface, put_together
from tofcapture.errors import DataError, TofError
from tofcapture.files.disk import full_disk_named
from tofcapture.files.hdf import dumps
from tofcapture.files.layout import SHARD, MaskBit
from tofcapture.files.seal import digest_path, sealed_digest
from tofcapture.files.shard import Sample, ShardReader, ShardWriter
from tofcapture.files.view import read_depth_view
from tofcapture.frames import NO_TRUTH, View
from tofcapture.ops.phase import Decoder
from tofcapture.pool import Pool, one_thread
from tofcapture.rig import Rig, dumps_rig

ViewsDone = Callable[[int], None]
"""Called with the number of views of the scene that are finished."""
WORK = ".work-"  # folders beside the shards in which they are made


@dataclass(frozen=True)
class SceneTask:
    """Say what one shard is made of, and where it goes.

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

    def digest(self, inputs: Sequence[str]) -> str:
        """Digest everything that the shard's bytes depend on, given the digests of the view files."""
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
    """Report what became of a task.

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

    sha256: str | None = None
    skipped: bool = False
    error: TofError | None = None
    peak_memory: int = 0


def versions() -> dict[str, str]:
    """Name the versions that a shard's bytes depend on."""
    libraries = {name: version(name) for name in ("numpy", "h5py", "numba")}
    return {"tofcapture": __version__, "zlib": zlib.ZLIB_RUNTIME_VERSION, **libraries}


def build_scene(
    task: SceneTask, pool: Pool | None = None, progress: ViewsDone | None = None, *, only_look: bool = False
) -> SceneOutcome:
    """Do a task unless its shard is there already; a view that cannot be used is an outcome, not an exception.

    ``pool`` makes samples in parallel, ``progress`` is told after each view; ``only_look`` says whether it is there.
    """
    with one_thread():
        try:
            inputs = [sealed_digest(p) for p in task.views]
            found = finished(task, inputs)
            if found is not None or only_look:
                return SceneOutcome(found, skipped=found is not None, peak_memory=_peak_memory())
            with full_disk_named(task.path):
                digest = build_shard(task, inputs, pool, progress)
            return SceneOutcome(digest, peak_memory=_peak_memory())
        except TofError as err:
            return SceneOutcome(error=err, peak_memory=_peak_memory())


def finished(task: SceneTask, inputs: Sequence[str]) -> str | None:
    """Return the SHA-256 of a shard that is already what the task would make; ``None`` when it has to be built."""
    if not task.path.is_file():
        return None
    try:
        with ShardReader(task.path) as shard:
            same = shard.provenance.get("digest") == task.digest(inputs)
        return sealed_digest(task.path) if same else None
    except TofError:
        return None


def build_shard(
    task: SceneTask, inputs: Sequence[str], pool: Pool | None = None, progress: ViewsDone | None = None
) -> str:
    """Make one shard, whole or not at all.

    ``inputs`` are the SHA-256 of the view files. Returns that of the shard.

    Raises :class:`DataError`: a view is damaged or is of another camera than the rig, or stereo measured
    nothing in the ToF camera's image in any view; nothing is left behind.
    """
    first, _ = read_depth_view(task.views[0])
    decoder = decoder_for(first, task.rig)
    errors, good, seen = list[ViewError](), list[int](), False
    with _work_folder(task.path) as work:
        made = work / task.path.name
        info = calibrated(first.tof.info, task.rig)
        with ShardWriter(made, task.scene, task.rig, info, first.stereo.info, len(task.views)) as shard:
            surface = None
            if task.config.truth == "fused":
                surface = put_together(task.views, task.rig, task.config.reach, work / "clouds", pool)
            made_of = _samples(task, decoder, pool, surface)
            for path, (sample, error) in zip(task.views, made_of, strict=True):
                shard.add(sample, path)
                mask = sample.ground_truth[2].mask
                good.append(int((mask == 0).sum()))
                seen = seen or not (mask & MaskBit.NOT_HIT).all()
                errors += [] if error is None else [error]
                if progress:
                    progress(len(good))
            if not seen and first.stereo.info.model == NO_TRUTH:
                raise DataError(
                    f"{task.scene}: its views have no ground truth",
                    hint="tofcapture predict takes them as they are; or import them again with ground truth",
                )
            if not seen:
                raise DataError(
                    f"{task.scene}: stereo measured nothing in the ToF camera's image in any of {len(good)} views",
                    hint="is it the rig of these cameras? tofcapture view shows both",
                )
            digest = shard.seal(
                _provenance(task, inputs, first, good, pooled(errors) if errors else None, surface)
            )
        digest_path(made).replace(digest_path(task.path))  # first: a shard always has its digest
        made.replace(task.path)
    return digest


def sample_of(
    path: Path, rig: Rig, config: SampleConfig, decoder: Decoder, surface: tuple[Surface, int] | None
) -> tuple[Sample, ViewError | None]:
    """Read a view and make its sample, with its error where the truth is known."""
    view, depth = read_depth_view(path)
    sample = make_sample(view, rig, config, np.random.default_rng(view.index), decoder, depth, surface)
    return sample, view_error(sample, view)


def _samples(
    task: SceneTask, decoder: Decoder, pool: Pool | None, surface: Surface | None
) -> Iterator[tuple[Sample, ViewError | None]]:
    """Samples in the order of the views, made here or in the pool."""
    work = [
        (path, task.rig, task.config, decoder, None if surface is None else (surface, number))
        for number, path in enumerate(task.views)
    ]
    if pool is None:
        yield from (sample_of(*arguments) for arguments in work)
        return
    early: dict[int, tuple[Sample, ViewError | None]] = {}
    expected = 0
    for index, made in pool.run(sample_of, work):
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
    task: SceneTask, inputs: Sequence[str], first: View, good: Sequence[int], gt: TruthError | None,
    surface: Surface | None,
) -> dict[str, Any]:  # fmt: skip
    # Simulated scenes know their objects; check looks for them in other splits.
    objects = first.provenance.get("objects")
    return {
        **({} if objects is None else {"objects": list(objects)}),
        "digest": task.digest(inputs),
        "config": task.config.table(),
        "versions": versions(),
        "views": [
            {"name": path.name, "sha256": digest, "good_pixels": pixels, **truth}
            for path, digest, pixels, truth in zip(
                task.views, inputs, good, _truths(task, surface), strict=True
            )
        ],
        "gt": None if gt is None else gt.table(),
    }


def _truths(task: SceneTask, surface: Surface | None) -> list[dict[str, Any]]:
    """Say of every view whether its truth is fused, and of how many views, or why it is its own alone."""
    if surface is None:
        return [{"truth": "single"}] * len(task.views)
    return [
        {"truth": "single", "why": surface.alone[k]}
        if k in surface.alone
        else {"truth": "fused", "of": len(surface.members(k))}
        for k in range(len(task.views))
    ]


def _peak_memory() -> int:
    """Largest resident size of this process so far, bytes."""
    with suppress(
        OSError, StopIteration
    ):  # Linux: what getrusage says begins with the size of the process that started this one
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM:")).split()[1])
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
