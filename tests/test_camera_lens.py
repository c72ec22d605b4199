"""Cameras with distortion: OpenCV's numbers, exact inversion, folds refused, and right all the way to ground truth and decode."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import answers
from tofcapture import poses
from tofcapture.camera import Camera, lens_coefficients
from tofcapture.errors import ConfigError
from tofcapture.files.hdf import stereo_table, tof_from, tof_table
from tofcapture.frames import StereoInfo, TofInfo
from tofcapture.ops.normals import normals_from_depth
from tofcapture.ops.phase import Decoder, radial_to_range, taps
from tofcapture.ops.project import project, triangulate
from tofcapture.rig import Rig, dumps_rig, loads_rig

PLAIN = Camera(120, 90, 95.3, 100.4, 58.4, 50.7)
LENS = replace(PLAIN, distortion=(-0.25, 0.08, 0.001, -0.0015, 0.0))
# An Azure Kinect's depth camera, narrow field of view, as its factory file has it.
KINECT = Camera(
    640, 576, 503.9276, 503.9787, 332.0643, 325.8806,
    (3.130577, 2.324939, 8.1e-05, -5.1e-05, 0.130416, 3.458652, 3.350115, 0.662942),
)  # fmt: skip
STEREO = Camera(320, 256, 220.0, 220.0, 159.5, 127.5)


def pixels_of(camera):
    """(H, W, 2) u, v of the pixel centres."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize("camera", [LENS, KINECT, replace(LENS, distortion=(0.3, 0.1, 0.02, 0.5, 0.2, 0.01))])
def test_project_and_rays_are_opencvs(camera):
    """The same numbers as cv2.projectPoints over the whole image, polynomial and rational; rays come back to 1e-9 px."""
    cv2 = pytest.importorskip("cv2")
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = (0.7 * camera.rays[::9, ::9]).reshape(-1, 3)
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(camera.distortion))[0][:, 0]
    np.testing.assert_allclose(camera.project(points)[0], theirs, atol=1e-9)
    np.testing.assert_allclose(theirs, pixels_of(camera)[::9, ::9].reshape(-1, 2), atol=1e-9)


def test_coefficients_are_told_apart_by_their_number():
    """OpenCV's 4, 5, 8, 12 and 14, and the six k1 to k6 of a rational model; what the model lacks is refused."""
    four, eight = (-0.2, 0.05, 0.001, 0.002), KINECT.distortion
    assert lens_coefficients(four) == lens_coefficients((*four, 0.0, 0.0, 0.0, 0.0)) == (*four, 0.0)
    assert lens_coefficients((1, 2, 3, 4, 5, 6)) == (1, 2, 0, 0, 3, 4, 5, 6)
    assert lens_coefficients((*eight, *(0.0,) * 6)) == eight
    with pytest.raises(ConfigError, match="thin-prism"):
        lens_coefficients((*eight, 0.01, 0.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match="k1 to k6"):
        lens_coefficients((0.1,) * 7)


@given(st.lists(st.floats(-1.5, 4), min_size=6, max_size=6))
@settings(max_examples=30)
def test_every_rational_lens_is_inverted_or_refused(k):
    """Also one whose denominator vanishes inside the image: a ray that is given projects to its pixel."""
    try:
        camera = replace(PLAIN, distortion=tuple(k))
        rays = camera.rays
    except ConfigError:
        return
    np.testing.assert_allclose(camera.project(rays)[0], pixels_of(camera), atol=1e-5)


@given(st.floats(-0.15, 0.2), st.floats(0.0, 0.1), st.floats(-0.003, 0.003), st.floats(-0.003, 0.003))
@settings(max_examples=8)
def test_rays_of_a_lens_project_to_their_pixels(k1, k2, p1, p2):
    """Undistortion inverts distortion over the whole image for every moderate lens."""
    camera = replace(PLAIN, distortion=(k1, k2, p1, p2, 0.0))
    np.testing.assert_allclose(camera.project(camera.rays)[0], pixels_of(camera), atol=1e-6)


def test_scaled_lens_keeps_the_view():
    """A scaled camera has the same lens; the middle of its s x s pixels is the pixel of the coarse one."""
    fine = LENS.scaled(3)
    assert fine.distortion == LENS.distortion
    np.testing.assert_allclose(fine.rays[1::3, 1::3], LENS.rays, atol=1e-12)


def test_a_folding_lens_is_refused_and_folded_points_have_no_pixel():
    """A lens that turns over inside the image is named; points beyond the fold of a good one do not come back into it."""
    with pytest.raises(ConfigError, match="folds"):
        replace(PLAIN, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0)).rays  # noqa: B018
    barrel = replace(PLAIN, distortion=(-0.15, 0.0, 0.0, 0.0, 0.0))
    assert np.isnan(barrel.project(np.array([[4.0, 0.0, 1.0]]))[0]).all()
    with pytest.raises(ConfigError, match="k1, k2, p1, p2"):
        replace(PLAIN, distortion=(0.1, 0.2))


