"""Tables of ``station.toml`` that more than one test needs."""

HALF_SIZE_STEREO = """
[sim.stereo]
width = 640
height = 512
fx = 577.5
fy = 577.5
cx = 319.5
cy = 255.5
"""
HALF_SIZE_CAMERAS = (
    HALF_SIZE_STEREO
    + """
[sim.tof]
width = 120
height = 90
fx = 95.3
fy = 100.4
cx = 57.9
cy = 50.2
"""
)
