"""Stops at the moments of a move at every layer, and default plans driven to their end, on the emulated UR controller or franky-sim.

    python -m benchmarks.motion stops [--arm franka --layers host,daemon --step 5 --until 1000]
    python -m benchmarks.motion plans [--seeds 20 --models ur10e,ur5e]

Nothing but an emulator on loopback is moved. Plans are driven at ten times the arm's speed; every motion goes through the
driver's own checks.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tests import emulated, franka_sim
from tests.franka_sim import FrankaSim
from tests.stopping import LAYERS, faults_of, sweep
from tests.ur_emulator.process import Emulator
from tofcapture.devices.station import open_station
from tofcapture.record.plan import plan_scene, prove

_PLANS = (("calibration", 12), ("calibration", 25), ("mug", 25))


def stops(arm: str, layers: list[str], moments: range, folder: Path) -> Iterator[str]:
    """One row a layer: stops, the longest time to rest and the largest turn after one, and how many were late or unsaid."""
    yield "| layer | stops | rest after, s: median | longest | by its clock | turned after it, deg: most | late or unsaid |"
    yield "|---|---|---|---|---|---|---|"
    with FrankaSim() if arm == "franka" else Emulator() as emulator:
        if arm == "franka":
            file = franka_sim.station_file(folder, emulator.host)
        else:
            emulator.calm()
            file = emulated.station_file(folder, emulator)
        for layer in layers:
            delays = [ms / 1e3 for ms in moments][:: max(1, 25 // moments.step) if layer == "daemon" else 1]
            trials = sweep(layer, emulator.host, file, delays)
            rest, own, turned = ([t[key] for t in trials] for key in ("rest_s", "arm_s", "turned_deg"))
            bad = len(faults_of(trials))
            yield f"| {layer} | {len(trials)} | {np.median(rest):.3f} | {max(rest):.3f} | {max(own):.3f} | {max(turned):.2f} | {bad} |"


def plans(models: list[str], seeds: int, folder: Path) -> Iterator[str]:
    """One row a model and kind of plan: how many are complete, motions driven, views by way of home, the farthest turn."""
    yield "| arm | plan | complete | motions | by way of home | largest turn, deg |\n|---|---|---|---|---|---|"
    for model in models:
        with Emulator(model=model) as emulator:
            emulator.order("haste", factor=10.0)
            file = emulated.station_file(folder, emulator, f'model = "{model}"')
            for scene, views in _PLANS:
                done, motions, homes, turn = 0, 0, 0, 0.0
                for seed in range(seeds):
                    with open_station(file, seed, allow_motion=True) as station:
                        plan = plan_scene(station, scene, views)
                        here = station.arm.state().joints
                        ways = prove(station, plan)
                        for goal in [q for way in ways for q in way]:
                            station.arm.move_to(goal)
                            turn, here = max(turn, float(np.degrees(np.abs(goal - here).max()))), goal
                        done += len(plan.views) == views
                        motions += sum(map(len, ways))
                        homes += sum(len(way) > 1 for way in ways)
                yield f"| {model} | {scene}, {views} views | {done} of {seeds} | {motions} | {homes} | {turn:.1f} |"


def main() -> None:
    """Print one of the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["stops", "plans"])
    parser.add_argument("--layers", default=",".join(LAYERS))
    parser.add_argument("--arm", choices=["ur", "franka"], default="ur")
    parser.add_argument("--step", type=int, default=5, help="ms between stops (daemon: 25 at least)")
    parser.add_argument("--until", type=int, default=100, help="ms after the start of the move")
    parser.add_argument("--models", default="ur10e,ur5e")
    parser.add_argument("--seeds", type=int, default=20)
    args, start = parser.parse_args(), time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        if args.what == "stops":
            moments = range(-50, args.until + 1, args.step)
            rows = stops(args.arm, args.layers.split(","), moments, Path(folder))
        else:
            rows = plans(args.models.split(","), args.seeds, Path(folder))
        for row in rows:
            print(row, flush=True)
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
