"""Exports hold what the shards hold: PLY, 16-bit PNG and MCAP, read back by other programs; resumed; atomic."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.test_dataset_card import make
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.dataset import export as exporting
from tofcapture.dataset.export import UNIT, check_export, export
from tofcapture.dataset.export_mcap import image_of, quaternion
from tofcapture.dataset.export_ply import parse_ply, ply_bytes, ply_points, pose_comment
from tofcapture.dataset.export_png import quantise
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.png import png_bytes
from tofcapture.files.shard import ShardReader
from tofcapture.o3d import load_open3d
from tofcapture.poses import exp


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Three scenes of two views."""
    return make(tmp_path_factory.mktemp("export") / "data")


def test_ply_round_trip(dataset, tmp_path):
    """Points, normals, mask and pose come back bit by bit, and Open3D reads the same file."""
    done = export(dataset, "ply", tmp_path)
    assert (done.files, done.written) == (6, ("box", "gear-2", "mug"))
    with ShardReader(dataset / "shards/mug.h5") as shard:
        path = tmp_path / "mug/view-001.ply"
        points, comments = parse_ply(path.read_bytes())
        np.testing.assert_array_equal(points, ply_points(shard, 1))
        gt = shard.ground_truth(1, 2)
        hit = np.isfinite(gt.depth)
        np.testing.assert_array_equal(points["z"], gt.depth[hit])
        np.testing.assert_array_equal(points["mask"], gt.mask[hit])
        pixels, _ = shard.camera.scaled(2).project(np.stack([points[c] for c in "xyz"], axis=-1))
        np.testing.assert_allclose(pixels, np.argwhere(hit)[:, ::-1], atol=1e-4)
        pose = np.array([float(x) for x in comments[-1].split()[1:]]).reshape(4, 4)
        np.testing.assert_array_equal(pose, shard.T_base_tof(1))
        assert pose_comment(pose) == comments[-1]
    cloud = load_open3d().io.read_point_cloud(str(path))
    np.testing.assert_array_equal(
        np.asarray(cloud.points, np.float32), np.stack([points[c] for c in "xyz"], -1)
    )
    np.testing.assert_array_equal(
        np.asarray(cloud.normals, np.float32), np.stack([points[c] for c in ("nx", "ny", "nz")], -1)
    )


@pytest.mark.parametrize(
    "damage", [lambda d: d[:-1], lambda d: d.replace(b"float x", b"double x"), lambda _: b""]
)
def test_a_foreign_or_cut_ply_is_refused(dataset, damage):
    """Another header, or fewer bytes than it promises."""
    with ShardReader(dataset / "shards/mug.h5") as shard:
        data = ply_bytes(ply_points(shard, 0), ["x"])
    with pytest.raises(FormatError, match="PLY"):
        parse_ply(damage(data))


def test_png_round_trip(dataset, tmp_path):
    """OpenCV reads depth to half a step, none as 0, and the mask exactly; the JSON beside it has unit, intrinsics and poses."""
    export(dataset, "png16", tmp_path)
    table = json.loads((tmp_path / "mug/cameras.json").read_text())
    assert (table["unit_m"], table["none"]) == (UNIT, 0)
    with ShardReader(dataset / "shards/mug.h5") as shard:
        gt, tof = shard.ground_truth(1, 2), shard.tof(1)
        assert table["depth"]["fx"] == shard.camera.scaled(2).fx
        np.testing.assert_array_equal(table["views"][1]["T_base_tof"], shard.T_base_tof(1))
    for name, depth in (("depth", gt.depth), ("tof", tof.depth)):
        read = cv2.imread(str(tmp_path / f"mug/{name}-001.png"), cv2.IMREAD_UNCHANGED)
        assert read.dtype == np.uint16
        np.testing.assert_array_equal(read == 0, np.isnan(depth))
        known = read > 0
        np.testing.assert_allclose(read[known] * table["unit_m"], depth[known], rtol=0, atol=UNIT / 2 + 1e-7)
    mask = cv2.imread(str(tmp_path / "mug/mask-001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, gt.mask)
    assert b"unit_m\x000.000125" in (tmp_path / "mug/depth-001.png").read_bytes()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from([np.uint8, np.uint16]), st.integers(1, 9), st.integers(1, 9))
def test_any_picture_survives_png(seed, dtype, H, W):
    """OpenCV gives back every value of any image."""
    image = np.random.default_rng(seed).integers(0, np.iinfo(dtype).max + 1, (H, W)).astype(dtype)
    read = cv2.imdecode(np.frombuffer(png_bytes(image, {"a": "b"}), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(read, image)


@pytest.mark.parametrize("depth", [8.2, 1e-5])
def test_a_depth_that_does_not_fit_is_refused(depth):
    """Too far for 16 bits, or so near that it would read as none."""
    with pytest.raises(DataError, match="in steps of") as info:
        quantise(np.array([[depth, np.nan]]), UNIT, "x")
    assert "--unit" in info.value.hint


def test_mcap_round_trip(dataset, tmp_path):
    """mcap's own reader gives back every bit of every image, the calibration and the pose, at the frames' times."""
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    export(dataset, "mcap", tmp_path)
    with (tmp_path / "mug/mug.mcap").open("rb") as file:
        rows = list(reader.make_reader(file).iter_messages())
    found = {(c.topic, m.sequence): (m.log_time, s.name, json.loads(m.data)) for s, c, m in rows}
    assert len(found) == len(rows) == 16
    with ShardReader(dataset / "shards/mug.h5") as shard:
        for view in range(2):
            tof, gt = shard.tof(view), shard.ground_truth(view, 2)
            images = {"/tof/depth": tof.depth, "/tof/confidence": tof.confidence, "/tof/flags": tof.flags}
            images |= {"/gt/depth": gt.depth, "/gt/mask": gt.mask}
            for topic, image in images.items():
                time, schema, message = found[topic, view]
                assert (time, schema) == (shard.time_ns(view, 0), "foxglove.RawImage")
                np.testing.assert_array_equal(image_of(message), image)
            assert found["/gt/calibration", view][2]["K"][0] == shard.camera.scaled(2).fx
            pose = found["/tf", view][2]
            np.testing.assert_allclose(list(pose["translation"].values()), shard.T_base_tof(view)[:3, 3])


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3.2, 3.2), min_size=3, max_size=3))
def test_quaternions_are_rotations(w):
    """The matrix of the quaternion is the one that it was made from, half turns included."""
    R = exp([*w, 0.0, 0.0, 0.0])[:3, :3]
    x, y, z, s = quaternion(R)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    again = np.eye(3) + 2 * s * cross + 2 * cross @ cross
    np.testing.assert_allclose(again, R, atol=1e-9)
    assert np.hypot(np.hypot(x, y), np.hypot(z, s)) == pytest.approx(1)
    assert s >= 0


