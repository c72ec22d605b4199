"""The driver ``ensenso``: an Ensenso stereo camera through the ``nxlib`` package and the Ensenso SDK; see docs/ensenso.md.

::

    [stereo]
    driver = "ensenso"
    serial = "171197"
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import ensenso_nxlib as sdk
from tofcapture.devices.contact import read_contact, write_contact
from tofcapture.devices.host import hosted
from tofcapture.errors import ConfigError, DeviceError, FormatError
from tofcapture.files.info import stereo_from
from tofcapture.frames import StereoFrame, StereoInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_SETTINGS = ("serial", "flexview", "exposure", "timeout", "link", "contact", "library")
_DESCRIPTION = ("model", "camera")


class Ensenso:
    """One Ensenso camera.

    Its point maps are in the left eye's frame, in metres, NaN where nothing was measured. The exposure time is found by the
    camera on the first capture after opening and held from then on, unless ``exposure`` names one.

    Parameters
    ----------
    table
        ``serial`` (required); ``flexview`` (image pairs, 3 to 8 on an N35; 0 is off; default 8); ``exposure`` (seconds);
        ``timeout`` (seconds for one capture, default 5); ``link``: ``"refuse"`` (default) or ``"clear"`` a link that would turn point
        maps into another frame; ``contact`` (file that keeps what the camera said of itself); ``library`` (path of the SDK's
        shared library); ``model`` and ``camera`` to describe it before the first contact.
    context
        The station.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        self._table = _checked(table)
        self._serial = str(table["serial"])
        self._contact = Path(context.folder) / str(table.get("contact", f"ensenso-{self._serial}.toml"))
        self._stack: ExitStack | None = None
        self._camera: Any = None
        self._frozen: float | None = None

    def __enter__(self) -> Self:
        self._open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the camera and the SDK; again does nothing."""
        stack, self._stack, self._camera = self._stack, None, None
        if stack is not None:
            stack.close()

    def describe(self) -> StereoInfo:
        """Say what this camera is, from ``station.toml`` and the contact file; opens nothing.

        Raises
        ------
        ConfigError
            The camera was never opened and ``station.toml`` does not describe it.
        """
        said = {
            **(read_contact(self._contact) or {}),
            **{k: v for k, v in self._table.items() if k in _DESCRIPTION},
        }
        said["serial"] = self._serial
        missing = [k for k in _DESCRIPTION if k not in said]
        if missing:
            raise ConfigError(
                f"[stereo] {self._serial}: expected {', '.join(missing)}, which the camera has not said",
                hint="open it once, or write model and [stereo.camera] into station.toml",
            )
        try:
            return stereo_from(said, f"[stereo] {self._serial}")
        except FormatError as err:
            raise ConfigError(err.message, hint="see docs/ensenso.md") from err

    def capture(self) -> StereoFrame:
        """Take one point map.

        A capture that times out is tried once more as it is, then once after closing and opening the camera.

        Returns
        -------
        Frame with ``time_ns`` in the middle of the exposures, host's monotonic clock.

        Raises
        ------
        DeviceError
            The camera does not deliver; the next call opens it anew.
        """
        try:
            try:
                return self._attempt(tries=2)
            except sdk.CaptureTimeoutError:
                self.close()
                return self._attempt(tries=1)
        except DeviceError:
            self.close()
            raise

    def _attempt(self, tries: int) -> StereoFrame:
        info = self._open()
        while True:
            tries -= 1
            try:
                start = time.monotonic_ns()
                sdk.expose(self._camera, float(self._table["timeout"]))
                middle = (start + time.monotonic_ns()) // 2
                break
            except sdk.CaptureTimeoutError:
                if not tries:
                    raise
        self._freeze()
        points = metres(sdk.point_map(self._camera), info.camera.shape, self._serial)
        return StereoFrame(points, middle, info)

    def _freeze(self) -> None:
        """Hold the exposure that the camera found, so that all views of a scene are lit alike."""
        if self._frozen is None:
            self._frozen = sdk.freeze_exposure(self._camera)

    def _open(self) -> StereoInfo:
        if self._camera is None:
            with ExitStack() as stack:
                stack.enter_context(sdk.library(self._table.get("library")))
                camera = stack.enter_context(sdk.opened(self._serial))
                sdk.check_link(camera, clear=self._table["link"] == "clear")
                exposure = self._table.get("exposure")
                self._frozen = self._frozen if exposure is None else float(exposure)
                sdk.configure(camera, int(self._table["flexview"]), self._frozen)
                self._admit(sdk.said_by(camera))
                self._camera, self._stack = camera, stack.pop_all()
        return self.describe()

    def _admit(self, said: Mapping[str, Any]) -> None:
        """Refuse intrinsics other than the known ones; remember them on first contact."""
        known = read_contact(self._contact)
        if known is not None and known.get("camera") != said["camera"]:
            raise DeviceError(
                f"[stereo] {self._serial}: its calibration is not the one of {self._contact.name}",
                hint="it was calibrated anew: delete that file, begin a new recording, align again",
            )
        write_contact(self._contact, said)


def metres(points_mm: NDArray[np.float32], shape: tuple[int, int], serial: str) -> NDArray[np.float32]:
    """Point map in metres.

    Parameters
    ----------
    points_mm
        (H, W, 3) float32 millimetres, NaN (in any coordinate) where nothing was measured.
    shape
        (H, W) expected.
    serial
        For messages.

    Returns
    -------
    (H, W, 3) float32, all three coordinates NaN where any is not finite.

    Raises
    ------
    DeviceError
        Another shape or type; or not one point.
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


def _checked(table: Mapping[str, Any]) -> dict[str, Any]:
    known = (*_SETTINGS, *_DESCRIPTION)
    unknown = table.keys() - set(known)
    if unknown:
        raise ConfigError(
            f"[stereo] does not know {', '.join(sorted(unknown))}", hint=f"it knows {', '.join(known)}"
        )
    if not isinstance(table.get("serial"), str):
        raise ConfigError(
            f'[stereo] serial: expected the camera\'s serial, "171197", got {table.get("serial")!r}'
        )
    full = {"flexview": 8, "timeout": 5.0, "link": "refuse", **table}
    if full["link"] not in ("refuse", "clear"):
        raise ConfigError(f'[stereo] link: expected "refuse" or "clear", got {full["link"]!r}')
    if full["flexview"] not in range(17) or full["flexview"] == 1:
        raise ConfigError(
            f"[stereo] flexview: expected 0 (off) or 2 to 16 image pairs, got {full['flexview']!r}"
        )
    return full


# Opening waits until the SDK has looked through the network for cameras.
DRIVERS = {
    "stereo": hosted("stereo", "tofcapture.devices.ensenso:Ensenso", {"__enter__": 40.0, "capture": 120.0})
}
