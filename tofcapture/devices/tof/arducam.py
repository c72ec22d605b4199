"""The driver ``arducam``: an Arducam ToF module through its Python SDK, ``ArducamDepthCamera``; see docs/arducam.md for its limits.

::

    [tof]
    driver = "arducam"
    connection = "usb"
    modulation_hz = [37.5e6, 37.5e6, 37.5e6, 37.5e6]
    phase_rad = [0.0, 1.5707963267948966, 3.141592653589793, 4.71238898038469]
    exposure = 400e-6
    serial = "..."
    [tof.camera]
    ...
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import ReopenedCamera, tof_info
from tofcapture.devices.host import hosted
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_SETTINGS = ("connection", "index")
_REQUIRED = ("serial", "camera", "modulation_hz", "phase_rad", "exposure")
_OPTIONAL = {
    "model": "Arducam ToF",
    "illuminator": [0.0, 0.0, 0.0],
    "saturation": 4095.0,
    "range_errors": [],
    "offset": True,
    "reach": None,
}
_REQUEST_MS = 2000
_MISSES = 5  # frames in a row that may fail to come


class Arducam(ReopenedCamera, TofCamera):
    """One Arducam ToF module, in RAW output.

    Parameters
    ----------
    table
        ``connection`` ("csi" or "usb"), ``index`` (default 0), and the module's description, because the SDK says neither
        its modulation frequencies nor its phase steps: ``serial``, ``camera``, ``modulation_hz``, ``phase_rad``,
        ``exposure``; optionally ``model``, ``illuminator``, ``saturation``, ``range_errors``, ``offset``, ``reach``.
    context
        The station; not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        known = {*_SETTINGS, *_REQUIRED, *_OPTIONAL}
        unknown, missing = sorted(table.keys() - known), [k for k in _REQUIRED if k not in table]
        if unknown or missing:
            raise ConfigError(
                f"[tof] arducam: unknown: {', '.join(unknown) or 'none'}; missing: {', '.join(missing) or 'none'}",
                hint="see docs/arducam.md",
            )
        self._info = tof_info({**_OPTIONAL, **table}, "[tof] arducam", "docs/arducam.md")
        self._connection, self._index = str(table.get("connection", "csi")), int(table.get("index", 0))
        if self._connection not in ("csi", "usb"):
            raise ConfigError(f'[tof] connection: expected "csi" or "usb", got {self._connection!r}')
        self._camera: Any = None

    def describe(self) -> TofInfo:
        """Say what ``station.toml`` says of this camera; opens nothing."""
        return self._info

    def capture(self, frames: int) -> TofBurst:
        """Take so many new frames.

        Returns the burst with the host's monotonic time at which each frame was handed over, which is after its
        exposure, and NaN temperatures: the SDK gives neither.

        Raises :class:`ConfigError`: fewer than one frame; :class:`DeviceError`: frames do not come, or are no
        stack of phase images; the next call opens the camera anew.
        """
        if frames < 1:
            raise ConfigError(f"frames: expected at least 1, got {frames}")
        with self.opened():
            self._frame()  # one may have been waiting since before the arm stood still
            raw, times = zip(*(self._frame() for _ in range(frames)), strict=True)
        return TofBurst(np.stack(raw), np.array(times, dtype=np.int64), np.full(frames, np.nan), self._info)

    def connect(self, stack: ExitStack) -> None:
        """Open the module and start its RAW output."""
        try:
            import ArducamDepthCamera
        except ImportError as err:
            raise ConfigError(
                f"the driver arducam needs the Python package ArducamDepthCamera: {err}",
                hint="pip install ArducamDepthCamera, in an environment with numpy below 2",
            ) from err
        connections = ArducamDepthCamera.Connection
        mode = connections.CSI if self._connection == "csi" else connections.USB
        self._camera = camera = ArducamDepthCamera.ArducamCamera()
        _succeed(camera.open(mode, self._index), f"open ({self._connection}, {self._index})")
        stack.callback(camera.close)
        _succeed(camera.start(ArducamDepthCamera.FrameType.RAW), "start RAW")
        stack.callback(camera.stop)

    def _frame(self) -> tuple[NDArray[np.uint16], int]:
        """One frame (K, H, W) and the host time (ns) when it was handed over."""
        for _ in range(_MISSES):
            frame = self._camera.requestFrame(_REQUEST_MS)
            now = time.monotonic_ns()
            if frame is None:
                continue
            try:
                return _phases(frame, self._info), now
            finally:
                self._camera.releaseFrame(frame)
        raise DeviceError(
            f"Arducam: no frame in {_MISSES * _REQUEST_MS / 1e3:.0f} s",
            hint="check its cable and its 5 V, 2 A supply",
        )


def _phases(frame: Any, info: TofInfo) -> NDArray[np.uint16]:
    """Copy a frame's phase images (K, H, W) out of the SDK's memory.

    Raises :class:`DeviceError`: it is no RAW frame, or not a stack of K images of H x W.
    """
    data = getattr(frame, "raw_data", None)
    if data is None:
        raise DeviceError(
            f"Arducam: expected a RAW frame, got {type(frame).__name__}: depth that the SDK computed cannot be recorded",
            hint="see docs/arducam.md",
        )
    K, (H, W) = len(info.modulation_hz), info.camera.shape
    array = np.asarray(data)
    if array.shape not in ((K * H, W), (K, H, W)):
        raise DeviceError(
            f"Arducam: expected {K} phase images of {H} x {W} below each other, got a frame of shape {array.shape}",
            hint="this module's RAW output is not the one described in [tof]; see docs/arducam.md",
        )
    out = array.reshape(K, H, W).astype(np.int32)
    if out.min() < 0 or out.max() > 4095:
        raise DeviceError(
            f"Arducam: expected 12-bit values, got {out.min()} to {out.max()}", hint="see docs/arducam.md"
        )
    return out.astype(np.uint16)


def _succeed(code: Any, doing: str) -> None:
    """Turn a code other than success into an error with its name."""
    if int(code) != 0:
        raise DeviceError(
            f"Arducam: {doing}: {getattr(code, 'name', code)}",
            hint="check its cable, its power, the overlay of the CSI port, and that no other program holds it",
        )


DRIVERS = {"tof": hosted("tof", "tofcapture.devices.tof.arducam:Arducam")}
