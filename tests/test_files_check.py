"""check() finds every kind of damage and never raises."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tofcapture.dataset.build import build_dataset
from tofcapture.devices.sim.scenes import TABLE_CENTRE, scene_objects
from tofcapture.devices.sim.world import SimWorld, read_constants
from tofcapture.files.check import check
from tofcapture.files.seal import digest_path, sha256_of
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import invert, look_at

SMALL = {
    "tof": {"width": 40, "height": 30, "fx": 31.8, "fy": 33.4, "cx": 19.5, "cy": 16.9},
    "stereo": {"width": 160, "height": 128, "fx": 144.0, "fy": 144.0, "cx": 79.5, "cy": 63.5},
    "render": {"multipath": False, "subpixels": 1},
}


def simulate(scene, index):
    world = SimWorld(read_constants(SMALL, "test"), 0, scene_objects)
    target = np.asarray(TABLE_CENTRE) + np.array([0, 0, 0.03])
    T_base_tof = look_at(target + np.array([0.1 * index, 0.15, 0.45]), target)
    T_base_flange = T_base_tof @ invert(world.true_rig.T_flange_tof)
    world.place(scene)
    world.set_pose(T_base_flange, bytes([index]))
    times = iter(range(1, 10**9, 10**6))
    burst, stereo = world.tof(2, times.__next__), world.stereo(times.__next__)
    state = ArmState(np.zeros(6), T_base_flange, 5)
    return View(scene, index, burst, stereo, state, state, world.nominal_rig(), {}, world.truth())


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    """A recording of two scenes and the dataset built from it."""
    root = tmp_path_factory.mktemp("check")
    for scene in ("box", "gear"):
        write_view(view_path(root / "recording", scene, 0), simulate(scene, 0))
    build_dataset([root / "recording"], root / "dataset", true_rig=True, jobs=1)
    return root


@pytest.fixture
def here(sealed, tmp_path):
    """A copy to damage."""
    return shutil.copytree(sealed, tmp_path / "copy")


def reseal(path):
    """Make the stored digest agree with damaged bytes, so that deeper checks have to find the damage."""
    digest_path(path).write_text(f"{sha256_of(path)}  {path.name}\n")


def edit(path, change):
    path.chmod(0o644)
    with h5py.File(path, "a") as file:
        change(file)
    reseal(path)


def test_what_is_right_has_no_problems(sealed):
    """A recording, a dataset, a view and a shard as they were sealed."""
    for path in ("recording", "dataset", "recording/views/box/view-000.h5", "dataset/shards/box.h5"):
        assert check(sealed / path) == []


OFFSETS = [*range(0, 100, 9), *np.random.default_rng(0).integers(100, 10**6, 30).tolist(), -1]


@pytest.mark.parametrize("name", ["recording/views/box/view-000.h5", "dataset/shards/box.h5"])
def test_any_flipped_byte_is_found(here, name):
    """Whatever byte is flipped, in the superblock, in metadata or in data, the file's digest tells."""
    path = here / name
    path.chmod(0o644)
    good = path.read_bytes()
    for offset in OFFSETS:
        data = bytearray(good)
        data[offset % len(good)] ^= 0x10
        path.write_bytes(bytes(data))
        problems = check(path)
        assert any("sha256" in p.message for p in problems), offset


@pytest.mark.parametrize("keep", [0, 1, 47, 2048, 0.5, -1])
def test_truncation_is_found_with_and_without_a_digest(here, keep):
    """A file cut anywhere is a problem, even when its digest was lost."""
    path = here / "recording/views/box/view-000.h5"
    path.chmod(0o644)
    size = path.stat().st_size
    os.truncate(path, int(keep * size) if isinstance(keep, float) else keep % size)
    assert check(path)
    digest_path(path).unlink()
    assert check(path)


def test_chunk_checksums_name_the_dataset(here):
    """With a digest that was made after the damage, Fletcher-32 still finds it and says where."""
    path = here / "dataset/shards/box.h5"
    path.chmod(0o644)
    with h5py.File(path, "r") as file:
        at = file["gt/depth_2x"].id.get_chunk_info(0).byte_offset
    data = bytearray(path.read_bytes())
    data[at + 30] ^= 1
    path.write_bytes(bytes(data))
    reseal(path)
    assert [p.where for p in check(path)] == ["/gt/depth_2x"]


def set_attr(name, value):
    return lambda f: f.attrs.__setitem__(name, value)


def set_array(name, index, value):
    return lambda f: f[name].__setitem__(index, value)


def delete(name):
    return lambda f: f.__delitem__(name)


def replaced(name, array):
    def change(file):
        units = file[name].attrs["units"]
        del file[name]
        file[name] = array
        file[name].attrs["units"] = units

    return change


