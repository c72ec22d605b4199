"""A UR arm on the emulator, for the tests that drive it with the real library; the fixture is in ``conftest``."""

import numpy as np

from tofcapture.devices.kinematics import HOME
from tofcapture.testing.stations import ur_station

THERE = HOME - [1.2, 0, 0, 0, 0, 0]


def station_file(tmp_path, emulator, more=""):
    """``station.toml`` of small simulated cameras on the emulated arm."""
    file = tmp_path / "station.toml"
    file.write_text(ur_station(emulator.host, more))
    return file


def at_home(arm):
    """Wherever an earlier test left the arm, it begins at home."""
    if np.abs(arm.state().joints - HOME).max() > 1e-3:
        arm.move_to(HOME)
