"""rig.toml keeps every bit and refuses what is not a rig."""

import numpy as np
import pytest

from tofcapture.camera import Camera
from tofcapture.errors import ConfigError
from tofcapture.poses import exp, invert
from tofcapture.rig import RangeError, Rig, dumps_rig, load_rig, loads_rig

RIG = Rig(
    tof=Camera(240, 180, 190.6, 200.7, 116.8, 101.4),
    stereo=Camera(1280, 1024, 1155.0, 1155.0, 639.5, 511.5),
    T_tof_stereo=exp([0.1, 0.02, 1 / 3, 0.01, 0.2, 0.03]),
    T_flange_tof=exp([0.0, 0.02, 0.1, 0.1, 0.0, 0.03]),
    illuminator=np.array([0.007, 0, 0]),
    range_errors=(RangeError(100e6, -0.7, 0.0, ((2, 0.006, 0.001), (4, 0.1 / 3, 0))),),
)


def test_round_trip_is_exact():
    """Text and back gives the same floats."""
    back = loads_rig(dumps_rig(RIG))
    np.testing.assert_array_equal(back.T_tof_stereo, RIG.T_tof_stereo)
    np.testing.assert_array_equal(back.T_flange_tof, RIG.T_flange_tof)
    assert (back.tof, back.stereo, back.range_errors) == (RIG.tof, RIG.stereo, RIG.range_errors)


def test_subscripts_cancel():
    """T_flange_stereo = T_flange_tof T_tof_stereo, and the inverse is T_stereo_tof."""
    np.testing.assert_allclose(RIG.T_flange_stereo @ invert(RIG.T_tof_stereo), RIG.T_flange_tof, atol=1e-12)
    np.testing.assert_allclose(RIG.T_stereo_tof @ RIG.T_tof_stereo, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('units = "m"', 'units = "mm"', "units"),
        ("width = 240", "widht = 240", "width"),
        ("T_flange_tof", "T_flange_tol", "unknown"),
        ("[tof]", "[tof", "not TOML"),
    ],
)
def test_wrong_rigs_are_explained(old, new, message):
    """Every mistake names itself."""
    with pytest.raises(ConfigError, match=message):
        loads_rig(dumps_rig(RIG).replace(old, new, 1))


def test_missing_file_says_what_writes_one(tmp_path):
    """A missing rig.toml points to align."""
    with pytest.raises(ConfigError) as caught:
        load_rig(tmp_path / "rig.toml")
    assert "align" in caught.value.hint
