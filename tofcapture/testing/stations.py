"""Station files for tests: small simulated cameras on a chosen arm."""

from __future__ import annotations

_CAMERAS = """
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
[plan]
table = -0.50
target = [0.70, 0.0, -0.44]
board = [0.70, 0.0, -0.22]
board_normal = [-0.258819, 0.0, 0.965926]
"""


def ur_station(host: str, more: str = "") -> str:
    """Text of a station: a UR arm, fast and hardly settling, and simulated cameras of few pixels that follow it.

    Parameters
    ----------
    host
        Address of the controller, as a rule of an emulator.
    more
        Further lines of the table ``[arm]``.
    """
    arm = f'[arm]\ndriver = "ur_rtde"\nhost = "{host}"\nspeed = 1.0\nacceleration = 1.4\nsettle = 0.05\n{more}\n'
    return arm + _CAMERAS
