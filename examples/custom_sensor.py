"""Train on a sensor of your own, here a simulated one of 64 x 48 pixels: ``python custom_sensor.py out``.

Size and intrinsics stand in each shard, so nothing but the station says which sensor it is.
"""

import sys
from dataclasses import replace
from pathlib import Path

import tofcapture_model
from tofcapture.cli import main as tofcapture
from tofcapture.devices.station import DEFAULT
from tofcapture_model.config import preset

SENSOR = """
[sim.tof]
width = 64
height = 48
fx = 50.8
fy = 53.5
cx = 31.2
cy = 27.1
[sim.stereo]
width = 320
height = 256
fx = 288.8
fy = 288.8
cx = 159.5
cy = 127.5
"""


def main(out: str, scenes: str = "3", steps: int = 4) -> None:
    """Simulate a few scenes, train for a few steps."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    station, dataset = folder / "station.toml", folder / "dataset"
    station.write_text(DEFAULT.read_text(encoding="utf-8") + SENSOR, encoding="utf-8")
    line = f"simulate-dataset --suite multipath --scenes {scenes} --views 2 --frames 2 --jobs 1".split()
    if tofcapture([*line, "--station", str(station), "--out", str(dataset)]) != 0:
        raise SystemExit("simulate-dataset failed")
    config = preset("demo")  # its crops are larger than this sensor's image: take whole images
    config = replace(config, training=replace(config.training, crop=()))
    trained = tofcapture_model.train(config, dataset, folder / "model", stop_after=steps)
    print(f"{trained.steps} steps on 64 x 48 pixels, losses {trained.losses}")


if __name__ == "__main__":
    main(sys.argv[1])
