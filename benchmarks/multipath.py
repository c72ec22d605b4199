"""Hold the simulator's multipath against an independent transient path tracer (Mitsuba 3 with mitransient).

The reference renders a histogram over optical path length and takes its Fourier transform at 20 and 100 MHz; we render the
same world file with ``tofcapture simulate --ideal``. Printed per world and frequency: the multipath bias, the median
absolute difference of the decoded ranges, the share of the bias that we explain, and both times.

    pip install mitsuba==3.9.1 mitransient==1.3.1     # and libllvm19 from the system
    python benchmarks/multipath.py [WORLD.toml ...]

Skips with a reason where the reference is not installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tofcapture.devices.sim.config import load_world
from tofcapture.devices.sim.world import simulate
from tofcapture.ops.phase import mean_phasors, radial_to_range, wrapped_range
from tofcapture.poses import transform_points

HZ = (20e6, 100e6)
LIGHT = 299_792_458.0


def example_worlds(folder: Path) -> list[Path]:
    """Write two worlds: a 90-degree corner of albedo 0.8, and an open box of albedo 0.75 with a sphere in it."""
    quad = np.array([[0, 1, 2], [0, 2, 3]])

    def ply(name: str, vertices: np.ndarray, triangles: np.ndarray) -> None:
        lines = [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(vertices)}",
            *(f"property float {a}" for a in "xyz"),
        ]
        lines += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
        lines += [" ".join(f"{x:.9g}" for x in v) for v in vertices] + [
            "3 " + " ".join(map(str, t)) for t in triangles
        ]
        (folder / name).write_text("\n".join(lines) + "\n")

    e0, e1, reach = np.array([0, -0.5, 1.0]), np.array([0, 0.5, 1.0]), np.array([0.5, 0, -0.5])
    ply("right.ply", np.array([e0, e0 + reach, e1 + reach, e1]), quad)
    ply("left.ply", np.array([e0, e1, e1 + reach * [-1, 1, 1], e0 + reach * [-1, 1, 1]]), quad)
    x, y, near, far = 0.25, 0.2, 0.6, 1.0
    walls = [
        [(-x, -y, far), (x, -y, far), (x, y, far), (-x, y, far)],
        [(-x, -y, near), (-x, -y, far), (-x, y, far), (-x, y, near)],
        [(x, -y, near), (x, y, near), (x, y, far), (x, -y, far)],
        [(-x, -y, near), (x, -y, near), (x, -y, far), (-x, -y, far)],
        [(-x, y, near), (-x, y, far), (x, y, far), (x, y, near)],
    ]
    ply("box.ply", np.array(walls).reshape(-1, 3), np.concatenate([quad + 4 * i for i in range(5)]))
    head = 'units = "m"\n[tof]\nwidth = 120\nheight = 90\nfx = 95.0\nfy = 95.0\ncx = 59.5\ncy = 44.5\nilluminator = [0.007, 0.0, 0.0]\n'
    corner, box = folder / "corner.toml", folder / "box.toml"
    corner.write_text(
        head + '[[object]]\nmesh = "left.ply"\nalbedo = 0.8\n[[object]]\nmesh = "right.ply"\nalbedo = 0.8\n'
    )
    box.write_text(
        head
        + '[[object]]\nmesh = "box.ply"\nalbedo = 0.75\n[[object]]\nfamily = "sphere"\nalbedo = 0.6\n'
        + "T_world_object = [[1, 0, 0, 0.05], [0, 1, 0, 0.03], [0, 0, 1, 0.85], [0, 0, 0, 1]]\n"
    )
    return [corner, box]


def reference_phasors(path: Path, samples: int, depth: int = 24) -> np.ndarray:
    """(2, H, W) complex phasors of the transient path tracer; depth 2 is direct light only."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_mono")
    import mitransient  # noqa: F401  registers the transient plugins

    world = load_world(path)
    camera, T = world.constants.tof, world.T_world_tof
    if abs(camera.fx - camera.fy) > 1e-9:
        sys.exit(f"{path}: the reference needs square pixels, fx == fy")
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's camera has x left, y up
    bins, width = 3000, 0.004
    scene = {
        "type": "scene",
        "integrator": {
            "type": "transient_path",
            "max_depth": depth,
            "rr_depth": depth,
            "temporal_filter": "box",
        },
        "sensor": {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))),
            "fov_axis": "x",
            "principal_point_offset_x": (camera.cx + 0.5) / camera.width - 0.5,
            "principal_point_offset_y": (camera.cy + 0.5) / camera.height - 0.5,
            "to_world": mi.ScalarTransform4f((T @ flip).tolist()),
            "near_clip": 0.001,
            "sampler": {"type": "independent", "sample_count": samples},
            "film": {
                "type": "transient_hdr_film",
                "width": camera.width,
                "height": camera.height,
                "temporal_bins": bins,
                "bin_width_opl": width,
                "start_opl": 0.0,
                "rfilter": {"type": "box"},
            },
        },
        "light": {
            "type": "point",
            "position": transform_points(T, world.constants.illuminator).tolist(),
            "intensity": {"type": "spectrum", "value": 1.0},
        },
    }
    for i, o in enumerate(world.objects):
        corners = o.corners()
        mesh = mi.Mesh(f"object{i}", 3 * len(corners), len(corners))
        params = mi.traverse(mesh)
        params["vertex_positions"] = corners.astype(np.float32).ravel()
        params["faces"] = np.arange(3 * len(corners), dtype=np.uint32)
        params.update()
        name = str(path.parent / f"_reference_{i}.ply")
        mesh.write_ply(name)
        scene[f"object{i}"] = {
            "type": "ply",
            "filename": name,
            "face_normals": True,
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "spectrum", "value": o.albedo}},
            },
        }
    loaded = mi.load_dict(scene)
    total = 0.0
    length = (np.arange(bins) + 0.5) * width
    turn = np.exp(2j * np.pi * np.outer(HZ, length) / LIGHT)
    passes = max(1, samples // 128)
    for seed in range(passes):
        _, transient = mi.render(loaded, spp=min(samples, 128), seed=seed)
        histogram = np.asarray(transient).reshape(camera.height, camera.width, bins)
        total = total + np.einsum("fk,hwk->fhw", turn, histogram) / passes
    return total


def compare(path: Path, samples: int) -> list[str]:
    """One line per frequency."""
    start = time.perf_counter()
    view = simulate(path, ideal=True, frames=1)
    ours_s = time.perf_counter() - start
    info = view.tof.info
    ours = mean_phasors(view.tof.raw, info.modulation_hz, info.phase_rad)
    start = time.perf_counter()
    reference = reference_phasors(path, samples)
    reference_s = time.perf_counter() - start
    straight = reference_phasors(path, 256, depth=2)
    assert view.truth is not None
    H, W = info.camera.shape
    depth = view.truth.depth.reshape(H, 2, W, 2)
    flat = np.ptp(depth, axis=(1, 3)) < 0.02
    true = radial_to_range(
        info.camera.depth_to_radial(depth.mean(axis=(1, 3))), info.camera, info.illuminator
    )
    lines = [
        f"{path.stem}: ours {ours_s:.1f} s, reference {reference_s:.1f} s, ratio {reference_s / ours_s:.0f}"
    ]
    for i, hz in enumerate(HZ):
        a, b = wrapped_range(ours[i], hz), wrapped_range(reference[i], hz)
        good = flat & np.isfinite(true) & (np.abs(straight[i]) > 0)
        # The histogram's bins shift the reference by a fraction of a millimetre: its own direct light takes that off.
        bias = (b - wrapped_range(straight[i], hz))[good]
        miss = (a - true)[good] - bias
        explained = 1 - np.abs(miss).sum() / np.abs(bias).sum()
        net = 1 + miss.sum() / bias.sum()
        lines.append(
            f"  {hz / 1e6:5.0f} MHz: bias median {np.median(bias) * 1e3:7.2f} mm | median |difference| "
            f"{np.median(np.abs(miss)) * 1e3:5.2f} mm, signed {np.median(miss) * 1e3:+5.2f} mm | explained {explained:6.1%} pixelwise, {net:6.1%} in sum"
        )
    return lines


def main() -> int:
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("worlds", nargs="*", type=Path)
    parser.add_argument("--samples", type=int, default=4096)
    args = parser.parse_args()
    library = next(Path("/usr/lib").glob("*/libLLVM.so.19*"), None)
    if library is not None:
        os.environ.setdefault("DRJIT_LIBLLVM_PATH", str(library))
    missing = [name for name in ("mitsuba", "mitransient") if importlib.util.find_spec(name) is None]
    if missing or library is None:
        print(f"skipped: {', '.join(missing) or 'libLLVM 19'} is not installed")
        return 0
    with tempfile.TemporaryDirectory() as folder:
        for path in args.worlds or example_worlds(Path(folder)):
            print("\n".join(compare(path, args.samples)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
