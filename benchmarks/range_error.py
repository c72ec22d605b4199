"""Range calibration over seeds of the simulated station, with and without light between surfaces.

``python benchmarks/range_error.py --seeds 3`` makes, for every seed, a station whose sensor has a 17 mm offset, a wave of 6 mm, a term
over the image and a fixed offset of every pixel, takes board views from 0.3 to 1.5 m, fits the range errors jointly with a rig transform
that is wrong within its prior (0.3 mm, 0.03 deg), once as drawn and once the other way, and prints what is left of the true range error
over 0.3 to 1.5 m and the whole image (RMS of both, per frequency), before and after. Both, because scattered light in the lens pulls the
transform along z by a few tenths of a millimetre: one sign of the error alone flatters or slanders a change.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from calibration.range_error.fit import RangeFit, fit_ranges
from calibration.range_error.views import Seen, seen_of
from tofcapture.channels import SPEED_OF_LIGHT
from tofcapture.devices.sim.config import Constants, read_constants
from tofcapture.devices.sim.scenes import BOARD_CENTRE, BOARD_TILT, scene_objects
from tofcapture.devices.sim.world import SimWorld
from tofcapture.errors import QualityError, TofError
from tofcapture.frames import ArmState, View
from tofcapture.ops.phase import radius_px
from tofcapture.poses import Float64, exp, invert, look_at, rotation_exp
from tofcapture.rig import RangeError, image_places

LAMP = {"half_angle": 0.70, "edge": 0.17}
ERRORS = (
    RangeError(
        20e6, 0.017, 0.0, ((4, 0.018, 0.010),), 1.54e-4, -1.8e-4, image=((1, 0, 0.002), (0, 2, -0.001))
    ),
    RangeError(
        100e6, 0.017, 0.0, ((2, -0.006, 0.0012), (4, -7e-4, 2e-4)), 1.54e-4, -1.8e-4, image=((1, 1, 0.002),)
    ),
)
SIGMA = np.r_[[3e-4] * 3, [5e-4] * 3]
NEAR, FAR = 0.3, 1.5


def constants_of(multipath: bool) -> Constants:
    """Station with the benchmark's range errors and a maker that knows none of them."""
    c = read_constants({"lamp": LAMP, "render": {"multipath": multipath, "subpixels": 2}}, "benchmark")
    return replace(c, sensor=replace(c.sensor, range_errors=ERRORS))


def poses_of(rng: np.random.Generator, views: int) -> list[Float64]:
    """``T_base_tof`` of board views, tilted 5 to 35 degrees, evenly from near to far."""
    upright, out = rotation_exp([0.0, BOARD_TILT, 0.0]), []
    for i in range(views):
        tilt, turn = np.radians(rng.uniform(5, 35)), 2.399963 * i
        direction = upright @ [np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)]
        away = NEAR + (FAR - NEAR) * i / (views - 1)
        eye = BOARD_CENTRE + away * direction
        out.append(look_at(eye, BOARD_CENTRE + rng.uniform(-0.05, 0.05, 3), up=[1.0, 0.0, 0.0]))
    return out


def seen_by(world: SimWorld, pose: Float64, index: int) -> Seen:
    """Take one view."""
    world.set_pose(pose @ invert(world.true_rig.T_flange_tof), str(index).encode())
    state = ArmState(np.zeros(6), np.eye(4), 0)
    tof = replace(world.tof(10, clock=int), info=replace(world.tof_info, range_errors=()))
    view = View("calibration", index, tof, world.stereo(clock=int), state, state, world.true_rig)
    return seen_of(view, f"view-{index:03d}")


def left(world: SimWorld, found: tuple[RangeError, ...]) -> Float64:
    """RMS (F,) of true minus found error over range and image, metres."""
    camera, out = world.constants.tof, []
    place, radius = image_places(camera)[None], radius_px(camera)[None]
    r = np.linspace(NEAR, FAR, 61)[:, None, None]
    for mine, true in zip(found, ERRORS, strict=True):
        turned = 4 * np.pi * true.modulation_hz / SPEED_OF_LIGHT * r
        both = [e.at(turned, radius, 45.0, place, np.full((1, 1, 1), 200.0)) for e in (mine, true)]
        out.append(np.sqrt(np.mean(np.square(both[0] - both[1]))))
    return np.array(out)


def run(seed: int, views: int, multipath: bool) -> tuple[Float64, RangeFit, int]:
    """One seed: what is left, the fit from the error as drawn, and how many views served."""
    rng = np.random.default_rng([seed, 11])
    world = SimWorld(constants_of(multipath), seed, lambda name, _: scene_objects(name, seed))
    world.place("calibration")
    seen = [seen_by(world, pose, i) for i, pose in enumerate(poses_of(rng, views))]
    error, true = exp(SIGMA * rng.standard_normal(6)), world.true_rig.T_tof_stereo
    fits = [fit_ranges(seen, E @ true, SIGMA) for E in (error, invert(error))]
    rest = np.sqrt(np.mean(np.square([left(world, fit.errors) for fit in fits]), axis=0))
    return rest, fits[0], len(fits[0].views)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--views", type=int, default=25)
    parser.add_argument("--only", choices=("clean", "multipath"))
    args = parser.parse_args()
    nothing = tuple(RangeError(e.modulation_hz) for e in ERRORS)
    print("light      seed  before mm (20, 100 MHz)   left mm (20, 100 MHz)   views differ mm   s of CPU")
    for multipath in (False, True):
        word = "multipath" if multipath else "clean"
        rows = []
        for seed in range(args.seeds if args.only in (None, word) else 0):
            began = time.process_time()
            try:
                rest, fit, _ = run(seed, args.views, multipath)
            except (TofError, QualityError) as err:
                print(f"{word:10}{seed:5d}  {err}")
                continue
            world = SimWorld(constants_of(multipath=False), seed, lambda name, _: scene_objects(name, 0))
            before = 1e3 * left(world, nothing)
            rows.append(1e3 * rest)
            print(
                f"{word:10}{seed:5d}{before[0]:14.2f}{before[1]:8.2f}{rows[-1][0]:20.2f}{rows[-1][1]:8.2f}"
                f"{1e3 * fit.spread[0]:14.2f}{1e3 * fit.spread[1]:7.2f}{time.process_time() - began:10.0f}",
                flush=True,
            )
        if rows:
            middle = np.median(rows, axis=0)
            print(f"{word:10}median{middle[0]:41.2f}{middle[1]:8.2f}   (expected at most 1.00)")


if __name__ == "__main__":
    main()
