"""The driver ``ensenso``: an Ensenso stereo camera through the ``nxlib`` package and the Ensenso SDK; see docs/devices.md.

::

    [stereo]
    driver = "ensenso"
    serial = "171197"
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices.cameras import DescribedStereo
from tofcapture.devices.host import hosted
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import StereoFrame

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_DEFAULTS = {"flexview": 8, "timeout": 5.0, "link": "refuse"}
_TIMEOUTS = ("CaptureTimeout", "DeviceTimeout", "Timeout")
_HINTS = {
    "CaptureTimeout": "network: a direct link, jumbo frames, no switch; a long FlexView needs a longer [stereo] timeout",
    "CameraNotFound": "the camera went away: check its cable and power",
    "NxLibInitializationNotAllowed": "the SDK is being closed; start the program anew",
}


class CaptureTimeoutError(DeviceError):
    """The images did not arrive in time."""


class Ensenso(DescribedStereo):
    """One Ensenso camera.

    Its point maps are in the left eye's frame, in metres, NaN where nothing was measured. The camera finds the exposure
    time on the first capture after opening, and it is held from then on, unless ``exposure`` names one.

    Parameters
    ----------
    table
        ``serial`` (required); ``flexview`` (image pairs, 3 to 8 on an N35; 0 is off; default 8); ``exposure`` (seconds);
        ``timeout`` (seconds for one capture, default 5); ``link``: ``"refuse"`` (default) or ``"clear"`` a link that would
        turn point maps into another frame; ``description`` (file that keeps what the camera said of itself); ``library``
        (path of the SDK's shared library); ``model`` and ``camera`` to describe it before it was first opened.
    context
        The station.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        super().__init__(table, context, "ensenso", ("exposure", "library"), _DEFAULTS)
        if self._table["link"] not in ("refuse", "clear"):
            raise ConfigError(f'[stereo] link: expected "refuse" or "clear", got {self._table["link"]!r}')
        if (pairs := self._table["flexview"]) not in range(17) or pairs == 1:
            raise ConfigError(f"[stereo] flexview: expected 0 (off) or 2 to 16 image pairs, got {pairs!r}")
        self._camera: Any = None
        self._exposure: float | None = None

    def capture(self) -> StereoFrame:
        """Take one point map.

        A capture that times out is tried once more as it is, then once after closing and opening the camera.

        Returns the frame with ``time_ns`` in the middle of the exposures, host's monotonic clock.

        Raises :class:`DeviceError`: the camera does not deliver; the next call opens it anew.
        """
        with suppress(CaptureTimeoutError), self.opened():
            try:
                return self._take()
            except CaptureTimeoutError:
                return self._take()
        with self.opened():
            return self._take()

    def _take(self) -> StereoFrame:
        start = time.monotonic_ns()
        timeout = round(float(self._table["timeout"]) * 1e3)
        with _errors("capturing"):
            self._camera.capture({"Timeout": timeout})
        middle = (start + time.monotonic_ns()) // 2
        if self._exposure is None:
            self._exposure = _held_exposure(self._camera)
        with _errors("computing the point map"):
            self._camera.compute_disparity_map()
            self._camera.compute_point_map()
            points_mm = self._camera.get_point_map()
        info = self.describe()
        return StereoFrame(metres(points_mm, info.camera.shape, self._name), middle, info)

    def connect(self, stack: ExitStack) -> None:
        """Open SDK and camera, set its parameters, and see that its calibration is the known one."""
        stack.enter_context(library(self._table.get("library")))
        camera = self._camera = stack.enter_context(_open_camera(self._name))
        _check_link(camera, clear=self._table["link"] == "clear")
        if (exposure := self._table.get("exposure")) is not None:
            self._exposure = float(exposure)
        _configure(camera, int(self._table["flexview"]), self._exposure)
        self.remember(_said_by(camera))


def metres(points_mm: NDArray[np.float32], shape: tuple[int, int], serial: str) -> NDArray[np.float32]:
    """Turn a point map (H, W, 3) float32 into metres; all three coordinates become NaN where any is not finite.

    Raises :class:`DeviceError`: another shape than ``shape`` (H, W), another type; or not one point.
    """
    if points_mm.shape != (*shape, 3) or points_mm.dtype != np.float32:
        raise DeviceError(
            f"[stereo] {serial}: point map: expected {(*shape, 3)} float32, got {points_mm.shape} {points_mm.dtype}",
            hint="binning or a region of interest is set; reset the camera's parameters",
        )
    points = points_mm * np.float32(1e-3)
    valid = np.isfinite(points).all(axis=-1)
    if not valid.any():
        raise DeviceError(
            f"[stereo] {serial}: the point map has no point",
            hint="is the scene within range and the projector on? look at it in NxView",
        )
    points[~valid] = np.nan
    return points


# Below is what speaks to ``nxlib``. The names of the SDK's tree are the vendor's own.


@contextmanager
def library(path: str | None) -> Iterator[None]:
    """Load and initialise the SDK; finalise it on leaving.

    Raises :class:`ConfigError`: the Python package or the SDK's shared library is missing;
    :class:`DeviceError`: the SDK does not initialise.
    """
    try:
        from nxlib import api
    except ImportError as err:
        raise ConfigError(
            "the driver ensenso needs the Python package nxlib", hint="pip install nxlib"
        ) from err
    try:
        with _errors("initialising the Ensenso SDK"):
            api.initialize(path=path)
    except OSError as err:
        raise ConfigError(
            f"the Ensenso SDK is not installed: {err}",
            hint="install it from ensenso.com, or point NXLIB_LIBRARY_PATH or [stereo] library to libNxLib64.so",
        ) from err
    try:
        yield
    finally:
        with suppress(DeviceError), _errors("finalising the Ensenso SDK"):
            api.finalize()


@contextmanager
def _open_camera(serial: str) -> Iterator[Any]:
    """Open the camera of that serial number, or say why it cannot be; close it on leaving."""
    from nxlib import NxLibItem, context
    from nxlib.constants import VAL_STEREO, VAL_STRUCTURED_LIGHT

    try:
        with _errors(f"opening camera {serial}"):
            camera = context.Camera.from_serial(serial, [VAL_STEREO, VAL_STRUCTURED_LIGHT])
            camera.open()
    except context.CameraNotFoundError as err:
        there = ", ".join(NxLibItem()["Cameras"].value()) or "none"
        raise DeviceError(
            f"no Ensenso camera {serial}; there are: {there}",
            hint="check power, network and firewall; look with NxView",
        ) from err
    except context.CameraTypeError as err:
        raise DeviceError(f"camera {serial}: {err}", hint="name the stereo camera's serial number") from err
    except context.CameraOpenError as err:
        raise DeviceError(
            f"camera {serial} cannot be opened",
            hint="another program holds it, or its IP address is unreachable",
        ) from err
    try:
        yield camera
    finally:
        with suppress(DeviceError), _errors(f"closing camera {serial}"):
            camera.close()


def _check_link(camera: Any, *, clear: bool) -> None:
    """Refuse a link, which would move point maps into another frame.

    ``clear`` clears it first, in the SDK's memory and not in the camera. Raises DeviceError when a link is left.
    """
    with _errors("reading the camera's link"):
        link = camera["Link"]
        if clear and _linked(link):
            link["Target"].set_string("")
            link["Rotation"]["Angle"].set_double(0.0)
            for axis in range(3):
                link["Translation"][axis].set_double(0.0)
        if _linked(link):
            raise DeviceError(
                f"the camera is linked to {link.value().get('Target') or 'a pose'!r}: its point maps are not in its own frame",
                hint='set link = "clear" in [stereo], or clear workspace and hand-eye calibration in NxView',
            )


def _linked(link: Any) -> bool:
    """Tell whether a link leads anywhere: to another frame by name, or by a motion."""
    if not link.exists() or link.is_null():
        return False
    says: Mapping[str, Any] = link.value()
    turned = (says.get("Rotation") or {}).get("Angle") or 0.0
    return bool(says.get("Target")) or bool(turned) or any(says.get("Translation") or ())


def _configure(camera: Any, flexview: int, exposure: float | None) -> None:
    """Set trigger, FlexView (image pairs, 0 for off) and exposure (seconds; ``None`` lets the camera find it)."""
    with _errors("setting the camera's parameters"):
        capture = camera["Parameters"]["Capture"]
        capture["TriggerMode"] = "Software"
        capture["FlexView"] = flexview or False
        capture["AutoExposure"] = exposure is None
        if exposure is not None:
            capture["Exposure"] = exposure * 1e3


def _held_exposure(camera: Any) -> float:
    """Hold the exposure that the last capture found, so that all views are lit alike; returns it in seconds."""
    with _errors("holding the exposure"):
        capture = camera["Parameters"]["Capture"]
        found_ms = float(capture["Exposure"].as_double())
        capture["AutoExposure"] = False
        capture["Exposure"] = found_ms
    return found_ms * 1e-3


def _said_by(camera: Any) -> dict[str, Any]:
    """Model, serial, and intrinsics of the rectified left eye, whose grid the point map has.

    The SDK's matrix is indexed by column, then row.
    """
    with _errors("reading the camera's calibration"):
        columns = camera["Calibration"]["Stereo"]["Left"]["Camera"].value()
        width, height = camera["Sensor"]["Size"].value()
        intrinsics = {
            "width": int(width), "height": int(height), "fx": float(columns[0][0]), "fy": float(columns[1][1]),
            "cx": float(columns[2][0]), "cy": float(columns[2][1]),
        }  # fmt: skip
        return {"model": camera.get_model_name(), "serial": camera.get_serial_number(), "camera": intrinsics}


@contextmanager
def _errors(doing: str) -> Iterator[None]:
    """Turn the library's codes into our errors, all of them, here and nowhere else."""
    from nxlib.exception import NxLibError, NxLibException

    try:
        yield
    except NxLibException as err:
        symbol, text = _symbol(err)
        kind = CaptureTimeoutError if symbol in _TIMEOUTS or err.get_error_code() == 8 else DeviceError
        raise kind(
            f"Ensenso: {doing}: {symbol}: {text}", hint=_HINTS.get(symbol, "look at the camera with NxView")
        ) from err
    except NxLibError as err:
        raise DeviceError(f"Ensenso: {doing}: {err}", hint="look at the camera with NxView") from err


def _symbol(err: Any) -> tuple[str, str]:
    """Error symbol and sentence, of a command where it was one."""
    from nxlib.exception import NxLibException

    if err.is_command_execution_failure():
        with suppress(NxLibException):
            return err.get_command_error_symbol(), err.get_command_error_text()
    return err.get_error_text(), str(err.get_item_path())


# Opening waits until the SDK has looked through the network for cameras.
DRIVERS = {
    "stereo": hosted(
        "stereo", "tofcapture.devices.stereo.ensenso:Ensenso", {"__enter__": 40.0, "capture": 120.0}
    )
}
