"""A maker's calibration file becomes the rig's lens, and what it does not hold is named."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calibration.factory import factory_camera
from tests.commands import calibrate
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, FormatError, TofError
from tofcapture.rig import Rig, dumps_rig, load_rig

KINECT = (
    0.5122697949409485, 0.49451231956481934, 0.4921168386936188, 0.4921667277812958, 3.1305770874023438, 2.324939012527466,
    0.1304156482219696, 3.458651542663574, 3.350114583969116, 0.6629416346549988, 0, 0, -5.11557373101823e-05, 8.132171933539212e-05,
)  # fmt: skip
LENS = (3.1306, 2.3249, 8.13e-05, -5.116e-05, 0.13042, 3.4587, 3.3501, 0.66294)


def kinect(location="CALIBRATION_CameraLocationD0", model="BrownConrady", **more):
    intrinsics = {
        "ModelType": f"CALIBRATION_LensDistortionModel{model}",
        "ModelParameters": list(KINECT),
        **more,
    }
    other = {"Location": "CALIBRATION_CameraLocationPV0", "Intrinsics": {"ModelParameters": [0] * 14}}
    return {"CalibrationInformation": {"Cameras": [other, {"Location": location, "Intrinsics": intrinsics}]}}


def saved(path, content):
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


@pytest.mark.parametrize("size", [(640, 576), (320, 288), (1024, 1024), (512, 512)])
def test_azure_kinect_has_the_pixels_its_own_library_gives(tmp_path, size):
    """The maker's library gives cx 332.064270, cy 325.880615, fx 503.927643, fy 503.978729 in the narrow unbinned mode."""
    camera = factory_camera(saved(tmp_path / "c.json", kinect()), size)
    narrow = factory_camera(tmp_path / "c.json", (640, 576))
    found = [narrow.fx, narrow.fy, narrow.cx, narrow.cy]
    np.testing.assert_allclose(found, [503.927643, 503.978729, 332.064270, 325.880615], atol=1e-5)
    np.testing.assert_allclose(camera.distortion, LENS, rtol=1e-3)
    wide = factory_camera(tmp_path / "c.json", (1024, 1024))
    v, u = np.array(camera.shape) // 2
    step = 1024 // (512 if size[0] in {320, 512} else 1024)
    left, top = {640: (192, 180), 320: (192, 180)}.get(size[0], (0, 0))
    pixel = [(u + 0.5) * step - 0.5 + left, (v + 0.5) * step - 0.5 + top]
    np.testing.assert_allclose(camera.rays_at(np.array([u, v])), wide.rays_at(np.array(pixel)), atol=1e-9)


ROS = """image_width: 640
image_height: 480
camera_name: tof
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 501, 241, 0, 0, 1]}
distortion_model: rational_polynomial
distortion_coefficients: {rows: 1, cols: 8, data: [1.5, 0.2, 0.001, 0.002, 0.03, 1.6, 0.4, 0.05]}
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
M: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [500, 0, 320, 0, 501, 241, 0, 0, 1]
D: !!opencv-matrix
   rows: 1
   cols: 8
   dt: d
   data: [1.5, 0.2, 0.001, 0.002, 0.03, 1.6, 0.4, 0.05]
"""
NUMBERS = {"fx": 500, "fy": 501, "cx": 320, "cy": 241, "width": 640, "height": 480}
COEFFICIENTS = {"k1": 1.5, "k2": 0.2, "p1": 0.001, "p2": 0.002, "k3": 0.03, "k4": 1.6, "k5": 0.4, "k6": 0.05}


@pytest.mark.parametrize(
    "content",
    [
        ROS,
        OPENCV,
        {"intrinsics": {**NUMBERS, **COEFFICIENTS, "codx": 0, "cody": 0}},
        {"depthIntrinsic": NUMBERS, "depthDistortion": COEFFICIENTS, "rgb": {**NUMBERS, "width": 1920, "height": 1080}},
        {
            "cameraData": [
                [2, {"intrinsicMatrix": [[500, 0, 320], [0, 501, 241], [0, 0, 1]], "width": 640, "height": 480, "cameraType": "Perspective",
                     "distortionCoeff": [*COEFFICIENTS.values(), 0, 0, 0, 0, 0, 0]}],
                [0, {"intrinsicMatrix": [[9, 0, 5], [0, 9, 5], [0, 0, 1]], "width": 1280, "height": 800, "distortionCoeff": [0] * 14}],
            ]
        },
    ],
)  # fmt: skip
def test_files_that_name_their_numbers(tmp_path, content):
    """ROS, OpenCV, plain JSON, Orbbec's and depthai's: the same camera; images of half the size see the same rays."""
    path = saved(tmp_path / "c.yaml", content)
    expected = Camera(640, 480, 500, 501, 320, 241, tuple(COEFFICIENTS.values()))
    assert factory_camera(path, (640, 480)) == expected
    assert factory_camera(path, (320, 240)).scaled(2) == expected


@pytest.mark.parametrize(
    ("content", "error", "says"),
    [
        (kinect(location="elsewhere"), DataError, "CameraLocationD0"),
        (kinect(model="Rational6KT"), ConfigError, "BrownConrady"),
        (kinect(ModelParameters=[0.5] * 4), DataError, "14 parameters"),
        ({"a": NUMBERS, "b": NUMBERS}, DataError, "one camera"),
        ({**NUMBERS, "width": 600}, DataError, "600x480"),
        ({k: v for k, v in NUMBERS.items() if k != "cx"}, DataError, "one camera"),
        ({**NUMBERS, "distortion_model": "equidistant"}, ConfigError, "equidistant"),
        ({**NUMBERS, "distortion_model": "fisheye"}, ConfigError, "fisheye"),
        ({**NUMBERS, "codx": 0.01}, ConfigError, "codx"),
        ({**NUMBERS, "fx": "wide"}, FormatError, "wide"),
        ("\x00\x01 : [", FormatError, "YAML"),
        ([1, 2], DataError, "one camera"),
    ],
)
def test_what_a_file_does_not_hold_is_named(tmp_path, content, error, says):
    with pytest.raises(error, match=says):
        factory_camera(
            saved(tmp_path / "c.json", content), (640, 576) if "Calib" in str(content) else (640, 480)
        )


def test_a_part_is_chosen_by_name_and_the_rig_gets_the_lens(tmp_path):
    """calibrate lens --factory writes rig.toml and keeps all else of the rig."""
    path = saved(tmp_path / "c.json", {"tof": {**NUMBERS, **COEFFICIENTS}, "ir": NUMBERS})
    rig = Rig(Camera(640, 480, 490, 490, 319.5, 239.5), Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))
    (tmp_path / "rig.toml").write_text(dumps_rig(rig))
    outcome = calibrate("lens", tmp_path, "--factory", path, "--camera", "tof")
    found = load_rig(tmp_path / "rig.toml")
    assert found.tof == Camera(640, 480, 500, 501, 320, 241, tuple(COEFFICIENTS.values()))
    assert found.stereo == rig.stereo
    assert outcome.data["lens"]["k4"] == {"value": 1.6, "before": 0.0}
    with pytest.raises(TofError, match="no such file"):
        calibrate("lens", tmp_path, "--factory", tmp_path / "none.json")
