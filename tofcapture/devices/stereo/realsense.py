"""The driver ``realsense``: a RealSense D4xx through ``pyrealsense2``; see docs/devices.md.

::

    [stereo]
    driver = "realsense"
    serial = "819612073528"
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.camera import Camera
from tofcapture.devices import StereoDevice
from tofcapture.devices.cameras import (
    ReopenedCamera,
    described,
    read_description,
    stereo_info,
    write_description,
)
from tofcapture.devices.host import hosted
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import StereoFrame, StereoInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_DESCRIPTION = ("model", "camera")
_DEFAULTS = {"size": [1280, 720], "fps": 6, "timeout": 5.0, "settle": 5}
_SETTINGS = ("serial", "exposure", "description", "bag", *_DEFAULTS)


class RealSense(ReopenedCamera, StereoDevice):
    """One RealSense depth camera. Its projector is lit for its own exposures only: it would shine into ToF pixels.

    Parameters
    ----------
    table
        ``serial`` (required); ``size`` (width, height; default 1280 x 720), ``fps`` (default 6); ``exposure`` (seconds; the
        camera finds it unless named); ``settle`` (frames left out after the projector is lit, default 5); ``timeout`` (seconds for
        a frame, default 5); ``description`` (file that keeps what the camera said of itself); ``bag`` (a recorded file instead
        of a camera); ``model`` and ``camera`` to describe it before it was first opened.
    context
        The station.
    """

    def __init__(self, table: Mapping[str, Any], context: StationContext) -> None:
        check_keys(table, (*_SETTINGS, *_DESCRIPTION), "[stereo]")
        if not isinstance(table.get("serial"), str):
            raise ConfigError(
                f'[stereo] serial: expected "819612073528" or the like, got {table.get("serial")!r}'
            )
        self._table = {**_DEFAULTS, **table}
        self._folder, self._serial = Path(context.folder), str(table["serial"])
        self._file = self._folder / str(table.get("description", f"realsense-{self._serial}.toml"))
        self._sensor: Any = None

    def describe(self) -> StereoInfo:
        """Say what this camera is, from ``station.toml`` and the description file; opens nothing.

        Raises ConfigError when the camera was never opened and ``station.toml`` does not describe it.
        """
        where = f"[stereo] {self._serial}"
        said = described(read_description(self._file), self._table, _DESCRIPTION, where)
        return stereo_info({**said, "serial": self._serial}, where, "docs/devices.md")

    def capture(self) -> StereoFrame:
        """Light the projector, take one depth image, put the projector out.

        Returns
        -------
        Frame of points in the left imager's frame, NaN where depth is 0, with the host's time at which it came.

        Raises
        ------
        DeviceError
            The camera does not deliver; the next call opens it anew.
        """
        with self.opened(), _errors(f"capturing with {self._serial}"):
            with self._projector():
                for _ in range(int(self._table["settle"])):
                    self._wait()  # exposed before, or while the exposure was sought
                frame, now = self._wait(), time.monotonic_ns()
            depth = np.asarray(frame.get_data()).astype(np.float64) * self._unit
        info = self.describe()
        if depth.shape != info.camera.shape:
            raise DeviceError(f"RealSense: expected depth of {info.camera.shape}, got {depth.shape}")
        return StereoFrame(_points(depth, info.camera), now, info)

    def _wait(self) -> Any:
        return self._queue.wait_for_frame(round(float(self._table["timeout"]) * 1e3))

    @contextmanager
    def _projector(self) -> Iterator[None]:
        """Light the projector meanwhile; frames that wait are of before."""
        self._emitter(1.0)
        try:
            yield
        finally:
            with suppress(RuntimeError):  # what went wrong before is what is told
                self._emitter(0.0)

    def _emitter(self, value: float) -> None:
        self._set(self._rs.option.emitter_enabled, value)

    def _set(self, option: Any, value: float) -> None:
        """Set an option that the sensor has; a recording's stay what they were."""
        if self._sensor.supports(option) and not self._sensor.is_option_read_only(option):
            self._sensor.set_option(option, value)

    def connect(self, stack: ExitStack) -> None:
        """Find the camera, choose its mode, start depth, and see that its calibration is the known one."""
        try:
            import pyrealsense2 as rs
        except ImportError as err:
            raise ConfigError(
                f"the driver realsense needs pyrealsense2: {err}", hint="pip install 'tofcapture[realsense]'"
            ) from err
        self._rs = rs
        with _errors(f"opening {self._serial}"):
            bag = self._table.get("bag")
            device = _found(rs, self._serial, None if bag is None else self._folder / str(bag))
            sensor, profile = _mode(rs, device, tuple(self._table["size"]), int(self._table["fps"]))
            said = _said_by(rs, device, profile, self._serial)
            known = read_description(self._file)
            if known is not None and known.get("camera") != said["camera"]:
                raise DeviceError(
                    f"[stereo] {self._serial}: its calibration is not the one of {self._file.name}",
                    hint="it was calibrated anew, or size is another: delete that file, record and align again",
                )
            write_description(self._file, said)
            self._sensor, self._queue = sensor, rs.frame_queue(1)
            self._unit = float(sensor.get_option(rs.option.depth_units))
            self._expose(rs)
            sensor.open(profile)
            stack.callback(_quietly, sensor.close)
            sensor.start(self._queue)
            stack.callback(_quietly, sensor.stop)
            self._emitter(0.0)

    def _expose(self, rs: Any) -> None:
        """Set the exposure, or let the camera find it."""
        exposure = self._table.get("exposure")
        self._set(rs.option.enable_auto_exposure, float(exposure is None))
        if exposure is not None:
            self._set(rs.option.exposure, float(exposure) * 1e6)


