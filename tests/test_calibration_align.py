"""Alignment end to end: ray-cast board views with mixed pixels, noise and wiggle go in, the rig's transform comes out."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.align import align
from calibration.alignment.averages import average_transforms
from calibration.alignment.methods import alignment_error
from calibration.alignment.rounds import Solution, fit_range_residual
from calibration.cli.align import ALIGN
from calibration.evidence import evidence_of
from calibration.registration.clouds import (
    Cloud,
    grid_normals,
    plane_departure,
    stereo_cloud,
    surface_points,
    tof_depth,
)
from calibration.registration.gate import (
    Refusal,
    Registration,
    check_registration,
    measure_registration,
    residuals,
)
from calibration.registration.pairs import Pair, pair_of, sighting_of
from calibration.registration.rims import rim_cloud, stereo_rims, tof_rims
from tests import answers
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.files.view import open_view, view_path, write_view
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, Truth, View
from tofcapture.importing.said import Said
from tofcapture.importing.views import import_data
from tofcapture.libraries import load_open3d
from tofcapture.ops import phase
from tofcapture.rig import SPEED_OF_LIGHT, RangeError, Rig, load_rig

TOF = Camera(240, 180, 190.6186, 200.7526, 116.8406, 101.4767)
STEREO = Camera(640, 512, 575.0, 575.0, 319.5, 255.5)
TRUE = poses.transform(poses.rotation_exp([0.01, -0.06, 0.02]), [0.095, 0.012, -0.02])
GUESS = poses.exp([0.006, -0.007, 0.005, 0.015, -0.012, 0.02]) @ TRUE
SUB = 3  # sub-samples per ToF pixel and axis: mixed pixels come out right


def box_mesh(size, T):
    """Triangles of a box centred on its frame."""
    o3d = load_open3d()
    mesh = o3d.geometry.TriangleMesh.create_box(*size)
    mesh.translate(-np.asarray(size) / 2)
    return mesh.transform(T)


def board_meshes():
    """0.5 x 0.4 m board as strips around two windows of different size, a box, a ball, table and wall; world z up."""
    o3d = load_open3d()
    tilt = poses.transform(poses.rotation_exp([0.0, -0.35, 0.0]), [0.0, 0.0, 0.27])
    strips = [
        ((0.01, 0.5, 0.06), (0, 0, 0.17)),
        ((0.01, 0.5, 0.05), (0, 0, -0.175)),
        ((0.01, 0.5, 0.05), (0, 0, 0.03)),
        ((0.01, 0.06, 0.4), (0, 0.22, 0)),
        ((0.01, 0.05, 0.4), (0, -0.225, 0)),
        ((0.01, 0.07, 0.2), (0, 0.02, 0.1)),
        ((0.01, 0.12, 0.2), (0, -0.06, -0.1)),
        ((0.01, 0.1, 0.1), (0, 0.15, 0.1)),
    ]
    meshes = [box_mesh(size, tilt @ poses.transform(np.eye(3), at)) for size, at in strips]
    turned = poses.rotation_exp([0.0, 0.0, 0.6])
    meshes.append(box_mesh((0.12, 0.1, 0.2), poses.transform(turned, [-0.12, 0.33, 0.1])))
    meshes.append(o3d.geometry.TriangleMesh.create_sphere(0.07, 40).translate([-0.08, -0.33, 0.07]))
    meshes.append(box_mesh((1.4, 1.2, 0.02), poses.transform(np.eye(3), [0, 0, -0.01])))
    meshes.append(box_mesh((0.02, 2.4, 2.0), poses.transform(np.eye(3), [0.55, 0, 0.6])))
    return meshes


def scene_of(meshes):
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    for mesh in meshes:
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    return scene


def cast(scene, T_world_camera, rays):
    """Depth factor along unnormalised rays (..., 3) and normals in the camera frame."""
    o3d = load_open3d()
    world = poses.rotate_vectors(T_world_camera, rays)
    origin = np.broadcast_to(T_world_camera[:3, 3], world.shape)
    hit = scene.cast_rays(o3d.core.Tensor(np.concatenate([origin, world], -1).astype(np.float32)))
    t = hit["t_hit"].numpy().astype(np.float64)
    normals = poses.rotate_vectors(poses.invert(T_world_camera), hit["primitive_normals"].numpy())
    return np.where(np.isfinite(t), t, np.nan), normals


def tof_burst(scene, T_world_tof, rng, frames, wiggle, scatter):
    """Burst of a coaxial ToF camera: I/Q averaged over sub-samples, wiggle in metres, scattered light, read noise."""
    fine = TOF.scaled(SUB)
    depth, normals = cast(scene, T_world_tof, fine.rays)
    radial = depth * fine.ray_lengths
    cosine = np.abs((normals * fine.rays).sum(-1)) / fine.ray_lengths
    amplitude = np.nan_to_num(250 * cosine / radial**2)
    planes = []
    for hz in (20e6, 100e6):
        k = 4 * np.pi * hz / 299_792_458.0
        longer = np.nan_to_num(radial) + wiggle * np.sin(2 * k * np.nan_to_num(radial))
        z = amplitude * np.exp(1j * k * longer)
        z = z.reshape(TOF.height, SUB, TOF.width, SUB).mean(axis=(1, 3))
        planes.append(z * (1 - scatter) + scatter * z.mean())
    phasor = np.stack(planes)
    offset = np.full(phasor.shape, 900.0) + np.abs(phasor)
    info = TofInfo("test", "0", TOF, np.zeros(3))
    clean = phase.taps(phasor, offset, info.modulation_hz, info.phase_rad)
    noisy = rng.normal(clean, 7.0, (frames, *clean.shape))
    raw = np.clip(np.round(noisy), 0, 4095).astype(np.uint16)
    return TofBurst(raw, np.arange(frames, dtype=np.int64), np.full(frames, 45.0), info), depth


def stereo_frame(scene, T_world_stereo, rng):
    """Point map with 0.03 % noise and holes where the surface is grazing or the right eye is blocked."""
    depth, normals = cast(scene, T_world_stereo, STEREO.rays)
    points = depth[..., None] * STEREO.rays
    cosine = np.abs((normals * STEREO.rays).sum(-1)) / STEREO.ray_lengths
    eye = poses.transform(np.eye(3), [0.1, 0, 0])
    seen, _ = cast(scene, T_world_stereo @ eye, np.nan_to_num(points - eye[:3, 3], nan=1.0))
    good = (cosine > np.cos(np.radians(70))) & (np.abs(seen - 1) < 0.003) & (depth < 3)
    noisy = points * (1 + rng.normal(0, 3e-4, depth.shape))[..., None]
    return StereoFrame(
        np.where(good[..., None], noisy, np.nan).astype(np.float32), 0, StereoInfo("test", "0", STEREO)
    )


def simulated_view(index, seed=0, frames=4, wiggle=0.001, scatter=0.003, meshes=None, T_world_tof=None):
    """One view of the board from a direction tilted 15 to 40 degrees, 0.55 to 0.95 m away."""
    rng = np.random.default_rng([seed, index])
    if T_world_tof is None:
        yaw, pitch = (
            np.radians(38) * np.sin(2.4 * index + 0.5),
            np.radians(20 + 16 * np.cos(2.4 * index + 0.5)),
        )
        away = 0.55 + 0.4 * ((index * 0.618) % 1)
        eye = np.array([0, 0, 0.25]) + away * np.array(
            [-np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)]
        )
        T_world_tof = poses.look_at(eye, [0, 0, 0.23], roll=rng.uniform(-0.3, 0.3))
    scene = scene_of(board_meshes() if meshes is None else meshes)
    burst, _ = tof_burst(scene, T_world_tof, rng, frames, wiggle, scatter)
    state = ArmState(np.zeros(6), np.eye(4), 0)
    fine = TOF.scaled(2).shape
    truth = Truth(
        np.full(fine, np.nan, np.float32),
        np.full((*fine, 3), np.nan, np.float32),
        np.zeros(fine, bool),
        TRUE,
        np.eye(4),
    )
    rig = Rig(TOF, STEREO, GUESS, np.eye(4))
    return View(
        "calibration",
        index,
        burst,
        stereo_frame(scene, T_world_tof @ TRUE, rng),
        state,
        state,
        rig,
        {},
        truth,
    )


@pytest.fixture(scope="module")
def views():
    return [simulated_view(i) for i in range(6)]


@pytest.fixture(scope="module")
def recording(views, tmp_path_factory):
    """Recording folder with six board views."""
    folder = tmp_path_factory.mktemp("recording")
    for view in views:
        write_view(view_path(folder, "calibration", view.index), view)
    return folder


@pytest.fixture(scope="module")
def aligned(recording):
    """The recording after ``align``: rig and evidence."""
    return align(recording)


def test_align_recovers_the_rig(aligned):
    """From a guess off by 1.5 degrees and 1.5 cm, six views bring the true rig to 0.1 degrees and 1 mm at 0.8 m."""
    rig, evidence = aligned
    rotation, translation = alignment_error(rig.T_tof_stereo, TRUE)
    assert np.degrees(rotation) < 0.1
    assert translation < 0.001
    assert evidence["truth"]["rotation_error_deg"] == pytest.approx(np.degrees(rotation))
    assert evidence["truth"]["translation_error_mm"] == pytest.approx(1e3 * translation)


@pytest.mark.slow
def test_align_finds_the_second_camera_of_imported_views(views, tmp_path):
    """Taps and point maps of the board, without a word of how the cameras stand; what comes after is placed by the answer."""
    for view in views:
        np.save(tmp_path / f"raw_{view.index}.npy", view.tof.raw)
        np.save(tmp_path / f"points_{view.index}.npy", view.stereo.points)
    tof = {k: getattr(TOF, k) for k in ("fx", "fy", "cx", "cy")}
    with pytest.raises(ConfigError, match=r"missing \[truth\] T_tof_truth") as info:
        import_data([tmp_path], tmp_path / "rec", Said(scene="mug", tof=tof))
    assert "--scene calibration" in info.value.hint
    found = import_data([tmp_path], tmp_path / "rec", Said(scene="calibration", tof=tof))
    assert f"align {tmp_path / 'rec'} --initial none" in found.warnings[0]
    rig, _ = align(tmp_path / "rec", initial="none")
    rotation, translation = alignment_error(rig.T_tof_stereo, TRUE)
    assert np.degrees(rotation) < 0.1
    assert translation < 0.001
    (tmp_path / "mug").mkdir()
    for name in ("raw_0.npy", "points_0.npy"):
        (tmp_path / name).rename(tmp_path / "mug" / name)
    import_data([tmp_path / "mug"], tmp_path / "rec", Said(scene="mug", tof=tof))
    mug = open_view(view_path(tmp_path / "rec", "mug", 0))
    np.testing.assert_allclose(mug.rig.T_tof_stereo, rig.T_tof_stereo, atol=1e-12)


def test_align_keeps_what_it_does_not_measure(aligned):
    """Only T_tof_stereo changes; the initial guess is stated."""
    rig, evidence = aligned
    assert (rig.tof, rig.stereo) == (TOF, STEREO)
    np.testing.assert_array_equal(rig.T_flange_tof, np.eye(4))
    np.testing.assert_array_equal(evidence["initial_T_tof_stereo"], GUESS)


def test_align_writes_rig_and_evidence(recording, aligned):
    """The files hold what the function returned, and no partial file is left."""
    rig, evidence = aligned
    np.testing.assert_array_equal(load_rig(recording / "rig.toml").T_tof_stereo, rig.T_tof_stereo)
    assert json.loads((recording / "evidence.json").read_text()) == evidence
    assert not list(recording.glob(".*partial"))


def test_evidence_tells_every_pair(aligned):
    """Each view has a row with its residual, and the rows agree with the counts."""
    _, evidence = aligned
    assert (evidence["format"], evidence["version"], evidence["views"]) == ("tofcapture-evidence", 1, 6)
    assert evidence["used"] == sum(pair["accepted"] for pair in evidence["pairs"]) >= 4
    assert all(pair["rmse_mm"] < 3 and pair["inliers"] > 1000 for pair in evidence["pairs"])
    assert [pair["view"] for pair in evidence["pairs"]] == list(evidence["provenance"]["inputs"])


def test_numbers_of_evidence_are_those_of_the_registrations():
    """Of known registrations every number is the hand-computed one, in its unit; the checks and the verdict follow from them."""
    at = np.array([0.0, 0.0, 0.8])
    moved = [
        0.0,
        1e-3,
        -1e-3,
        0.05,
        0.0,
    ]  # m along x; the fourth is an outlier, the last did not pass the gate
    registrations = [
        Registration(poses.transform(np.eye(3), [x, 0, 0]), 900, 0.002, 0.6, np.eye(6), 7.0, at, np.zeros(6))
        for x in moved
    ]
    lost = replace(registrations[4], inliers=0, rmse=np.nan, condition=np.inf, fitness=0.0)
    refusals = [None] * 4 + [Refusal.NO_OVERLAP]
    average = average_transforms([r.T_target_source for r in registrations[:4]], at)
    residual = RangeError(
        100e6, offset=0.004, per_pixel_radius=1e-5, harmonics=((1, 0, 0), (2, 0.001, -0.002), (4, 0, 0))
    )
    solution = Solution([*registrations[:4], lost], refusals, average, [0, 1, 2, 3], at, residual)
    rig = Rig(TOF, STEREO, np.eye(4), np.eye(4))
    none = Cloud(np.zeros((0, 3)), np.zeros((0, 3)))
    pairs = [
        Pair(f"view-{i:03d}.h5", f"{i}", np.zeros((0, 3)), none, rig, 100e6, np.eye(4)) for i in range(5)
    ]
    start = poses.exp([0.0, 0.012, 0.0, 0.0, 0.0, np.radians(4.0)])
    found = evidence_of(pairs, solution, "open3d", start, np.eye(4), {"method": "averaged"})
    assert (found["views"], found["used"], found["verdict"]) == (5, 3, "WARN")
    assert [p["reason"] for p in found["pairs"]] == ["", "", "", "outlier", "no overlap"]
    assert found["spread"] == {"rotation_deg": 0.0, "translation_mm": pytest.approx(1.0)}
    assert found["standard_error"]["translation_mm"] == pytest.approx(1 / np.sqrt(3))
    assert found["pairs"][1] == {
        "view": "view-001.h5", "accepted": True, "reason": "", "rmse_mm": 2.0, "inliers": 900, "fitness": 0.6, "condition": 7.0,
        "rotation_from_mean_deg": 0.0, "translation_from_mean_mm": pytest.approx(1.0),
    }  # fmt: skip
    assert found["pairs"][3]["translation_from_mean_mm"] == pytest.approx(50.0)
    assert [found["pairs"][4][key] for key in ("rmse_mm", "condition", "translation_from_mean_mm")] == [
        None
    ] * 3
    assert found["range_residual"]["harmonics"] == [[1, 0, 0], [2, 0.001, -0.002], [4, 0, 0]]
    assert found["range_residual"]["per_pixel_radius"] == 1e-5
    assert (found["range_residual"]["offset"], found["working_point_m"]) == (0.004, [0, 0, 0.8])
    assert found["truth"] == {"rotation_error_deg": 0.0, "translation_error_mm": 0.0}
    judged = {c["words"]: (c["value"], c["verdict"]) for c in found["checks"]}
    assert judged["board views used"] == ("3", "WARN")
    assert judged["median residual of the used views"] == ("2 mm", "PASS")
    assert judged["turned from the initial guess"] == ("4 deg", "WARN")
    assert judged["moved from the initial guess"] == ("12 mm", "PASS")
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_same_recording_gives_the_same_bytes(recording, aligned):
    """A second run, started from the first one's files, writes identical files."""
    before = [(recording / name).read_bytes() for name in ("rig.toml", "evidence.json")]
    align(recording)
    assert [(recording / name).read_bytes() for name in ("rig.toml", "evidence.json")] == before


