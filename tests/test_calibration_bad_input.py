"""``align`` on a small simulated recording: the joint method through the command line, and bad input refused with its likely cause."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest

from calibration.align import align
from calibration.alignment.diagnosis import check_start, unusable
from tests.stations import HALF_SIZE_CAMERAS
from tofcapture.cli import main
from tofcapture.errors import ConfigError, DataError, QualityError
from tofcapture.files.view import open_view, view_path, write_view
from tofcapture.poses import invert, transform

VIEWS = 4
SMALL = (
    HALF_SIZE_CAMERAS
    + """[sim.render]
multipath = false
"""
)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Recording of four board views with cameras of half size."""
    folder = tmp_path_factory.mktemp("small")
    embedded = files("tofcapture.devices").joinpath("station.toml").read_text(encoding="utf-8")
    (folder / "station.toml").write_text(embedded + SMALL)
    words = ["record", "--calibration", "--views", VIEWS, "--frames", 3]
    assert (
        main([str(w) for w in [*words, "--out", folder / "rec", "--station", folder / "station.toml"]]) == 0
    )
    return folder / "rec"


@pytest.fixture(scope="module")
def views(recording):
    return [open_view(view_path(recording, "calibration", i)) for i in range(VIEWS)]


def of_stereo(view, change):
    """The view with its stereo points changed."""
    return replace(view, stereo=replace(view.stereo, points=change(view.stereo.points)))


def written(folder, views):
    """A recording folder that holds these views."""
    for view in views:
        write_view(view_path(folder, "calibration", view.index), view)
    return folder


def test_joint_alignment_through_the_command_line(recording, capsys):
    """Four views of half-size cameras are aligned; sigma, spread and error on all outputs are the joint method's own."""
    capsys.readouterr()
    assert main(["align", str(recording), "--method", "joint", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    evidence = json.loads((recording / "evidence.json").read_text())
    assert evidence["method"] == "joint"
    assert said["rotation_error_deg"] < 0.3
    assert said["translation_error_mm"] < 3
    sigma = np.sqrt(np.diag(evidence["covariance"]))
    np.testing.assert_allclose(evidence["sigma"]["translation_mm"], 1e3 * sigma[:3])
    np.testing.assert_allclose(evidence["sigma"]["rotation_deg"], np.degrees(sigma[3:]))
    stated = evidence["standard_error"]
    assert stated["translation_mm"] == pytest.approx(1e3 * np.linalg.norm(sigma[:3]))
    assert said["standard_error"] == stated
    assert said["sigma"] == evidence["sigma"]
    assert evidence["in_words"] in (recording / "evidence.html").read_text().replace("&#39;", "'")


def test_weighted_alignment_states_its_own_sigma(recording):
    """The weighted method replaces the average's spread and standard error by what leaving out pairs shows."""
    _, evidence = align(recording, method="weighted")
    sigma = np.sqrt(np.diag(evidence["covariance"]))
    assert evidence["standard_error"]["translation_mm"] == pytest.approx(1e3 * np.linalg.norm(sigma[:3]))
    assert evidence["spread"]["translation_mm"] > evidence["standard_error"]["translation_mm"]
    assert len(evidence["sigma"]["rotation_deg"]) == 3


def test_swapped_initial_transform_is_named(views, tmp_path):
    """From the inverse of the guess nothing fits, and the error says so; nothing is written."""
    wrong = [replace(v, rig=replace(v.rig, T_tof_stereo=invert(v.rig.T_tof_stereo))) for v in views]
    with pytest.raises(ConfigError, match="inverse") as caught:
        align(written(tmp_path, wrong))
    assert "swapped" in caught.value.hint
    assert not (tmp_path / "rig.toml").exists()


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["x", "y"])
def test_mirrored_axis_is_named(views, tmp_path, axis):
    """Stereo points with one image axis turned round fit when it is turned back."""
    signs = np.ones(3, dtype=np.float32)
    signs["xy".index(axis)] = -1
    with pytest.raises(DataError, match=f"with {axis} of the stereo points turned round"):
        align(written(tmp_path, [of_stereo(v, lambda p: p * signs) for v in views]))


@pytest.mark.slow
def test_images_of_different_boards_are_named(views, tmp_path):
    """ToF frames of one placement and stereo frames of another do not fit, and that is the likely cause given."""
    mixed = [replace(v, stereo=views[(i + 1) % VIEWS].stereo) for i, v in enumerate(views)]
    with pytest.raises(QualityError, match="at least 3") as caught:
        align(written(tmp_path, mixed))
    assert "board" in caught.value.hint
    assert "likely cause" in caught.value.hint


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda v: of_stereo(v, lambda p: 1000 * p), "median depth"),
        (lambda v: of_stereo(v, lambda p: p * np.float32([1, -1, -1])), "behind the camera"),
        (lambda v: of_stereo(v, lambda p: np.full_like(p, np.nan)), "no point at all"),
        (lambda v: of_stereo(v, lambda p: 3 * p), "expected a board"),
        (
            lambda v: replace(v, tof=replace(v.tof, raw=np.full_like(v.tof.raw, 7))),
            "every pixel reads the same",
        ),
    ],
)
def test_useless_view_says_why(views, change, said):
    """Millimetres, turned axes, all NaN, a board out of reach and a dark ToF camera each have their own message."""
    assert unusable(views[0], "view") is None
    found = unusable(change(views[0]), "view")
    assert found is not None
    assert said in found.message
    assert found.hint


def test_rig_in_millimetres_is_refused_before_any_work(views):
    """Cameras tens of metres apart are millimetres; a transform of NaN is no guess."""
    T = views[0].rig.T_tof_stereo
    check_start(T)
    with pytest.raises(ConfigError, match="apart") as caught:
        check_start(transform(T[:3, :3], 1000 * T[:3, 3]))
    assert "millimetres" in caught.value.hint
    with pytest.raises(ConfigError, match="apart"):
        check_start(np.full((4, 4), np.nan))


def test_millimetres_stop_the_alignment_by_name(views, tmp_path):
    """A recording whose stereo points are in millimetres is a data error that says so."""
    with pytest.raises(DataError, match="metres") as caught:
        align(written(tmp_path, [of_stereo(v, lambda p: 1000 * p) for v in views[:3]]))
    assert "millimetres" in caught.value.hint
