"""Networks see through lenses: rays, normals, cues, crops, mirrors, loss, batches of unlike cameras, training, exports."""

# ruff: noqa: E402  torch is optional
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch")

from tests.analytic import make_dataset
from tests.test_model_predict import saved
from tests.test_model_predict_inputs import SMALL, save_network, wall
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.frames import TofInfo
from tofcapture.rig import Rig, dumps_rig
from tofcapture_model.config import Config, Network, Stage, preset
from tofcapture_model.data import FrameDataset, collate, crop, frame_decoder, mirror
from tofcapture_model.data.raw_input import NOMINAL_CAMERA
from tofcapture_model.evaluation.evaluate import evaluate
from tofcapture_model.geometry.decoder import TorchDecoder
from tofcapture_model.geometry.maps import (
    cut_intrinsics,
    depth_to_normals,
    expect_usable,
    intrinsics_of,
    mirror_intrinsics,
    propagate_depth,
    rays,
    scale_intrinsics,
    thin_intrinsics,
    unproject,
    with_lens,
)
from tofcapture_model.geometry.multipath import cues, patches
from tofcapture_model.inference import predict as predicting
from tofcapture_model.inference.predict import Predictor, predict
from tofcapture_model.training.train import train

PLAIN = Camera(120, 90, 95.0, 100.0, 58.4, 50.7)
LENS = replace(PLAIN, distortion=(-0.2, 0.06, 0.002, -0.003, 0.01))


def rays_of(camera):
    """Rays (1, 3, H, W) by the camera's own, exact rule."""
    return torch.tensor(camera.rays, dtype=torch.float32).permute(2, 0, 1)[None]


def numbers(camera):
    return intrinsics_of(camera)[None]


def tilted(camera, normal=(0.3, -0.25, -1.0), distance=0.8):
    """Depth (1, 1, H, W) and normal (1, 3, 1, 1) of a plane through (0, 0, distance), along the lens's rays."""
    n = torch.tensor(normal) / np.linalg.norm(normal)
    n = n.float()[None, :, None, None]
    return (n[:, 2:] * distance) / (n * rays_of(camera)).sum(1, keepdim=True), n


def degrees(found, expected):
    apart = torch.linalg.cross(found, expected.expand_as(found), dim=1).norm(dim=1)
    return torch.rad2deg(torch.atan2(apart, (found * expected).sum(1)))


def usable(camera):
    """The camera, unless it or the networks refuse its lens."""
    try:
        expect_usable(camera)
    except ConfigError:
        assume(False)
    return camera


@st.composite
def lenses(draw):
    """Lenses as calibrations give them, most with two coefficients that matter; many of them fold somewhere outside the image."""
    k1, k2 = draw(st.floats(-0.4, 0.2)), draw(st.sampled_from([0.0, 0.01, 0.05, -0.05, 0.1]))
    p1, p2, k3 = (
        draw(st.floats(-0.005, 0.005)),
        draw(st.floats(-0.005, 0.005)),
        draw(st.sampled_from([0.0, -0.03])),
    )
    focal = draw(st.floats(42, 100))
    if draw(st.booleans()):  # a rational lens, near the same polynomial one
        k4 = draw(st.floats(0.0, 3.0))
        k1, k2, k3 = k1 + k4, k2 + k1 * k4 + 0.5 * k4, k3 + 0.05 * k4
        lens = (k1, k2, p1, p2, k3, k4, 0.5 * k4, 0.05 * k4)
    else:
        lens = (k1, k2, p1, p2, k3)
    try:
        return Camera(60, 45, focal, 1.03 * focal, 28.4, 23.7, lens)
    except ConfigError:
        assume(False)


@settings(max_examples=30)
@given(lenses())
def test_rays_are_the_cameras(camera):
    """For every lens that is not refused, at the sensor's resolution and at twice that."""
    usable(camera)
    close = {"atol": 1e-4, "rtol": 0}
    torch.testing.assert_close(rays(numbers(camera), *camera.shape), rays_of(camera), **close)
    fine = scale_intrinsics(numbers(camera), 2)
    torch.testing.assert_close(rays(fine, *camera.scaled(2).shape), rays_of(camera.scaled(2)), **close)


