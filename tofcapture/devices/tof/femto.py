"""The driver ``femto``: raw phases of an Orbbec Femto Bolt, a camera of the Azure Kinect's class, over UVC; see docs/devices.md.

::

    [tof]
    driver = "femto"
    device = "/dev/video0"
    mode = "narrow"
    serial = "CL8H1234"
    exposure = 12.8e-3
    [tof.camera]
    ...
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tofcapture.devices.cameras import tof_info
from tofcapture.devices.host import hosted
from tofcapture.devices.registry import check_keys
from tofcapture.devices.tof.v4l2 import OPTIONAL, REQUIRED, Taken, V4l2Tof, Wire, settings, stamped
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.files.camera_bytes import FEMTO, FEMTO_IMAGES, FemtoHeader, femto_frame

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_MHZ = [196.75, 191.57, 53.57]  # as others fitted them; a camera's headers say their own
_PHASES = 3
_CLOCK = 6e3  # Hz; headers tell multiples of 10 kHz
_PAGE = "docs/devices.md"


class FemtoTof(V4l2Tof):
    """One such camera, a device of V4L2; or a file or a pipe of its pictures. Each frame's headers must name the channels.

    Parameters
    ----------
    table
        ``mode`` (``narrow`` or ``wide``), ``serial``, ``camera``, ``exposure`` (seconds); optionally ``device``, ``mhz`` (three),
        ``illuminator``, ``range_errors``.
    context
        The station; not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        check_keys(table, (*REQUIRED, *OPTIONAL, "mhz"), "[tof]")
        mode, device, rest = settings(table, FEMTO, _PAGE)
        layout, mhz = FEMTO[mode], rest.pop("mhz", _MHZ)
        if (
            not isinstance(mhz, list)
            or len(mhz) != _PHASES
            or not all(isinstance(f, int | float) for f in mhz)
        ):
            raise ConfigError(f"[tof] mhz: expected three frequencies, got {mhz!r}", hint=f"see {_PAGE}")
        said = {"model": f"Femto Bolt {mode}", "saturation": 32767.0, "offset": True, "reach": None}
        said["modulation_hz"] = [round(f * 1e6) for f in mhz for _ in range(_PHASES)]
        said["phase_rad"] = [2 * np.pi * k / _PHASES for k in range(_PHASES)] * len(mhz)
        info = tof_info({**rest, **said}, "[tof] femto", _PAGE)
        if info.camera.shape != layout.shape:
            raise ConfigError(
                f"[tof.camera]: {mode} is {layout.shape[1]} x {layout.shape[0]}", hint=f"see {_PAGE}"
            )
        super().__init__(device, Wire("Femto", _PAGE, layout.width, layout.rows, "Y16", layout.size), info)

    def frame(self) -> Taken:
        """Take one picture, and see that its headers are of this mode and these channels."""
        images, heads = femto_frame(self.take()[1], self._info.camera.shape)
        self._check(heads)
        return stamped(images, heads[0].celsius)

    def _check(self, heads: list[FemtoHeader]) -> None:
        first = heads[0]
        if (first.shape, first.captures) != (self._info.camera.shape, FEMTO_IMAGES):
            raise DeviceError(
                f"Femto: expected {FEMTO_IMAGES} images of {self._info.camera.shape}, the header says "
                f"{first.captures} of {first.shape}",
                hint="the camera is in another mode: choose [tof] mode",
            )
        named = [(h.modulation_hz, h.phase_rad) for h in heads]
        wanted = list(zip(self._info.modulation_hz, self._info.phase_rad, strict=True))[: len(heads)]
        if not all(
            abs(f - g) < _CLOCK and abs(p - q) < 0.01 for (f, p), (g, q) in zip(named, wanted, strict=True)
        ):
            words = ", ".join(f"{f / 1e6:.2f} MHz at {np.degrees(p):.0f} deg" for f, p in named)
            raise DeviceError(f"Femto: the headers name other channels: {words}", hint="correct [tof] mhz")


DRIVERS = {"tof": hosted("tof", "tofcapture.devices.tof.femto:FemtoTof")}