def test_recording_without_board_views_says_what_to_do(tmp_path):
    """An empty recording is a data error whose hint is the command that fills it."""
    with pytest.raises(DataError, match="views of the board") as caught:
        align(tmp_path)
    assert "record --calibration" in caught.value.hint


def test_too_few_good_pairs_write_nothing(views, tmp_path):
    """Two views cannot be averaged: a quality error with the reasons, and no rig.toml."""
    for view in views[:2]:
        write_view(view_path(tmp_path, "calibration", view.index), view)
    with pytest.raises(QualityError, match="at least 3"):
        align(tmp_path)
    assert not (tmp_path / "rig.toml").exists()


def test_unknown_backend_fails_before_any_work(tmp_path):
    """The backend's name is checked first."""
    with pytest.raises(ConfigError, match="open3d"):
        align(tmp_path, backend="teaser")


def test_views_of_another_camera_are_refused(views, tmp_path):
    """One recording holds one rig."""
    other = replace(views[2], rig=replace(views[2].rig, tof=replace(TOF, fx=200.0)))
    for view in (*views[:2], other):
        write_view(view_path(tmp_path, "calibration", view.index), view)
    with pytest.raises(DataError, match="other cameras"):
        align(tmp_path)


def test_view_that_saw_nothing_is_an_empty_pair():
    """Dead cameras give an empty pair and no numerical warnings; the gate calls it empty."""
    view = simulated_view(0, frames=2)
    dark = replace(view.tof, raw=np.zeros_like(view.tof.raw))
    blind = replace(view.stereo, points=np.full_like(view.stereo.points, np.nan))
    view = replace(view, tof=dark, stereo=blind)
    pair = pair_of(view, sighting_of(view), "view-000", "")
    result = measure_registration(np.eye(4), pair.source, pair.target)
    assert (len(pair.source), len(pair.target)) == (0, 0)
    assert check_registration(result, pair.source, pair.target, np.eye(4)) is Refusal.EMPTY