SHARD_DAMAGE = {
    "version": (set_attr("version", 3), "version"),
    "foreign format": (set_attr("format", "x"), "format"),
    "units": (set_attr("units", "mm"), "units"),
    "rig": (set_attr("rig", "units = 'm'"), "rig"),
    "tof_info": (set_attr("tof_info", "{}"), "tof_info"),
    "scene": (set_attr("scene", "mug"), "scene"),
    "missing dataset": (delete("gt/mask_1x"), "/gt/mask_1x"),
    "half of an optional group": (delete("truth/depth_2x"), "/truth/depth_2x"),
    "dataset units": (lambda f: f["tof/depth"].attrs.__setitem__("units", "mm"), "/tof/depth"),
    "dtype": (replaced("views/index", np.zeros(1, np.int32)), "/views/index"),
    "shape": (replaced("tof/celsius", np.zeros((1, 3))), "/tof/celsius"),
    "zero depth": (set_array("tof/depth", (0, 3, 4), 0.0), "/tof/depth[0]"),
    "depth where not hit": (set_array("gt/mask_2x", (0, slice(None)), 1), "/gt/mask_2x[0]"),
    "unknown bit": (set_array("gt/mask_1x", (0, 0, 0), 33), "/gt/mask_1x[0]"),
    "not rigid": (set_array("views/T_base_tof", (0, 0, 0), 2.0), "/views/T_base_tof"),
    "time": (set_array("tof/time_ns", (0, 1), 0), "/tof/time_ns"),
    "blind sensor": (set_array("tof/raw", (0, 1), 0), "/tof/raw[0, 1]"),
}


@pytest.mark.parametrize("damage", SHARD_DAMAGE)
def test_broken_rules_of_a_shard_are_named(here, damage):
    """Every rule of the layout and of the arrays, broken one at a time, is reported at its place."""
    change, where = SHARD_DAMAGE[damage]
    path = here / "dataset/shards/box.h5"
    edit(path, change)
    assert where in {p.where for p in check(path)}


def test_normals_must_be_unit_and_face_the_camera(here):
    """Turned and stretched normals are two different problems."""
    path = here / "dataset/shards/box.h5"

    def turn(file):
        file["gt/normals_1x"][...] *= -1
        file["gt/normals_2x"][...] *= 2

    edit(path, turn)
    messages = {p.where: p.message for p in check(path)}
    assert "face the camera" in messages["/gt/normals_1x[0]"]
    assert "unit" in messages["/gt/normals_2x[0]"]


def test_half_measured_points_are_found(here):
    """A stereo point is finite as a whole or not at all."""
    path = here / "recording/views/box/view-000.h5"
    edit(path, set_array("stereo/points", (5, 5), [np.nan, 0.0, 1.0]))
    assert [p.where for p in check(path)] == ["/stereo/points"]


def test_a_view_in_the_wrong_place_is_found(here):
    """A view copied over another scene's is noticed."""
    views = here / "recording/views"
    shutil.copy(views / "box/view-000.h5", views / "gear/view-001.h5")
    reseal(views / "gear/view-001.h5")
    assert [p.where for p in check(here / "recording")] == ["scene"]


@pytest.mark.parametrize("content", [b"", b"text\n" * 50, b"\x89HDF\r\n\x1a\n" + b"\0" * 500])
def test_what_is_no_hdf5_is_found(here, content):
    """Empty files, text, and a signature followed by nothing."""
    path = here / "x.h5"
    path.write_bytes(content)
    assert check(path)
    assert check(here / "nothing there")
    assert check(here)[0].message.startswith("expected a recording")


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
    (dataset / "manifest.json").write_text(json.dumps(manifest))
    found = {(p.path.name, p.where) for p in check(dataset)}
    assert found == {
        ("manifest.json", "box"),
        ("gone.h5", ""),
        ("gear.h5", ""),
        ("stray.h5", ""),
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


def test_the_command(here):
    """`tofcapture check` exits with 0, 5 and 3 and speaks JSON."""

    def run(*args):
        done = subprocess.run(
            [sys.executable, "-m", "tofcapture", "check", *map(str, args), "--json"],
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, json.loads(done.stdout)

    assert run(here / "recording") == (
        0,
        {"path": str(here / "recording"), "ok": True, "files": 2, "problems": []},
    )
    (here / "dataset/shards/box.h5").chmod(0o644)
    os.truncate(here / "dataset/shards/box.h5", 5000)
    code, result = run(here / "dataset")
    assert (code, result["ok"]) == (5, False)
    assert all({"path", "where", "message", "hint"} == set(p) for p in result["problems"])
    assert run(here / "nowhere")[0] == 3


def test_simulated_views_of_other_poses_are_fine(tmp_path):
    """Another pose and no truth: still nothing to report."""
    path = tmp_path / "views/box/view-003.h5"
    write_view(path, replace(simulate("box", 3), truth=None))
    assert check(path) == []
