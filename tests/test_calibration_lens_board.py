"""A lens from the board's edges: what made the rims comes out, error bars hold, and a pinhole stays one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from calibration.board.fit import Model, clear_of_walls
from calibration.board.geometry import load_board
from calibration.cli.sensor import lens_report, lens_table
from calibration.lens import BoardSeen, LensRefused, fit_lens, fit_lens_to_board
from tests import answers
from tofcapture import poses
from tofcapture.camera import Camera
from tofcapture.cli import main
from tofcapture.devices.station import DEFAULT
from tofcapture.errors import DataError
from tofcapture.files.view import open_view
from tofcapture.poses import invert, look_at
from tofcapture.rig import dumps_rig, load_rig

MODEL = Model(load_board())
TRUE = Camera(240, 180, 191.5, 200.2, 117.9, 100.6, (-0.12, 0.05, 0.0008, -0.0006, 0.0))
GUESS = Camera(240, 180, 189.0, 202.5, 119.5, 98.5)


def seen(camera, count=14, noise=0.15, growth=0.2, seed=0, far=(0.35, 0.8)):
    """Rims of tilted boards, seen through a lens, all plates too large by some of a pixel."""
    rng, out = np.random.default_rng(seed), []
    middle = np.r_[
        (MODEL.board.outline.max(axis=0) + MODEL.board.outline.min(axis=0)) / 2, MODEL.board.thickness
    ]
    for i in range(count):
        tilt, turn, away = np.radians(rng.uniform(15, 40)), 2.4 * i, rng.uniform(*far)
        way = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
        aim = middle + np.r_[rng.uniform(-0.1, 0.1, 2), 0]
        T = invert(look_at(aim + away * way, aim, up=[0, 1, 0], roll=rng.uniform(-1, 1)))
        xy = np.concatenate(
            [
                np.linspace(a, b, 25, endpoint=False)
                for r in MODEL.board.rings
                for a, b in zip(r, np.roll(r, -1, axis=0), strict=False)
            ]
        )
        edges = MODEL.edges(xy + 1e-7)
        clear = clear_of_walls(T, MODEL.board, xy, edges.outward)
        at = poses.transform_points(T, np.column_stack([xy, np.full(len(xy), MODEL.board.thickness)]))
        out_px = camera.project(at + 1e-4 * edges.outward @ T[:3, :2].T)[0] - camera.project(at)[0]
        pixels = camera.project(at)[0] + growth * out_px / np.linalg.norm(out_px, axis=1, keepdims=True)
        pixels += rng.normal(0, noise, pixels.shape)
        good = clear & (pixels > 3).all(axis=1) & (pixels < [camera.width - 4, camera.height - 4]).all(axis=1)
        off = poses.exp(np.r_[rng.normal(0, 0.003, 3), rng.normal(0, 0.01, 3)])
        out.append(BoardSeen(pixels[good][:: max(1, good.sum() // 300)], off @ T))
    return out


def farthest(a, b):
    """Largest disagreement of two lenses over the image, pixels, a common turn taken off."""
    off = (a.rays - b.rays)[..., :2] * [b.fx, b.fy]
    return np.abs(off - off.mean(axis=(0, 1))).max()


def test_the_lens_that_made_the_rims_comes_out():
    """Rims with 0.15 px of noise that all lie 0.2 px off give the lens to half a pixel, and say that it is distorted."""
    fit = fit_lens_to_board(MODEL, seen(TRUE), GUESS)
    assert fit.model != "pinhole"
    assert farthest(fit.camera, TRUE) < 0.6
    assert abs(fit.camera.fx - TRUE.fx) < 4 * fit.sigma[0] + 0.05
    assert fit.rms < 0.3
    data = lens_report(fit, GUESS)
    text = lens_table({**data, "refused": ["view-001 wrong board"]})
    answers.hold("lens", {"data": data, "text": text}, off=0.03, least=1e-5)


def test_a_wide_rational_lens_comes_out():
    """A field of view that four coefficients miss by pixels: the views ask for more, and inside what they cover it holds."""
    wide = (3.130577, 2.324939, 8.1e-05, -5.1e-05, 0.130416, 3.458652, 3.350115, 0.662942)
    true = Camera(240, 180, 130.0, 130.0, 118.0, 92.0, wide)
    guess = Camera(240, 180, 131.3, 128.7, 120.0, 90.0)
    fit = fit_lens_to_board(MODEL, seen(true, 10, far=(0.2, 0.6)), guess)
    assert "k6" in fit.model
    assert len(fit.camera.distortion) == 8
    assert fit.rms < 0.25
    v, u = np.mgrid[:180, :240]
    inside = np.hypot(u - 118, v - 92) < 110
    off = ((fit.camera.rays - true.rays)[..., :2] * 130)[inside]
    assert np.abs(off - np.median(off, axis=0)).max() < 1.0


def test_corners_of_a_pattern_give_the_lens():
    """Corners at known places of the board, with a tenth of a pixel of noise, tell the same lens as rims do."""
    rng, views = np.random.default_rng(3), []
    x, y = np.meshgrid(np.linspace(-0.12, 0.12, 9), np.linspace(-0.09, 0.09, 7))
    at = np.column_stack([x.reshape(-1), y.reshape(-1)])
    places = np.column_stack([at, np.full(len(at), MODEL.board.thickness)])
    for view in seen(TRUE, 8):
        T = poses.exp(np.r_[rng.normal(0, 0.003, 3), rng.normal(0, 0.01, 3)]) @ view.T_camera_board
        pixels = TRUE.project(poses.transform_points(T, places))[0] + rng.normal(0, 0.1, at.shape)
        good = (pixels > 3).all(axis=1) & (pixels < [TRUE.width - 4, TRUE.height - 4]).all(axis=1)
        views.append(BoardSeen(pixels[good], view.T_camera_board, at[good]))
    fit = fit_lens_to_board(MODEL, views, GUESS)
    assert farthest(fit.camera, TRUE) < 1.0
    assert fit.rms < 0.15


def test_rims_that_no_lens_explains_are_refused():
    """Rims of another board lie pixels off, and none of them is quietly left out."""
    views = [replace(v, pixels=v.pixels + 6 * np.sin(v.pixels[:, ::-1])) for v in seen(TRUE, 6, noise=0.0)]
    with pytest.raises(LensRefused, match="poor fit"):
        fit_lens_to_board(MODEL, views, GUESS)


def test_a_pinhole_stays_one():
    """Where no distortion is, none is written, and the pinhole's numbers come back."""
    plain = replace(TRUE, distortion=())
    fit = fit_lens_to_board(MODEL, seen(plain, seed=1), GUESS)
    assert fit.camera.distortion == ()
    assert farthest(fit.camera, plain) < 0.4


