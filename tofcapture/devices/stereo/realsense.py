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
from tofcapture.devices.cameras import DescribedStereo
from tofcapture.devices.host import hosted
from tofcapture.errors import ConfigError, DeviceError
from tofcapture.frames import StereoFrame

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_DEFAULTS = {"size": [1280, 720], "fps": 6, "timeout": 5.0, "settle": 5}


class RealSense(DescribedStereo):
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
        super().__init__(table, context, "realsense", ("exposure", "bag"), _DEFAULTS)
        self._sensor: Any = None

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
        with self.opened(), _errors(f"capturing with {self._name}"):
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
        with _errors(f"opening {self._name}"):
            bag = self._table.get("bag")
            device = _found(rs, self._name, None if bag is None else self._folder / str(bag))
            sensor, profile = _mode(rs, device, tuple(self._table["size"]), int(self._table["fps"]))
            self.remember(_said_by(rs, device, profile, self._name))
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