def test_surface_points_lie_on_the_board(views):
    """What survives of a view lies within millimetres of the true board: no flying pixels, no background."""
    view = simulated_view(1, wiggle=0.0, scatter=0.0)
    _, depth = tof_depth(view.tof)
    points = surface_points(view.tof, depth)
    found = residuals(points, stereo_cloud(view.stereo), poses.invert(TRUE))
    assert len(points) > 1000
    assert len(found.source) > 0.9 * len(points)
    assert np.quantile(np.abs(found.distance), 0.99) < 0.009
    assert abs(np.median(found.distance)) < 0.0005


def test_rims_of_both_cameras_agree_at_the_true_rig():
    """ToF rims come to lie on stereo rims to half a millimetre in the median, a tenth of a ToF pixel."""
    view = simulated_view(3)
    phasor, depth = tof_depth(view.tof)
    tof = tof_rims(phasor, depth, TOF)
    stereo = rim_cloud(stereo_rims(view.stereo.points), poses.invert(TRUE)[:3, 3])
    found = residuals(tof.points, stereo, poses.invert(TRUE))
    assert len(found.source) > 100
    assert abs(np.median(found.distance)) < 0.0005
    assert np.median(np.abs(found.distance)) < 0.001


def test_plane_departure_is_zero_on_any_plane_and_half_a_jump_at_an_edge():
    """Inverse depth is linear on a plane; across a step the departure is about half of the step."""
    normal = np.array([0.6, -0.3, 0.8])
    depth = 0.8 / (TOF.rays @ normal)
    assert plane_departure(depth)[1:-1, 1:-1].max() < 1e-12
    depth = np.full((9, 9), 0.8)
    depth[:, 5:] = 0.81
    assert plane_departure(depth)[4, 4] == pytest.approx(0.005, rel=0.05)
    assert plane_departure(depth)[4, 2] == 0


