"""The files of a prediction, read back by other programs' rules."""

from __future__ import annotations

import errno
import os

import numpy as np
import pytest

pytest.importorskip("torch")

from tofcapture.camera import Camera
from tofcapture.files.disk import DiskFull
from tofcapture_model.inference.prediction import Prediction, write_prediction

CAMERA = Camera(6, 4, 5.0, 5.5, 2.5, 1.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A prediction of random depths, and the folder that it was written to."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 3, CAMERA.shape).astype(np.float32)
    normals = rng.normal(size=(*CAMERA.shape, 3))
    normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)
    prediction = Prediction(
        depth=depth,
        error=depth / 100,
        normals=normals,
        measured=depth > 1,
        camera=CAMERA,
        network="compact",
        sensor=depth[::2, ::2],
    )
    folder = tmp_path_factory.mktemp("out")
    write_prediction(prediction, folder)
    return prediction, folder


def test_the_depth_image_counts_tenths_of_millimetres(written):
    """16 bits, to half a count."""
    cv2 = pytest.importorskip("cv2")
    prediction, folder = written
    image = cv2.imread(str(folder / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert image.dtype == np.uint16
    np.testing.assert_allclose(image * 1e-4, prediction.depth, atol=0.5e-4 + 1e-7)


def test_normals_are_coloured_as_seen_by_the_viewer(written):
    """Red to the right, green up, blue towards the viewer: the camera's y and z turned round; to one count."""
    cv2 = pytest.importorskip("cv2")
    prediction, folder = written
    image = cv2.imread(str(folder / "normals.png"))[..., ::-1] / 127.5 - 1
    np.testing.assert_allclose(image, prediction.normals * [1, -1, -1], atol=1 / 127.5)


def test_the_cloud_holds_the_camera_s_points_with_normals_and_errors(written):
    """Seven float32 of each pixel, row by row, in the camera's own frame and in metres."""
    prediction, folder = written
    head, _, body = (folder / "cloud.ply").read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in head.decode().splitlines() if line.startswith("property float")]
    assert names == ["x", "y", "z", "nx", "ny", "nz", "expected_error"]
    assert f"element vertex {prediction.depth.size}" in head.decode().splitlines()
    rows = np.frombuffer(body, "<f4").reshape(*CAMERA.shape, 7)
    np.testing.assert_allclose(rows[..., :3], CAMERA.unproject(prediction.depth), rtol=1e-6)
    np.testing.assert_array_equal(rows[..., 3:6], prediction.normals)
    np.testing.assert_array_equal(rows[..., 6], prediction.error)


@pytest.mark.parametrize("name", ["depth", "error", "normals", "measured"])
def test_arrays_are_what_was_predicted(written, name):
    """To the bit."""
    prediction, folder = written
    np.testing.assert_array_equal(np.load(folder / f"{name}.npy"), getattr(prediction, name))


@pytest.mark.parametrize("number", [1, 3, 5, 8, 13])
def test_a_full_disk_leaves_no_file_cut_short(written, tmp_path, monkeypatch, number):
    """Full at any write, it is named, and each file under its final name is whole."""
    prediction, whole = written
    real, count = os.fsync, iter(range(1, 100))

    def full(handle):
        if next(count) >= number:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DiskFull):
        write_prediction(prediction, tmp_path / "out")
    left = list((tmp_path / "out").iterdir())
    assert len(left) == number // 2
    assert all(path.read_bytes() == (whole / path.name).read_bytes() for path in left)
