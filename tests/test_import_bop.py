"""Scenes of BOP datasets with raw frames become recordings: models in their poses, or depth, are the ground truth."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from tests.test_dataset_card import make
from tests.test_importing import SHAPE, TOF, imported, scenes
from tofcapture.dataset.export import export
from tofcapture.errors import TofError
from tofcapture.importing.cameras import camera_keys
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data

K = [TOF["fx"], 0, TOF["cx"], 0, TOF["fy"], TOF["cy"], 0, 0, 1]
CUBE = (
    np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 5000.0
)  # mm: a wall before the camera
FACES = [
    (0, 1, 3),
    (0, 3, 2),
    (4, 6, 7),
    (4, 7, 5),
    (0, 4, 5),
    (0, 5, 1),
    (2, 3, 7),
    (2, 7, 6),
    (0, 2, 6),
    (0, 6, 4),
    (1, 5, 7),
    (1, 7, 3),
]


def dataset(root, objects=False, change=None):
    """Two images in depth_scale 0.1; a model of a cube, as ASCII PLY, in its pose."""
    raw, depth = scenes(2)
    scene = root / "test/000003"
    for name in ("raw", "depth"):
        (scene / name).mkdir(parents=True)
    cameras, poses = {}, {}
    for i in range(2):
        if objects:
            depth[i] = 0.9
            u = (np.arange(SHAPE[1]) - TOF["cx"]) / TOF["fx"]
            v = (np.arange(SHAPE[0])[:, None] - TOF["cy"]) / TOF["fy"]
            phi = (
                4
                * np.pi
                * np.repeat([20e6, 100e6], 4)[:, None, None]
                / 299_792_458
                * 0.9
                * np.sqrt(1 + u**2 + v**2)
            )
            raw[i] = np.rint(1500 + 500 * np.cos(phi + np.tile(np.arange(4) * np.pi / 2, 2)[:, None, None]))
        np.save(scene / f"raw/{i:06d}.npy", raw[i])
        cv2.imwrite(str(scene / f"depth/{i:06d}.png"), np.rint(depth[i] * 10000).astype(np.uint16))
        cameras[i] = {
            "cam_K": K,
            "depth_scale": 0.1,
            "cam_R_w2c": np.eye(3).ravel().tolist(),
            "cam_t_w2c": [-100.0 * i, 0, 0],
        }
        poses[i] = (
            [{"obj_id": 5, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 5900.0]}]
            if objects
            else []
        )
    if change:
        change(cameras, poses)
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    (scene / "scene_gt.json").write_text(json.dumps(poses))
    if objects:
        (root / "models").mkdir()
        head = f"ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face {len(FACES)}\n"
        lines = [" ".join(map(str, p)) for p in CUBE] + [f"3 {a} {b} {c}" for a, b, c in FACES]
        text = f"{head}property list uchar int vertex_indices\nend_header\n" + "\n".join(lines) + "\n"
        (root / "models/obj_000005.ply").write_text(text)
    return scene


def test_depth_of_a_scene_is_its_ground_truth(tmp_path):
    """Raw bit for bit, depth in tenths of millimetres, K, and poses of the camera in the world."""
    raw, depth = scenes(2)
    found = imported(dataset(tmp_path / "bop"), tmp_path / "rec", tof={})
    assert [v.scene for v in found] == ["000003", "000003"]
    for i, view in enumerate(found):
        np.testing.assert_array_equal(view.tof.raw[0], raw[i])
        np.testing.assert_allclose(view.stereo.points[..., 2], depth[i], atol=5.1e-5)
        assert (view.rig.tof.fx, view.rig.tof.shape) == (TOF["fx"], SHAPE)
        np.testing.assert_allclose(view.arm_before.T_base_flange[:3, 3], [0.1 * i, 0, 0])


def test_models_in_their_poses_are_ground_truth(tmp_path):
    """The near side of a cube of ten metres stands 0.9 m before the camera."""
    for view in imported(dataset(tmp_path / "bop", objects=True), tmp_path / "rec", tof={}):
        assert view.stereo.info.model == "imported mesh"
        np.testing.assert_allclose(view.stereo.points[..., 2], 0.9, atol=1e-5)


def test_what_went_out_names_its_camera(tmp_path):
    """A folder of export-dataset has no raw frames, which is said; its camera is read."""
    out = tmp_path / "out"
    export(make(tmp_path / "data"), "bop", out)
    with pytest.raises(TofError, match="found none in raw/"):
        import_data([out / "train/000000"], tmp_path / "rec", Said())
    with pytest.raises(TofError, match="3 scenes") as info:
        import_data([out], tmp_path / "rec", Said())
    assert "train/000000" in info.value.hint
    assert camera_keys(str(out / "camera.json"))["fx"] > 0
    assert camera_keys(str(out / "train/000000/scene_camera.json"))["fx"] > 0


WRONG = {
    "mirrored": (lambda c, p: c[0].update(cam_R_w2c=[-1, 0, 0, 0, 1, 0, 0, 0, 1]), "expected a rotation"),
    "no K": (lambda c, p: c[0].pop("cam_K"), "expected cam_K"),
    "fewer images": (lambda c, p: c.pop(1), "got 1"),
    "no model": (lambda c, p: p[0][0].update(obj_id=9), "object 9"),
    "depth in metres": (
        lambda c, p: [c[i].update(depth_scale=1e-4) for i in c] and [p[i].clear() for i in p],
        "median",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_in_a_scene_is_named(tmp_path, name):
    change, message = WRONG[name]
    scene = dataset(tmp_path / "bop", objects=True, change=change)
    with pytest.raises(TofError, match=message):
        import_data([scene], tmp_path / "rec", Said())
    assert not list((tmp_path / "rec").glob("views/*"))
