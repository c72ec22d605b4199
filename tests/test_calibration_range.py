"""Range calibration: the terms that were put into a made sensor come out, and what the data cannot tell is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.range_error.fit import fit_ranges
from calibration.range_error.views import seen_of, surface_at_pixels
from tests import answers
from tests.commands import calibrate
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.devices.sim.light import Light
from tofcapture.devices.sim.sensor import Sensor, expose
from tofcapture.errors import DataError, QualityError, UsageError
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, StereoFrame, StereoInfo, TofBurst, TofInfo, View
from tofcapture.ops import phase
from tofcapture.ops.phase.reference import decode_phasors
from tofcapture.rig import SPEED_OF_LIGHT, RangeError, Rig, dumps_rig, image_places, load_rig, loads_rig

CAMERA = Camera(120, 90, 95.3, 100.4, 58.4, 50.7)
STEREO = Camera(480, 384, 420.0, 420.0, 239.5, 191.5)
T_TOF_STEREO = poses.transform(poses.rotation_exp([0.03, 0.01, 0.02]), [-0.05, 0.03, 0.004])
INFO = TofInfo("made", "1", CAMERA, np.array([0.007, 0.0, 0.0]))
ERRORS = (
    RangeError(20e6, 0.017, 0.0, ((4, 0.012, 0.0),), 1.5e-4, image=((1, 0, 0.002), (0, 2, -0.0015))),
    RangeError(100e6, 0.017, 0.0, ((2, -0.0058, 0.0015), (4, 0.0005, 0.0)), 1.5e-4, image=((1, 1, 0.002),)),
)
SENSOR = Sensor(range_errors=ERRORS, scattering=0.0, pixel_offset=0.0003, celsius_drift=0.0)
VIEWS = 16


def plane_depth(camera, T_camera_tof, normal, centre):
    """Depth image of the plane through ``centre`` (ToF frame) and the cosine at its pixels."""
    n = T_camera_tof[:3, :3] @ normal
    c = T_camera_tof[:3, :3] @ centre + T_camera_tof[:3, 3]
    return (n @ c) / (camera.rays @ n)


def made_view(index, rng, sensor=SENSOR, thrown_back=0.0, grey=False, celsius=45.0, away=None):
    """A tilted board as both cameras see it; a share of light that took a longer way falls on it."""
    tilt, turn = np.radians(rng.uniform(5, 35)), 2.399963 * index
    away = 0.3 + 1.2 * index / (VIEWS - 1) if away is None else away
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    centre = np.array([0.0, 0.0, away])
    depth = plane_depth(CAMERA, np.eye(4), normal, centre)
    radial = CAMERA.depth_to_radial(depth)
    range_ = phase.radial_to_range(radial, CAMERA, INFO.illuminator)
    cosine = -(CAMERA.rays @ normal) / CAMERA.ray_lengths
    albedo = np.where(image_places(CAMERA)[..., 0] * 7 % 2 < 1, 0.15, 0.9) if grey else 0.9
    steady = albedo * cosine / radial**2
    k = 4 * np.pi / SPEED_OF_LIGHT * np.array([20e6, 100e6])[:, None, None]
    phasor = steady * (np.exp(1j * k * range_) + thrown_back * np.exp(1j * k * (range_ + 0.4)))
    raw, warm = expose(Light(phasor, steady), replace(sensor, celsius=celsius), INFO, 4, rng, 3)
    z = plane_depth(STEREO, poses.invert(T_TOF_STEREO), normal, centre)
    points = STEREO.unproject(z + rng.normal(0, 0.0004, z.shape)).astype(np.float32)
    arm = ArmState(np.zeros(6), np.eye(4), 0)
    return View(
        "calibration",
        index,
        TofBurst(raw, np.arange(4), warm, INFO),
        StereoFrame(points, 0, StereoInfo("made", "2", STEREO)),
        arm,
        arm,
        Rig(CAMERA, STEREO, T_TOF_STEREO, np.eye(4), INFO.illuminator),
    )


def made(index, rng, **more):
    """The same, reduced."""
    return seen_of(made_view(index, rng, **more), f"view-{index:03d}")


def left(found, true):
    """RMS over 0.3 to 1.5 m and the image of what the fitted error leaves, (F,) metres."""
    out = []
    for mine, theirs in zip(found, true, strict=True):
        r = np.linspace(0.3, 1.5, 61)[:, None, None]
        turned = 4 * np.pi * mine.modulation_hz / SPEED_OF_LIGHT * r
        place, radius = image_places(CAMERA)[None], phase.radius_px(CAMERA)[None]
        a, b = (e.at(turned, radius, 45.0, place, np.full((1, 1, 1), 200.0)) for e in (mine, theirs))
        out.append(np.sqrt(np.mean(np.square(a - b))))
    return np.array(out)


def test_the_surface_is_right_to_a_hundredth_of_a_millimetre():
    """A plane seen by the stereo camera with little noise gives its own depth at every ToF pixel that is good."""
    normal, centre = np.array([0.3, 0.2, -0.93]) / np.linalg.norm([0.3, 0.2, -0.93]), np.array([0, 0, 0.7])
    z = plane_depth(STEREO, poses.invert(T_TOF_STEREO), normal, centre)
    z = z + np.random.default_rng(0).normal(0, 2e-5, z.shape)
    seen = replace(made(0, np.random.default_rng(0)), depth=z)
    planes, good = surface_at_pixels(seen, T_TOF_STEREO)
    assert good.mean() > 0.5
    depth = 1 / (planes * CAMERA.rays).sum(axis=-1)
    assert np.abs(depth - plane_depth(CAMERA, np.eye(4), normal, centre))[good].max() < 1e-5


@pytest.fixture(scope="module")
def clean():
    """All views of the sensor as it is, reduced."""
    rng = np.random.default_rng(0)
    return [made(i, rng) for i in range(VIEWS)]


@pytest.mark.parametrize("guess", [np.zeros(6), np.array([2e-4, -3e-4, 3e-4, 3e-4, -3e-4, 2e-4])])
def test_offset_waves_and_image_terms_come_out(clean, guess):
    """17 mm, a 6 mm wave and terms over the image: less than a millimetre is left at both frequencies."""
    T = poses.exp(guess) @ T_TOF_STEREO
    fit = fit_ranges(clean, T, np.r_[[3e-4] * 3, [5e-4] * 3])
    assert (left(fit.errors, ERRORS) < 1e-3).all(), left(fit.errors, ERRORS)
    assert left(fit.errors, ERRORS)[1] < 8e-4
    assert not any({"temperature", "darkness"} & set(t.names) for t in fit.terms)


def test_light_thrown_back_shows_as_spread_of_the_views(clean):
    """Views that receive other shares of a detour differ from each other, and the fit says by how much."""
    rng = np.random.default_rng(1)
    seen = [made(i, rng, thrown_back=float(rng.uniform(0, 0.03))) for i in range(VIEWS)]
    fit = fit_ranges(seen, T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    assert fit.spread[0] > 0.001
    without = fit_ranges(clean, T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    assert (without.spread < 0.0008).all(), without.spread


def test_temperature_and_darkness_are_fitted_when_they_vary():
    """A drift of 0.3 mm/K and an error of dark surfaces are found once temperature and greys vary."""
    errors = tuple(replace(e, per_kelvin=-3e-4, per_inverse_amplitude=0.15) for e in ERRORS)
    sensor, rng = replace(SENSOR, range_errors=errors), np.random.default_rng(2)
    celsius = 45 + 6 * np.sin(np.arange(VIEWS) * 1.7)
    seen = [made(i, rng, sensor=sensor, grey=True, celsius=c) for i, c in enumerate(celsius)]
    fit = fit_ranges(seen, T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    assert all({"temperature", "darkness"} < set(t.names) for t in fit.terms)
    assert fit.errors[1].per_kelvin == pytest.approx(-3e-4, abs=5e-5)
    assert fit.errors[1].per_inverse_amplitude == pytest.approx(0.15, abs=0.05)
    assert (left(fit.errors, errors) < 1e-3).all()


def test_fitted_errors_correct_a_burst():
    """A burst decoded with the fitted errors gives the depth of the board, by the reference and by the fast decoder."""
    rng = np.random.default_rng(0)
    fit = fit_ranges([made(i, rng) for i in range(VIEWS)], T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    away = made(40, rng, sensor=replace(SENSOR, read_noise=0.0, shot_noise=False, quantise=False), away=0.83)
    decoded = decode_phasors(away.phasor, replace(INFO, range_errors=fit.errors), 45.0)
    planes, good = surface_at_pixels(away, T_TOF_STEREO)
    off = decoded.radial - CAMERA.ray_lengths / (planes * CAMERA.rays).sum(axis=-1)
    assert np.sqrt(np.mean(np.square(off[good]))) < 1e-3
    errors = tuple(replace(e, per_inverse_amplitude=0.1) for e in fit.errors)
    slow = decode_phasors(away.phasor, replace(INFO, range_errors=errors), 45.0)
    raw = phase.taps(away.phasor, 2 * np.abs(away.phasor), INFO.modulation_hz, INFO.phase_rad)
    fast = phase.Decoder(replace(INFO, range_errors=errors))(raw, 45.0)
    assert np.abs(fast.depth - CAMERA.radial_to_depth(slow.radial)).max() < 2e-5
    assert np.abs(slow.radial - decoded.radial).max() > 1e-4
    assert (
        loads_rig(dumps_rig(Rig(CAMERA, STEREO, np.eye(4), np.eye(4), range_errors=errors))).range_errors
        == errors
    )


def test_a_short_range_leaves_the_waves_physical():
    """Over half a metre waves, offset and scale look alike: none comes out larger than a sensor's, and beyond the range it stays near."""
    rng = np.random.default_rng(0)
    seen = [made(i, rng, away=0.8 + 0.5 * i / 11) for i in range(12)]
    fit = fit_ranges(seen, T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    for error, true in zip(fit.errors, ERRORS, strict=True):
        known = {m: np.hypot(a, b) for m, a, b in true.harmonics}
        for m, a, b in error.harmonics:
            assert abs(np.hypot(a, b) - known.get(m, 0.0)) < 0.007
        assert error.fitted_m is not None
        assert 0.5 < error.fitted_m[0] < 0.8
        assert 1.3 < error.fitted_m[1] < 1.9
    assert (left(fit.errors, ERRORS) < 2.5e-3).all(), left(fit.errors, ERRORS)


def test_an_impossible_wave_is_held():
    """Ranges that only a wave of 200 mm explains do not get one: 71 mrad of phase are the most that four taps make."""
    wild = tuple(replace(e, harmonics=((1, 0.2, 0.0),)) for e in ERRORS[:1])
    rng = np.random.default_rng(1)
    fit = fit_ranges(
        [made(i, rng, sensor=replace(SENSOR, range_errors=wild)) for i in range(VIEWS)], T_TOF_STEREO
    )
    for m, a, b in fit.errors[0].harmonics:
        assert np.hypot(a, b) <= 0.0711 * 7.495 / (2 * np.pi), m


def test_a_constant_between_the_frequencies_is_found():
    """40 and 70 MHz whose ranges are 65 mm apart, as in captures of such a camera."""
    info = replace(INFO, modulation_hz=(40e6,) * 4 + (70e6,) * 4)
    errors = (RangeError(40e6, offset=0.065), RangeError(70e6, offset=0.0))
    rng, seen = np.random.default_rng(4), []
    k = 4 * np.pi / SPEED_OF_LIGHT * np.array([40e6, 70e6])[:, None, None]
    for i in range(8):
        view = made(2 * i, rng)
        depth = plane_depth(CAMERA, np.eye(4), *plane_of(view))
        range_ = phase.radial_to_range(CAMERA.depth_to_radial(depth), CAMERA, INFO.illuminator)
        late = np.array([e.offset for e in errors])[:, None, None]
        seen.append(replace(view, info=info, phasor=300 * np.exp(1j * k * (range_ + late))))
    fit = fit_ranges(seen, T_TOF_STEREO, np.r_[[3e-4] * 3, [5e-4] * 3])
    at = np.array(
        [
            [e.at(k[i, 0, 0] * r, 20.0, 45.0, np.zeros(2)) for r in (0.5, 0.9, 1.3)]
            for i, e in enumerate(fit.errors)
        ]
    )
    np.testing.assert_allclose(at[0], 0.065, atol=1.5e-3)
    np.testing.assert_allclose(at[1], 0.0, atol=1.5e-3)


def plane_of(seen):
    """Normal and a point, ToF frame, of the plane that a view's stereo camera sees."""
    points = poses.transform_points(T_TOF_STEREO, STEREO.unproject(seen.depth).reshape(-1, 3))
    normal = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]
    return normal / np.linalg.norm(normal), points.mean(axis=0)


