"""The meter of board views: tilts, directions in the image, distances and the part of the image, from poses alone."""

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.devices.clearance import stage_of
from tofcapture.devices.kinematics import MODELS
from tofcapture.devices.station import read_station
from tofcapture.poses import look_at, rotation_exp, transform
from tofcapture.record.plan import board_sampling, plan_views
from tofcapture.record.quality import SECTORS, lean_of, meter
from tofcapture.rig import Rig

CAMERA = Camera(240, 180, 190.0, 200.0, 119.5, 89.5)
BOARD, NORMAL = np.array([0.7, 0.0, -0.2]), np.array([0.0, 0.0, 1.0])


def view(tilt, turn, distance=0.7, roll=0.0):
    tilt, turn = np.radians([tilt, turn])
    way = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    return look_at(BOARD + distance * way, BOARD, roll=roll)


def test_meter_counts_what_was_seen():
    """Two views, of 20 and 30 degrees, 0.5 and 0.9 m away, are counted in their bins."""
    text = meter([view(20, 0, 0.5), view(30, 90, 0.9)], BOARD, NORMAL, CAMERA)
    assert "2 board views, 0.50 to 0.90 m" in text
    assert "15-25 deg 1" in text
    assert "25-40 deg 1" in text
    assert meter([], BOARD, NORMAL, CAMERA) == "no board views yet"


def test_roll_turns_the_lean():
    """A camera turned by a quarter about its axis sees the board lean a quarter further."""
    first, second = (lean_of(view(30, 40, roll=r), NORMAL) for r in (0.0, np.pi / 2))
    np.testing.assert_allclose(second, [first[1], -first[0]], atol=1e-12)
    assert np.linalg.norm(first) == pytest.approx(np.sin(np.radians(30)))


def test_a_board_that_stands_upright_in_the_image_faces_up_or_down():
    """Seen from a tilt without roll, the front leans down the image: its upper edge is farther away."""
    assert "below 1" in meter([view(30, 10)], BOARD, NORMAL, CAMERA) or "above 1" in meter(
        [view(30, 10)], BOARD, NORMAL, CAMERA
    )


def test_planned_board_views_lean_in_all_directions_of_the_image():
    """Twelve planned views face at least six of the eight directions, and no direction more than four times."""
    rig = Rig(
        tof=CAMERA,
        stereo=CAMERA,
        T_tof_stereo=transform(rotation_exp([0.04, 0.01, 0.0]), [-0.05, 0.08, 0.0]),
        T_flange_tof=transform(rotation_exp([0.01, -0.02, 0.02]), [0.0, -0.035, 0.08]),
    )
    stage = stage_of(read_station(None))
    for seed in (0, 1):
        plan = plan_views(
            MODELS["ur10e"], rig, stage, stage.board, board_sampling(stage), 12, np.random.default_rng(seed)
        )
        assert len(plan.views) == 12
        leans = np.array(
            [lean_of(v.T_base_flange @ rig.T_flange_tof, stage.board_normal) for v in plan.views]
        )
        sector = np.round(np.arctan2(leans[:, 1], leans[:, 0]) / (np.pi / 4)).astype(int) % len(SECTORS)
        counts = np.bincount(sector, minlength=8)
        assert (counts > 0).sum() >= 6
        assert counts.max() <= 4
