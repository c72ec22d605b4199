"""What one camera's calibration does to the figures of a network: the same simulated frames, decoded with other calibrations.

    python benchmarks/camera_draws.py DATASET [--split test] [--weights RUN] [--draws 16] [--every 1]

A simulated camera hands over its range errors as its maker would know them, wrong by a draw of the simulator's ``[factory]``
constants. A test by one camera rests on one draw. Here each view is decoded once with every draw, as if one and the same camera had
taken them all, and once with the true range errors, which is where `tofcapture calibrate range` leads. Printed for each: the network's
MAE, its ratio to the sensor's, and the share of errors within one predicted sigma.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tofcapture.devices.sim.config import read_constants
from tofcapture.devices.sim.world import factory_calibration
from tofcapture.rig import RangeError
from tofcapture_model.data import FrameDataset, batched, frame_decoder, make_frame
from tofcapture_model.networks.baselines import sensor_estimate
from tofcapture_model.networks.checkpoint import load_checkpoint
from tofcapture_model.networks.joint import JointModel

SEED = 900_000  # far from those of any data


def measured(data: FrameDataset, model: JointModel, every: int, errors: tuple[RangeError, ...]) -> np.ndarray:
    """MAE in mm, its ratio to the sensor's, share within one sigma; over all good pixels of every ``every``-th view."""
    ours, theirs, within = [], [], []
    for view in data.samples[::every]:
        reader, target = data.readers[view.scene], data.target(view)
        info = replace(reader.info, range_errors=errors)
        decoder = frame_decoder(info, reader.camera)
        raw, celsius = reader.raw(view.view, view.frame), reader.celsius(view.view, view.frame)
        frame = batched(make_frame(raw, info, reader.camera, celsius, decoder))
        with torch.inference_mode():
            found, decoded = model(frame), sensor_estimate(frame)[0]
        apart = (found.depth[0] - target.depth).abs()[target.good]
        ours.append(apart.numpy())
        theirs.append((decoded[0] - target.depth).abs()[target.good].numpy())
        within.append((apart < found.error[0][target.good]).numpy())
    mine, sensors, inside = (np.concatenate(x) for x in (ours, theirs, within))
    return np.array([1000 * mine.mean(), mine.mean() / sensors.mean(), inside.mean()])


def main() -> None:
    """Print a line for every draw, their spread, and the line of the true range errors."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--draws", type=int, default=16)
    parser.add_argument("--every", type=int, default=1)
    args = parser.parse_args()
    data = FrameDataset(args.dataset, args.split, frames=1, cache_bytes=2e9)
    model, _, _ = load_checkpoint(args.weights)
    constants = read_constants({}, "the simulator's constants")

    def line(what: str, row: np.ndarray) -> None:
        print(
            f"{what:28} MAE {row[0]:5.2f} mm, {row[1]:.3f} of the sensor's, within one sigma {row[2]:.1%}",
            flush=True,
        )

    rows = []
    for k in range(args.draws):
        rows.append(measured(data, model, args.every, factory_calibration(constants, SEED + k)))
        line(f"draw {k}", rows[-1])
    for share, name in (
        (0, "least"),
        (0.25, "lower quartile"),
        (0.5, "median"),
        (0.75, "upper quartile"),
        (1, "most"),
    ):
        line(name, np.quantile(rows, share, axis=0))
    line("true range errors", measured(data, model, args.every, constants.sensor.range_errors))


if __name__ == "__main__":
    main()