def test_too_few_views_and_a_wrong_frequency_are_refused():
    """Three views, and phases whose sign is reversed, have names."""
    rng = np.random.default_rng(3)
    with pytest.raises(DataError, match="at least 6"):
        fit_ranges([made(i, rng) for i in range(3)], T_TOF_STEREO)
    with pytest.raises(QualityError, match="no fixed difference"):
        fit_ranges(
            [replace(s, phasor=s.phasor.conj()) for s in (made(2 * i, rng) for i in range(8))], T_TOF_STEREO
        )


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Eight views from 0.3 to 1.4 m."""
    root, rng = tmp_path_factory.mktemp("range"), np.random.default_rng(5)
    for i, k in enumerate(range(0, 16, 2)):
        write_view(view_path(root, "calibration", i), made_view(k, rng))
    return root


@pytest.fixture(scope="module")
def dry(recording):
    """What the command says of it without writing."""
    outcome = calibrate("range", recording, "--dry-run")
    assert not (recording / "rig.toml").exists()
    return outcome


def test_command_writes_rig_and_report(recording, dry):
    """calibrate range fits a recording, writes rig.toml and range.json, and says what it could not know."""
    outcome = calibrate("range", recording)
    found = load_rig(recording / "rig.toml")
    assert (left(found.range_errors, ERRORS) < 2e-3).all()
    written = json.loads((recording / "range.json").read_text())
    assert [list(e.fitted_m) for e in found.range_errors] == [written["covered_m"]] * 2
    assert f"valid from {written['covered_m'][0]:.2f} to" in outcome.text
    assert written["transform"] == "nothing"
    assert written == dry.data == {k: v for k, v in outcome.data.items() if k != "rig"}
    answers.hold("range", {"data": written, "text": outcome.text}, off=0.03, least=1e-4)
    for word in ("align", "temperature varied by 0.0 K", "no term of dark"):
        assert word in outcome.text
    with pytest.raises(UsageError, match="harmonics"):
        calibrate("range", recording, "--orders", "0")
    with pytest.raises(UsageError, match="whole numbers"):
        calibrate("range", recording, "--orders", "two")


def test_the_report_s_numbers_are_those_of_the_sensor(dry):
    """What the report says in millimetres is the error that was put in before the fit, and what it lacks of it afterwards."""
    data = dry.data
    near, far = data["covered_m"]
    assert 0.25 < near < 0.32
    assert 1.3 < far < 2.1
    for row, error in zip(data["frequencies"], ERRORS, strict=True):
        assert row["found"]["offset"]["value"] == pytest.approx(
            0.017, abs=3 * row["found"]["offset"]["sigma"]
        )
        assert row["found"]["radius"]["value"] == pytest.approx(1.5e-4, abs=4e-5)
        for line in row["by_range"]:
            r = np.linspace(line["from_m"], line["from_m"] + 0.1, 21)[:, None, None]
            turned = 4 * np.pi * error.modulation_hz / SPEED_OF_LIGHT * r
            put_in = error.at(turned, phase.radius_px(CAMERA), 45.0, image_places(CAMERA))
            assert 1e3 * put_in.min() - 2 < line["before_mm"] < 1e3 * put_in.max() + 2
            assert abs(line["left_out_mm"]) < 5
            assert line["pixels"] > 100
        assert {round(10 * line["from_m"]) for line in row["by_range"]} >= {3, 7, 9, 11, 13}
        assert 10 < row["before_mm"] < 30
        assert row["after_mm"] < 1
        assert row["after_mm"] <= row["left_out_mm"] < 2
        assert row["views_differ_mm"] < 1
        assert row["verdict"] == ("PASS" if row["left_out_mm"] <= 1 else "WARN")
    moved = data["transform_moved"]
    assert np.abs(moved["translation_mm"]).max() < 5
    assert np.abs(moved["rotation_deg"]).max() < 0.3


def test_what_the_alignment_vouches_for_holds_the_transform(recording, tmp_path):
    """Evidence of the very rig narrows the transform's prior, of the averaged method less; of another rig it counts for nothing."""
    copied = tmp_path / "recording"
    (copied / "views").mkdir(parents=True)
    (copied / "views" / "calibration").symlink_to(recording / "views" / "calibration")
    rig = Rig(CAMERA, STEREO, T_TOF_STEREO, np.eye(4), INFO.illuminator)
    (copied / "rig.toml").write_text(dumps_rig(rig))
    error = {"translation_mm": 0.001, "rotation_deg": 0.0001}
    evidence = {
        "T_tof_stereo": T_TOF_STEREO.tolist(), "working_point_m": [0, 0, 0.8], "standard_error": error,
    }  # fmt: skip
    stated = {"translation_mm": [0.001] * 3, "rotation_deg": [0.0001] * 3}
    other = (poses.exp([0.01, 0, 0, 0, 0, 0]) @ T_TOF_STEREO).tolist()
    for extra, known, most in (
        ({"sigma": stated}, "aligned", 0.001),
        ({}, "averaged", 0.003),
        ({"T_tof_stereo": other}, "nothing", np.inf),
    ):
        (copied / "evidence.json").write_text(json.dumps(evidence | extra))
        data = calibrate("range", copied, "--dry-run").data
        assert data["transform"] == known
        assert np.abs(data["transform_moved"]["translation_mm"]).max() < 3 * most
