"""View files: bit-exact round trips, sealing, and errors that name the file."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.test_files_shard import write as write_shard
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.seal import sealed_digest, stored_digest
from tofcapture.files.view import open_view, read_depth_view, view_path, write_view
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth, View
from tofcapture.poses import exp
from tofcapture.rig import RangeError, Rig

TOF = Camera(8, 6, 7.1, 7.3, 3.4, 2.6)
STEREO = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)


def make_view(seed=0, *, ideal=False, truth=True, frames=2):
    rng = np.random.default_rng(seed)
    raw = rng.integers(0, 4096, (frames, 8, 6, 8)).astype(np.uint16)
    points = rng.normal(size=(12, 16, 3)).astype(np.float32) + np.float32([0, 0, 9])
    points[rng.random((12, 16)) < 0.3] = np.nan
    errors = (RangeError(20e6, 0.1, harmonics=((2, rng.normal(), -0.0012),)), RangeError(100e6, rng.normal()))
    info = TofInfo("tof", f"serial {seed}", TOF, rng.normal(size=3), range_errors=errors)
    T = [exp(0.3 * rng.normal(size=6)) for _ in range(4)]
    normals = rng.normal(size=(12, 16, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    known = Truth(
        rng.uniform(0.3, 2, (12, 16)).astype(np.float32),
        normals.astype(np.float32),
        rng.random((12, 16)) < 0.5,
        T[0],
        T[1],
    )
    return View(
        scene="mug",
        index=7,
        tof=TofBurst(
            raw.astype(np.float64) / 3 if ideal else raw,
            np.arange(frames) + seed,
            rng.normal(40, 3, frames),
            info,
        ),
        stereo=StereoFrame(points, 12345, StereoInfo("stereo", "s", STEREO)),
        arm_before=ArmState(rng.normal(size=6), T[2], 1),
        arm_after=ArmState(rng.normal(size=6), T[2], 2),
        rig=Rig(TOF, STEREO, T[0], T[3], range_errors=errors),
        provenance={"seed": seed, "nested": {"list": [1, 2.5, None]}},
        truth=known if truth else None,
    )


def same(a, b):
    """Bit by bit, NaN payloads included."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if hasattr(a, "__dataclass_fields__"):
        return all(same(getattr(a, k), getattr(b, k)) for k in a.__dataclass_fields__)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


@given(st.integers(0, 2**31), st.booleans(), st.booleans(), st.integers(1, 3))
@settings(max_examples=10)
def test_round_trip_is_bit_exact(tmp_path_factory, seed, ideal, truth, frames):
    """What is read back is what was written, to the last bit, raw dtype included."""
    view = make_view(seed, ideal=ideal, truth=truth, frames=frames)
    path = tmp_path_factory.mktemp("views") / "view-007.h5"
    write_view(path, view)
    assert same(open_view(path), view)


def test_the_same_view_gives_the_same_bytes(tmp_path):
    """Files are reproducible: no time stamps, no addresses."""
    digests = [write_view(tmp_path / name / "view-007.h5", make_view()) for name in "ab"]
    assert digests[0] == digests[1] == stored_digest(tmp_path / "a/view-007.h5")
    assert sealed_digest(tmp_path / "b/view-007.h5") == digests[0]


def test_view_path_is_confined():
    """Views lie in their scene's folder; names that climb out of it are refused."""
    assert view_path("rec", "mug-2", 7).as_posix() == "rec/views/mug-2/view-007.h5"
    for name in ("../mug", "", "a/b", ".hidden", "x" * 65):
        with pytest.raises(ConfigError, match="scene"):
            view_path("rec", name, 0)


def test_a_sealed_view_is_read_only_and_leaves_nothing_else(tmp_path):
    """Mode 0444, a digest beside it, no temporary file."""
    path = tmp_path / "view-007.h5"
    write_view(path, make_view())
    assert path.stat().st_mode & 0o777 == 0o444
    assert {p.name for p in tmp_path.iterdir()} == {"view-007.h5", "view-007.sha256"}


def test_a_killed_writer_leaves_no_view_and_the_next_one_goes_on(tmp_path):
    """What a killed writer left under the temporary name is replaced, and an older view by a newer one."""
    path = tmp_path / "view-007.h5"
    path.with_name("view-007.h5.partial").write_bytes(b"half a file")
    write_view(path, make_view(1))
    write_view(path, make_view(2))
    assert same(open_view(path), make_view(2))
    assert not path.with_name("view-007.h5.partial").exists()


