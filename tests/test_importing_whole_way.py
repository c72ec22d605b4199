"""The page's ten lines and five commands run as they are printed; surfaces and poses; an import that is cut off is no whole one."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from tests.test_importing import SHAPE, TOF, scene, scenes
from tofcapture.cli import main
from tofcapture.files.check import UNFINISHED, check
from tofcapture.files.view import find_views, open_view
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data, make_view
from tofcapture.poses import exp, invert, transform_points
from tofcapture.rig import load_rig

PAGE = Path(__file__).parents[1] / "docs/howto/own-data.md"


@pytest.mark.slow
def test_the_page_runs_as_it_is_printed(tmp_path, monkeypatch, capsys):
    """Ten lines of numpy and five commands, without Python, lead to a trained network; check finds nothing."""
    monkeypatch.chdir(tmp_path)
    blocks = dict(re.findall(r"```(python|sh)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL))
    exec(compile(blocks["python"], "page", "exec"), {})  # noqa: S102
    commands = [shlex.split(line)[1:] for line in blocks["sh"].splitlines()]
    assert [c[0] for c in commands] == ["import", "build-dataset", "check", "evaluate", "train"]
    for command in commands:
        brief = ["--minutes", "0.05"] if command[0] == "train" else []
        assert main([*command, *brief]) == 0, capsys.readouterr().err
    assert check(tmp_path / "recording") == check(tmp_path / "dataset") == []
    sensor = json.loads((tmp_path / "results.json").read_text())["methods"]["sensor"]
    assert sensor["depth"]["pixel"]["mae"] < 2e-3
    assert (tmp_path / "run/model.safetensors").is_file()


def test_an_import_that_is_cut_off_is_not_whole_and_goes_on(tmp_path):
    """Stopped after a view, nothing lies among the views and check says so; again, the same bytes as in one go."""
    raw, depth = scenes()
    (tmp_path / "in").mkdir()
    for i in range(3):
        np.save(tmp_path / f"in/raw_{i}.npy", raw[i])
        np.save(tmp_path / f"in/depth_{i}.npy", depth[i])

    def stop(_scene, done, _total):
        if done == 2:
            raise KeyboardInterrupt

    said, source = Said(scene="mug", tof=TOF), [tmp_path / "in"]
    with pytest.raises(KeyboardInterrupt):
        import_data(source, tmp_path / "out/a", said, stop)
    assert not (tmp_path / "out/a/views").exists()
    assert any("not finished" in str(p) for p in check(tmp_path / "out/a"))
    first = (tmp_path / "out/a" / UNFINISHED / "mug/view-000.h5").stat().st_mtime_ns
    for name in "ab":
        import_data(source, tmp_path / "out" / name, said)
    a, b = (find_views(tmp_path / "out" / name)["mug"] for name in "ab")
    assert [p.read_bytes() for p in a] == [p.read_bytes() for p in b]
    assert a[0].stat().st_mtime_ns == first
    assert check(tmp_path / "out/a") == []


def test_surfaces_in_the_world_are_seen_from_the_poses(tmp_path):
    """One mesh and a line of poses give the depth that was made with them, in every view, as does its cloud of points."""
    o3d = pytest.importorskip("open3d")
    raw, depth = scene(3)
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    rays = np.stack([(u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"], 1.0 + 0 * u], axis=-1)
    T_world_tof = exp([0.3, -0.2, 0.5, 0.1, 0.2, -0.3])
    points = transform_points(T_world_tof, depth[..., None] * rays)
    index = np.arange(v.size).reshape(SHAPE)
    a, b, c, d = (
        index[r, s].ravel() for r in (slice(-1), slice(1, None)) for s in (slice(-1), slice(1, None))
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(1000 * points.reshape(-1, 3)), o3d.utility.Vector3iVector(faces)
    )
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(1000 * points.reshape(-1, 3)))
    for name, save, held in (
        ("scene.stl", o3d.io.write_triangle_mesh, mesh.compute_triangle_normals()),
        ("scene.ply", o3d.io.write_point_cloud, cloud),
        ("scene.pcd", o3d.io.write_point_cloud, cloud),
    ):
        folder = tmp_path / name.replace(".", "-")
        folder.mkdir()
        save(str(folder / name), held)
        for i in range(2):
            np.save(folder / f"raw_{i}.npy", raw)
        line = " ".join(f"{x:.17g}" for x in T_world_tof[:3].ravel())
        (folder / "poses.csv").write_text(f"matrix, row by row\n{line}\n{line}\n")
        said = Said(tof=TOF, truth={"unit": "mm"}, poses={"file": "poses.csv"})
        import_data([folder], tmp_path / f"rec-{name}", said)
        (paths,) = find_views(tmp_path / f"rec-{name}").values()
        view = open_view(paths[1])
        np.testing.assert_allclose(view.arm_before.T_base_flange, T_world_tof, atol=1e-12)
        z = view.stereo.points[..., 2]
        z = z if z.shape == SHAPE else z[::2, ::2]
        inner = (
            np.isfinite(z) & (np.abs(np.gradient(depth)[1]) < 0.02) & (np.abs(np.gradient(depth)[0]) < 0.02)
        )
        assert inner.mean() > 0.5
        assert np.abs(z - depth)[inner].max() < 0.02


def test_a_rig_needs_only_its_tof_camera_to_predict_and_names_all_that_is_missing(tmp_path, capsys):
    """``rig init`` writes what predict takes; a rig with [tof] alone is read so, and refused with every missing key elsewhere."""
    rig = tmp_path / "rig.toml"
    assert (
        main(
            [
                "rig",
                "init",
                "--camera",
                "190.6,200.8,116.8,101.5,-0.1",
                "--size",
                "180,240",
                "--out",
                str(rig),
            ]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "240 x 180" in said
    assert "64.4 x 48.3" in said  # deg, by width and height over twice the focal lengths
    assert load_rig(rig).tof.distortion[0] == -0.1
    alone = tmp_path / "alone.toml"
    alone.write_text("[tof]\nwidth = 240\nheight = 180\nfx = 190.0\nfy = 200.0\ncx = 117.0\ncy = 101.0\n")
    assert load_rig(alone, tof_only=True).tof.fx == 190
    alone.write_text('units = "m"\n[tof]\nwidth = 240\nfx = 190.0\n')
    with pytest.raises(
        Exception, match=r"\[tof\] height, fy, cx, cy, \[stereo\] .*T_tof_stereo, T_flange_tof"
    ):
        load_rig(alone)
    assert main(["rig", "show", str(alone)]) == 3


def test_a_dry_run_draws_and_a_guess_is_read_back(tmp_path, monkeypatch):
    """Nothing is written but the picture; a guessed import.toml knows the unit, and is enough once the lens is filled in."""
    monkeypatch.chdir(tmp_path)
    raw, depth = scene()
    source = tmp_path / "mug"
    source.mkdir()
    np.save(source / "raw.npy", raw)
    np.save(source / "depth.npy", (1000 * depth).round().astype(np.uint16))
    assert main(["import", "--guess", str(source)]) == 0
    text = (source / "import.toml").read_text()
    assert 'unit = "mm"' in text
    for key, value in TOF.items():
        text = re.sub(rf"# {key} = .*", f"{key} = {value}", text)
    (source / "import.toml").write_text(text)
    assert main(["import", str(source), "--dry-run"]) == 0
    assert (tmp_path / "import.png").is_file()
    assert not (tmp_path / "rec").exists()
    assert main(["import", str(source), "--out", "rec"]) == 0
    (paths,) = find_views(tmp_path / "rec").values()
    np.testing.assert_allclose(open_view(paths[0]).stereo.points[..., 2], depth, atol=6e-4)


def test_without_ground_truth_there_is_a_view_to_predict_from(tmp_path, capsys):
    """Raw arrays alone become a recording; build-dataset says that it has no ground truth."""
    raw, _ = scene()
    np.save(tmp_path / "raw.npy", raw)
    words = ["import", str(tmp_path / "raw.npy"), "--camera", "45,46,19,15.5", "--out", str(tmp_path / "rec")]
    assert main(words) == 0
    assert "predict only" in capsys.readouterr().err
    assert check(tmp_path / "rec") == []
    assert main(["build-dataset", str(tmp_path / "rec"), "--out", str(tmp_path / "ds"), "--jobs", "1"]) == 5
    assert "ground truth" in capsys.readouterr().out


def test_depth_of_a_second_camera_lies_where_its_transform_says(tmp_path):
    """Depth of a camera beside the ToF camera is compared where both see; the inverse transform is refused by name."""
    raw, depth = scene()
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    rays = np.stack([(u - TOF["cx"]) / TOF["fx"], (v - TOF["cy"]) / TOF["fy"], 1.0 + 0 * u], axis=-1)
    T_tof_truth = exp([0.04, 0.0, 0.0, 0.0, 0.0, 0.0])
    p = transform_points(invert(T_tof_truth), depth[..., None] * rays)
    second = np.full(SHAPE, np.nan)
    columns = np.rint(p[..., 0] / p[..., 2] * TOF["fx"] + TOF["cx"]).astype(int)
    inside = (columns >= 0) & (columns < SHAPE[1])
    second[v[inside], columns[inside]] = p[..., 2][inside]
    np.save(tmp_path / "raw.npy", raw)
    np.save(tmp_path / "depth.npy", second)
    camera = {"width": SHAPE[1], "height": SHAPE[0], **TOF}
    said = Said(tof=TOF, truth={"camera": camera, "T_tof_truth": T_tof_truth.tolist()})
    from tofcapture.importing.plan import plan

    pixels = [TOF[k] for k in ("fx", "fy", "cx", "cy")]
    one = {
        "camera_model": "pinhole",
        "intrinsics": pixels,
        "distortion_coeffs": [],
        "resolution": SHAPE[::-1],
    }
    chain = {"tof": one, "second": {**one, "T_cn_cnm1": invert(T_tof_truth).tolist()}}
    (tmp_path / "camchain.yaml").write_text(json.dumps(chain))
    of_chain = Said(str(tmp_path / "import.toml"), tof=TOF, truth={"camera": "camchain.yaml#second"})
    for told in (said, of_chain):
        view, overlap = make_view(plan(tmp_path, told)[0], told)
        np.testing.assert_allclose(view.rig.T_tof_stereo, T_tof_truth, atol=1e-9)
        assert overlap.share > 0.7
        assert abs(overlap.difference) < 2e-3