def test_no_distortion_leaves_files_as_they_were():
    """Zeros are a pinhole, whose tables have no entry; a lens survives the tables of info and rig; a distorted stereo grid is refused."""
    assert replace(PLAIN, distortion=(0.0,) * 5) == PLAIN
    info = TofInfo("made", "1", PLAIN, np.zeros(3))
    assert "distortion" not in tof_table(info)["camera"]
    bent = tof_from(tof_table(replace(info, camera=LENS)), "test")
    assert bent.camera == LENS
    for camera in (LENS, KINECT):
        rig = Rig(camera, STEREO, np.eye(4), np.eye(4))
        assert loads_rig(dumps_rig(rig)).tof == camera
    named = re.sub(r"distortion = \[[^]]*\]", "distortion = {k1 = 1.5, k4 = 1.6, k5 = 0.1}", dumps_rig(rig))
    assert loads_rig(named).tof.distortion == (1.5, 0, 0, 0, 0, 1.6, 0.1, 0)
    with pytest.raises(ConfigError, match="k7"):
        loads_rig(named.replace("k5", "k7"))
    assert "distortion" not in stereo_table(StereoInfo("m", "s", STEREO))["camera"]
    with pytest.raises(ConfigError, match="rectified"):
        StereoInfo("m", "s", replace(STEREO, distortion=LENS.distortion))
    with pytest.raises(ConfigError, match="rectified"):
        Rig(LENS, replace(STEREO, distortion=LENS.distortion), np.eye(4), np.eye(4))


def test_decode_follows_the_lens():
    """Taps made along the lens's rays decode to the depth of the wall that they met."""
    depth = np.full(LENS.shape, 0.8)
    info = TofInfo("made", "1", LENS, np.array([0.007, 0.0, 0.0]))
    range_ = radial_to_range(LENS.depth_to_radial(depth), LENS, info.illuminator)
    z = 300 * np.exp(4j * np.pi * np.array([20e6, 100e6])[:, None, None] * range_ / 299_792_458.0)
    raw = taps(z, np.full(z.shape, 500.0), info.modulation_hz, info.phase_rad)
    found = Decoder(info)(raw)
    assert np.abs(found.depth - depth).max() < 1e-4
    normals = normals_from_depth(depth, LENS)
    np.testing.assert_allclose(
        normals[10:-10, 10:-10], np.broadcast_to([0, 0, -1.0], (70, 100, 3)), atol=1e-9
    )


def test_ground_truth_follows_the_lens():
    """A stereo sheet of a tilted wall with a box before it, rendered through the lens, has the depth that its rays meet."""
    T = poses.transform(poses.rotation_exp([0.02, -0.03, 0.01]), [-0.04, 0.02, 0.0])
    normal = np.array([0.2, 0.3, -1.0])
    z = (normal @ [0, 0, 0.9]) / (STEREO.rays @ normal)
    v, u = np.mgrid[: STEREO.height, : STEREO.width]
    box = (np.abs(u - 160) < 40) & (np.abs(v - 130) < 35)
    sheet = triangulate(np.where(box, 0.6, z), STEREO)
    found = project(sheet, STEREO, T, LENS, edge_pixels=1)
    n = T[:3, :3] @ normal
    wall = (n @ (T[:3, :3] @ [0, 0, 0.9] + T[:3, 3])) / (LENS.rays @ n)
    m = T[:3, :3] @ np.array([0.0, 0.0, 1.0])
    front = (m @ (T[:3, :3] @ [0, 0, 0.6] + T[:3, 3])) / (LENS.rays @ m)
    good = np.isfinite(found.depth) & ~found.edge & ~found.occluded
    assert good.mean() > 0.5
    assert 0.55 < np.nanmin(found.depth) < np.nanmax(found.depth) < np.nanmax(wall) + 0.01
    told = {name: int(getattr(found, name).sum()) for name in ("edge", "occluded")}
    answers.hold("lens-projection", {**told, "depth": float(np.nanmean(found.depth))}, off=2e-3)
    off = np.minimum(np.abs(found.depth - wall), np.abs(found.depth - front))
    assert off[good].max() < 1e-5
    points = poses.transform_points(poses.invert(T), (found.depth[..., None] * LENS.rays)[good])
    np.testing.assert_allclose(STEREO.project(points)[0], found.pixels[good], atol=1e-6)
