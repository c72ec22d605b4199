"""The driver ``arducam``: Arducam ToF modules over V4L2, without the vendor's package; see docs/devices.md.

::

    [tof]
    driver = "arducam"
    device = "/dev/video0"
    mode = "b0548-double"
    serial = "B0548-1"
    exposure = 400e-6
    [tof.camera]
    ...
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.cameras import tof_info
from tofcapture.devices.host import hosted
from tofcapture.devices.registry import check_keys
from tofcapture.devices.tof.v4l2 import OPTIONAL, REQUIRED, Taken, V4l2Tof, Wire, settings, stamped
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.files.camera_bytes import ARDUCAM

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_PAGE = "docs/devices.md"


class ArducamTof(V4l2Tof):
    """One Arducam ToF module, a device of V4L2; or a file or a pipe of such frames, one after another. It tells no temperature.

    Parameters
    ----------
    table
        ``mode`` (one of :data:`tofcapture.files.camera_bytes.ARDUCAM`), ``serial``, ``camera``, ``exposure`` (seconds); optionally
        ``device``, ``illuminator``, ``range_errors``.
    context
        The station; not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        check_keys(table, (*REQUIRED, *OPTIONAL), "[tof]")
        mode, device, rest = settings(table, ARDUCAM, _PAGE)
        layout = self._layout = ARDUCAM[mode]
        said = {"model": f"Arducam {mode}", "saturation": 1023.0, "offset": True, "reach": None}
        said |= {"modulation_hz": layout.modulation_hz, "phase_rad": layout.phase_rad}
        info = tof_info({**rest, **said}, "[tof] arducam", _PAGE)
        if info.camera.shape != (layout.height, layout.width):
            raise ConfigError(
                f"[tof.camera]: {mode} is {layout.width} x {layout.height}", hint=f"see {_PAGE}"
            )
        super().__init__(device, Wire("Arducam", _PAGE, layout.width, layout.rows, "Y12P", layout.size), info)

    def frame(self) -> Taken:
        """Take one frame: phases that come in turn begin with a number that four divides, and none may lack."""
        count, images = self._layout.frames, list[NDArray[np.int16]]()
        for _ in range(2 * count):
            number, data = self.take()
            if number % count != len(images):
                images = []  # one was dropped
            if number % count == len(images):
                images.append(self._layout.images(data))
            if len(images) == count:
                return stamped(np.concatenate(images))
        raise DeviceError(f"Arducam: {self._device}: frames are dropped", hint="is the machine overloaded?")


DRIVERS = {"tof": hosted("tof", "tofcapture.devices.tof.arducam:ArducamTof")}
