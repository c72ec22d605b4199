"""Cameras of other tools' files are the cameras that those tools mean."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.importing.cameras import camera_keys, cameras_of
from tofcapture.rig import camera_from

LENS = (-0.21, 0.06, 0.001, -0.0007, 0.003)
WANTED = Camera(240, 180, 190.6, 200.8, 116.8, 101.5, LENS)
K = [190.6, 0, 116.8, 0, 200.8, 101.5, 0, 0, 1]

KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.21, 0.06, 0.001, -0.0007]
  distortion_model: radtan
  intrinsics: [190.6, 200.8, 116.8, 101.5]
  resolution: [240, 180]
  rostopic: /tof/image
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.05]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.01]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [900.0, 901.0, 640.0, 512.0]
  resolution: [1280, 1024]
"""
ROS = """
image_width: 240
image_height: 180
camera_name: tof
camera_matrix:
  rows: 3
  cols: 3
  data: [190.6, 0., 116.8, 0., 200.8, 101.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.21, 0.06, 0.001, -0.0007, 0.003]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [190.6, 0, 116.8, 0, 0, 200.8, 101.5, 0, 0, 0, 1, 0]}
"""
ECHO = """header:
  stamp: {sec: 12, nanosec: 5}
  frame_id: tof
height: 180
width: 240
distortion_model: plumb_bob
d: [-0.21, 0.06, 0.001, -0.0007, 0.003]
k: [190.6, 0.0, 116.8, 0.0, 200.8, 101.5, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [190.6, 0.0, 116.8, 0.0, 0.0, 200.8, 101.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 FULL_OPENCV 240 180 190.6 200.8 117.3 102 -0.21 0.06 0.001 -0.0007 0.003 0 0 0
"""


