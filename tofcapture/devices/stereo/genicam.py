"""The driver ``genicam``: 3-D cameras of the GenICam standard, as Photoneo's and Basler's, through Aravis; see docs/devices.md.

::

    [stereo]
    driver = "genicam"
    device = "Photoneo-ABC-123"
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices.cameras import DescribedStereo
from tofcapture.devices.host import hosted
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import StereoFrame

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_FEATURES = ("settings", "lit", "dark")
_UNITS = {"Millimeter": 1e-3, "Inch": 0.0254, "Meter": 1.0}
# What a buffer may hold: the standard's numbers, whether it is whole points, and the type of a value
_FORMATS = {
    0x026000C0: (True, "<f4"), 0x023000B9: (True, "<u2"), 0x011000B8: (False, "<u2"), 0x012000BF: (False, "<f4"), 0x01100007: (False, "<u2"),
}  # fmt: skip


class GenICam(DescribedStereo):
    """One such camera: it hands out an organised cloud, or a range image and its intrinsics.

    Parameters
    ----------
    table
        ``device`` (its name in Aravis, or its address); ``pixels`` (``Coord3D_ABC32f``, ``Coord3D_ABC16``, ``Coord3D_C16`` ...);
        ``exposure`` (seconds); ``settings``, ``lit``, ``dark`` (tables of features to set once, before and after each exposure);
        ``timeout`` (seconds for a frame); ``description`` (file that keeps what the camera said of itself); ``model`` and
        ``camera`` where it says none.
    context
        The station.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        defaults = {"pixels": "Coord3D_ABC32f", "timeout": 5.0}
        super().__init__(table, context, "genicam", ("exposure", *_FEATURES), defaults, key="device")
        if wrong := [k for k in _FEATURES if not isinstance(table.get(k, {}), Mapping)]:
            raise ConfigError(f"[stereo] {wrong[0]}: expected a table of features")
        self._camera: Any = None

    def capture(self) -> StereoFrame:
        """Take one frame; the camera exposes for it alone, lit where ``lit`` and ``dark`` say how.

        Returns
        -------
        Frame of points in metres, NaN where the camera marks none, with the host's time at which it came.

        Raises
        ------
        DeviceError
            The camera does not deliver, or another format or size; the next call opens it anew.
        """
        with self.opened(), _errors(self._name, "capturing"):
            try:
                self._set("lit")
                buffer, now = (
                    self._camera.acquisition(round(1e6 * self._table["timeout"])),
                    time.monotonic_ns(),
                )
            finally:
                self._set("dark")
            info = self.describe()
            points = self._points(buffer, info.camera)
        return StereoFrame(points, now, info)

    def _points(self, buffer: Any, camera: Camera) -> NDArray[np.float32]:
        if buffer is None or buffer.get_status().value_nick != "success":
            words = (
                "no frame" if buffer is None else f"a frame with the status {buffer.get_status().value_nick}"
            )
            raise DeviceError(
                f"GenICam: {self._name}: {words} within {self._table['timeout']:g} s",
                hint="check its cable, its trigger mode, and that no other program has it",
            )
        parts = {int(buffer.get_part_pixel_format(i)): i for i in range(buffer.get_n_parts())}
        number = next((f for f in parts if f in _FORMATS), None)
        if number is None:
            raise DeviceError(
                f"GenICam: {self._name}: expected {self._table['pixels']}, the frame holds {', '.join(map(hex, parts))}",
                hint="switch its range component on, or name another [stereo] pixels",
            )
        shape = buffer.get_part_height(parts[number]), buffer.get_part_width(parts[number])
        if shape != camera.shape:
            raise DeviceError(
                f"GenICam: {self._name}: expected {camera.shape}, the frame is {shape}",
                hint=f"another region or binning is set; if it shall be, delete {self._file.name}",
            )
        data = bytes(buffer.get_part_data(parts[number]))
        return points_of(data, number, camera, self._scale, self._offset, self._invalid)

    def connect(self, stack: ExitStack) -> None:
        """Open the camera, choose its format, read its scale and intrinsics, and see that they are the known ones."""
        try:
            import gi

            gi.require_version("Aravis", "0.8")
            from gi.repository import Aravis
        except (ImportError, ValueError) as err:
            raise ConfigError(
                f"the driver genicam needs Aravis and PyGObject: {err}",
                hint="apt-get install gir1.2-aravis-0.8 python3-gi; see docs/devices.md",
            ) from err
        with _errors(self._name, "opening"):
            self._camera = _found(Aravis, self._name)
            stack.callback(setattr, self, "_camera", None)
            self._camera.set_pixel_format_from_string(self._table["pixels"])
            if "exposure" in self._table:
                self._camera.set_exposure_time(1e6 * float(self._table["exposure"]))
            self._set("settings")
            self._set("dark")
            self._scale, self._offset, self._invalid = self._coordinates()
            self.remember(self._said())

    def _coordinates(self) -> tuple[NDArray[np.float64], NDArray[np.float64], float | None]:
        """Scale and offset (3,) of A, B, C in metres, and the value that stands for none."""
        unit = _UNITS.get(str(self._ask("Scan3dDistanceUnit", "string", "Millimeter")), 1e-3)
        scale, offset = np.ones(3), np.zeros(3)
        for i, axis in enumerate(("CoordinateA", "CoordinateB", "CoordinateC")):
            if self._camera.is_feature_available("Scan3dCoordinateSelector"):
                self._camera.set_string("Scan3dCoordinateSelector", axis)
            scale[i] = self._ask("Scan3dCoordinateScale", "float", 1.0)
            offset[i] = self._ask("Scan3dCoordinateOffset", "float", 0.0)
        flagged = self._ask("Scan3dInvalidDataFlag", "boolean", True)
        none = self._ask("Scan3dInvalidDataValue", "float", 0.0) if flagged else None
        return scale * unit, offset * unit, none

    def _ask(self, feature: str, kind: str, default: Any) -> Any:
        if not self._camera.is_feature_available(feature):
            return default
        return getattr(self._camera, f"get_{kind}")(feature)

    def _set(self, group: str) -> None:
        """Set the features of a table of the station."""
        kinds = {bool: "boolean", int: "integer", float: "float", str: "string"}
        for feature, value in self._table.get(group, {}).items():
            getattr(self._camera, f"set_{kinds[type(value)]}")(feature, value)

    def _said(self) -> dict[str, Any]:
        """Name, and intrinsics where the camera has them."""
        _, _, width, height = self._camera.get_region()
        said: dict[str, Any] = {"model": self._camera.get_model_name(), "serial": self._name}
        focal = self._ask("Scan3dFocalLength", "float", None)
        if focal is not None:
            ratio = self._ask("Scan3dAspectRatio", "float", 1.0)
            place = {
                k: self._ask(f"Scan3dPrincipalPoint{k}", "float", n / 2)
                for k, n in (("U", width), ("V", height))
            }
            said["camera"] = {"width": width, "height": height, "fx": focal, "fy": focal * ratio}
            said["camera"] |= {"cx": place["U"], "cy": place["V"]}
        return said


