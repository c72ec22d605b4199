"""Exports hold what the shards hold: PLY, 16-bit PNG and MCAP, read back by other programs; resumed; atomic."""

from __future__ import annotations

import base64
import json
from dataclasses import replace

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
from tofcapture.files.manifest import load_manifest, write_manifest
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
    assert "; 0 written in" in capsys.readouterr().out


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


def test_a_bop_folder_is_what_its_format_says(dataset, tmp_path):
    """Steps times ``depth_scale`` are the sensor's millimetres; points go by K and the pose to where the base has them."""
    export(dataset, "bop", tmp_path)
    assert sorted(p.parent.name + "/" + p.name for p in tmp_path.glob("*/0*")) == [
        "test/000000",
        "train/000000",
        "train/000001",
    ]
    scene = tmp_path / "train/000001"  # mug: gear-2 comes before it
    tables = [bop_table(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info")]
    assert tables[1] == tables[2] == {0: [], 1: []}
    told = tables[0][1]
    R, t, K = (np.array(told[k]) for k in ("cam_R_w2c", "cam_t_w2c", "cam_K"))
    with ShardReader(dataset / "shards/mug.h5") as shard:
        depths = {"depth": shard.tof(1).depth, "depth_gt": shard.ground_truth(1, 1).depth}
        for name, depth in depths.items():
            read = bop_depth(scene / f"{name}/000001.png") * told["depth_scale"]
            np.testing.assert_array_equal(read == 0, np.isnan(depth))
            np.testing.assert_allclose(read[read > 0], 1000 * depth[read > 0], atol=UNIT * 500 + 1e-4)
        in_base = (shard.T_base_tof(1) @ [0.02, -0.01, 0.5, 1])[:3] * 1000
        seen = K.reshape(3, 3) @ (R.reshape(3, 3) @ in_base + t)
        np.testing.assert_allclose(
            seen[:2] / seen[2], shard.camera.project(np.array([0.02, -0.01, 0.5]))[0], atol=1e-9
        )
    camera = json.loads((tmp_path / "camera.json").read_text())
    assert (camera["fx"], camera["depth_scale"]) == (told["cam_K"][0], told["depth_scale"])
    assert "train/000001: mug" in (tmp_path / "dataset_info.md").read_text()


def bop_table(path):
    """As bop_toolkit loads it, by bop_toolkit where it is installed: numbers for keys."""
    try:
        from bop_toolkit_lib import inout
    except ImportError:
        return {int(k): v for k, v in json.loads(path.read_text()).items()}
    return inout.load_json(path, keys_to_int=True)


def bop_depth(path):
    try:
        from bop_toolkit_lib import inout
    except ImportError:
        read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert read.dtype == np.uint16
        return read.astype(np.float32)
    return inout.load_depth(path)


def test_bop_toolkit_reads_it(dataset, tmp_path):
    """Its own loaders of cameras, objects' poses and pictures."""
    inout = pytest.importorskip("bop_toolkit_lib.inout", reason="bop_toolkit is not on PyPI")
    export(dataset, "bop", tmp_path)
    scene = tmp_path / "train/000000"
    assert inout.load_scene_camera(scene / "scene_camera.json")[1]["cam_K"].shape == (3, 3)
    assert inout.load_scene_gt(scene / "scene_gt.json") == {0: [], 1: []}
    assert inout.load_cam_params(tmp_path / "camera.json")["im_size"] == (8, 6)
    assert inout.load_im(scene / "gray/000000.png").shape == (6, 8)


def test_a_lens_is_taken_out_of_bop(tmp_path, monkeypatch):
    """A plane seen through a lens is a plane again: points that K gives lie on it to the nearest pixel."""
    lens = Camera(64, 48, 50.0, 50.0, 31.2, 23.4, (-0.3, 0.08, 0.001, -0.001, 0.0))
    rays = lens.rays
    plane = 0.6 / (rays @ [0.3, -0.2, 1.0])
    from tofcapture.dataset.export.pictures import _rectified

    straight, rectified = _rectified(lens)
    points = straight.unproject(rectified(plane))
    inside = points[..., 2] > 0
    assert inside.mean() > 0.8
    off = points[inside] @ [0.3, -0.2, 1.0] - 0.6
    naive = straight.unproject(plane)[inside] @ [0.3, -0.2, 1.0] - 0.6
    assert np.abs(off).max() < 0.01 < np.abs(naive).max()


def test_a_scene_that_moves_is_written_again(dataset, tmp_path):
    """A numbered folder holds one dataset; a new scene moves others, nothing of the old numbering stays."""
    folder = make(tmp_path / "data")
    out = tmp_path / "out"
    export(folder, "bop", out)
    manifest = load_manifest(folder)
    moved = replace(manifest.scenes["gear-2"], split="val")
    write_manifest(folder, replace(manifest, scenes={**manifest.scenes, "gear-2": moved}))
    assert export(folder, "bop", out).written == ("gear-2", "mug")
    assert sorted(p.parent.relative_to(out).as_posix() for p in out.glob("*/*/scene_gt.json")) == [
        "test/000000",
        "train/000000",
        "val/000000",
    ]
    assert export(folder, "bop", out).written == ()
    with pytest.raises(FormatError, match="got also box, gear-2"):
        export(folder / "shards/mug.h5", "bop", out)


def test_nerfstudio_sees_the_points_where_they_are(dataset, tmp_path):
    """Its convention, y up, z backwards, centres at halves: a depth's point is the base's, to float32 millimetres."""
    export(dataset, "nerfstudio", tmp_path)
    table = json.loads((tmp_path / "mug/transforms.json").read_text())
    frame = table["frames"][1]
    depth = np.load(tmp_path / "mug" / frame["depth_file_path"]) * 1e-3  # the parser's default factor
    v, u = np.argwhere(depth > 0)[-1]
    z = depth[v, u]
    ray = [(u + 0.5 - table["cx"]) / table["fl_x"], -(v + 0.5 - table["cy"]) / table["fl_y"], -1]
    in_base = np.array(frame["transform_matrix"]) @ [*(z * np.array(ray)), 1]
    with ShardReader(dataset / "shards/mug.h5") as shard:
        expected = shard.T_base_tof(1) @ [*shard.points(1, 1)[v, u], 1]
    np.testing.assert_allclose(in_base, expected, atol=1e-6)
    assert cv2.imread(str(tmp_path / "mug" / frame["file_path"]), cv2.IMREAD_UNCHANGED).shape == depth.shape


def test_nerfstudio_parses_it(dataset, tmp_path):
    """Its own parser gives back poses, focal lengths and as many depths as images."""
    parser = pytest.importorskip("nerfstudio.data.dataparsers.nerfstudio_dataparser")
    export(dataset, "nerfstudio", tmp_path)
    config = parser.NerfstudioDataParserConfig(
        data=tmp_path / "mug",
        orientation_method="none",
        center_method="none",
        auto_scale_poses=False,
        eval_mode="all",
        load_3D_points=False,
    )
    found = config.setup().get_dataparser_outputs("train")
    with ShardReader(dataset / "shards/mug.h5") as shard:
        T, camera = shard.T_base_tof(1), shard.camera
    np.testing.assert_allclose(found.cameras.camera_to_worlds[1, :, 3], T[:3, 3], atol=1e-6)
    np.testing.assert_allclose(found.cameras.fx[0], camera.fx, rtol=1e-6)
    assert len(found.metadata["depth_filenames"]) == len(found.image_filenames) == 2


def test_a_rational_lens_is_refused_by_nerfstudio(tmp_path, monkeypatch):
    lens = (0.1, 0.0, 0.0, 0.0, 0.0, 0.2, 0.0, 0.0)
    monkeypatch.setattr(ShardReader, "camera", Camera(8, 6, 7.1, 7.3, 3.4, 2.6, lens))
    write(tmp_path / "mug.h5")
    with pytest.raises(ConfigError, match="no rational lens") as info:
        export(tmp_path / "mug.h5", "nerfstudio", tmp_path / "out")
    assert "--format bop" in info.value.hint


def test_datasets_reads_every_bit(dataset, tmp_path, monkeypatch):
    """Hugging Face's library finds splits, shapes and dtypes; raw taps, maps, NaN and poses come back as they were."""
    datasets = pytest.importorskip("datasets", reason="datasets is not installed")
    export(dataset, "huggingface", tmp_path / "out")
    monkeypatch.setattr("datasets.config.HF_HUB_OFFLINE", True)
    read = datasets.load_dataset(str(tmp_path / "out"), cache_dir=str(tmp_path / "cache"))
    assert {split: len(rows) for split, rows in read.items()} == {"train": 4, "test": 2}
    features = read["train"].features
    rows = [r for r in read["train"] if r["scene"] == "mug"]
    with ShardReader(dataset / "shards/mug.h5") as shard:
        raw = np.stack([shard.raw(1, f) for f in range(shard.frames)])
        wanted = {"raw": raw, "T_base_tof": shard.T_base_tof(1), "tof_depth": shard.tof(1).depth}
        wanted |= {
            "gt_normals_2x": shard.ground_truth(1, 2).normals,
            "gt_mask_1x": shard.ground_truth(1, 1).mask,
        }
        for name, array in wanted.items():
            assert (tuple(features[name].shape), features[name].dtype) == (array.shape, array.dtype.name)
            np.testing.assert_array_equal(np.array(rows[1][name], array.dtype), array)
        assert rows[1]["amplitude"].size == (shard.camera.width, shard.camera.height)
        assert json.loads(rows[1]["camera"])["fx"] == shard.camera.fx
        assert rows[1]["view"] == shard.index(1)


def test_lerobot_rows_are_the_views(dataset, tmp_path):
    """Episodes are scenes, split by split; depths are lossless TIFF that Pillow reads; statistics are those of all rows."""
    pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    export(dataset, "lerobot", tmp_path)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert (info["splits"], info["total_frames"]) == ({"train": "0:2", "test": "2:3"}, 6)
    files = sorted((tmp_path / "data").rglob("*.parquet"))
    rows = [r for f in files for r in pq.read_table(f).to_pylist()]
    assert [r["index"] for r in rows] == list(range(6))
    episodes = [
        pq.read_table(f).to_pylist()[0] for f in sorted((tmp_path / "meta/episodes").rglob("*.parquet"))
    ]
    assert [(e["tasks"], e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (["gear-2"], 0, 2),
        (["mug"], 2, 4),
        (["box"], 4, 6),
    ]
    mug = rows[3]
    with ShardReader(dataset / "shards/mug.h5") as shard:
        depths = {"tof": shard.tof(1).depth, "ground_truth": shard.ground_truth(1, 2).depth}
        np.testing.assert_allclose(mug["observation.state"][:3], shard.T_base_tof(1)[:3, 3], rtol=1e-6)
    for name, depth in depths.items():
        data = np.frombuffer(mug[f"observation.depth.{name}"]["bytes"], np.uint8)
        np.testing.assert_array_equal(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), np.nan_to_num(depth))
    states = np.array([r["observation.state"] for r in rows])
    stats = json.loads((tmp_path / "meta/stats.json").read_text())["observation.state"]
    np.testing.assert_allclose(stats["mean"], states.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(stats["std"], states.std(axis=0), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(stats["max"], states.max(axis=0))
    assert rows[0]["action"] == rows[1]["observation.state"] == rows[1]["action"]


def test_lerobot_reads_it(dataset, tmp_path):
    """LeRobot's own reader gives depth as it is stored, in metres, or since 0.6 in millimetres by default, and the task."""
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset", reason="lerobot is not installed")
    export(dataset, "lerobot", tmp_path)
    read = lerobot.LeRobotDataset("local/tof", root=tmp_path)
    with ShardReader(dataset / "shards/mug.h5") as shard:
        depth = np.nan_to_num(shard.tof(1).depth)
    assert (len(read), read[3]["task"]) == (6, "mug")
    found = read[3]["observation.depth.tof"].numpy()[0]
    unit = round(float(np.median(found[depth > 0] / depth[depth > 0])))
    assert unit in {1, 1000}
    np.testing.assert_allclose(found, unit * depth, rtol=1e-6)