def test_too_few_views_are_refused():
    """Three views say so."""
    with pytest.raises(DataError, match="at least 5"):
        fit_lens_to_board(MODEL, seen(TRUE, 3), GUESS)


def test_views_that_a_wrong_lens_hid_are_looked_at_again():
    """With the believed pinhole three boards look like another one; with the lens of the others they are found, and used."""
    views = seen(TRUE, 9)

    def look(camera):
        lost = {1} if camera.distortion else {1, 3, 7}
        return [v for i, v in enumerate(views) if i not in lost], [f"view-{i:03d} wrong board" for i in lost]

    fit, refused = fit_lens(MODEL, look, GUESS)
    assert len(fit.left_out) == len(views) - 1
    assert refused == ["view-001 wrong board"]
    assert farthest(fit.camera, TRUE) < 0.6


def test_a_wrong_board_in_the_second_look_does_not_count():
    """Boards found in addition that do not fit the lens as well leave the first look's lens and its refusals."""
    views = seen(TRUE, 9)

    def look(camera):
        return (seen(TRUE, 9, noise=0.6), []) if camera.distortion else (views[1:], ["view-000 wrong board"])

    fit, refused = fit_lens(MODEL, look, GUESS)
    assert len(fit.left_out) == len(views) - 1
    assert refused == ["view-000 wrong board"]


@pytest.mark.slow
def test_a_recording_through_an_unknown_lens_gives_the_lens(tmp_path, capsys):
    """From record to rig.toml by commands: a driver that describes a pinhole, one per cent off, and the lens that the station has."""
    lens = (-0.18, 0.05, 0.001, -0.0008, 0.0)
    station = tmp_path / "station.toml"
    station.write_text(f"{DEFAULT.read_text()}\n[sim.tof]\ndistortion = {list(lens)}\n")
    recording = tmp_path / "board"
    assert main(["record", "--calibration", "--station", str(station), "--out", str(recording)]) == 0
    rig = open_view(min((recording / "views/calibration").glob("*.h5"))).rig
    true = rig.tof
    assert true.distortion == lens
    wrong = replace(true, fx=true.fx * 1.01, fy=true.fy * 0.99, cx=true.cx + 2, cy=true.cy - 2, distortion=())
    (recording / "rig.toml").write_text(dumps_rig(replace(rig, tof=wrong)))
    assert main(["calibrate", "lens", str(recording)]) == 0
    assert "verdict: PASS" in capsys.readouterr().out
    found = load_rig(recording / "rig.toml").tof
    told = json.loads((recording / "lens.json").read_text())
    assert told["views"] >= 10
    assert farthest(found, true) < 3 * told["pixel_sigma"] < 1