def opencv(path, **names):
    """A file as OpenCV itself writes it."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in names.items():
        file.write(name, value)
    file.release()


def colmap_bin(path):
    told = [190.6, 200.8, 117.3, 102, *LENS, 0, 0, 0]
    path.write_bytes(struct.pack("<QiiQQ12d", 1, 1, 6, 240, 180, *told))


def text(content):
    return lambda path: path.write_text(content)


def table(content):
    return text(json.dumps(content))


MATRICES = {"camera_matrix": np.reshape(K, (3, 3)), "distortion_coefficients": np.array([LENS])}
FILES = {
    "ros.yaml": text(ROS),
    "echo.yaml": text(ECHO),
    "ros1.yaml": text(ECHO.replace("\nd:", "\nD:").replace("\nk:", "\nK:")),
    "opencv.yml": lambda p: opencv(p, image_width=240, image_height=180, **MATRICES),
    "opencv.xml": lambda p: opencv(p, image_width=240, image_height=180, **MATRICES),
    "opencv.json": lambda p: opencv(p, image_width=240, image_height=180, **MATRICES),
    "mtx.npz": lambda p: np.savez(p, mtx=np.reshape(K, (3, 3)), dist=np.array([LENS]), image_size=(240, 180)),
    "cameras.txt": text(COLMAP),
    "cameras.bin": colmap_bin,
    "transforms.json": table(
        {"camera_model": "OPENCV", "w": 240, "h": 180, "fl_x": 190.6, "fl_y": 200.8, "cx": 117.3, "cy": 102.0}
        | dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
        | {"frames": []}
    ),
    "tof.toml": text(
        f"[tof]\nwidth = 240\nheight = 180\nfx = 190.6\nfy = 200.8\ncx = 116.8\ncy = 101.5\ndistortion = {list(LENS)}\n"
    ),
    "calib.mat": lambda p: savemat(p, {"K": np.reshape(K, (3, 3)), "dist": LENS, "image_size": (240, 180)}),
    "realsense.json": table(
        {
            "width": 240,
            "height": 180,
            "ppx": 116.8,
            "ppy": 101.5,
            "fx": 190.6,
            "fy": 200.8,
            "coeffs": list(LENS),
            "model": "brown_conrady",
        }
    ),
    "orbslam.yaml": text(
        "%YAML:1.0\nCamera.fx: 190.6\nCamera.fy: 200.8\nCamera.cx: 116.8\nCamera.cy: 101.5\nCamera.width: 240\nCamera.height: 180\n"
        + "".join(f"Camera.{k}: {v}\n" for k, v in zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
    ),
    "utf16.yaml": lambda p: p.write_text(ROS, encoding="utf-16"),
}


@pytest.mark.parametrize("name", FILES)
def test_every_tool_means_the_same_camera(tmp_path, name):
    """Sizes, centres and the lens come back in our conventions."""
    FILES[name](tmp_path / name)
    found = camera_from(camera_keys(str(tmp_path / name)), "")
    assert found.shape == WANTED.shape
    for key in ("fx", "fy", "cx", "cy", "distortion"):
        np.testing.assert_allclose(getattr(found, key), getattr(WANTED, key), rtol=1e-12)


@pytest.mark.parametrize("name", ["K.npy", "K.txt", "K.csv"])
def test_a_matrix_alone_is_a_camera(tmp_path, name):
    """As NumPy saves it; the size comes from the images."""
    if name == "K.npy":
        np.save(tmp_path / name, np.reshape(K, (3, 3)))
    else:
        np.savetxt(tmp_path / name, np.reshape(K, (3, 3)), delimiter="," if name == "K.csv" else " ")
    assert camera_keys(str(tmp_path / name)) == {"fx": 190.6, "fy": 200.8, "cx": 116.8, "cy": 101.5}


def test_colmaps_folder_is_its_camera(tmp_path):
    (tmp_path / "sparse/0").mkdir(parents=True)
    (tmp_path / "sparse/0/cameras.txt").write_text(COLMAP)
    assert camera_keys(str(tmp_path))["cx"] == pytest.approx(116.8)


def test_kalibrs_chain_has_both_cameras_and_how_they_stand(tmp_path):
    """``T_cn_cnm1`` maps the one before into this one; several cameras ask for a name."""
    path = tmp_path / "camchain.yaml"
    path.write_text(KALIBR)
    found = cameras_of(path)
    assert camera_from(found["cam0"].keys, "").distortion == (*LENS[:4], 0.0)
    np.testing.assert_allclose(
        found["cam1"].T, [[1, 0, 0, 0.05], [0, 1, 0, 0], [0, 0, 1, -0.01], [0, 0, 0, 1]]
    )
    assert camera_keys(f"{path}#cam1")["width"] == 1280
    with pytest.raises(ConfigError, match="cam0, cam1") as info:
        camera_keys(str(path))
    assert "#cam0" in info.value.hint


def test_opencvs_stereo_pair(tmp_path):
    """Numbers at the names' ends; R and T map points of the first camera into the second."""
    T = np.array([[-0.06], [0.0], [0.002]])
    opencv(
        tmp_path / "s.yml",
        M1=np.reshape(K, (3, 3)),
        D1=np.array([LENS]),
        M2=np.eye(3) * [900, 900, 1],
        D2=np.zeros((1, 5)),
        R=np.eye(3),
        T=T,
    )
    found = cameras_of(tmp_path / "s.yml")
    assert (found["1"].keys["fx"], found["2"].keys["fx"]) == (190.6, 900)
    np.testing.assert_allclose(found["2"].T[:3, 3], [0.06, 0, -0.002])


def test_binning_and_a_region_move_the_centre(tmp_path):
    """K is of the full image: a quarter of it, from the right lower corner, sees the same rays."""
    (tmp_path / "c.yaml").write_text(
        ECHO.replace("binning_x: 0", "binning_x: 2")
        .replace("binning_y: 0", "binning_y: 2")
        .replace(
            "x_offset: 0, y_offset: 0, height: 0, width: 0",
            "x_offset: 40, y_offset: 20, height: 160, width: 200",
        )
    )
    found = camera_from(camera_keys(str(tmp_path / "c.yaml")), "")
    assert found.shape == (80, 100)
    whole = WANTED.rays_at(np.array([40 + 2 * 7 + 0.5, 20 + 2 * 5 + 0.5]))
    np.testing.assert_allclose(found.rays_at(np.array([7.0, 5.0])), whole, atol=1e-9)