def test_an_export_goes_on_where_it_was_killed(dataset, tmp_path, monkeypatch):
    """Finished scenes are kept; a file that was damaged or lost since is written again; nothing half-written stays."""
    real, started = exporting.EXPORTERS["ply"], []

    def dies_at_mug(shard, folder, unit):
        started.append(shard.scene)
        if shard.scene == "mug":
            raise KeyboardInterrupt
        return real(shard, folder, unit)

    monkeypatch.setattr(exporting, "EXPORTERS", {"ply": dies_at_mug})
    with pytest.raises(KeyboardInterrupt):
        export(dataset, "ply", tmp_path)
    monkeypatch.undo()
    assert export(dataset, "ply", tmp_path).written == ("mug",)
    check_export(tmp_path)
    (tmp_path / "box/view-000.ply").write_bytes(b"ply")
    with pytest.raises(DataError, match="box"):
        check_export(tmp_path)
    assert export(dataset, "ply", tmp_path).written == ("box",)
    assert not list(tmp_path.rglob("*.partial"))
    with pytest.raises(FormatError, match="expected"):
        export(dataset, "png16", tmp_path)
    with pytest.raises(ConfigError):
        export(dataset, "stl", tmp_path / "other")


def test_the_command(dataset, tmp_path, capsys):
    """It takes one shard as well, and says files, size and time; the second time nothing is written."""
    line = [
        "export-dataset",
        str(dataset / "shards/box.h5"),
        "--format",
        "png16",
        "--out",
        str(tmp_path / "x"),
    ]
    assert main([*line, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["scenes"], answer["written"], answer["files"]) == (["box"], ["box"], 7)
    assert answer["bytes"] == sum(p.stat().st_size for p in (tmp_path / "x/box").iterdir())
    assert main(line) == 0
    assert "0 scenes written" in capsys.readouterr().out


def test_png_is_what_a_decoder_reads():
    """16-bit grey, 8-bit colour and colour tables survive another library's decoder."""
    grey = np.random.default_rng(0).integers(0, 65536, (7, 5), dtype=np.uint16)
    colour = np.random.default_rng(0).integers(0, 256, (7, 5, 3), dtype=np.uint8)
    for image, back in ((grey, slice(None)), (colour, (..., slice(None, None, -1)))):
        data = np.frombuffer(png_bytes(image), np.uint8)
        assert (cv2.imdecode(data, cv2.IMREAD_UNCHANGED)[back] == image).all()
    table = np.random.default_rng(1).integers(0, 256, (256, 3), dtype=np.uint8)
    indices = (grey >> 8).astype(np.uint8)
    data = np.frombuffer(png_bytes(indices, colours=table, level=9), np.uint8)
    assert (cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] == table[indices]).all()


def test_a_lens_is_told_as_plumb_bob():
    """Foxglove and ROS have the same five coefficients in the same order; a pinhole has zeros."""
    from tofcapture.dataset.export_mcap import _calibration

    lens = (-0.18, 0.05, 0.001, -0.0008, 0.002)
    told = _calibration(Camera(240, 180, 190.0, 200.0, 117.0, 101.0, lens))
    assert (told["distortion_model"], told["D"]) == ("plumb_bob", list(lens))
    assert _calibration(Camera(240, 180, 190.0, 200.0, 117.0, 101.0))["D"] == [0.0] * 5
