"""A UR arm on the emulator, for the tests that drive it with the real library; the fixture is in ``conftest``."""

import numpy as np

from tofcapture.devices.kinematics import HOME

THERE = HOME - [1.2, 0, 0, 0, 0, 0]
# Simulated cameras of few pixels.
CAMERAS = """
[tof]
driver = "sim"
[stereo]
driver = "sim"
[operator]
driver = "sim"
[sim.render]
multipath = false
subpixels = 1
[sim.tof]
width = 24
height = 18
fx = 19.0
fy = 20.0
cx = 11.7
cy = 10.1
[sim.stereo]
width = 64
height = 50
fx = 60.0
fy = 60.0
cx = 31.5
cy = 24.5
"""
# A UR arm, fast and hardly settling, and the cameras that follow it. A busy machine may not get round to its watchdog twice a second.
STATION = (
    CAMERAS
    + """
[arm]
driver = "ur_rtde"
host = "{host}"
speed = 1.0
camera_speed = 1.5
acceleration = 1.4
settle = 0.05
watchdog_hz = 1.0
{more}
[plan]
table = -0.50
target = [0.70, 0.0, -0.44]
board = [0.70, 0.0, -0.22]
board_normal = [-0.258819, 0.0, 0.965926]
"""
)


def station_file(tmp_path, emulator, more=""):
    """``station.toml`` of small simulated cameras on the emulated arm; ``more`` lines go into ``[arm]``."""
    file = tmp_path / "station.toml"
    file.write_text(STATION.format(host=emulator.host, more=more))
    return file


def at_home(arm):
    """Wherever an earlier test left the arm, it begins at home."""
    if np.abs(arm.state().joints - HOME).max() > 1e-3:
        arm.move_to(HOME)
