"""The evidence page, its limits, and the comparison with an older calibration."""

from __future__ import annotations

import json
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import asdict

import numpy as np
import pytest

from calibration.board.detector import BoardRefusal, detect, stereo_sight, tof_sight
from calibration.board.geometry import load_board
from calibration.cli.align import _page
from calibration.evidence import (
    OldRig,
    drift,
    drift_text,
    judged_evidence,
    load_old,
    read_evidence,
    uncertainty,
)
from calibration.evidence.page import (
    Samples,
    image_medians,
    page_content,
    sample_recording,
    write_evidence_page,
)
from calibration.limits import LENS, LIMITS, judged, worst
from tests import answers, pictures
from tofcapture.camera import Camera
from tofcapture.colours import Scale
from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, scene_objects
from tofcapture.devices.sim.world import SimWorld
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.files.view import view_path, write_view
from tofcapture.frames import ArmState, View
from tofcapture.poses import exp, invert, look_at, rotation_angle, rotation_exp, transform
from tofcapture.rig import dumps_rig
from tofcapture.viz import page as charts

CAMERA = Camera(240, 180, 190.6, 200.7, 116.8, 101.5)
TRUE = exp([0.05, 0.07, 0.004, 0.01, -0.02, 0.01])
LIGHTER = {"render": {"patches": 200, "patch_rays": 16, "rays": 4, "subpixels": 3}}


def evidence(**changes):
    """An evidence as align writes it, of two views."""
    pair = {
        "accepted": True, "reason": "", "rmse_mm": 1.0, "inliers": 9000, "fitness": 0.9, "condition": 5.0,
        "rotation_from_mean_deg": 0.05, "translation_from_mean_mm": 0.4,
    }  # fmt: skip
    bad = {**pair, "accepted": False, "reason": "poor fit", "rotation_from_mean_deg": None}
    found = {
        "format": "tofcapture-evidence", "version": 1, "backend": "open3d", "views": 2, "used": 1,
        "T_tof_stereo": TRUE.tolist(), "initial_T_tof_stereo": (exp([0.01, 0, 0, 0, 0.02, 0]) @ TRUE).tolist(),
        "spread": {"rotation_deg": 0.1, "translation_mm": 0.5},
        "standard_error": {"rotation_deg": 0.03, "translation_mm": 0.15},
        "working_point_m": [0.0, 0.0, 0.8],
        "pairs": [{**pair, "view": "views/calibration/view-000.h5"}, {**bad, "view": "views/calibration/view-001.h5"}],
        "truth": None, **changes,
    }  # fmt: skip
    return {**found, "checks": [asdict(c) for c in judged_evidence(found)]}


def samples(n=4000, bias=0.0):
    """Residuals with a bias that grows over the range."""
    rng = np.random.default_rng(0)
    r = rng.uniform(0.5, 1.0, n)
    T = transform(rotation_exp([np.pi - 0.4, 0, 0]), [0, 0, 0.8])
    circle = 0.2 * np.stack([np.cos(np.arange(32) / 5), np.sin(np.arange(32) / 5)], axis=1)
    return Samples(
        CAMERA,
        rng.uniform([0, 0], [239, 179], (n, 2)),
        r,
        rng.uniform(100, 2000, n),
        bias * (r - 0.75) + 0.0005 * rng.standard_normal(n),
        0.0002 * rng.standard_normal(300),
        [T],
        [circle],
    )


def view_of_board():
    """One simulated board view at full size, light kept cheap."""
    world = SimWorld(read_constants(LIGHTER, "test"), 3, scene_objects)
    world.place("calibration")
    tilt = rotation_exp([0, BOARD_TILT, 0]) @ rotation_exp([0.45, 0.2, 0])
    eye = BOARD_CENTRE + 0.7 * tilt[:, 2]
    T_flange = look_at(eye, BOARD_CENTRE, up=(1.0, 0.0, 0.2)) @ invert(world.true_rig.T_flange_tof)
    world.set_pose(T_flange, b"board")
    state = ArmState(np.zeros(6), T_flange, 1)
    return View(
        "calibration", 0, world.tof(4, lambda: 1), world.stereo(lambda: 1), state, state, world.nominal_rig(), {}, world.truth()
    )  # fmt: skip


