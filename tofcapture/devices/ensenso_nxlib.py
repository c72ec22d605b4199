"""The only place that speaks to ``nxlib``: the exact commands, and its codes turned into our errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofcapture.errors import ConfigError, DeviceError

_TIMEOUTS = ("CaptureTimeout", "DeviceTimeout", "Timeout")


class CaptureTimeoutError(DeviceError):
    """The images did not arrive in time."""


@contextmanager
def library(path: str | None) -> Iterator[None]:
    """Load and initialise the SDK; finalise it on leaving.

    Raises
    ------
    ConfigError
        The Python package or the SDK's shared library is missing.
    DeviceError
        The SDK does not initialise.
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
def opened(serial: str) -> Iterator[Any]:
    """Open the camera of that serial number; close it on leaving.

    Raises
    ------
    DeviceError
        No such camera, of another kind, in use, or out of reach.
    """
    from nxlib import NxLibItem, context
    from nxlib.constants import ITM_CAMERAS, VAL_STEREO, VAL_STRUCTURED_LIGHT

    try:
        with _errors(f"opening camera {serial}"):
            camera = context.Camera.from_serial(serial, [VAL_STEREO, VAL_STRUCTURED_LIGHT])
            camera.open()
    except context.CameraNotFoundError as err:
        there = ", ".join(NxLibItem()[ITM_CAMERAS].value()) or "none"
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


def check_link(camera: Any, *, clear: bool) -> None:
    """See to it that point maps stay in the camera's frame.

    Parameters
    ----------
    camera
        Open.
    clear
        Clear a link instead of refusing it; only in the SDK's memory, not in the camera.

    Raises
    ------
    DeviceError
        There is a link and it was not cleared.
    """
    from nxlib.constants import ITM_ANGLE, ITM_LINK, ITM_ROTATION, ITM_TARGET, ITM_TRANSLATION

    with _errors("reading the camera's link"):
        link = camera[ITM_LINK]
        if clear and _linked(link):
            link[ITM_TARGET].set_string("")
            link[ITM_ROTATION][ITM_ANGLE].set_double(0.0)
            for axis in range(3):
                link[ITM_TRANSLATION][axis].set_double(0.0)
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


def configure(camera: Any, flexview: int, exposure: float | None) -> None:
    """Set trigger, FlexView and exposure.

    Parameters
    ----------
    camera
        Open.
    flexview
        Image pairs, 0 for off.
    exposure
        Seconds; ``None`` lets the camera find it.
    """
    from nxlib.constants import (
        ITM_AUTO_EXPOSURE,
        ITM_CAPTURE,
        ITM_EXPOSURE,
        ITM_FLEX_VIEW,
        ITM_PARAMETERS,
        ITM_TRIGGER_MODE,
        VAL_SOFTWARE,
    )

    with _errors("setting the camera's parameters"):
        capture = camera[ITM_PARAMETERS][ITM_CAPTURE]
        capture[ITM_TRIGGER_MODE] = VAL_SOFTWARE
        capture[ITM_FLEX_VIEW] = flexview or False
        capture[ITM_AUTO_EXPOSURE] = exposure is None
        if exposure is not None:
            capture[ITM_EXPOSURE] = exposure * 1e3


def freeze_exposure(camera: Any) -> float:
    """Hold the exposure that the last capture found; returns it in seconds."""
    from nxlib.constants import ITM_AUTO_EXPOSURE, ITM_CAPTURE, ITM_EXPOSURE, ITM_PARAMETERS

    with _errors("holding the exposure"):
        capture = camera[ITM_PARAMETERS][ITM_CAPTURE]
        found_ms = float(capture[ITM_EXPOSURE].as_double())
        capture[ITM_AUTO_EXPOSURE] = False
        capture[ITM_EXPOSURE] = found_ms
    return found_ms * 1e-3


def expose(camera: Any, timeout: float) -> None:
    """Trigger and fetch the images; ``timeout`` in seconds.

    Raises
    ------
    CaptureTimeoutError
        The images did not come in time.
    DeviceError
        Anything else.
    """
    from nxlib.constants import ITM_TIMEOUT

    with _errors("capturing"):
        camera.capture({ITM_TIMEOUT: round(timeout * 1e3)})


def point_map(camera: Any) -> NDArray[np.float32]:
    """Compute the point map of the last capture; (H, W, 3) float32, millimetres."""
    with _errors("computing the point map"):
        camera.compute_disparity_map()
        camera.compute_point_map()
        out: NDArray[np.float32] = camera.get_point_map()
        return out


def said_by(camera: Any) -> dict[str, Any]:
    """What the camera says of itself: model, serial, and intrinsics of the rectified left eye, whose grid the point map has.

    The SDK's matrix is indexed by column, then row.
    """
    from nxlib.constants import ITM_CALIBRATION, ITM_CAMERA, ITM_LEFT, ITM_SENSOR, ITM_SIZE, ITM_STEREO

    with _errors("reading the camera's calibration"):
        columns = camera[ITM_CALIBRATION][ITM_STEREO][ITM_LEFT][ITM_CAMERA].value()
        width, height = camera[ITM_SENSOR][ITM_SIZE].value()
        intrinsics = {
            "width": int(width),
            "height": int(height),
            "fx": float(columns[0][0]),
            "fy": float(columns[1][1]),
            "cx": float(columns[2][0]),
            "cy": float(columns[2][1]),
        }
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


_HINTS = {
    "CaptureTimeout": "network: a direct link, jumbo frames, no switch; a long FlexView needs a longer [stereo] timeout",
    "CameraNotFound": "the camera went away: check its cable and power",
    "NxLibInitializationNotAllowed": "the SDK is being closed; start the program anew",
}


def _symbol(err: Any) -> tuple[str, str]:
    """Error symbol and sentence, of a command where it was one."""
    from nxlib.exception import NxLibException

    if err.is_command_execution_failure():
        with suppress(NxLibException):
            return err.get_command_error_symbol(), err.get_command_error_text()
    return err.get_error_text(), str(err.get_item_path())