@pytest.mark.parametrize("step", ["written", "verified", "sealed"])
def test_sigkill_at_any_step(tmp_path, step):
    """SIGKILL before the rename leaves no view under the final name; the next write succeeds and checks out."""
    path = tmp_path / "view-007.h5"
    code = f"""
import h5py, os, pathlib, signal, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
import test_files_view as t
die = lambda *a, **k: os.kill(os.getpid(), signal.SIGKILL)
if {step!r} == "written": h5py.File.__exit__ = die
if {step!r} == "verified": os.fsync = die
if {step!r} == "sealed":
    real = pathlib.Path.replace
    pathlib.Path.replace = lambda self, to: die() if str(to).endswith(".h5") else real(self, to)
t.write_view(pathlib.Path({str(path)!r}), t.make_view())
"""
    done = subprocess.run([sys.executable, "-c", code], check=False)
    assert done.returncode == -signal.SIGKILL
    assert not path.exists()
    write_view(path, make_view())
    assert same(open_view(path), make_view())
    assert sealed_digest(path) == stored_digest(path)


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    """An OSError while writing removes the temporary file and keeps the older view."""
    path = tmp_path / "view-007.h5"
    write_view(path, make_view(1))

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(h5py.Dataset, "__setitem__", full)
    with pytest.raises(OSError, match="No space"):
        write_view(path, make_view(2))
    assert same(open_view(path), make_view(1))
    assert not path.with_name("view-007.h5.partial").exists()


def test_depth_alone_is_z_of_the_whole(tmp_path):
    """Reading without x and y gives z bit by bit and everything else as it is."""
    view = make_view()
    write_view(tmp_path / "a.h5", view)
    with h5py.File(tmp_path / "a.h5") as file:
        assert file["stereo/points"].chunks[-1] == 1
    found, depth = read_depth_view(tmp_path / "a.h5")
    assert depth.tobytes() == np.ascontiguousarray(view.stereo.points[..., 2]).tobytes()
    assert np.isnan(found.stereo.points).all()
    assert same(replace(found, stereo=view.stereo), view)


def test_a_disk_that_lies_is_noticed(tmp_path, monkeypatch):
    """When what is read back differs, nothing is sealed."""
    real = h5py.Dataset.__setitem__
    monkeypatch.setattr(
        h5py.Dataset, "__setitem__", lambda self, part, data: real(self, part, np.zeros_like(data))
    )
    with pytest.raises(DataError, match="read back differs"):
        write_view(tmp_path / "view-007.h5", make_view())
    with pytest.raises(DataError, match="read back differs"):
        write_shard(tmp_path / "mug.h5")
    assert list(tmp_path.iterdir()) == []


def test_arrays_that_break_the_layout_are_refused(tmp_path):
    """A wrong dtype, and truth that does not fit the ToF camera, never reach the disk."""
    view = make_view()
    wrong = replace(view, tof=replace(view.tof, raw=view.tof.raw.astype(np.int32)))
    with pytest.raises(FormatError, match="tof/raw"):
        write_view(tmp_path / "a.h5", wrong)
    small = replace(view.truth, depth=view.truth.depth[:3])
    with pytest.raises(FormatError, match="truth/depth"):
        write_view(tmp_path / "a.h5", replace(view, truth=small))


@pytest.mark.parametrize(
    "damage", ["missing", "text", "empty", "truncated", "foreign", "version", "dataset", "chunk"]
)
def test_reading_names_what_is_wrong(tmp_path, damage):
    """Every kind of damage is a DataError that names the file."""
    path = tmp_path / "view-007.h5"
    write_view(path, make_view(frames=3))
    path.chmod(0o644)
    if damage == "missing":
        path.unlink()
    elif damage in ("text", "empty"):
        path.write_text("" if damage == "empty" else "not HDF5 at all\n" * 99)
    elif damage == "truncated":
        os.truncate(path, path.stat().st_size - 100)
    elif damage == "chunk":
        with h5py.File(path, "r") as file:
            at = file["tof/raw"].id.get_chunk_info(1).byte_offset
        data = bytearray(path.read_bytes())
        data[at + 20] ^= 4
        path.write_bytes(bytes(data))
    else:
        with h5py.File(path, "a") as file:
            if damage == "dataset":
                del file["arm/after/joints"]
            else:
                file.attrs["format" if damage == "foreign" else "version"] = (
                    "another" if damage == "foreign" else 99
                )
    with pytest.raises(DataError, match=r"view-007\.h5") as caught:
        open_view(path)
    expected = {"version": "version 1, got 99", "dataset": "arm/after/joints", "chunk": "/tof/raw is damaged"}
    assert expected.get(damage, "") in str(caught.value)
    assert isinstance(caught.value, FormatError) == (damage in ("foreign", "version", "dataset"))
