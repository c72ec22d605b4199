"""A driver of a ToF camera in one file: ``python own_camera.py`` puts it through the contract. Replace what says YOURS."""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import ReopenedCamera, tof_info
from tofcapture.devices.registry import StationContext, check_keys
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo

SAID = {  # YOURS: lengths in metres, times in seconds, the order of the channels
    "model": "own camera", "illuminator": [0.0, 0.0, 0.0], "exposure": 400e-6, "saturation": 4095.0, "range_errors": [],
    "modulation_hz": [60e6] * 4 + [20e6] * 4, "phase_rad": [k * np.pi / 2 for k in range(4)] * 2, "offset": True, "reach": None,
    "camera": {"width": 32, "height": 24, "fx": 28.0, "fy": 28.0, "cx": 15.5, "cy": 11.5},
}  # fmt: skip


class OwnTof(ReopenedCamera, TofCamera):
    """YOURS: ``table`` has the settings of ``[tof]`` in station.toml."""

    def __init__(self, table: dict[str, Any], context: StationContext) -> None:
        del context
        check_keys(table, ("serial",), "[tof]")
        said = {**SAID, "serial": str(table.get("serial", "1"))}
        self._info = tof_info(said, "[tof]", "docs/howto/own-camera.md")

    def describe(self) -> TofInfo:
        """Say what it is; opens nothing."""
        return self._info

    def connect(self, stack: ExitStack) -> None:
        """YOURS: open the camera; ``stack`` closes it."""
        self._random = np.random.default_rng(0)
        stack.callback(self._random.bit_generator.random_raw)

    def capture(self, frames: int) -> TofBurst:
        """YOURS: take frames (8, 24, 32), each with its time."""
        if frames < 1:
            raise ConfigError(f"frames: expected at least 1, got {frames}")
        raw, times = np.empty((frames, 8, 24, 32), np.uint16), np.empty(frames, np.int64)
        with self.opened():
            for k in range(frames):
                try:
                    raw[k], times[k] = self._random.integers(200, 3000, raw[k].shape), time.monotonic_ns()
                except OSError as err:  # YOURS: what your library raises
                    raise DeviceError(f"own camera: {err}", hint="check its cable") from err
        return TofBurst(raw, times, np.full(frames, np.nan), self._info)


if __name__ == "__main__":
    from tofcapture.testing import check_tof

    check_tof(lambda: OwnTof({"serial": "7"}, StationContext({}, Path())))
    print("the driver keeps the contract")
