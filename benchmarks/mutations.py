"""Damage a dataset at random, many times: does check report it, do readers refuse it or still give what is right.

Or, worse, do they give wrong arrays and say nothing?

    python benchmarks/mutations.py [--count 500] [--seed 0] [--json]

Each time one file (shard, digest beside it, manifest) has a bit flipped, is truncated, has a block zeroed, bytes inserted, a
character replaced, is swapped with another (a shard also together with its digest) or deleted; then the dataset is put back. A
corruption that changes no stored bit is drawn again. The last column reads the same shards with plain h5py, in a process of its
own: what HDF5 and its Fletcher-32 let through when nobody compares digests.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from tofcapture.camera import Camera
from tofcapture.dataset.card import write_card
from tofcapture.errors import TofError
from tofcapture.files.check import check
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, ShardReader, ShardWriter, TofMaps
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.poses import exp
from tofcapture.rig import Rig
from tofcapture_model.data import open_scenes

TOF, STEREO = Camera(16, 12, 12.7, 13.4, 7.8, 6.8), Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
RIG = Rig(TOF, STEREO, exp([-0.05, 0.07, 0, 0, 0.01, 0]), np.eye(4))
INFO, STEREO_INFO = TofInfo("tof", "1", TOF, np.zeros(3)), StereoInfo("stereo", "2", STEREO)
LIMIT = 10  # s for one plain read


def _truth(scale: int, rng: np.random.Generator) -> GroundTruth:
    shape = TOF.scaled(scale).shape
    depth = rng.uniform(0.5, 1, shape).astype(np.float32)
    normals = np.zeros((*shape, 3), np.float32)
    normals[..., 2] = -1
    missing = rng.random(shape) < 0.2
    depth[missing], normals[missing] = np.nan, np.nan
    return GroundTruth(depth, normals, missing.astype(np.uint8))


def _sample(index: int) -> Sample:
    rng = np.random.default_rng(index)
    truths = {s: _truth(s, rng) for s in (1, 2)}
    maps = [rng.uniform(0.5, 1, TOF.shape).astype(np.float32) for _ in range(2)]
    return Sample(
        index,
        rng.integers(0, 4096, (2, 8, *TOF.shape)).astype(np.uint16),
        rng.normal(40, 1, 2),
        np.arange(2),
        TofMaps(maps[0], maps[1], (rng.random(TOF.shape) < 0.1).astype(np.uint8)),
        rng.uniform(0.5, 1, STEREO.shape).astype(np.float32),
        truths,
        exp(0.1 * rng.normal(size=6)),
        ExactMaps(truths[2].depth, truths[2].normals),
    )


def make(folder: Path) -> None:
    """Three scenes of two views, a manifest, a card."""
    entries = {}
    for i, scene in enumerate(("box", "gear", "mug")):
        path = folder / f"shards/{scene}.h5"
        with ShardWriter(path, scene, RIG, INFO, STEREO_INFO, 2) as shard:
            for k in range(2):
                shard.add(_sample(10 * i + k))
            entries[scene] = SceneEntry(f"shards/{scene}.h5", shard.seal({"digest": scene}), 2, "train")
    manifest = Manifest(entries, {"far": 2.0}, {"tofcapture": "0"})
    write_manifest(folder, manifest)
    write_card(folder, manifest, None)


def _flip(data: bytearray, rng: np.random.Generator) -> None:
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))


def _truncate(data: bytearray, rng: np.random.Generator) -> None:
    del data[rng.integers(len(data)) :]


def _zero(data: bytearray, rng: np.random.Generator) -> None:
    at, n = int(rng.integers(len(data))), int(rng.integers(1, 4096))
    data[at : at + n] = bytes(len(data[at : at + n]))


def _insert(data: bytearray, rng: np.random.Generator) -> None:
    at = int(rng.integers(len(data) + 1))
    data[at:at] = rng.bytes(int(rng.integers(1, 64)))


def _text(data: bytearray, rng: np.random.Generator) -> None:
    letters = [i for i, b in enumerate(data) if chr(b).isascii() and chr(b).isalnum()]
    data[letters[rng.integers(len(letters))]] = int(rng.choice(list(b"0123456789abcdefxyzTF")))


EDITS: dict[str, Callable[[bytearray, np.random.Generator], None]] = {
    "flip a bit": _flip,
    "truncate": _truncate,
    "zero a block": _zero,
    "insert": _insert,
    "replace a character": _text,
}
KINDS = (*EDITS, "swap two files", "delete")


def _swap(a: Path, b: Path) -> None:
    aside = a.with_name("aside")
    a.rename(aside)
    b.rename(a)
    aside.rename(b)


def corrupt(folder: Path, kind: str, rng: np.random.Generator) -> str:
    """Damage a dataset once; returns what was hit: shard, digest or manifest."""
    shards = sorted((folder / "shards").glob("*.h5"))
    path = shards[rng.integers(len(shards))]
    target = "shard"
    if kind == "swap two files":
        other = shards[(shards.index(path) + 1) % len(shards)]
        what = int(rng.integers(3))  # shards, digests, or both
        target = ("shard", "digest", "shard and digest")[what]
        if what != 1:
            _swap(path, other)
        if what:
            _swap(path.with_suffix(".sha256"), other.with_suffix(".sha256"))
        return target
    where = rng.random()
    if where > 0.65:
        path, target = folder / "manifest.json", "manifest"
    elif where > 0.5:
        path, target = path.with_suffix(".sha256"), "digest"
    if kind == "delete":
        path.unlink()
        return target
    before = path.read_bytes()
    data = bytearray(before)
    while data == before:
        EDITS[kind](data, rng)
    path.chmod(0o644)
    path.write_bytes(data)
    return target


def _digest(*arrays: object) -> str:
    found = hashlib.sha256()
    for array in arrays:
        found.update(array if isinstance(array, bytes) else np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def read_shard(path: Path, sha256: str | None = None) -> tuple[str, str]:
    """Scene and digest of all that a reader gives."""
    with ShardReader(path, sha256) as shard:
        parts: list[object] = [repr((shard.camera, shard.info, shard.stereo_info, shard.provenance)).encode()]
        for view in range(shard.views):
            parts += [shard.raw(view, f) for f in range(shard.frames)]
            parts += [shard.celsius(view, f) for f in range(shard.frames)]
            parts += [
                *vars(shard.tof(view)).values(),
                shard.native(view),
                shard.T_base_tof(view),
                shard.index(view),
            ]
            for scale in (1, 2):
                parts += vars(shard.ground_truth(view, scale)).values()
            truth = shard.truth(view)
            parts += [] if truth is None else vars(truth).values()
        return shard.scene, _digest(*parts)


def read_dataset(folder: Path) -> str:
    """Digest of all that training reads of the split."""
    parts: list[object] = []
    readers = open_scenes(folder, "train").values()
    try:
        for reader in readers:
            for view in range(reader.views):
                parts += vars(reader.ground_truth(view, 2)).values()
                for frame in range(reader.frames):
                    parts += [reader.raw(view, frame), np.array(reader.celsius(view, frame))]
    finally:
        for reader in readers:
            reader.close()
    return _digest(*parts)


def read_plain(path: Path) -> str:
    """Digest of all arrays and attributes, by h5py alone."""
    parts: list[object] = []
    with h5py.File(path, "r") as file:

        def visit(name: str, thing: object) -> None:
            if isinstance(thing, h5py.Dataset):
                parts.extend((name.encode(), thing[()]))

        file.visititems(visit)
        parts.append(repr(sorted(file.attrs.items())).encode())
    return _digest(*parts)


def plain_outcome(path: Path, right: str) -> str:
    """``right``, ``error``, ``wrong``, or ``crash``: libhdf5 may die of what it reads, so a child does it."""
    if not path.exists():
        return "error"
    child = os.fork()
    if child == 0:
        signal.alarm(LIMIT)
        try:
            os._exit(0 if read_plain(path) == right else 1)
        except BaseException:
            os._exit(2)
    status = os.waitpid(child, 0)[1]
    return {0: "right", 1: "wrong", 2: "error"}.get(os.waitstatus_to_exitcode(status), "crash")


def outcome(read: Callable[[], object], right: Callable[[object], bool]) -> str:
    """``right``, ``named error``, ``other error`` or ``wrong``."""
    try:
        return "right" if right(read()) else "wrong"
    except TofError:
        return "named error"
    except Exception as err:
        return f"other error: {type(err).__name__}: {err}"


def one(
    folder: Path, pristine: Path, good: dict[str, str], plain: dict[str, str], whole: str
) -> dict[str, list[str]]:
    """Outcome of every reader on a damaged dataset; a shard that is not there counts as an error of h5py."""
    paths = [folder / f"shards/{scene}.h5" for scene in good]
    entries = outcome(lambda: load_manifest(folder), lambda m: set(m.scenes) == set(good))
    return {
        "check": ["reported" if check(folder) else "missed"],
        "manifest": [entries],
        "dataset": [outcome(lambda: read_dataset(folder), lambda d: d == whole)],
        "shard": [outcome(lambda p=p: read_shard(p), lambda r: good.get(r[0]) == r[1]) for p in paths],
        "h5py": [
            plain_outcome(p, plain[p.stem]) for p in paths if not _same(p, pristine / "shards" / p.name)
        ],
    }


def _same(a: Path, b: Path) -> bool:
    return a.exists() and a.read_bytes() == b.read_bytes()


def run(count: int, seed: int) -> list[tuple[str, str, dict[str, list[str]]]]:
    """Corrupt ``count`` times; returns kind, target and outcomes of each."""
    rng = np.random.default_rng(seed)
    rows = []
    with tempfile.TemporaryDirectory() as tmp:
        pristine, folder = Path(tmp) / "pristine", Path(tmp) / "data"
        make(pristine)
        shards = sorted((pristine / "shards").glob("*.h5"))
        good, plain = dict(map(read_shard, shards)), {p.stem: read_plain(p) for p in shards}
        whole = read_dataset(pristine)
        assert check(pristine) == []
        for i in range(count):
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(pristine, folder)
            kind = KINDS[i % len(KINDS)]
            target = corrupt(folder, kind, rng)
            rows.append((kind, target, one(folder, pristine, good, plain, whole)))
    return rows


def _table(rows: list[tuple[str, str, dict[str, list[str]]]]) -> str:
    lines = [
        "| corruption | of | n | check reports | training error / right / wrong | ShardReader wrong | plain h5py wrong |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, target in sorted({(k, t) for k, t, _ in rows}):
        mine = [o for k, t, o in rows if (k, t) == (kind, target)]
        data = Counter(o["dataset"][0] for o in mine)
        silent = ["shard", "h5py"]
        wrong = [sum("wrong" in o[name] for o in mine) for name in silent]
        lines.append(
            f"| {kind} | {target} | {len(mine)} | {sum(o['check'] == ['reported'] for o in mine)} "
            f"| {data['named error']} / {data['right']} / {data['wrong']} | {wrong[0]} | {wrong[1]} |"
        )
    return "\n".join(lines)


def summary(rows: list[tuple[str, str, dict[str, list[str]]]]) -> dict[str, object]:
    """Counts over all corruptions."""
    readers = [o for _, _, row in rows for name in ("manifest", "dataset", "shard") for o in row[name]]
    return {
        "corruptions": len(rows),
        "reported": sum(row["check"] == ["reported"] for _, _, row in rows),
        "reads": dict(Counter(o.split(":")[0] for o in readers)),
        "other": sorted({o for o in readers if o.startswith("other")}),
        "h5py": dict(Counter(o for _, _, row in rows for o in row["h5py"])),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    rows = run(args.count, args.seed)
    print(json.dumps(summary(rows)) if args.json else f"{_table(rows)}\n\n{summary(rows)}")


if __name__ == "__main__":
    main()