@pytest.mark.parametrize(
    "lens",
    [
        Camera(60, 45, 35.9, 35.9, 28.4, 23.7, (-0.278, -0.065, -0.002, -0.002, 0.044)),
        replace(NOMINAL_CAMERA, distortion=(-0.2215, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_a_lens_that_nearly_folds_is_refused_before_anything_is_computed(lens):
    """Both are rays that the camera can still compute at its own resolution: wrong in eight steps, or folded at twice the resolution."""
    lens.rays  # noqa: B018
    with pytest.raises(ConfigError, match="fold"):
        frame_decoder(TofInfo("t", "", lens, np.zeros(3)), lens)
    with pytest.raises(ConfigError, match="fold"):
        TorchDecoder(TofInfo("t", "", lens, np.zeros(3)), lens, torch.device("cpu"))


@settings(max_examples=25)
@given(lenses())
def test_every_cue_is_finite_for_every_lens(camera):
    """Also what is expected of the scene beyond the image, where most lenses fold."""
    depth, _ = tilted(usable(camera), (0.0, 0.0, -1.0))
    phasor = torch.full((1, 4, *camera.shape), 0.02)
    found = cues(phasor, depth, torch.ones_like(depth), torch.zeros_like(depth), numbers(camera), (2e7, 1e8))
    assert found.isfinite().all()
    assert found[:, :2].abs().max() < 0.1


@pytest.mark.parametrize("k1", [-0.1, -0.15, -0.2, 0.1])
def test_the_bundled_network_answers_through_one_coefficient(k1):
    """As calibrations often give it: these fold outside the image, and inside all is well."""
    lens = replace(NOMINAL_CAMERA, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    found = Predictor()(wall(lens), TofInfo("t", "", lens, np.zeros(3)))
    assert np.abs(found.depth - 0.8).mean() < 0.02
    assert np.isfinite(found.normals).all()
    assert np.isfinite(found.error).all()


def test_windows_mirrors_and_every_tenth_pixel_keep_their_rays():
    """What is cut, flipped or thinned looks where it looked; x and y of a mirrored world change sign."""
    k, whole = numbers(LENS), rays_of(LENS)
    close = {"atol": 1e-5, "rtol": 0}
    torch.testing.assert_close(rays(cut_intrinsics(k, 11, 23), 40, 50), whole[..., 11:51, 23:73], **close)
    torch.testing.assert_close(rays(thin_intrinsics(k, 10), 9, 12), whole[..., 5::10, 5::10], **close)
    for axis, signs in ((-1, (-1, 1, 1)), (-2, (1, -1, 1))):
        flipped = rays(mirror_intrinsics(k, axis, LENS.shape[axis]), *LENS.shape)
        expected = whole.flip(axis) * torch.tensor(signs).reshape(1, 3, 1, 1)
        torch.testing.assert_close(flipped, expected, **close)
        twice = mirror_intrinsics(mirror_intrinsics(k, axis, 120), axis, 120)
        torch.testing.assert_close(twice, k)


def test_a_lens_of_zeros_is_none():
    """Cameras with and without a lens may share a batch."""
    k = numbers(PLAIN)
    assert k.shape == (1, 4)
    assert with_lens(k).shape == (1, 12)
    torch.testing.assert_close(rays(with_lens(k), *PLAIN.shape), rays(k, *PLAIN.shape), atol=1e-6, rtol=0)
    depth, _ = tilted(PLAIN)
    found = [depth_to_normals(depth, torch.ones_like(depth), each) for each in (k, with_lens(k))]
    torch.testing.assert_close(*found, atol=1e-5, rtol=0)


def test_a_plane_is_flat_through_a_lens():
    """Plane fits give its normal everywhere, points lie on it, and propagation leaves it where it is; a pinhole's numbers would not."""
    depth, normal = tilted(LENS)
    found = depth_to_normals(depth, torch.ones_like(depth), numbers(LENS), radius=3)
    off = degrees(found, normal)[0]
    assert off[3:-3, 3:-3].max() < 0.1
    assert off.max() < 0.3  # the windows of the border look to one side, and the lens bends there most
    wrong = depth_to_normals(depth, torch.ones_like(depth), numbers(PLAIN), radius=3)
    assert degrees(wrong, normal).max() > 3
    points = unproject(depth, numbers(LENS))
    assert ((points * normal).sum(1) - normal[:, 2] * 0.8).abs().max() < 1e-5
    moved = propagate_depth(depth, normal.expand_as(found), numbers(LENS), torch.ones_like(depth))
    assert (moved - depth).abs().max() < 1e-5


def test_expected_interreflection_does_not_depend_on_the_lens():
    """The same corner through a lens and through a pinhole: along the same rays the physics expects the same error."""
    maps = []
    for camera in (PLAIN, LENS):
        planes = [tilted(camera, (side * 0.9, 0.1, -0.7), 0.8)[0] for side in (1, -1)]
        depth = torch.minimum(*(torch.where(p > 0, p, torch.inf) for p in planes)).clamp_max(1.6)
        amplitude = 0.015 / (depth * rays_of(camera).norm(dim=1, keepdim=True)).square()
        phase = 4 * np.pi * 1e8 / 299_792_458 * depth * rays_of(camera).norm(dim=1, keepdim=True)
        phasor = torch.cat(
            [torch.zeros(1, 2, *camera.shape), amplitude * phase.cos(), amplitude * phase.sin()], 1
        )
        seen = cues(
            phasor, depth, torch.ones_like(depth), torch.zeros_like(depth), numbers(camera), (2e7, 1e8)
        )
        maps.append(seen[0, :2])
    x, y, _ = rays_of(LENS)[0]
    grid = torch.stack(
        [(x * PLAIN.fx + PLAIN.cx + 0.5) / 60 - 1, (y * PLAIN.fy + PLAIN.cy + 0.5) / 45 - 1], -1
    )
    there = torch.nn.functional.grid_sample(maps[0][None], grid[None], align_corners=False)[0]
    inside = (grid.abs() < 0.75).all(-1)
    inside &= torch.from_numpy(np.hypot(*np.mgrid[-45:45, -60:60]) < 50)
    assert maps[0].max() > 0.01
    # what is seen differs with the field of view; continued beyond the image, it is the same scene
    for of, limit in ((0, 0.08), (1, 0.03)):
        assert (maps[1] - there)[of][inside].abs().mean() / there[of][inside].mean() < limit


def test_patches_have_the_size_that_the_lens_gives_them():
    """Rays and areas of every tenth pixel are those of the camera's own rays; beyond the border both go on straight, as a pinhole's do everywhere."""
    r, density = patches(thin_intrinsics(numbers(LENS), 10), 9, 12, 3)
    whole = torch.tensor(LENS.rays[..., :2])
    along_u = (whole[5::10, 6::10] - whole[5::10, 4:-2:10]) * 5
    along_v = (whole[6::10, 5::10] - whole[4:-2:10, 5::10]) * 5
    area = along_u[..., 0] * along_v[..., 1] - along_u[..., 1] * along_v[..., 0]
    inner = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(1 / density[0][inner], area, rtol=1e-3)
    np.testing.assert_allclose(r[0, :2][:, *inner], whole[5::10, 5::10].permute(2, 0, 1), atol=1e-5)
    for axis in (1, 2):  # second differences beyond the border and across it
        bent = r[0, :2].diff(n=2, dim=axis).abs()
        assert bent.narrow(axis, 0, 2).max() < 1e-5
        assert bent.narrow(axis, bent.shape[axis] - 2, 2).max() < 1e-5
    step = r[0, :2, 6, 2] - r[0, :2, 6, 3]  # one beyond, and the border itself
    np.testing.assert_allclose(-step, along_u[3, 0], rtol=5e-3, atol=2e-4)
    step = r[0, :2, 2, 6] - r[0, :2, 3, 6]
    np.testing.assert_allclose(-step, along_v[0, 3], rtol=5e-3, atol=2e-4)
    plain, _ = patches(thin_intrinsics(numbers(PLAIN), 10), 9, 12, 3)
    shifted = cut_intrinsics(thin_intrinsics(numbers(PLAIN), 10), -3, -3)
    torch.testing.assert_close(plain, rays(shifted, 15, 18), atol=1e-6, rtol=0)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A dataset through a strong lens, and one without, at half the sensor's resolution."""
    folder = tmp_path_factory.mktemp("lens")
    lens = make_dataset(folder / "lens", views=2, scale=2, distortion=LENS.distortion, seed=3)
    plain = make_dataset(folder / "plain", views=2, scale=2, splits=("train",), seed=9)
    return lens, plain


def test_frames_crops_and_mirrors_keep_the_geometry(seen):
    """Plane fits of the ground truth give its normals, in a whole frame, a window and a mirror."""
    data = FrameDataset([seen[0]], "train")
    frame, target = data[(0, 0)]
    assert frame.intrinsics.shape == (12,)

    def off(frame, target):
        k = scale_intrinsics(frame.intrinsics[None], 2)
        fitted = depth_to_normals(target.depth[None], target.good[None].float() + 1e-6, k, radius=1)
        return degrees(fitted, target.normals[None])[target.good].median()

    for changed in (
        (frame, target),
        crop(frame, target, 9, 31, (48, 64)),
        mirror(frame, target, -1),
        mirror(frame, target, -2),
    ):
        assert off(*changed) < 0.3


def test_cameras_with_and_without_a_lens_share_a_batch(seen):
    """The pinhole's frames get a lens that does nothing."""
    data = FrameDataset(seen, "train")
    frame, _ = collate([data[(0, i)] for i in range(len(data))])
    assert frame.intrinsics.shape == (len(data), 12)
    lenses = frame.intrinsics[:, 4:].abs().sum(1) > 0
    assert lenses.any()
    assert (~lenses).any()
    assert FrameDataset([seen[1]], "train")[(0, 0)][0].intrinsics.shape == (4,)


@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_networks_learn_and_are_measured_through_a_lens(seen, tmp_path, kind):
    """Both networks train on both cameras; what is measured of the sensor through the lens is what is measured through a pinhole."""
    base = preset("demo")
    network = (
        replace(base.network, width=4, levels=2)
        if kind == "compact"
        else Network(width=4, levels=2, refine_iterations=1)
    )
    config = Config(
        network=network,
        losses=replace(base.losses, chamfer=0.1 if kind == "compact" else 0.0),
        training=replace(base.training, batch=2, crop=(48, 64)),
        stages=(Stage("joint", 1, 1e-3),),
    )
    lens, plain = seen
    assert train(config, lens, tmp_path / "run", also=[plain]).steps > 0
    straight = make_dataset(tmp_path / "straight", views=2, scale=2, seed=3)
    found, without = (evaluate(d, tmp_path / "run", tmp_path / "results.json") for d in (lens, straight))
    for of, name in (("depth", "mae"), ("normal", "mean_deg")):
        told = [r["methods"]["sensor"][of]["pixel"][name] for r in (found, without)]
        assert told[0] == pytest.approx(told[1], rel=0.1)
    assert np.isfinite(found["methods"]["model"]["depth"]["pixel"]["mae"])


@pytest.mark.filterwarnings("ignore")
def test_an_export_takes_any_lens(tmp_path, monkeypatch):
    """One export serves cameras with and without a lens; one made before lenses were known says what to do."""
    pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("onnx")
    from tofcapture_model.inference.export import export

    monkeypatch.setattr(predicting, "WARM", 0)
    monkeypatch.setattr(predicting, "RUNS", 1)
    base = preset("demo")
    small = replace(base.network, width=4, levels=2, refine_iterations=0)
    weights = save_network(tmp_path / "run", replace(base, network=small))
    exported = weights.with_suffix(".onnx")
    export(weights, exported, size=SMALL.shape)
    for lens in ((), (-0.1, 0.02, 0.001, 0.002, 0.0)):
        camera = replace(SMALL, distortion=lens)
        rig = tmp_path / "rig.toml"
        rig.write_text(dumps_rig(Rig(camera, Camera(10, 8, 10, 10, 4.5, 3.5), np.eye(4), np.eye(4))))
        raw = saved(tmp_path / "raw.npy", wall(camera))
        for backend in ("torch", "onnx"):
            predict(raw, tmp_path / backend, weights=weights, rig=rig, backend=backend)
        for name in ("depth", "normals"):
            ours, theirs = (np.load(tmp_path / b / f"{name}.npy") for b in ("torch", "onnx"))
            np.testing.assert_allclose(theirs, ours, atol=1e-4)
    model = onnx.load(str(exported))
    place = next(i for i in model.graph.input if i.name == "intrinsics")
    assert place.type.tensor_type.shape.dim[1].dim_value == 12
