"""How far is the sensor from ground truth? ``python read_shard.py dataset/shards/mug.h5``."""

import sys

import numpy as np

from tofcapture.files.shard import ShardReader


def main(path: str) -> None:
    """Print the error of every view in millimetres."""
    with ShardReader(path) as shard:
        for view in range(shard.views):
            sensor, truth = shard.tof(view), shard.ground_truth(view, scale=1)
            good = (truth.mask == 0) & np.isfinite(sensor.depth)  # on the object, seen, not at an edge
            error = 1e3 * (sensor.depth - truth.depth)[good]
            if error.size:
                print(
                    f"{shard.scene} {shard.index(view)}: {np.abs(error).mean():.2f} mm on {error.size} pixels, bias {error.mean():+.2f} mm"
                )
            else:
                print(f"{shard.scene} {shard.index(view)}: no good pixel")


if __name__ == "__main__":
    main(sys.argv[1])