def points_of(
    data: bytes,
    number: int,
    camera: Camera,
    scale: NDArray[np.float64],
    offset: NDArray[np.float64],
    none: float | None,
) -> NDArray[np.float32]:
    """Turn a frame's bytes, of the pixel format ``number``, into points (H, W, 3); ``none`` is the value for no measurement."""
    whole, kind = _FORMATS[number]
    H, W = camera.shape
    values = np.frombuffer(data, kind, H * W * (3 if whole else 1)).reshape(H, W, -1).astype(np.float64)
    missing = ~np.isfinite(values[..., -1]) | (values[..., -1] == (np.nan if none is None else none))
    if whole:
        points = values * scale + offset
        missing |= points[..., 2] <= 0
    else:
        points = camera.unproject(np.where(missing, np.nan, values[..., 0] * scale[2] + offset[2]))
    points[missing] = np.nan
    if missing.all():
        raise DeviceError(
            "GenICam: the frame is empty", hint="is the scene within range, and the projector uncovered?"
        )
    return points.astype(np.float32)


def _found(Aravis: Any, name: str) -> Any:
    """Open a camera by name or address."""
    if name.startswith("Fake"):
        Aravis.enable_interface("Fake")
    Aravis.update_device_list()
    there = [Aravis.get_device_id(i) for i in range(Aravis.get_n_devices())]
    if name not in there and not name[:1].isdigit():
        raise DeviceError(
            f"no GenICam camera {name}; there are: {', '.join(there) or 'none'}",
            hint="check power, cable and that the network card is in the camera's network; arv-tool-0.8 lists cameras",
        )
    return Aravis.Camera.new(name)


@contextmanager
def _errors(name: str, doing: str) -> Iterator[None]:
    """Turn the library's errors into ours, here and nowhere else."""
    try:
        yield
    except RuntimeError as err:  # GLib.Error is one
        raise DeviceError(
            f"GenICam: {doing} {name}: {getattr(err, 'message', err)}",
            hint="check its cable; end other programs that use it; are the features of [stereo] those it has?",
        ) from err


DRIVERS = {"stereo": hosted("stereo", "tofcapture.devices.stereo.genicam:GenICam")}
