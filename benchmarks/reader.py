"""How fast one random training sample is read: shard, cache, flat memory map; and what compression costs.

    python benchmarks/reader.py [--dataset DATASET --split train] [--seconds 3]

A sample is one raw frame and its view's depth, normals and mask at 2x: 3.6 MB at full size. Without ``--dataset`` a synthetic one
is written to a temporary folder: smooth scenes, taps with shot noise. Everything is read from the page cache, many times; a disk
slower than memory makes the smaller form faster.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from tofcapture.camera import Camera
from tofcapture.files.cache import PackedScene, pack
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.shard import GroundTruth, Sample, ShardReader, ShardWriter, TofMaps
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.ops.phase import ambiguity, frequencies, radial_to_range, taps
from tofcapture.rig import Rig

TOF = Camera(240, 180, 190.6, 200.8, 116.8, 101.5)
STEREO = Camera(1280, 1024, 1400.0, 1400.0, 639.5, 511.5)
FRAMES = 10
NAMES = ("tof/raw", "gt/depth_2x", "gt/normals_2x", "gt/mask_2x")


def synthetic_sample(index: int) -> Sample:
    """A wavy surface with an empty corner."""
    rng = np.random.default_rng(index)
    info = TofInfo("synthetic", "0", TOF, np.zeros(3))
    truths = {}
    for scale in (1, 2):
        camera = TOF.scaled(scale)
        x, y = camera.rays[..., 0], camera.rays[..., 1]
        depth = 0.8 + 0.05 * np.sin(7 * x + index) * np.cos(9 * y)
        normals = normals_from_depth(depth, camera)
        missing = (x + y > 0.6) | ~np.isfinite(normals).all(axis=-1)
        depth, normals = np.where(missing, np.nan, depth), np.where(missing[..., None], np.nan, normals)
        truths[scale] = GroundTruth(
            depth.astype(np.float32), normals.astype(np.float32), missing.astype(np.uint8)
        )
    depth = np.where(np.isfinite(truths[1].depth), truths[1].depth, 1.5).astype(np.float64)
    range_ = radial_to_range(TOF.depth_to_radial(depth), TOF, info.illuminator)
    amplitude = 170 / depth**2
    z = np.stack(
        [
            a * amplitude * np.exp(2j * np.pi * range_ / ambiguity(f))
            for a, f in zip((1.4, 1.0), frequencies(info.modulation_hz), strict=True)
        ]
    )
    clean = taps(z, np.stack([1.7 * amplitude + 20] * 2), info.modulation_hz, info.phase_rad)
    raw = rng.poisson(16 * np.maximum(clean, 0), (FRAMES, *clean.shape)) / 16
    raw += rng.normal(0, 1.25, raw.shape)
    return Sample(
        index=index,
        raw=np.clip(np.rint(raw), 0, 4095).astype(np.uint16),
        celsius=np.full(FRAMES, 45.0),
        time_ns=np.arange(FRAMES),
        tof=TofMaps(depth.astype(np.float32), amplitude.astype(np.float32), np.zeros(TOF.shape, np.uint8)),
        native_depth=np.full(STEREO.shape, 0.8, np.float32),
        ground_truth=truths,
        T_base_tof=np.eye(4),
    )


def synthetic_dataset(folder: Path, scenes: int, views: int) -> Path:
    rig = Rig(TOF, STEREO, np.eye(4), np.eye(4))
    info, stereo = TofInfo("synthetic", "0", TOF, np.zeros(3)), StereoInfo("synthetic", "0", STEREO)
    entries = {}
    for s in range(scenes):
        path = f"shards/scene-{s}.h5"
        with ShardWriter(folder / path, f"scene-{s}", rig, info, stereo, views) as shard:
            for view in range(views):
                shard.add(synthetic_sample(views * s + view))
            entries[f"scene-{s}"] = SceneEntry(path, shard.seal({}), views, "train")
    write_manifest(folder, Manifest(entries))
    return folder


def rates(readers: dict[str, Callable[[int], object]], count: int, seconds: float) -> dict[str, float]:
    """Samples per second of CPU of each reader at random indices; readers take turns, the best turn counts."""
    rng = np.random.default_rng(0)
    best = dict.fromkeys(readers, 0.0)
    for _ in range(5):
        for name, read in readers.items():
            order, done, start = rng.integers(count, size=4096), 0, time.process_time()
            while time.process_time() - start < seconds / 5:
                read(int(order[done % len(order)]))
                done += 1
            best[name] = max(best[name], done / (time.process_time() - start))
    return best


def sample(reader: ShardReader | PackedScene, view: int, frame: int) -> list[np.ndarray]:
    """One training sample, in memory of its own."""
    return [np.array(a) for a in (reader.raw(view, frame), *vars(reader.ground_truth(view, 2)).values())]


def unfiltered(path: Path, out: Path) -> list[h5py.Dataset]:
    """The same chunks, neither compressed nor checked."""
    file = h5py.File(out, "w")
    with h5py.File(path) as source:
        return [
            file.create_dataset(name, data=source[name][()], chunks=source[name].chunks) for name in NAMES
        ]


def compressions(path: Path, folder: Path) -> None:
    """Bytes, write and read time of one view's arrays under plain h5py filters."""
    with h5py.File(path) as source:
        arrays: dict[str, np.ndarray] = {}
        source.visititems(
            lambda name, d: (
                arrays.update({name: d[:2]}) if isinstance(d, h5py.Dataset) and d.ndim > 2 else None
            )
        )
    safe = {"shuffle": True, "fletcher32": True}
    options: dict[str, dict[str, Any]] = {
        "none": {},
        "none, checked": {"fletcher32": True},
        "lzf": {"compression": "lzf", **safe},
        "gzip 1": {"compression": "gzip", "compression_opts": 1, **safe},
        "gzip 4": {"compression": "gzip", "compression_opts": 4, **safe},
    }
    print(f"\n{'filter':14} {'MB/view':>8} {'write ms/view':>14} {'read ms/sample':>15}")
    for name, option in options.items():
        out = folder / "filter.h5"
        start = time.process_time()
        with h5py.File(out, "w") as file:
            for key, a in arrays.items():
                file.create_dataset(
                    key, data=a, chunks=(1, 1, *a.shape[2:]) if a.ndim == 5 else (1, *a.shape[1:]), **option
                )
        write = (time.process_time() - start) / 2
        with h5py.File(out) as file:
            sets = [file[key] for key in NAMES]
            start = time.process_time()
            for i in range(20):
                _ = [sets[0][i % 2, i % FRAMES], *(d[i % 2] for d in sets[1:])]
            read = (time.process_time() - start) / 20
        print(f"{name:14} {out.stat().st_size / 2e6:8.2f} {1e3 * write:14.0f} {1e3 * read:15.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", type=Path)
    parser.add_argument("--split", default="train")
    parser.add_argument("--seconds", type=float, default=3.0, help="per reader")
    parser.add_argument("--views", type=int, default=8, help="of the synthetic dataset's two scenes")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        dataset = args.dataset or synthetic_dataset(folder / "dataset", 2, args.views)
        start = time.process_time()
        cache = pack(dataset, args.split, folder / "cache")
        packing = time.process_time() - start
        entries = load_manifest(dataset).split(args.split)
        shards = {n: ShardReader(dataset / e.path, e.sha256) for n, e in entries.items()}
        plain = {n: unfiltered(dataset / e.path, folder / f"{n}.h5") for n, e in entries.items()}
        every = [(n, v, f) for n, r in shards.items() for v in range(r.views) for f in range(r.frames)]
        size = sum(a.nbytes for a in sample(cache[every[0][0]], 0, 0))
        flat = [np.memmap(scene.path, np.uint8, mode="r") for scene in cache.values()]
        spots = np.random.default_rng(1).random(len(every))

        def flat_read(i: int) -> np.ndarray:
            whole = flat[i % len(flat)]
            at = int(spots[i] * (len(whole) - size)) & ~4095
            return np.array(whole[at : at + size])

        def plain_read(i: int) -> list[np.ndarray]:
            scene, view, frame = every[i]
            raw, *maps = plain[scene]
            return [raw[view, frame], *(d[view] for d in maps)]

        print(f"{len(every)} samples, {size / 1e6:.2f} MB each; packed in {packing:.1f} s of CPU")
        readers = {
            "flat memory map, same bytes": flat_read,
            "cache (tofcapture pack)": lambda i: sample(cache[every[i][0]], *every[i][1:]),
            "shard, as written": lambda i: sample(shards[every[i][0]], *every[i][1:]),
            "HDF5, same chunks, no filter": plain_read,
        }
        found = rates(readers, len(every), args.seconds)
        base = found["flat memory map, same bytes"]
        print(f"\n{'one random sample, one process':36} {'samples/s':>10} {'GB/s':>6} {'of flat':>8}")
        for reader, rate in found.items():
            print(f"{reader:36} {rate:10.0f} {rate * size / 1e9:6.2f} {rate / base:8.0%}")
        compressions(next(iter(shards.values())).path, folder)


if __name__ == "__main__":
    main()
