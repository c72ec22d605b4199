"""check() finds every kind of damage and never raises."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.sealed import delete, edit, replaced, reseal, set_array, set_attr, simulate
from tests.test_files_shard import write
from tofcapture.files.check import check
from tofcapture.files.seal import digest_path
from tofcapture.files.view import write_view


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
    "unknown flag": (set_array("tof/flags", (0, 0, 0), 128), "/tof/flags[0]"),
    "far": (set_array("tof/depth", (0, 3, 4), 31.0), "/tof/depth[0]"),
    "negative amplitude": (set_array("tof/confidence", (0, 3, 4), -1.0), "/tof/confidence[0]"),
    "hot": (set_array("tof/celsius", (0, 1), 200.0), "/tof/celsius"),
    "out of reach": (set_array("views/T_base_tof", (0, 0, 3), 25.0), "/views/T_base_tof"),
    "negative index": (set_array("views/index", 0, -1), "/views/index"),
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


FINE_DAMAGE = {
    "none": (lambda _: None, None),
    "depth missing": (delete("gt/depth_4x"), "/gt/depth_4x"),
    "mask missing": (delete("gt/mask_4x"), "/gt/mask_4x"),
    "only the mask": (lambda f: [delete(f"gt/{n}_4x")(f) for n in ("depth", "normals")], "/gt/normals_4x"),
    "shape": (replaced("gt/depth_4x", np.ones((2, 12, 16), np.float32)), "/gt/depth_4x"),
    "hit without depth": (set_array("gt/mask_4x", (1, slice(None)), 0), "/gt/mask_4x[1]"),
    "depth of zero": (set_array("gt/depth_4x", (1, 3, 4), 0.0), "/gt/depth_4x[1]"),
    "unit": (
        lambda f: f["gt/normals_4x"].__setitem__((...), 2 * f["gt/normals_4x"][()]),
        "/gt/normals_4x[0]",
    ),
    "all gone": (lambda f: [delete(f"gt/{n}_4x")(f) for n in ("depth", "normals", "mask")], None),
}


@pytest.mark.parametrize("damage", FINE_DAMAGE)
def test_ground_truth_at_four_times_obeys_the_same_rules(tmp_path, damage):
    """It is there whole or not at all, four times the image's size, depth where hit, unit normals."""
    change, where = FINE_DAMAGE[damage]
    path = tmp_path / "mug.h5"
    write(path, scales=(1, 2, 4))
    edit(path, change)
    found = {p.where for p in check(path)}
    assert where in found if where else not found


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
    told = [p.message for p in check(here / "recording")]
    assert told == ["passed over: a copy of box/view-000.h5"]


@pytest.mark.parametrize("content", [b"", b"text\n" * 50, b"\x89HDF\r\n\x1a\n" + b"\0" * 500])
def test_what_is_no_hdf5_is_found(here, content):
    """Empty files, text, and a signature followed by nothing."""
    path = here / "x.h5"
    path.write_bytes(content)
    assert check(path)
    assert check(here / "nothing there")
    assert check(here)[0].message.startswith("expected a recording")


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
    assert run(here / "nowhere")[0] == 5


def test_simulated_views_of_other_poses_are_fine(tmp_path):
    """Another pose and no truth: still nothing to report."""
    path = tmp_path / "views/box/view-003.h5"
    write_view(path, replace(simulate("box", 3), truth=None))
    assert check(path) == []


def test_random_damage_is_reported_and_never_read(tmp_path):
    """Thirty random corruptions: check reports each, readers raise named errors or give what was stored."""
    script = Path(__file__).parents[1] / "benchmarks/mutations.py"
    done = subprocess.run(
        [sys.executable, str(script), "--count", "30", "--seed", "1", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(done.stdout)
    assert (result["corruptions"], result["reported"]) == (30, 30)
    assert set(result["reads"]) == {"right", "named error"}, result
    assert result["reads"]["named error"] > 20
