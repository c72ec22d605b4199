"""How far is the sensor from ground truth? ``python read_shard.py dataset/shards/mug.h5``."""

import sys

import numpy as np

import tofcapture


def main(path: str) -> None:
    """Print the error of every view in millimetres."""
    with tofcapture.open_shard(path) as shard:
        for view in shard:
            sensor, truth = view.tof, view.ground_truth[1]
            good = (truth.mask == 0) & np.isfinite(sensor.depth)  # on the object, seen, not at an edge
            error = 1e3 * (sensor.depth - truth.depth)[good]
            told = f"{np.abs(error).mean():.2f} mm on {error.size} pixels" if error.size else "no good pixel"
            print(f"{shard.scene} {view.index}: {told}")


if __name__ == "__main__":
    main(sys.argv[1])
