"""The driver ``arducam``: Arducam ToF modules over V4L2, without the vendor's package; see docs/arducam.md.

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

import os
import select
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.devices import TofCamera
from tofcapture.devices.cameras import ReopenedCamera, tof_info
from tofcapture.devices.host import hosted
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError, FormatError
from tofcapture.files.camera_bytes import ARDUCAM, Arducam
from tofcapture.frames import TofBurst, TofInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_REQUIRED = ("mode", "serial", "camera", "exposure")
_OPTIONAL = {"device": "/dev/video0", "illuminator": [0.0, 0.0, 0.0], "range_errors": []}
_SILENCE = 5.0  # s without a frame
_BUFFERS = 8
_PAGE = "docs/arducam.md"

Frame = tuple[int, bytes]  # its number, its bytes
Next = Callable[[], Frame]


class ArducamTof(ReopenedCamera, TofCamera):
    """One Arducam ToF module, a device of V4L2; or a file or a pipe of such frames, one after another.

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
        check_keys(table, (*_REQUIRED, *_OPTIONAL), "[tof]")
        if missing := [k for k in _REQUIRED if k not in table]:
            raise ConfigError(f"[tof] arducam: expected {', '.join(missing)}", hint=f"see {_PAGE}")
        full = {**_OPTIONAL, **table}
        mode = str(full.pop("mode"))
        if mode not in ARDUCAM:
            raise ConfigError(
                f"[tof] mode: expected one of {', '.join(ARDUCAM)}, got {mode!r}", hint=f"see {_PAGE}"
            )
        self._device, self._layout = str(full.pop("device")), ARDUCAM[mode]
        said = {"model": f"Arducam {mode}", "saturation": 1023.0, "offset": True, "reach": None}
        said |= {"modulation_hz": self._layout.modulation_hz, "phase_rad": self._layout.phase_rad}
        self._info = tof_info({**full, **said}, "[tof] arducam", _PAGE)
        if self._info.camera.shape != (self._layout.height, self._layout.width):
            raise ConfigError(
                f"[tof.camera]: {mode} is {self._layout.width} x {self._layout.height}", hint=f"see {_PAGE}"
            )
        self._next: Next | None = None

    def describe(self) -> TofInfo:
        """Say what ``station.toml`` says of this camera; opens nothing."""
        return self._info

    def probe(self) -> str:
        """Tell whether the device's file is there."""
        if not Path(self._device).exists():
            raise DeviceError(f"Arducam: no {self._device}", hint=_hint(self._device))
        return self._device

    def capture(self, frames: int) -> TofBurst:
        """Take so many new frames.

        Returns burst of signed values with the host's time at which each frame was complete, after its
        exposure; the module gives no temperature (NaN).

        Raises :class:`ConfigError`: fewer than one frame; :class:`DeviceError`: frames do not come, or are of
        another size; the next call opens the device anew.
        """
        if frames < 1:
            raise ConfigError(f"frames: expected at least 1, got {frames}")
        with self.opened(), _errors(self._device):
            for _ in range(_BUFFERS if _is_camera(self._device) else 0):
                self._take()  # may have waited since before the rig stood still
            raw, times = zip(*(self._frame() for _ in range(frames)), strict=True)
        return TofBurst(np.stack(raw), np.array(times, dtype=np.int64), np.full(frames, np.nan), self._info)

    def connect(self, stack: ExitStack) -> None:
        """Open the device and start its stream."""
        self.probe()
        with _errors(self._device):
            opened = _camera if _is_camera(self._device) else _file
            self._next = opened(self._device, self._layout, stack)

    def _take(self) -> Frame:
        if self._next is None:
            raise DeviceError("the Arducam module is not open", hint="use the station as a context manager")
        return self._next()

    def _frame(self) -> tuple[NDArray[np.int16], int]:
        """One frame (K, H, W) of ours: phases that come in turn begin with a number that four divides, and none may lack."""
        count, images = self._layout.frames, list[NDArray[np.int16]]()
        for _ in range(2 * count):
            number, data = self._take()
            if number % count != len(images):
                images = []  # one was dropped
            if number % count == len(images):
                images.append(self._layout.images(data))
            if len(images) == count:
                return np.concatenate(images), time.monotonic_ns()
        raise DeviceError(f"Arducam: {self._device}: frames are dropped", hint="is the machine overloaded?")


def _is_camera(path: str) -> bool:
    return stat.S_ISCHR(Path(path).stat().st_mode)


def _hint(path: str) -> str:
    return f"check the cable, the CSI port's overlay, and v4l2-ctl --device {path} --all; see {_PAGE}"


def _await(handle: Any, path: str) -> None:
    """Wait until there is something to read."""
    if not select.select([handle], [], [], _SILENCE)[0]:
        raise DeviceError(f"Arducam: {path}: no frame for {_SILENCE:g} s", hint=_hint(path))


def _file(path: str, layout: Arducam, stack: ExitStack) -> Next:
    """Read frames from a file, or from a pipe, which need not be ready at once."""
    handle = stack.enter_context(os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", buffering=0))
    numbers = iter(range(10**12))

    def take() -> Frame:
        data = b""
        while len(data) < layout.size:
            _await(handle, path)
            part = handle.read(layout.size - len(data))
            if not part:
                raise DeviceError(
                    f"Arducam: {path} ended after {len(data)} of {layout.size} bytes of a frame"
                )
            data += part
        return next(numbers), data

    return take


def _camera(path: str, layout: Arducam, stack: ExitStack) -> Next:
    """Stream from a device of V4L2."""
    try:
        from linuxpy.video.device import BufferType, Device, PixelFormat, VideoCapture
    except ImportError as err:
        raise ConfigError(
            f"the driver arducam needs linuxpy: {err}", hint="pip install 'tofcapture[v4l2]'"
        ) from err
    device = stack.enter_context(Device(path))
    device.set_format(BufferType.VIDEO_CAPTURE, layout.width, layout.rows, PixelFormat.Y12P)
    found = device.get_format(BufferType.VIDEO_CAPTURE)
    if (found.width, found.height) != (layout.width, layout.rows) or found.pixel_format != PixelFormat.Y12P:
        raise DeviceError(
            f"Arducam: {path}: expected {layout.width} x {layout.rows} Y12P, it gives {found.width} x {found.height} {found.pixel_format!r}",
            hint="set the media graph to this mode first; see docs/arducam.md",
        )
    stream = VideoCapture(device, size=_BUFFERS)
    stack.enter_context(stream)

    def take() -> Frame:
        _await(device, path)
        frame = stream.buffer.read()
        return frame.frame_nb, bytes(frame)

    return take


@contextmanager
def _errors(path: str) -> Iterator[None]:
    """Turn errors of the system and of the layout into ours."""
    try:
        yield
    except FormatError as err:
        raise DeviceError(f"Arducam: {path}: {err.message}", hint=err.hint) from err
    except OSError as err:
        raise DeviceError(f"Arducam: {path}: {err.strerror or err}", hint=_hint(path)) from err


DRIVERS = {"tof": hosted("tof", "tofcapture.devices.tof.arducam:ArducamTof")}
