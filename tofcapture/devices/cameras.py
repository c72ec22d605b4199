"""Shared by drivers of cameras: opening anew after an error, and the file of what a camera said of itself."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from tofcapture.devices import Device, StereoDevice
from tofcapture.devices.registry import check_keys
from tofcapture.errors import ConfigError, DeviceError, FormatError
from tofcapture.files.hdf import stereo_from, tof_from
from tofcapture.files.seal import write_text
from tofcapture.frames import StereoInfo, TofInfo

if TYPE_CHECKING:
    from tofcapture.devices.registry import StationContext

_DESCRIPTION = ("model", "camera")


class ReopenedCamera(Device):
    """A camera that is closed after an error and opened anew by the next capture.

    A cable that was plugged in again, or a camera that started again, then needs nothing else.
    """

    _opened: ExitStack | None = None

    def connect(self, stack: ExitStack) -> None:
        """Open the parts of the camera; ``stack`` closes them, also when a later part fails."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def open(self) -> None:
        """Open the camera; one that is open stays as it is."""
        if self._opened is None:
            with ExitStack() as stack:
                self.connect(stack)
                self._opened = stack.pop_all()

    def close(self) -> None:
        """Close the camera; again does nothing."""
        stack, self._opened = self._opened, None
        if stack is not None:
            stack.close()

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Open the camera for a capture; close it when that ends in a DeviceError."""
        try:
            self.open()
            yield
        except DeviceError:
            self.close()
            raise


class DescribedStereo(ReopenedCamera, StereoDevice):
    """A stereo camera that says itself what it is; a file beside the station keeps what it said.

    Parameters
    ----------
    table
        ``[stereo]``: a text under ``key`` names the camera, ``description`` that file; ``model`` and ``camera`` describe a camera
        that was never opened; the driver's own settings are those ``known``, and those that have ``defaults``.
    context
        The station.
    driver
        Begins the file's name.
    """

    def __init__(
        self,
        table: Mapping[str, Any],
        context: StationContext,
        driver: str,
        known: Iterable[str],
        defaults: Mapping[str, Any],
        key: str = "serial",
    ) -> None:
        check_keys(table, (key, "description", *known, *defaults, *_DESCRIPTION), "[stereo]")
        if not isinstance(name := table.get(key), str):
            raise ConfigError(
                f"[stereo] {key}: expected a text, as the camera's own tool lists it, got {name!r}",
                hint="see docs/devices.md",
            )
        self._table, self._name, self._folder = {**defaults, **table}, name, Path(context.folder)
        self._file = self._folder / table.get("description", f"{driver}-{name.replace('/', '-')}.toml")

    def describe(self) -> StereoInfo:
        """Say what this camera is, from ``station.toml`` and the description file; opens nothing.

        Raises ConfigError when the camera was never opened and ``station.toml`` does not describe it.
        """
        where = f"[stereo] {self._name}"
        said = described(read_description(self._file), self._table, _DESCRIPTION, where)
        return stereo_info({**said, "serial": self._name}, where, "docs/devices.md")

    def remember(self, said: Mapping[str, Any]) -> None:
        """Keep what the opened camera says of itself; raises DeviceError when its intrinsics are not those it said before."""
        known = read_description(self._file)
        if known is not None and known.get("camera") != said.get("camera"):
            raise DeviceError(
                f"[stereo] {self._name}: its calibration is not the one of {self._file.name}",
                hint="it was calibrated anew, or its size is another: delete that file, record and align again",
            )
        write_description(self._file, said)


def read_description(path: Path) -> dict[str, Any] | None:
    """Read what a camera said of itself when it was first opened; ``None`` when it never was."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read what the camera said of itself: {err}",
            hint="delete it; opening writes it anew",
        ) from err


def write_description(path: Path, table: Mapping[str, Any]) -> None:
    """Keep what a camera said of itself; the same content again writes nothing."""
    import tomli_w

    text = tomli_w.dumps(table)
    try:
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            write_text(path, text)
    except OSError as err:
        raise ConfigError(
            f"{path}: cannot write what the camera said of itself: {err}",
            hint='name a writable file: description = "..."',
        ) from err


def described(
    said: Mapping[str, Any] | None, table: Mapping[str, Any], wanted: Iterable[str], where: str
) -> dict[str, Any]:
    """Lay the station's settings over what a camera ``said`` of itself, ``None`` before it was first opened.

    Raises ConfigError when one of the ``wanted`` names is missing.
    """
    merged = {**(said or {}), **{key: table[key] for key in wanted if key in table}}
    if missing := [key for key in wanted if key not in merged]:
        raise ConfigError(
            f"{where}: expected {', '.join(missing)}, which the camera has not said",
            hint="open it once, or write them into station.toml (camera: the intrinsics, a table of its own)",
        )
    return merged


def tof_info(table: Mapping[str, Any], where: str, page: str) -> TofInfo:
    """Turn a whole table into a ToF camera's description; raises ConfigError, with a ``page`` of the docs as the hint."""
    with _named(page):
        return tof_from(table, where)


def stereo_info(table: Mapping[str, Any], where: str, page: str) -> StereoInfo:
    """Turn a whole table into a stereo camera's description, as :func:`tof_info` does."""
    with _named(page):
        return stereo_from(table, where)


@contextmanager
def _named(page: str) -> Iterator[None]:
    try:
        yield
    except FormatError as err:
        raise ConfigError(err.message, hint=f"see {page}") from err
