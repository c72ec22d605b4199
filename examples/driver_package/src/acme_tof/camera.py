"""The driver itself: a class with the protocol of a ToF camera."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np

from tofcapture.camera import Camera
from tofcapture.devices import TofCamera
from tofcapture.devices.registry import StationContext
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo

_CAMERA = Camera(32, 24, 28.0, 28.0, 15.5, 11.5)
# The vendor's codes become errors here and nowhere else.
_MEANING = {
    -1: ("no camera with this serial number", "check the USB cable and [tof] serial"),
    -7: ("the burst did not arrive", "use a shorter cable or a USB port of its own"),
}


class AcmeTof(TofCamera):
    """A ToF camera.

    Parameters
    ----------
    table
        The station's table ``[tof]`` without ``driver``.
    context
        The station; not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        if table.keys() - {"serial"}:
            raise ConfigError(f"[tof] acme knows serial only, got {', '.join(table)}")
        self._serial = str(table.get("serial", "A-0001"))
        self._handle: Any = None

    def describe(self) -> TofInfo:
        """Say what this camera is, without opening it."""
        return TofInfo("Acme 32x24", self._serial, _CAMERA, illuminator=np.array([0.01, 0.0, 0.0]))

    def __enter__(self) -> Self:
        from acme_tof import vendor  # loaded in the child process only

        self._handle = _call(vendor.open_camera, self._serial)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handle is not None:
            self._handle.close()
        self._handle = None

    def capture(self, frames: int) -> TofBurst:
        """Take a burst of ``frames`` static frames.

        Raises
        ------
        DeviceError
            Not open, no burst, or no such length.
        """
        if self._handle is None:
            raise DeviceError("the Acme camera is not open", hint="use the station as a context manager")
        if not 1 <= frames <= 100:
            raise DeviceError(f"burst: expected 1 to 100 frames, got {frames}")
        raw, times = _call(self._handle.burst, frames)
        return TofBurst(raw, times, np.full(frames, np.nan), self.describe())


def _call(function: Any, *args: Any) -> Any:
    """Call the vendor's library, turn its codes into named errors."""
    from acme_tof import vendor

    try:
        return function(*args)
    except vendor.AcmeError as err:
        what, advice = _MEANING.get(err.code, (f"error {err.code}", ""))
        raise DeviceError(f"Acme camera: {what}", hint=advice) from err
