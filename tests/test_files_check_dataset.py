"""check() on whole recordings and datasets: what disagrees with a journal, with a manifest, or between files."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace

from tests.sealed import edit, set_array, set_attr
from tofcapture.files.cache import pack
from tofcapture.files.check import check
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, write_manifest
from tofcapture.files.seal import sha256_of


def test_a_recording_disagrees_with_its_journal(here):
    """A view that the journal promises and that is gone, or that is another one, is found; a broken journal is too."""
    recording = here / "recording"
    with closing(sqlite3.connect(recording / "journal.sqlite")) as db:
        db.execute('CREATE TABLE views (scene, "index", state, sha256)')
        for row in (
            ("box", 0, "sealed", "0" * 64),
            ("box", 1, "sealed", "1" * 64),
            ("box", 2, "failed", None),
        ):
            db.execute("INSERT INTO views VALUES (?, ?, ?, ?)", row)
        db.commit()
    problems = {p.path.name: p.message for p in check(recording)}
    assert set(problems) == {"view-000.h5", "view-001.h5"}
    assert "journal" in problems["view-000.h5"]
    (recording / "journal.sqlite").write_text("no database " * 100)
    (recording / "rig.toml").write_text("units = 'mm'")
    (recording / "evidence.json").write_text("{")
    assert {p.path.name for p in check(recording)} == {"journal.sqlite", "rig.toml", "evidence.json"}


def test_a_dataset_disagrees_with_its_manifest(here):
    """A missing shard, a shard that nobody lists, a wrong count, a wrong digest, an object in two splits."""
    dataset = here / "dataset"
    manifest = json.loads((dataset / "manifest.json").read_text())
    scenes = manifest["scenes"]
    shutil.copy(dataset / "shards/box.h5", dataset / "shards/box-2.h5")
    edit(dataset / "shards/box-2.h5", set_attr("scene", "box-2"))
    scenes["box-2"] = {
        **scenes["box"],
        "path": "shards/box-2.h5",
        "sha256": sha256_of(dataset / "shards/box-2.h5"),
    }
    scenes["box-2"]["split"] = "test" if scenes["box"]["split"] == "train" else "train"
    scenes["box"]["views"] = 4
    scenes["gone"] = {**scenes["gear"], "path": "shards/gone.h5"}
    scenes["gear"]["sha256"] = "0" * 64
    shutil.copy(dataset / "shards/gear.h5", dataset / "shards/stray.h5")
    write_manifest(dataset, Manifest({n: SceneEntry(**e) for n, e in scenes.items()}))
    found = {(p.path.name, p.where) for p in check(dataset)}
    assert found == {
        ("manifest.json", "box"),
        ("gone.h5", ""),
        ("gear.h5", ""),
        ("stray.h5", ""),
        ("box-2.h5", "view 0"),
        ("croissant.json", "distribution"),
    }
    assert any("box" in p.where and "is in" in p.message for p in check(dataset))


def test_a_dataset_without_a_readable_manifest(here):
    """A manifest that is gone or no JSON is one problem, not an exception."""
    path = here / "dataset/manifest.json"
    path.write_text("{")
    assert [p.path.name for p in check(here / "dataset")] == ["dataset"]
    path.unlink()
    assert len(check(here / "dataset")) == 1


def as_scene(dataset, old, new, change=lambda _file: None):
    """Copy a shard as another scene's; returns its entry of the manifest."""
    path = dataset / f"shards/{new}.h5"
    shutil.copy(dataset / f"shards/{old}.h5", path)
    edit(path, lambda f: (set_attr("scene", new)(f), change(f)))
    return replace(load_manifest(dataset).scenes[old], path=f"shards/{new}.h5", sha256=sha256_of(path))


def test_the_same_frames_under_two_names_are_found(here):
    """A view that is in two scenes, whatever else differs, and one that is twice in a scene."""
    dataset = here / "dataset"
    manifest = load_manifest(dataset)
    entry = as_scene(dataset, "box", "cup", set_array("tof/celsius", (0, 0), 20.0))
    write_manifest(dataset, replace(manifest, scenes={**manifest.scenes, "cup": entry}))
    found = [(p.path.name, p.where, p.message) for p in check(dataset) if p.path.name != "croissant.json"]
    assert found == [("cup.h5", "view 0", "the same frames as view 0 of box")]


def test_an_object_in_two_splits_is_found_by_what_the_data_say(here):
    """Scenes of other names share an object: by their provenance, or by the simulation's note."""
    dataset = here / "dataset"
    manifest = load_manifest(dataset)
    noisy = set_array("tof/raw", (0, 0, 0, 0), 7)
    objects = set_attr("provenance", json.dumps({"objects": ["bowl"]}))
    one = as_scene(dataset, "box", "cup", lambda f: (noisy(f), objects(f)))
    write_manifest(dataset, replace(manifest, scenes={**manifest.scenes, "cup": replace(one, split="val")}))
    (dataset / "simulation").mkdir()
    (dataset / "simulation/gear.json").write_text(json.dumps({"objects": ["bowl"]}))
    problems = [p for p in check(dataset) if p.path.name == "manifest.json"]
    assert [p.where for p in problems] == ["bowl"]
    assert "val (cup)" in problems[0].message


def test_strays_and_stale_caches_are_found(here):
    """Files that nobody lists; a cache in the dataset that is damaged, then stale; the same cache looked at by itself."""
    dataset = here / "dataset"
    split = load_manifest(dataset).scenes["box"].split
    pack(dataset, split, dataset / "cache")
    (dataset / "LICENSE").write_text("x")
    assert check(dataset) == []
    assert check(dataset / "cache") == []
    (dataset / "shards/notes.txt").write_text("x")
    (dataset / "old.h5").write_text("x")
    (dataset / "cache/extra").write_text("x")
    assert {p.path.name for p in check(dataset)} == {"notes.txt", "old.h5", "extra"}
    path = dataset / "cache/box.bin"
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)
    assert "box.bin" in {p.path.name for p in check(dataset / "cache")}
    edit(dataset / "shards/box.h5", set_array("tof/celsius", (0, 0), 20.0))
    manifest = load_manifest(dataset)
    box = replace(manifest.scenes["box"], sha256=sha256_of(dataset / "shards/box.h5"))
    write_manifest(dataset, replace(manifest, scenes={**manifest.scenes, "box": box}))
    assert any("stale: box" in p.message for p in check(dataset))


def test_half_a_dataset_is_still_checked(here):
    """A manifest whose shards are gone, and shards without their manifest, are both found."""
    dataset = here / "dataset"
    shutil.move(dataset / "shards", here / "aside")
    assert {p.path.name for p in check(dataset)} == {"box.h5", "gear.h5"}
    shutil.move(here / "aside", dataset / "shards")
    (dataset / "manifest.json").unlink()
    assert [p.path for p in check(dataset)] == [dataset]
