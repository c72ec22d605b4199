"""The driver ``espros``: a TOFcam-660 (epc660) through ESPROS's own client, ``epc-tofcam-toolkit``; see docs/devices.md.

::

    [tof]
    driver = "espros"
    address = "10.10.31.180"
    serial = "12-3456"              # wafer and chip, as the camera says them
    mhz = [24.0, 6.0]
    exposure = 400e-6
    [tof.camera]
    ...
"""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import ReopenedCamera, tof_info
from tofcapture.devices.host import hosted
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import TofBurst, TofInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_REQUIRED = ("serial", "camera", "mhz", "exposure")
_OPTIONAL = {
    "address": "10.10.31.180",
    "model": "TOFcam-660",
    "illuminator": [0.0, 0.0, 0.0],
    "range_errors": [],
}
_TABLE_MHZ = (24.0, 12.0, 6.0, 3.0, 1.5, 0.75)  # calibrated ones; any other is set by flexible modulation
_FLEXIBLE = (0.625, 24.0)  # MHz
_PHASES = (0.0, 1.5 * np.pi, np.pi, 0.5 * np.pi)  # the client: phi = atan2(dcs1 - dcs3, dcs0 - dcs2)
_MIDDLE, _FLAGS = 2048, 64000  # the client subtracts the first from all but flags
_CONNECT = 3.0  # s
_ANSWER = 1.0  # s, of a command; the client asks five times
_PAGE = "see docs/devices.md"


