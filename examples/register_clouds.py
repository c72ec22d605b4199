"""Register the ToF cloud of one view into its stereo cloud: ``python register_clouds.py rec/views/mug/view-000.h5``."""

import sys

import numpy as np

import tofcapture
from calibration.registration.clouds import stereo_cloud, surface_points, tof_depth
from calibration.registration.gate import register
from tofcapture.poses import invert, rotation_angle


def main(path: str) -> None:
    """Start from the rig that the view was taken with, and say how far registration moves it."""
    view = tofcapture.open_view(path)
    _, depth = tof_depth(view.tof)
    source = surface_points(view.tof, depth)  # (N, 3), ToF frame
    target = stereo_cloud(view.stereo)  # points and normals, stereo frame
    start = invert(view.rig.T_tof_stereo)  # T_stereo_tof
    found = register("open3d", source, target, start)
    moved = found.T_target_source @ invert(start)
    print(
        f"{len(source)} points into {len(target.points)}: RMSE {1e3 * found.rmse:.2f} mm, fitness {found.fitness:.2f}"
    )
    print(
        f"moved by {1e3 * np.linalg.norm(moved[:3, 3]):.2f} mm, {np.degrees(rotation_angle(moved)):.3f} deg"
    )


if __name__ == "__main__":
    main(sys.argv[1])
