"""Exports hold what the shards hold: PLY, 16-bit PNG and MCAP, read back by other programs; resumed; atomic."""

from __future__ import annotations

import base64
import json

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.test_dataset_card import make
from tests.test_files_shard import write
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.colours import png_bytes
from tofcapture.dataset.export import UNIT, export
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.shard import ShardReader
from tofcapture.libraries import load_open3d


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Three scenes of two views."""
    return make(tmp_path_factory.mktemp("export") / "data")


def test_ply_round_trip(dataset, tmp_path):
    """Open3D reads points and normals bit by bit, one a pixel; mask and pose come back too."""
    done = export(dataset, "ply", tmp_path)
    assert (done.files, done.written) == (6, ("box", "gear-2", "mug"))
    path = tmp_path / "mug/view-001.ply"
    cloud = load_open3d().io.read_point_cloud(str(path))
    points, normals = (np.asarray(a) for a in (cloud.points, cloud.normals))
    head, _, body = path.read_bytes().partition(b"end_header\n")
    comments = [line.split() for line in head.decode().splitlines() if line.startswith("comment T_base_tof")]
    with ShardReader(dataset / "shards/mug.h5") as shard:
        gt = shard.ground_truth(1, 2)
        hit = np.isfinite(gt.depth)
        np.testing.assert_array_equal(points[:, 2].astype(np.float32), gt.depth[hit])
        np.testing.assert_array_equal(normals.astype(np.float32), gt.normals[hit])
        np.testing.assert_array_equal(
            np.frombuffer(body, np.uint8).reshape(hit.sum(), -1)[:, -1], gt.mask[hit]
        )
        pixels, _ = shard.camera.scaled(2).project(points)
        np.testing.assert_allclose(pixels, np.argwhere(hit)[:, ::-1], atol=1e-4)
        pose = np.array([float(x) for x in comments[0][2:]]).reshape(4, 4)
        np.testing.assert_array_equal(pose, shard.T_base_tof(1))


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


@pytest.mark.parametrize("unit", [1e-5, 2.0])
def test_a_depth_that_does_not_fit_is_refused(dataset, tmp_path, unit):
    """Too far for 16 bits, or so near that it would read as none."""
    with pytest.raises(DataError, match="in steps of") as info:
        export(dataset, "png16", tmp_path, unit=unit)
    assert "--unit" in info.value.hint


def mcap_messages(path):
    reader = pytest.importorskip("mcap.reader", reason="mcap is not installed")
    with path.open("rb") as file:
        return [
            (c.topic, m.sequence, m.log_time, s.name, json.loads(s.data), json.loads(m.data))
            for s, c, m in reader.make_reader(file).iter_messages()
        ]


def test_mcap_round_trip(dataset, tmp_path):
    """mcap's own reader gives back every bit of every image, the calibration and the pose, at the frames' times."""
    export(dataset, "mcap", tmp_path)
    rows = mcap_messages(tmp_path / "mug/mug.mcap")
    found = {(topic, view): (time, schema, message) for topic, view, time, schema, _, message in rows}
    assert len(found) == len(rows) == 16
    for _, _, _, _, schema, message in rows:
        assert set(message) == set(schema["properties"])
    kinds = {"32FC1": "<f4", "8UC1": "u1"}
    with ShardReader(dataset / "shards/mug.h5") as shard:
        for view in range(2):
            tof, gt = shard.tof(view), shard.ground_truth(view, 2)
            images = {"/tof/depth": tof.depth, "/tof/confidence": tof.confidence, "/tof/flags": tof.flags}
            images |= {"/gt/depth": gt.depth, "/gt/mask": gt.mask}
            for topic, image in images.items():
                time, schema, message = found[topic, view]
                assert (time, schema) == (shard.time_ns(view, 0), "foxglove.RawImage")
                read = np.frombuffer(base64.b64decode(message["data"]), kinds[message["encoding"]])
                np.testing.assert_array_equal(read.reshape(message["height"], message["width"]), image)
            told = found["/gt/calibration", view][2]
            assert (told["K"][0], told["D"]) == (shard.camera.scaled(2).fx, [0.0] * 5)
            pose = found["/tf", view][2]
            np.testing.assert_allclose(list(pose["translation"].values()), shard.T_base_tof(view)[:3, 3])
            turned = Rotation.from_quat([pose["rotation"][c] for c in "xyzw"]).as_matrix()
            np.testing.assert_allclose(turned, shard.T_base_tof(view)[:3, :3], atol=1e-12)


def test_a_lens_is_told_as_plumb_bob(tmp_path, monkeypatch):
    """Foxglove and ROS have the same five coefficients in the same order."""
    lens = (-0.18, 0.05, 0.001, -0.0008, 0.002)
    monkeypatch.setattr(ShardReader, "camera", Camera(8, 6, 7.1, 7.3, 3.4, 2.6, lens))
    write(tmp_path / "mug.h5")
    export(tmp_path / "mug.h5", "mcap", tmp_path / "out")
    told = next(
        row[-1] for row in mcap_messages(tmp_path / "out/mug/mug.mcap") if row[0] == "/tof/calibration"
    )
    assert (told["distortion_model"], told["D"]) == ("plumb_bob", list(lens))


def test_an_export_goes_on_where_it_was_killed(dataset, tmp_path):
    """Finished scenes are kept; a file that was damaged or lost since is written again; nothing half-written stays."""

    def dies_after(name):
        def progress(scene, _done, _total):
            if scene == name:
                raise KeyboardInterrupt

        return progress

    with pytest.raises(KeyboardInterrupt):
        export(dataset, "ply", tmp_path, progress=dies_after("gear-2"))
    assert export(dataset, "ply", tmp_path).written == ("mug",)
    (tmp_path / "box/view-000.ply").write_bytes(b"ply")
    (tmp_path / "mug/view-001.ply").unlink()
    assert export(dataset, "ply", tmp_path).written == ("box", "mug")
    assert export(dataset, "ply", tmp_path).written == ()
    assert not list(tmp_path.rglob("*.partial"))
    with pytest.raises(FormatError, match="expected"):
        export(dataset, "png16", tmp_path)
    with pytest.raises(ConfigError):
        export(dataset, "stl", tmp_path / "other")


def test_the_command(dataset, tmp_path, capsys):
    """It takes one shard as well, and says files, size and time; the second time nothing is written."""
    out = tmp_path / "x"
    line = ["export-dataset", str(dataset / "shards/box.h5"), "--format", "png16", "--out", str(out)]
    assert main([*line, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["scenes"], answer["written"], answer["files"]) == (["box"], ["box"], 7)
    assert answer["bytes"] == sum(p.stat().st_size for p in (out / "box").iterdir())
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