def _points(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.float32]:
    """Unproject depth (H, W), metres, 0 for none, into points (H, W, 3)."""
    points = camera.unproject(np.where(depth > 0, depth, np.nan)).astype(np.float32)
    if not np.isfinite(points).any():
        raise DeviceError(
            "RealSense: the depth image is empty",
            hint="is the scene within range, and the projector on and uncovered?",
        )
    return points


def _found(rs: Any, serial: str, bag: Path | None) -> Any:
    """Find a camera by its serial number, or what a bag recorded."""
    if bag is not None and not bag.is_file():
        raise DeviceError(f"RealSense: no bag {bag}", hint="[stereo] bag is a path beside the station's file")
    devices = list(rs.context().query_devices()) if bag is None else [rs.context().load_device(str(bag))]
    serials = [d.get_info(rs.camera_info.serial_number) for d in devices]
    if serial not in serials:
        raise DeviceError(
            f"no RealSense camera {serial}; there are: {', '.join(serials) or 'none'}",
            hint="check its USB 3 cable and [stereo] serial; rs-enumerate-devices lists cameras",
        )
    return devices[serials.index(serial)]


def _mode(rs: Any, device: Any, size: tuple[int, ...], fps: int) -> tuple[Any, Any]:
    """Find the sensor and the profile that give depth of a size at a rate."""
    there = []
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() != rs.stream.depth or profile.format() != rs.format.z16:
                continue
            video = profile.as_video_stream_profile()
            if ((video.width(), video.height()), profile.fps()) == (size, fps):
                return sensor, profile
            there.append(f"{video.width()} x {video.height()} at {profile.fps()}")
    raise DeviceError(
        f"RealSense: no depth of {' x '.join(map(str, size))} at {fps} fps; there are: {', '.join(there) or 'none'}",
        hint="set [stereo] size and fps; a USB 2 cable leaves few modes",
    )


def _said_by(rs: Any, device: Any, profile: Any, serial: str) -> dict[str, Any]:
    """Model, and intrinsics of the depth image, which the camera has rectified."""
    found = profile.as_video_stream_profile().get_intrinsics()
    if any(found.coeffs):
        raise DeviceError(
            f"RealSense: {serial}: expected rectified depth, got distortion {list(found.coeffs)}"
        )
    intrinsics = {"width": found.width, "height": found.height, "fx": found.fx, "fy": found.fy}
    intrinsics |= {"cx": found.ppx, "cy": found.ppy}
    return {"model": device.get_info(rs.camera_info.name), "serial": serial, "camera": intrinsics}


def _quietly(close: Any) -> None:
    """Close; what is unplugged is closed."""
    with suppress(RuntimeError):
        close()


@contextmanager
def _errors(doing: str) -> Iterator[None]:
    """Turn the library's errors into ours, here and nowhere else."""
    try:
        yield
    except RuntimeError as err:
        raise DeviceError(
            f"RealSense: {doing}: {err}",
            hint="check its USB 3 cable; end other programs that use it; unplug it and plug it in",
        ) from err


DRIVERS = {"stereo": hosted("stereo", "tofcapture.devices.stereo.realsense:RealSense")}
