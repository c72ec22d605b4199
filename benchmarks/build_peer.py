"""What a plain script makes of a view: Open3D for clouds, numpy for images, one process, Open3D's own threads.

Statistical outlier removal, k-nearest-neighbour normals, ICP of the stereo cloud to the ToF cloud, a z-buffer of splatted
points at 1x and 2x. Ran by benchmarks/build.py.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tofcapture.camera import Camera
from tofcapture.files.view import open_view
from tofcapture.frames import View
from tofcapture.libraries import load_open3d
from tofcapture.ops.phase import Decoder
from tofcapture.rig import Rig


def splat(points: np.ndarray, normals: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Nearest point of each pixel: depth (H, W), normals (H, W, 3)."""
    pixels, z = camera.project(points)
    u, v = np.rint(np.nan_to_num(pixels, nan=-1)).astype(int).T
    ok = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    order = np.flatnonzero(ok)[np.argsort(-z[ok])]
    depth, image = np.full(camera.shape, np.nan, np.float32), np.full((*camera.shape, 3), np.nan, np.float32)
    depth[v[order], u[order]] = z[order]
    image[v[order], u[order]] = normals[order]
    return depth, image


def process(view: View, rig: Rig) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Arrays of one view, and the depth at 2x without the ICP's own error, by the given rig."""
    o3d = load_open3d()
    grid = view.stereo.points
    cloud = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(grid[np.isfinite(grid[..., 2])].astype(np.float64))
    )
    cloud, _ = cloud.remove_statistical_outlier(20, 2.0)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    info = replace(view.tof.info, camera=rig.tof, illuminator=rig.illuminator, range_errors=rig.range_errors)
    depth = Decoder(info).burst(view.tof.raw).depth
    points = rig.tof.unproject(depth)
    tof = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[np.isfinite(points[..., 2])]))
    inverse = np.linalg.inv(rig.T_tof_stereo)
    found = o3d.pipelines.registration.registration_icp(
        tof, cloud, 0.02, inverse, o3d.pipelines.registration.TransformationEstimationPointToPlane()
    )
    out = {"raw": view.tof.raw, "tof_depth": depth}
    for name, T in (("icp", np.linalg.inv(found.transformation)), ("rig", rig.T_tof_stereo)):
        moved = np.asarray(cloud.points) @ T[:3, :3].T + T[:3, 3]
        turned = np.asarray(cloud.normals) @ T[:3, :3].T
        for scale in (1, 2) if name == "icp" else (2,):
            depth, normals = splat(moved, turned, rig.tof.scaled(scale))
            out |= {f"{name}_depth_{scale}x": depth, f"{name}_normals_{scale}x": normals}
    return out, out["rig_depth_2x"]


def build(path: Path, rig: Rig, out: Path) -> tuple[dict[str, np.ndarray], View]:
    """Read, process, write without compression and without fsync."""
    view = open_view(path)
    arrays, _ = process(view, rig)
    np.savez(out, **arrays)
    return arrays, view