def test_grid_normals_of_a_plane_are_exact_and_face_the_camera():
    """On a noise-free plane the organised normals are the plane's."""
    normal = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])
    points = TOF.rays * (-0.8 / (TOF.rays @ normal))[..., None]
    np.testing.assert_allclose(
        grid_normals(points)[1:-1, 1:-1], np.broadcast_to(normal, (*TOF.shape, 3))[1:-1, 1:-1], atol=1e-9
    )


def test_range_residual_recovers_a_wave():
    """A wave put on the ranges of six tilted planes is found to a tenth of a millimetre with their poses unknown."""
    rng = np.random.default_rng(0)
    truth = RangeError(100e6, harmonics=((2, 0.001, -0.002),))
    pairs, registrations = [], []
    for _ in range(6):
        normal = np.append(rng.uniform(-0.5, 0.5, 2), 1.0)
        exact = (TOF.rays * (rng.uniform(0.6, 1.0) / (TOF.rays @ normal))[..., None])[::2, ::2].reshape(-1, 3)
        unit = -normal / np.linalg.norm(normal)
        target = Cloud(exact, np.tile(unit, (len(exact), 1)))
        range_ = np.linalg.norm(exact, axis=1)
        error = truth.at(4 * np.pi * 100e6 / SPEED_OF_LIGHT * range_, 0.0, 45.0)
        source = exact * (1 + error / range_)[:, None]
        pairs.append(Pair("", "", source, target, Rig(TOF, STEREO, np.eye(4), np.eye(4)), 100e6, None))
        registrations.append(measure_registration(np.eye(4), source, target))
    found = fit_range_residual(pairs, registrations, RangeError(100e6))
    np.testing.assert_allclose(found.harmonics[1], truth.harmonics[0], atol=2e-4)