@pytest.mark.parametrize(
    "lens", [(0.0, 0.0, 0.0, 0.0), (-0.02, 0.004, -0.001, 0.0002), (0.05, -0.03, 0.02, -0.006)]
)
def test_a_fisheye_is_a_rational_lens_over_the_image(tmp_path, lens):
    """Kalibr's equidistant model, projected by its own equation, to a fiftieth of a pixel."""
    told = KALIBR.replace("radtan", "equidistant", 1).replace(
        "[-0.21, 0.06, 0.001, -0.0007]", str(list(lens))
    )
    (tmp_path / "camchain.yaml").write_text(told)
    found = camera_from(camera_keys(f"{tmp_path}/camchain.yaml#cam0"), "")
    xy = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 2))
    pixels, _ = found.project(np.c_[xy, np.ones(200)])
    seen = cv2.fisheye.distortPoints(xy[None], np.reshape(K, (3, 3)), np.array(lens))[0]
    assert np.abs(pixels - seen).max() < 0.02


@pytest.mark.parametrize("form", ["named", "flat", "list"])
def test_a_rational_lens_stays_whole(tmp_path, form):
    """Eight coefficients by name, as Azure Kinect's tools write them, or in OpenCV's order."""
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    lens = (0.5, -2.4, 1e-4, -7e-5, 1.3, 0.4, -2.2, 1.2)
    table = {"width": 640, "height": 576, "fx": 504.0, "fy": 504.1, "cx": 320.1, "cy": 331.2}
    named = dict(zip(names, lens, strict=True))
    table |= {"named": {"distortion": named}, "flat": named, "list": {"distortion": list(lens)}}[form]
    (tmp_path / "c.json").write_text(json.dumps(table))
    assert camera_from(camera_keys(str(tmp_path / "c.json")), "").distortion == lens


WRONG = {
    "empty.yaml": (text(""), FormatError, "expected a camera"),
    "other.yaml": (text("frames: 3\nname: tof\n"), FormatError, "frames, name"),
    "broken.json": (text('{"fx": 1,'), FormatError, "expected JSON"),
    "list.json": (text("[1, 2, 3]"), FormatError, "expected a camera"),
    "entities.xml": (text('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><opencv_storage/>'), FormatError, "entities"),
    "omni.yaml": (text(KALIBR.replace("camera_model: pinhole", "camera_model: omni", 1)), ConfigError, "omni"),
    "fov.yaml": (text(KALIBR.replace("radtan", "fov")), ConfigError, "got fov"),
    "skew.yaml": (text(ROS.replace("[190.6, 0., 116.8", "[190.6, 3., 116.8")), FormatError, "fx 0 cx"),
    "turned.yaml": (text(ROS.replace("data: [190.6, 0., 116.8, 0., 200.8, 101.5, 0., 0., 1.]", "data: [190.6, 0., 0., 0., 200.8, 0., 116.8, 101.5, 1.]")), FormatError, "fx 0 cx"),
    "cameras.txt": (text("1 PINHOLE 240 180 190.6\n"), ConfigError, "PINHOLE with 1 numbers"),
    "images.txt": (text("1 0.8 0.1 0.1 0.5 0.1 0.2 0.3 1 a.png\n"), FormatError, "CAMERA_ID MODEL"),
    "short.bin": (lambda p: p.write_bytes(b"\1\0\0\0\0\0\0\0abc"), DataError, "11 bytes"),
    "thin.txt": (text("1 THIN_PRISM_FISHEYE 240 180 1 1 1 1 0 0 0 0 0 0 0 0\n"), ConfigError, "THIN_PRISM"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_camera_is_named(tmp_path, name):
    write, error, message = WRONG[name]
    write(tmp_path / name)
    with pytest.raises(error, match=message):
        cameras_of(Path(tmp_path / name))


@pytest.mark.parametrize("line", ["1,2,3", "a,b,c,d", "no/such/file.yaml"])
def test_a_line_that_is_no_camera(line):
    with pytest.raises(ConfigError, match="fx,fy,cx,cy") as info:
        camera_keys(line)
    assert info.value.hint
