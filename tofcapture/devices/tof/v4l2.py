"""ToF cameras whose raw frames come from a device of V4L2, or from a file or a pipe that holds them one after another."""

from __future__ import annotations

import os
import select
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import ReopenedCamera
from tofcapture.errors import ConfigError, DeviceError, FormatError
from tofcapture.frames import TofBurst, TofInfo

REQUIRED = ("mode", "serial", "camera", "exposure")
OPTIONAL = {"device": "/dev/video0", "illuminator": [0.0, 0.0, 0.0], "range_errors": []}
_SILENCE = 5.0  # s without a frame
_BUFFERS = 8

Frame = tuple[int, bytes]  # its number, its bytes
Next = Callable[[], Frame]
Taken = tuple[NDArray[np.int16], int, float]  # images (K, H, W), when they were complete, degrees Celsius


@dataclass(frozen=True)
class Wire:
    """Say in which frames a camera sends, and who it is in messages."""

    name: str
    page: str  # of the docs
    width: int
    rows: int
    pixels: str  # V4L2's four letters
    size: int  # bytes of a frame

    @property
    def hint(self) -> str:
        """What to look at when no frames come."""
        return f"check the cable, and v4l2-ctl --all of the device; see {self.page}"


class V4l2Tof(ReopenedCamera, TofCamera):
    """A ToF camera behind V4L2; a driver says what its frames hold."""

    def __init__(self, device: str, wire: Wire, info: TofInfo) -> None:
        self._device, self._wire, self._info = device, wire, info
        self._next: Next | None = None

    def frame(self) -> Taken:
        """Take one frame of ours."""
        raise NotImplementedError

    def describe(self) -> TofInfo:
        """Say what ``station.toml`` says of this camera; opens nothing."""
        return self._info

    def probe(self) -> str:
        """Tell whether the device's file is there."""
        if not Path(self._device).exists():
            raise DeviceError(f"{self._wire.name}: no {self._device}", hint=self._wire.hint)
        return self._device

    def capture(self, frames: int) -> TofBurst:
        """Take so many new frames.

        Returns burst of signed values with the host's time at which each frame was complete, after its exposure.

        Raises :class:`ConfigError`: fewer than one frame; :class:`DeviceError`: frames do not come, or are of
        another size; the next call opens the device anew.
        """
        if frames < 1:
            raise ConfigError(f"frames: expected at least 1, got {frames}")
        with self.opened(), self._errors():
            for _ in range(_BUFFERS if _is_camera(self._device) else 0):
                self.take()  # may have waited since before the rig stood still
            raw, times, celsius = zip(*(self.frame() for _ in range(frames)), strict=True)
        return TofBurst(np.stack(raw), np.array(times, dtype=np.int64), np.array(celsius, float), self._info)

    def connect(self, stack: ExitStack) -> None:
        """Open the device and start its stream."""
        self.probe()
        with self._errors():
            opened = _camera if _is_camera(self._device) else _file
            self._next = opened(self._device, self._wire, stack)

    def take(self) -> Frame:
        """Take one frame of the camera."""
        if self._next is None:
            raise DeviceError(f"{self._wire.name} is not open", hint="use the station as a context manager")
        return self._next()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Turn errors of the system and of the layout into ours."""
        where = f"{self._wire.name}: {self._device}"
        try:
            yield
        except FormatError as err:
            raise DeviceError(f"{where}: {err.message}", hint=err.hint) from err
        except OSError as err:
            raise DeviceError(f"{where}: {err.strerror or err}", hint=self._wire.hint) from err


def settings(
    table: Mapping[str, Any], modes: Mapping[str, Any], page: str
) -> tuple[str, str, dict[str, Any]]:
    """Split a station's table into mode, device and what the camera is; :class:`ConfigError` when a part is missing."""
    if missing := [k for k in REQUIRED if k not in table]:
        raise ConfigError(f"[tof] expected {', '.join(missing)}", hint=f"see {page}")
    rest = {**OPTIONAL, **table}
    mode, device = str(rest.pop("mode")), str(rest.pop("device"))
    if mode not in modes:
        raise ConfigError(f"[tof] mode: expected one of {', '.join(modes)}, got {mode!r}", hint=f"see {page}")
    return mode, device, rest


def _is_camera(path: str) -> bool:
    return stat.S_ISCHR(Path(path).stat().st_mode)


def _await(handle: Any, path: str, wire: Wire) -> None:
    """Wait until there is something to read."""
    if not select.select([handle], [], [], _SILENCE)[0]:
        raise DeviceError(f"{wire.name}: {path}: no frame for {_SILENCE:g} s", hint=wire.hint)


def _file(path: str, wire: Wire, stack: ExitStack) -> Next:
    """Read frames from a file, or from a pipe, which need not be ready at once."""
    handle = stack.enter_context(os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0))
    numbers = iter(range(10**12))

    def take() -> Frame:
        data = bytearray()
        while len(data) < wire.size:
            _await(handle, path, wire)
            part = handle.read(wire.size - len(data))
            if not part:
                raise DeviceError(
                    f"{wire.name}: {path} ended after {len(data)} of {wire.size} bytes of a frame"
                )
            data += part
        return next(numbers), bytes(data)

    return take


def _camera(path: str, wire: Wire, stack: ExitStack) -> Next:
    """Stream from a device of V4L2."""
    try:
        from linuxpy.video.device import BufferType, Device, PixelFormat, VideoCapture
    except ImportError as err:
        raise ConfigError(
            f"cameras of V4L2 need linuxpy: {err}", hint="pip install 'tofcapture[v4l2]'"
        ) from err
    device, pixels = stack.enter_context(Device(path)), PixelFormat[wire.pixels]
    device.set_format(BufferType.VIDEO_CAPTURE, wire.width, wire.rows, pixels)
    found = device.get_format(BufferType.VIDEO_CAPTURE)
    if (found.width, found.height) != (wire.width, wire.rows) or found.pixel_format != pixels:
        raise DeviceError(
            f"{wire.name}: {path}: expected {wire.width} x {wire.rows} {wire.pixels}, "
            f"it gives {found.width} x {found.height} {found.pixel_format!r}",
            hint=f"set the camera to this mode first; see {wire.page}",
        )
    stream = VideoCapture(device, size=_BUFFERS)
    stack.enter_context(stream)

    def take() -> Frame:
        _await(device, path, wire)
        frame = stream.buffer.read()
        return frame.frame_nb, bytes(frame)

    return take


def stamped(images: NDArray[np.int16], celsius: float = float("nan")) -> Taken:
    """Stamp images that are complete now."""
    return images, time.monotonic_ns(), celsius
