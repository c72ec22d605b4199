"""Shards, manifests and layouts."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.sealed import delete, edit, replaced, reseal, set_attr
from tofcapture.camera import Camera
from tofcapture.errors import DataError, FormatError
from tofcapture.files.hdf import create, open_checked
from tofcapture.files.layout import SHARD, VIEW, MaskBit
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, object_of, write_manifest
from tofcapture.files.shard import ExactMaps, GroundTruth, Sample, ShardReader, ShardWriter, TofMaps
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.poses import exp
from tofcapture.rig import Rig

TOF = Camera(8, 6, 7.1, 7.3, 3.4, 2.6)
STEREO = Camera(16, 12, 15.0, 15.0, 7.5, 5.5)
INFO = TofInfo("tof", "1", TOF, np.array([0.007, 0, 0]))
RIG = Rig(TOF, STEREO, exp([-0.05, 0.07, 0, 0, 0.01, 0]), np.eye(4))


def truth_at(scale, rng):
    shape = TOF.scaled(scale).shape
    normals = np.zeros((*shape, 3), np.float32)
    normals[..., 2] = -1
    depth = rng.uniform(0.5, 1, shape).astype(np.float32)
    mask = rng.choice([0, 0, 4, 8, 16], shape).astype(np.uint8)
    missing = rng.random(shape) < 0.2
    depth[missing], normals[missing], mask[missing] = np.nan, np.nan, MaskBit.NOT_HIT | MaskBit.EDGE
    return GroundTruth(depth, normals, mask)


def make_sample(index, *, exact=True, scales=(1, 2)):
    rng = np.random.default_rng(index)
    plane = (1 / (1 + 0.2 * STEREO.rays[..., 0])).astype(np.float32)
    exact_maps = ExactMaps(rng.random((12, 16), np.float32) + 1, truth_at(2, rng).normals)
    return Sample(
        index=index,
        raw=rng.integers(0, 4096, (3, 8, 6, 8)).astype(np.uint16),
        celsius=rng.normal(40, 1, 3),
        time_ns=np.arange(3),
        tof=TofMaps(
            np.full((6, 8), 0.9, np.float32),
            rng.random((6, 8), np.float32),
            rng.integers(0, 16, (6, 8), np.uint8),
        ),
        native_depth=plane,
        ground_truth={scale: truth_at(scale, rng) for scale in scales},
        T_base_tof=exp(0.1 * rng.normal(size=6)),
        truth=exact_maps if exact else None,
    )


def write(path, indices=(0, 3), scene="mug", **kwargs):
    with ShardWriter(path, scene, RIG, INFO, StereoInfo("stereo", "2", STEREO), len(indices)) as shard:
        for i in indices:
            shard.add(make_sample(i, **kwargs))
        return shard.seal({"digest": "abc"})


def test_round_trip(tmp_path):
    """The reader gives back every array of every sample, bit by bit, and the descriptions."""
    path = tmp_path / "mug.h5"
    write(path)
    with ShardReader(path) as shard:
        assert (shard.scene, shard.views, shard.frames, shard.camera) == ("mug", 2, 3, TOF)
        assert shard.provenance == {"digest": "abc"}
        assert shard.stereo_info.camera == STEREO
        np.testing.assert_array_equal(shard.rig.T_tof_stereo, RIG.T_tof_stereo)
        np.testing.assert_array_equal(shard.info.illuminator, INFO.illuminator)
        for view, sample in enumerate(map(make_sample, (0, 3))):
            assert shard.index(view) == sample.index
            np.testing.assert_array_equal(shard.raw(view, 2), sample.raw[2])
            assert shard.raw(view, 2).dtype == np.uint16
            assert shard.celsius(view, 1) == sample.celsius[1]
            np.testing.assert_array_equal(shard.T_base_tof(view), sample.T_base_tof)
            np.testing.assert_array_equal(shard.native(view), sample.native_depth)
            for name in ("depth", "confidence", "flags"):
                np.testing.assert_array_equal(getattr(shard.tof(view), name), getattr(sample.tof, name))
            for scale in (1, 2):
                for name in ("depth", "normals", "mask"):
                    expected = getattr(sample.ground_truth[scale], name)
                    np.testing.assert_array_equal(getattr(shard.ground_truth(view, scale), name), expected)
            np.testing.assert_array_equal(shard.truth(view).depth, sample.truth.depth)


def test_ground_truth_at_four_times_where_it_was_built(tmp_path):
    """It comes back bit by bit; a shard without it says how to build it; views that disagree on it are refused."""
    path = tmp_path / "mug.h5"
    write(path, scales=(1, 2, 4))
    with ShardReader(path) as shard:
        assert shard.scales == (1, 2, 4)
        for view, sample in enumerate(make_sample(i, scales=(1, 2, 4)) for i in (0, 3)):
            for name in ("depth", "normals", "mask"):
                expected = getattr(sample.ground_truth[4], name)
                np.testing.assert_array_equal(getattr(shard.ground_truth(view, 4), name), expected)
        assert shard.points(0, 4).shape == (24, 32, 3)
    write(tmp_path / "box.h5", scene="box")
    with ShardReader(tmp_path / "box.h5") as shard:
        assert shard.scales == (1, 2)
        with pytest.raises(DataError, match="4x, it is there at 1x and 2x") as caught:
            shard.ground_truth(0, 4)
        assert "build-dataset RECORDING --out DATASET --scales 1 2 4" in caught.value.hint
    info = StereoInfo("stereo", "2", STEREO)
    with ShardWriter(tmp_path / "odd.h5", "odd", RIG, INFO, info, 2) as writer:
        writer.add(make_sample(0, scales=(1, 2, 4)))
        with pytest.raises(FormatError, match="gt/depth_4x"):
            writer.add(make_sample(1))


def test_derived_arrays(tmp_path):
    """Points and normals that are not stored follow from depth and intrinsics."""
    path = tmp_path / "mug.h5"
    write(path, exact=False)
    with ShardReader(path) as shard:
        assert shard.truth(0) is None
        np.testing.assert_allclose(shard.native_points(0)[..., 2], shard.native(0))
        assert shard.points(0, 2).shape == (12, 16, 3)
        assert shard.tof_points(0).shape == (6, 8, 3)
        facing = np.einsum("hwc,hwc->hw", shard.tof_normals(0), TOF.rays) < 0
        assert facing.all()
        n = np.array([-0.2, 0, -1.0]) / np.sqrt(1.04)
        np.testing.assert_allclose(shard.native_normals(0)[6, 8], n, atol=1e-5)


def test_chunks_are_what_a_training_read_touches(tmp_path):
    """One frame of raw is one chunk, and every chunk carries a checksum."""
    path = tmp_path / "mug.h5"
    write(path, scales=(1, 2, 4))
    with h5py.File(path, "r") as file:
        assert file["tof/raw"].chunks == (1, 1, 8, 6, 8)
        assert file["gt/normals_2x"].chunks == (1, 12, 16, 3)
        there = [f for f in SHARD if not f.path.startswith("fused/")]  # of views built one by one
        assert all(file[f.path].fletcher32 for f in there if f.chunk)
        assert all(file[f.path].attrs["units"] == f.units for f in there)


@pytest.mark.parametrize("filters", ["as written", "others", "another burst"])
def test_a_burst_is_copied_as_it_is_packed(tmp_path, filters):
    """The shard is the same with and without the view file, however that one is packed; a burst of another view is noticed."""
    sample, view = make_sample(0), tmp_path / "view-000.h5"
    with h5py.File(view, "w") as file:
        field = VIEW["tof/raw"]
        raw = sample.raw + np.uint16(filters == "another burst")
        file.attrs.update(format=VIEW.format, version=VIEW.version)
        if filters == "others":
            file.create_dataset(field.path, data=raw, chunks=(3, 8, 6, 8), compression="lzf")
        else:
            create(file, field, raw.shape, raw.dtype)[...] = raw
    digests = []
    for name, path in (("a", None), ("b", view)):
        with ShardWriter(
            tmp_path / name / "mug.h5", "mug", RIG, INFO, StereoInfo("s", "2", STEREO), 1
        ) as shard:
            shard.add(sample, path)
            if path and filters == "another burst":
                with pytest.raises(DataError, match="/tof/raw read back differs"):
                    shard.seal({})
                return
            digests.append(shard.seal({}))
    assert digests[0] == digests[1]


def _raw_sum(reader, queue=None):
    total = int(reader.raw(1, 2).sum())
    if queue is not None:
        queue.put(total)
    return total


def test_open_files_hold_no_chunks(tmp_path):
    """A chunk is a frame, read whole: a cache of chunks would hold megabytes of every open shard for nothing."""
    path = tmp_path / "scene.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update(format=SHARD.format, version=SHARD.version)
        file.create_dataset("a", data=np.zeros((2, 64, 64)), chunks=(1, 64, 64))
    with open_checked(path, SHARD) as file:
        assert file["a"].id.get_access_plist().get_chunk_cache()[1] == 0


def test_the_reader_pickles_and_survives_a_fork(tmp_path):
    """A reader in use can go to a worker by pickle or by fork; both read the same."""
    path = tmp_path / "mug.h5"
    write(path)
    reader = ShardReader(path)
    expected = _raw_sum(reader)
    assert _raw_sum(pickle.loads(pickle.dumps(reader))) == expected  # noqa: S301
    if hasattr(os, "fork"):
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        children = [context.Process(target=_raw_sum, args=(reader, queue)) for _ in range(3)]
        for child in children:
            child.start()
        assert {_raw_sum(reader) for _ in range(50)} == {expected}  # while the others read
        assert {queue.get() for _ in children} == {expected}
        for child in children:
            child.join()
    assert _raw_sum(reader) == expected
    reader.close()
    assert _raw_sum(reader) == expected
    reader.close()


def test_samples_that_do_not_fit_are_refused_and_leave_nothing(tmp_path):
    """A sample of another shape, a missing one and one too many; no file remains."""
    path = tmp_path / "mug.h5"
    info = StereoInfo("stereo", "2", STEREO)
    for bad in (
        replace(make_sample(1), raw=np.zeros((2, 8, 6, 8), np.uint16)),
        replace(make_sample(1), truth=None),
        replace(make_sample(1), native_depth=np.zeros((12, 16))),
    ):
        with ShardWriter(path, "mug", RIG, INFO, info, 2) as shard:
            shard.add(make_sample(0))
            with pytest.raises(FormatError):
                shard.add(bad)
    with ShardWriter(path, "mug", RIG, INFO, info, 2) as shard:
        shard.add(make_sample(0))
        with pytest.raises(FormatError, match="expected 2 samples, got 1"):
            shard.seal({})
    assert list(tmp_path.iterdir()) == []


def test_reading_what_is_not_there(tmp_path):
    """No file, a foreign file, and a view past the end are named."""
    path = tmp_path / "mug.h5"
    with pytest.raises(DataError, match="found nothing"):
        ShardReader(path).views  # noqa: B018
    write(path)
    with ShardReader(path) as shard, pytest.raises(DataError, match="asked for"):
        shard.raw(2, 0)
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(FormatError, match="format"):
        ShardReader(tmp_path / "foreign.h5").scene  # noqa: B018


def garble_a_chunk(path):
    with h5py.File(path) as file:
        at = file["gt/depth_2x"].id.get_chunk_info(1).byte_offset
    data = bytearray(path.read_bytes())
    data[at + 30] ^= 1
    path.write_bytes(data)


WRONG = {
    "attribute gone": (lambda f: f.attrs.__delitem__("tof_info"), "the attribute 'tof_info', cannot read it"),
    "attribute no text": (set_attr("tof_info", 3), "the attribute 'tof_info' to be text, got int"),
    "attribute no JSON": (set_attr("tof_info", "{"), "'tof_info' is not JSON"),
    "no camera": (set_attr("tof_info", "{}"), "tof_info does not describe a ToF camera: KeyError"),
    "no stereo camera": (set_attr("stereo_info", "{}"), "stereo_info does not describe a stereo camera"),
    "rig": (set_attr("rig", "units = 'mm'"), "rig"),
    "dataset gone": (delete("gt/depth_2x"), "expected the dataset /gt/depth_2x, found none"),
    "dtype": (replaced("gt/depth_2x", np.ones((2, 12, 16))), "/gt/depth_2x: expected float32, got float64"),
    "chunk": (garble_a_chunk, r"/gt/depth_2x\[1\] is damaged"),
}


@pytest.mark.parametrize("case", WRONG)
def test_errors_of_the_reader_name_file_and_place(tmp_path, case):
    """Whatever is wrong in a file whose digest is right, the message says where; nothing is guessed."""
    change, said = WRONG[case]
    path = tmp_path / "mug.h5"
    write(path)
    if case == "chunk":
        path.chmod(0o644)
        change(path)
        reseal(path)
    else:
        edit(path, change)
    with pytest.raises(DataError, match=said) as caught, ShardReader(path) as shard:
        _ = shard.info, shard.stereo_info, shard.rig, shard.ground_truth(1, 2)
    assert str(path) in caught.value.message
    assert isinstance(caught.value, FormatError) == (case != "chunk")


def test_manifest_round_trip_and_validation(tmp_path):
    """A manifest comes back as written; damage and unknown splits are named."""
    manifest = Manifest(
        {
            "mug": SceneEntry("shards/mug.h5", "ab", 3, "train"),
            "box": SceneEntry("shards/box.h5", "cd", 2, "test"),
        },
        {"far": 2.0},
        {"tofcapture": "0"},
    )
    write_manifest(tmp_path, manifest)
    assert load_manifest(tmp_path) == manifest
    assert list(manifest.split("test")) == ["box"]
    path = tmp_path / "manifest.json"
    good = json.loads(path.read_text())
    for bad in (
        "{",
        "[]",
        json.dumps({**good, "version": 2}),
        json.dumps({**good, "config": {}}),
        json.dumps({**good, "scenes": {"mug": {"path": "x"}}}),
        json.dumps({**good, "scenes": {"m": {"path": "x", "sha256": "", "views": 1, "split": "dev"}}}),
        json.dumps({**good, "scenes": {"m": {"path": "../x", "sha256": "", "views": 1, "split": "val"}}}),
    ):
        path.write_text(bad)
        with pytest.raises(DataError, match=r"manifest\.json"):
            load_manifest(tmp_path)
    path.unlink()
    with pytest.raises(DataError, match="expected a dataset"):
        load_manifest(tmp_path)


def test_reading_needs_numpy_and_h5py_only():
    """Importing readers, checks and light ops loads nothing that a reader of the data does not have."""
    code = """
import sys
import tofcapture.files.shard, tofcapture.files.view, tofcapture.files.manifest, tofcapture.files.check
import tofcapture.ops.phase, tofcapture.ops.normals
print(sorted({"scipy", "torch", "open3d", "tomli_w", "matplotlib", "cv2", "jinja2"} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_objects_of_scenes():
    """A trailing number is another scene of the same object, except for random combinations."""
    names = ["mug", "mug-2", "mug-12", "065-a_cups", "random-1", "random-2"]
    assert [object_of(n) for n in names] == ["mug", "mug", "mug", "065-a_cups", "random-1", "random-2"]
