"""Packed splits: the same arrays as the shards, resumed, refused when stale, read by spawned workers."""

from __future__ import annotations

import json
import multiprocessing
import pickle
from dataclasses import replace

import numpy as np
import pytest

from tests.test_files_shard import write
from tofcapture.cli import main
from tofcapture.errors import DataError, FormatError
from tofcapture.files.cache import open_cache, pack, verify_cache
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.shard import ShardReader


def make(folder, scenes=("box", "mug"), split="train"):
    entries = {}
    for i, scene in enumerate(scenes):
        digest = write(folder / f"shards/{scene}.h5", (i, i + 5), scene)
        entries[scene] = SceneEntry(f"shards/{scene}.h5", digest, 2, split)
    write_manifest(folder, Manifest(entries))
    return folder


@pytest.fixture
def dataset(tmp_path):
    """Two scenes of two views of three frames."""
    return make(tmp_path / "dataset")


def test_a_cache_holds_what_the_shards_hold(dataset, tmp_path):
    """Every array, bit by bit, through the same calls; records open with numpy alone."""
    scenes = pack(dataset, "train", tmp_path / "cache")
    assert list(scenes) == ["box", "mug"]
    for name, scene in scenes.items():
        with ShardReader(dataset / f"shards/{name}.h5") as shard:
            assert (scene.views, scene.frames, scene.camera) == (shard.views, shard.frames, shard.camera)
            assert scene.info.range_errors == shard.info.range_errors
            for view in range(shard.views):
                for frame in range(shard.frames):
                    np.testing.assert_array_equal(scene.raw(view, frame), shard.raw(view, frame))
                    assert scene.celsius(view, frame) == shard.celsius(view, frame)
                pairs = zip(
                    vars(scene.ground_truth(view)).values(),
                    vars(shard.ground_truth(view, 2)).values(),
                    strict=True,
                )
                for a, b in pairs:
                    np.testing.assert_array_equal(a, b)
    fields = json.loads((tmp_path / "cache/index.json").read_text())["scenes"]["mug"]["fields"]
    dtype = np.dtype([(n, f, tuple(s)) for n, f, s in fields], align=True)
    plain = np.memmap(tmp_path / "cache/mug.bin", dtype, mode="r")
    np.testing.assert_array_equal(plain["raw"][1, 2], scenes["mug"].raw(1, 2))
    with pytest.raises(ValueError, match="read-only"):
        scenes["mug"].raw(0, 0)[:] = 0


def test_packing_goes_on_where_it_was_killed(dataset, tmp_path):
    """After a kill the finished scene is kept, to the file, and the result is that of an unbroken run."""
    cache = tmp_path / "cache"
    pack(dataset, "train", tmp_path / "whole")

    def dies_at_mug(scene, _view, _views):
        if scene == "mug":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pack(dataset, "train", cache, dies_at_mug)
    assert sorted(p.name for p in cache.iterdir()) == ["box.bin", "index.json"]
    with pytest.raises(DataError, match="stale: mug"):
        open_cache(cache, dataset)
    packed = set()
    pack(dataset, "train", cache, lambda scene, _view, _views: packed.add(scene))
    assert packed == {"mug"}
    for name in ("box.bin", "mug.bin", "index.json"):
        assert (cache / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_stale_cache_is_refused_and_brought_up_to_date(dataset, tmp_path):
    """A shard that was rebuilt, one that left and one that came: named, then packed; files of the gone are removed."""
    cache = tmp_path / "cache"
    pack(dataset, "train", cache)
    make(dataset, ("mug", "gear"))
    with pytest.raises(DataError, match=r"stale: box, gear, mug changed") as info:
        open_cache(cache, dataset)
    assert "tofcapture pack" in info.value.hint
    assert list(pack(dataset, "train", cache)) == ["gear", "mug"]
    assert sorted(p.name for p in cache.iterdir()) == ["gear.bin", "index.json", "mug.bin"]
    assert list(open_cache(cache, dataset)) == ["gear", "mug"]


def test_damage_is_named(dataset, tmp_path):
    """A cut file, a flipped byte, a garbled index, another split, a shard that is not the manifest's."""
    cache = tmp_path / "cache"
    scenes = pack(dataset, "train", cache)
    assert verify_cache(cache) == []
    data = bytearray(scenes["mug"].path.read_bytes())
    data[100] ^= 1
    scenes["mug"].path.write_bytes(data)
    assert verify_cache(cache) == ["mug"]
    with pytest.raises(DataError, match="changed after it was sealed"):
        open_cache(cache, dataset)["mug"].raw(0, 0)
    scenes["mug"].path.write_bytes(data[:-1])
    with pytest.raises(DataError, match=r"expected \d+ bytes"):
        open_cache(cache, dataset)["mug"].raw(0, 0)
    with pytest.raises(DataError, match="holds 2 views"):
        scenes["box"].raw(2, 0)
    with pytest.raises(DataError, match="holds 3 frames"):
        scenes["box"].raw(0, 3)
    with pytest.raises(DataError, match="2x only"):
        scenes["box"].ground_truth(0, 1)
    with pytest.raises(DataError, match="'val' is empty"):
        pack(dataset, "val", cache)
    manifest = load_manifest(dataset)
    write_manifest(dataset, Manifest({k: replace(e, split="val") for k, e in manifest.scenes.items()}))
    with pytest.raises(FormatError, match="of the split 'val'"):
        pack(dataset, "val", cache)
    write_manifest(dataset, Manifest({"mug": replace(manifest.scenes["mug"], sha256="0" * 64)}))
    with pytest.raises(DataError, match="not the shard of the manifest"):
        pack(dataset, "train", tmp_path / "other")
    for text in ("{", "[]", '{"format": "tofcapture-cache", "version": 1}'):
        (cache / "index.json").write_text(text)
        with pytest.raises(DataError, match="cache"):
            open_cache(cache)


def test_the_command_packs(dataset, tmp_path, capsys):
    """`tofcapture pack` says what it did, and the second time that there was nothing to do."""
    args = ["pack", str(dataset), "--out", str(tmp_path / "cache"), "--json"]
    for packed in (4, 0):
        assert main(args) == 0
        assert json.loads(capsys.readouterr().out)["packed"] == packed


def read_all(reader):
    """Every frame of a reader; runs in a spawned process."""
    return np.stack([reader.raw(v, f) for v in range(reader.views) for f in range(reader.frames)])


def test_a_reader_in_use_goes_to_a_spawned_worker(dataset, tmp_path):
    """Shards and caches that were read from here pickle, and give the same there."""
    packed, shard = pack(dataset, "train", tmp_path / "cache")["mug"], ShardReader(dataset / "shards/mug.h5")
    expected = read_all(shard)
    assert (read_all(packed) == expected).all()
    assert (read_all(pickle.loads(pickle.dumps(packed))) == expected).all()  # noqa: S301
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        for found in pool.map(read_all, [shard, packed]):
            assert (found == expected).all()
    packed.close()
    assert (read_all(packed) == expected).all()
    shard.close()