class Espros(ReopenedCamera, TofCamera):
    """One TOFcam-660. Its chip has one frequency at a time: a frame of ours is a frame of the camera at each.

    Parameters
    ----------
    table
        ``serial`` (wafer and chip), ``camera`` (intrinsics), ``mhz`` (one to three frequencies), ``exposure`` (seconds);
        optionally ``address``, ``model``, ``illuminator``, ``range_errors``.
    context
        The station; not needed.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        del context
        check_keys(table, (*_REQUIRED, *_OPTIONAL), "[tof]")
        if missing := [k for k in _REQUIRED if k not in table]:
            raise ConfigError(f"[tof] espros: expected {', '.join(missing)}", hint=_PAGE)
        full = {**_OPTIONAL, **table}
        self._address, self._mhz = str(full.pop("address")), _frequencies(full.pop("mhz"))
        hz = [f * 1e6 for f in self._mhz for _ in _PHASES]
        channels = {"modulation_hz": hz, "phase_rad": list(_PHASES) * len(self._mhz)}
        self._info = tof_info(
            {**full, **channels, "saturation": 4095.0, "offset": True, "reach": None}, "[tof] espros", _PAGE
        )
        self._client: Any = None

    def describe(self) -> TofInfo:
        """Say what ``station.toml`` says of this camera; opens nothing."""
        return self._info

    def capture(self, frames: int) -> TofBurst:
        """Take so many frames, each of one camera frame a frequency.

        Returns burst of the values on the wire (uint16, 2048 is no signal, from 64000 on flags), the time in
        the middle of each frame, and the chip's temperature.

        Raises :class:`ConfigError`: fewer than one frame; :class:`DeviceError`: frames do not come, or not in
        the mode that was set; the next call opens the camera anew.
        """
        if frames < 1:
            raise ConfigError(f"frames: expected at least 1, got {frames}")
        with self.opened():
            taken = [self._frame() for _ in range(frames)]
        raw, times, celsius = zip(*taken, strict=True)
        return TofBurst(np.stack(raw), np.array(times, np.int64), np.array(celsius), self._info)

    def _frame(self) -> tuple[NDArray[np.uint16], int, float]:
        begin, images, celsius = time.monotonic_ns(), [], []
        for mhz in self._mhz:
            with _errors(f"taking a frame at {mhz:g} MHz"):
                if len(self._mhz) > 1:
                    _modulate(self._client, mhz)
                values = self._client.get_raw_dcs_images()
                header = self._client.frame
            self._check(header, values)
            images.append(np.where(values >= _FLAGS, values, values + _MIDDLE).astype(np.uint16))
            celsius.append(header.temperature)
        return np.concatenate(images), (begin + time.monotonic_ns()) // 2, float(np.mean(celsius))

    def _check(self, header: Any, values: NDArray[Any]) -> None:
        """Refuse a frame of another mode than that which was set."""
        expected = (4, *self._info.camera.shape)
        if values.shape != expected:
            raise DeviceError(
                f"ESPROS: expected four images of {expected[1]} x {expected[2]}, got {values.shape}",
                hint="another program set binning or a region of interest, or [tof.camera] is of another mode",
            )
        if header.lowIntTime != _microseconds(self._info.exposure):
            raise DeviceError(
                f"ESPROS: expected an exposure of {_microseconds(self._info.exposure)} us, the frame says {header.lowIntTime}",
                hint="another program uses the camera: end it",
            )

    def connect(self, stack: ExitStack) -> None:
        """Connect, see that it is this camera, and set it to raw images without any correction."""
        try:
            from epc.tofCam660 import tofCam660
        except ImportError as err:
            raise ConfigError(
                f"the driver espros needs the Python package epc-tofcam-toolkit: {err}",
                hint="pip install 'tofcapture[espros]'",
            ) from err
        with _errors(f"connecting to {self._address}"), _patience(_CONNECT):
            client = self._client = tofCam660.TOFcam660(self._address)
        stack.callback(_close, client)
        client.tcpInterface.socket.settimeout(_ANSWER)
        with _errors("setting it up"):
            chip, wafer = client.device.get_chip_infos()
            if (there := f"{wafer}-{chip}") != self._info.serial:
                raise DeviceError(
                    f"ESPROS: expected the camera {self._info.serial} at {self._address}, it is {there}",
                    hint="correct [tof] serial or address",
                )
            client.initialize()
            settings = client.settings
            settings.set_minimal_amplitude(0)
            settings.set_compensations(*[False] * 4)
            settings.set_integration_time(_microseconds(self._info.exposure))
            _modulate(client, self._mhz[0])


def _frequencies(value: Any) -> tuple[float, ...]:
    """Read ``mhz``."""
    try:
        mhz = tuple(float(f) for f in value) if isinstance(value, list | tuple) else ()
    except (TypeError, ValueError):
        mhz = ()
    low, high = _FLEXIBLE
    if not 1 <= len(set(mhz)) == len(mhz) <= 3 or not all(low <= f <= high for f in mhz):
        raise ConfigError(
            f"[tof] mhz: expected one to three frequencies from {low} to {high} MHz, got {value!r}"
        )
    return mhz


def _modulate(client: Any, mhz: float) -> None:
    """Set the frequency of the next frame."""
    if mhz in _TABLE_MHZ:
        client.settings.set_modulation(mhz)
    else:
        client.settings.set_flex_mod_freq(mhz)


def _microseconds(exposure: float) -> int:
    return round(exposure * 1e6)


def _close(client: Any) -> None:
    """Close both connections; a dead one is no error."""
    for link in (client.tcpInterface, client.rxInterface):
        with suppress(OSError):
            link.close()


@contextmanager
def _patience(seconds: float) -> Iterator[None]:
    """Give new sockets of the client a time limit, which it sets itself only once it is connected."""
    before = socket.getdefaulttimeout()
    socket.setdefaulttimeout(seconds)
    try:
        yield
    finally:
        socket.setdefaulttimeout(before)


@contextmanager
def _errors(doing: str) -> Iterator[None]:
    """Turn the client's errors into ours, here and nowhere else."""
    try:
        yield
    except NotImplementedError as err:
        raise DeviceError(
            f"ESPROS: {doing}: {err}", hint="update the camera's firmware, or choose 24, 12, 6 MHz ..."
        ) from err
    except (OSError, EOFError, RuntimeError, ValueError) as err:
        words = " ".join(str(err).split())
        raise DeviceError(
            f"ESPROS: {doing}: {words}",
            hint="check its power, its cable and [tof] address; ping it; end other programs",
        ) from err


DRIVERS = {"tof": hosted("tof", "tofcapture.devices.tof.espros:Espros", {"__enter__": 14.0})}