@pytest.fixture(scope="module")
def view():
    return view_of_board()


@pytest.fixture(scope="module")
def recording(view, tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_view(view_path(folder, "calibration", 0), view)
    found = evidence(T_tof_stereo=view.truth.T_tof_stereo.tolist())
    (folder / "evidence.json").write_text(json.dumps(found))
    (folder / "rig.toml").write_text(dumps_rig(view.rig))
    return folder


@pytest.mark.parametrize("camera", ["tof", "stereo"])
def test_board_is_found_in_a_simulated_view(view, camera):
    """Both cameras of a simulated view, all sensor errors on, find the board within 0.2 deg and 1 mm."""
    T_base_board = transform(rotation_exp([0, BOARD_TILT, 0]), BOARD_CENTRE) @ transform(
        np.eye(3), [0, 0, -0.005]
    )
    T = invert(view.arm_before.T_base_flange @ view.truth.T_flange_tof) @ T_base_board
    if camera == "stereo":
        T = invert(view.truth.T_tof_stereo) @ T
    sight = tof_sight(view.tof) if camera == "tof" else stereo_sight(view.stereo)
    intrinsics = (view.tof if camera == "tof" else view.stereo).info.camera
    found = detect(sight, load_board(), intrinsics)
    assert np.degrees(rotation_angle(found.T_camera_board @ invert(T))) < 0.2
    assert np.linalg.norm(found.T_camera_board[:3, 3] - T[:3, 3]) < 0.001
    with pytest.raises(QualityError, match=BoardRefusal.WRONG_BOARD):
        detect(sight, load_board("second"), intrinsics)


def test_page_stands_alone(recording, drawn):
    """The page is written, holds no script and no address, and all its charts are well-formed."""
    out = write_evidence_page(recording, load_old(recording / "rig.toml"))
    page = out.read_text()
    assert "<script" not in page
    assert not re.search(r'(?:src|href)="(?!#|data:)', page)
    answers.hold(
        "evidence-page", answers.of_page(page), off=0.05, least=0.02, names=[(recording, "RECORDING")]
    )
    pictures.hold("evidence", drawn)
    charts_found = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert len(charts_found) >= 8
    for chart in charts_found:
        ET.fromstring(chart)  # noqa: S314  our own text
    assert "poor fit" in page
    assert "the evidence holds no covariance" in page
    assert "the evidence compares no methods" in page
    assert write_evidence_page(recording, load_old(recording / "rig.toml")).read_text() == page


def test_samples_at_the_true_rig_are_small(recording):
    """At the true rig the surface residuals are a ToF sensor's, the rims' a fraction of a millimetre."""
    s = sample_recording(recording, read_evidence(recording), lambda *_: None)
    assert len(s.residual) > 1000
    assert np.median(np.abs(s.residual)) < 0.006
    assert np.median(np.abs(s.rims)) < 0.0008
    assert (s.amplitude > 0).all()


def test_new_keys_are_shown():
    """Covariance, observability and methods of a newer evidence fill their sections."""
    C = np.diag([1e-8] * 3 + [1e-8] * 3)
    found = evidence(
        covariance=C.tolist(),
        observability={"unconstrained": ["slide along x"], "eigenvalues": [1.0, 2.5]},
        methods={"joint": {"rotation_deg": 0.01, "T_tof_stereo": TRUE.tolist()}},
        range_residual={
            "modulation_hz": 1e8,
            "offset": 0.001,
            "per_pixel_radius": 0.0,
            "harmonics": [[2, 0.001, 0.0]],
        },
    )
    content = page_content(found, samples(), None, "")
    assert content["uncertainty"]["sigma"][0] == ["tx", "0.100 mm"]
    assert ["unconstrained", "slide along x"] in content["observability"]
    assert content["methods"] == [("joint", [["rotation deg", "0.01"]])]
    words = [c.words for _, _, rows in content["sections"].values() for c in rows]
    assert LIMITS["uncertain_motion"].words in words
    assert LIMITS["wiggle"].words in words
    least = next(c for c in found["checks"] if c["words"] == LIMITS["uncertain_motion"].words)
    assert least["value"] == "0.1 mm"


def test_without_a_covariance_the_standard_errors_stand_for_it():
    """Each is spread evenly over three axes."""
    C, words = uncertainty(evidence())
    assert "standard errors" in words
    assert np.sqrt(np.trace(C[:3, :3])) == pytest.approx(0.15e-3)
    assert np.degrees(np.sqrt(np.trace(C[3:, 3:]))) == pytest.approx(0.03)
    assert uncertainty(evidence(covariance=np.eye(6).tolist()))[1] == "its covariance"


def test_a_range_bias_is_judged_and_explained():
    """A residual that grows by 5 mm over the range fails, and the cause names the range."""
    content = page_content(evidence(), samples(bias=0.010), None, "")
    bad = {c.words: c for c in content["problems"]}
    assert bad[LIMITS["bias_range"].words].verdict in {"WARN", "FAIL"}
    assert "range" in bad[LIMITS["bias_range"].words].cause
    assert content["verdict"] != "PASS"
    assert LIMITS["bias_range"].words not in {
        c.words for c in page_content(evidence(), samples(), None, "")["problems"]
    }


def test_limits_are_those_that_evidence_was_judged_by():
    """Good and bearable of every number: a change turns old evidence from PASS to FAIL, or back."""
    assert {name: (limit.good, limit.bearable) for name, limit in (LIMITS | LENS).items()} == {
        "used": (8, 3), "rmse": (4, 5), "condition": (100, 500), "spread_rotation": (0.15, 0.5),
        "spread_translation": (1.5, 5), "error_rotation": (0.05, 0.2), "error_translation": (0.5, 2),
        "initial_rotation": (3, 10), "initial_translation": (30, 100), "bias_range": (1, 2.5),
        "bias_amplitude": (1, 2.5), "bias_image": (1.5, 3), "rims": (0.6, 1.5), "wiggle": (4, 12), "image": (0.6, 0.35),
        "sectors": (6, 4), "tilt": (15, 8), "distances": (1.4, 1.15), "uncertain_motion": (1, 3),
        "truth_rotation": (0.1, 0.3), "truth_translation": (1, 3), "drift_rotation": (0.05, 0.2),
        "drift_translation": (0.5, 2), "rms": (0.4, 0.8), "left_out": (0.5, 1), "pixel_sigma": (0.3, 1),
        "coverage": (0.75, 0.5),
    }  # fmt: skip


def test_limits_judge_both_ways():
    """PASS, WARN and FAIL on either side, upwards and downwards; what is missing fails."""
    assert [judged("rmse", v).verdict for v in (4.0, 4.5, 6.0, None, float("nan"))] == [
        "PASS", "WARN", "FAIL", "FAIL", "FAIL",
    ]  # fmt: skip
    assert [judged("used", v).verdict for v in (8, 5, 2)] == ["PASS", "WARN", "FAIL"]
    assert worst(["PASS", "WARN"]) == "WARN"
    assert all(limit.cause for limit in LIMITS.values())


def test_image_medians_are_per_cell():
    """A bias in one cell shows there alone."""
    s = samples()
    inside = (s.pixel < [20, 20]).all(axis=1)
    s.residual[inside] += 0.004
    cells = image_medians(s)
    assert cells[0, 0] == pytest.approx(4.0, abs=0.4)
    assert np.nanmax(np.abs(cells[3:, 3:])) < 0.5


def test_drift_is_measured_at_the_working_point():
    """A turn about the working point moves nothing there; one about the camera moves it."""
    point = np.array([0.0, 0.0, 0.8])
    about = transform(np.eye(3), point) @ exp([0, 0, 0, 0, 0.002, 0]) @ transform(np.eye(3), -point)
    moved = drift(evidence(), OldRig("old", invert(about) @ TRUE))
    assert moved.translation == pytest.approx(0.0, abs=1e-9)
    assert moved.rotation == pytest.approx(0.002)
    np.testing.assert_allclose(moved.twist[3:], [0, 0.002, 0], atol=1e-9)
    far = drift(evidence(), OldRig("old", exp([0, 0, 0, 0, -0.002, 0]) @ TRUE))
    assert far.translation == pytest.approx(0.0016, rel=1e-3)


def test_drift_is_judged_by_size_and_significance():
    """No drift passes and may be chance; a millimetre does not; the same millimetre of an uncertain rig may be chance."""
    still = drift(evidence(), OldRig("old", TRUE))
    assert (still.verdict, round(still.probability)) == ("PASS", 1)
    old = OldRig("old", exp([0.001, 0, 0, 0, 0, 0]) @ TRUE)
    assert drift(evidence(), old).verdict == "WARN"
    assert "significant" in drift_text(drift(evidence(), old))
    # Chance exceeds 12.592, the squared sigmas of six numbers, once in twenty times; both rigs have the same sigma.
    sigma = np.sqrt(2 * uncertainty(evidence())[0][0, 0])
    edge = OldRig("old", exp([np.sqrt(12.592) * sigma, 0, 0, 0, 0, 0]) @ TRUE)
    assert drift(evidence(), edge).probability == pytest.approx(0.05, rel=0.02)
    vague = evidence(standard_error={"rotation_deg": 0.5, "translation_mm": 3.0})
    assert drift(vague, old).verdict == "PASS"


def test_the_old_rig_brings_its_own_evidence(recording, tmp_path, view):
    """Evidence beside the old rig is used where it is of that rig, and no other."""
    assert load_old(recording / "rig.toml").evidence is None
    (tmp_path / "rig.toml").write_text(dumps_rig(view.rig))
    (tmp_path / "evidence.json").write_text(json.dumps(evidence(T_tof_stereo=view.rig.T_tof_stereo.tolist())))
    assert load_old(tmp_path / "rig.toml").evidence is not None
    with pytest.raises(ConfigError):
        load_old(tmp_path / "none.toml")


def test_foreign_evidence_is_refused(tmp_path):
    """No evidence, broken evidence and foreign JSON name the file."""
    with pytest.raises(DataError, match=r"evidence\.json"):
        read_evidence(tmp_path)
    (tmp_path / "evidence.json").write_text('{"format": "other"}')
    with pytest.raises(DataError, match="tofcapture-evidence"):
        read_evidence(tmp_path)


def test_charts_of_nothing_are_empty():
    """Too few points draw nothing; cells without a value carry no number, those with one do."""
    assert charts.scatter(np.zeros(3), np.zeros(3), "x", "y", 1.0) == ""
    assert charts.bars(["a"], [None], [True], "mm") == ""
    some = charts.heat(np.array([[np.nan, 0.25]]), Scale("RdBu_r", -1.0, 1.0, "mm"), "mm")
    assert re.findall(r"<text[^>]*>([^<]*)</text>", some) == ["0.25"]


def test_align_goes_on_without_the_page(recording, monkeypatch):
    """Where the page cannot be written an older one is removed, and the reason is said."""
    (recording / "evidence.html").write_text("old")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "jinja2", None)
        path, reason = _page(recording, recording, None, read_evidence(recording), lambda *_: None)
    assert path is None
    assert "jinja2" in reason
    assert not (recording / "evidence.html").exists()