def test_evidence_and_rig_are_what_they_were(recording, aligned):
    """Of one recording: every pair's numbers, the checks, and the file that the other programs read."""
    told = {"evidence": aligned[1], "rig": (recording / "rig.toml").read_text()}
    answers.hold("align", told, off=0.03, least=1e-4, without=("provenance",))


def test_align_command_reports_as_text_and_json(recording, monkeypatch):
    """The command's text is a table with a verdict; its data is JSON and holds spread, error and paths."""
    evidence = json.loads((recording / "evidence.json").read_text())
    rig = load_rig(recording / "rig.toml")
    monkeypatch.setattr("calibration.align.align", lambda *_: (rig, evidence))
    parser = argparse.ArgumentParser()
    ALIGN.configure(parser)
    outcome = ALIGN.run(parser.parse_args([str(recording)]))
    assert f"verdict: {evidence['verdict']}" in outcome.text
    assert all(c["cause"] in outcome.text for c in evidence["checks"] if c["verdict"] != "PASS")
    assert outcome.text.count("view-") == 6
    data = json.loads(json.dumps(outcome.data))
    assert data["rotation_error_deg"] < 0.1
    assert data["rig"] == str(recording / "rig.toml")
    assert {"spread", "standard_error", "pairs", "evidence", "translation_error_mm"} <= data.keys()
