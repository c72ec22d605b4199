"""The Ensenso SDK's shared library as a Python object, for tests: ``nxlib`` itself runs on it, unchanged.

It keeps a tree like the SDK's, executes the few commands that a capture needs, refuses them in a wrong order, and writes down everything
that was asked of it::

    with installed(FakeNxLib(FakeCamera("171197"))) as sdk:
        ...                                     # anything that uses nxlib
    sdk.log                                     # ["Initialize", ("Open", {"Cameras": "171197"}), ...]
"""

from __future__ import annotations

import ctypes
import json
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

_MISSING, _TIMEOUT, _WRONG_TYPE = 3, 8, 13  # return codes
_TYPES = {type(None): 1, float: 2, int: 2, str: 3, bool: 4, list: 5, dict: 6}


def wall(H: int = 1024, W: int = 1280) -> NDArray[np.float32]:
    """Make a wall at 800 mm with a hole in it."""
    v, u = np.mgrid[0:H, 0:W].astype(np.float32)
    z = np.full((H, W), 800, np.float32)
    points = np.stack([(u - W / 2 + 0.5) * z / (0.9 * W), (v - H / 2 + 0.5) * z / (0.9 * W), z], axis=-1)
    points[: H // 8, : W // 8] = np.nan
    return points.astype(np.float32)


@dataclass
class FakeCamera:
    """What the fake SDK knows of one camera.

    Attributes
    ----------
    serial, kind
        Serial number; ``Stereo`` or another type.
    points_mm
        (H, W, 3) float32 that the next point map holds.
    found_ms
        Exposures that automatic exposure finds, one capture after the other.
    fail
        Command -> error symbols of its next executions; an empty symbol is success.
    """

    serial: str
    kind: str = "Stereo"
    points_mm: NDArray[np.float32] = field(default_factory=wall)
    found_ms: deque[float] = field(default_factory=lambda: deque([7.25, 9.5, 4.0]))
    fail: dict[str, deque[str]] = field(default_factory=dict)

    def tree(self) -> dict[str, Any]:
        """Build the camera's part of the SDK's tree."""
        H, W = self.points_mm.shape[:2]
        return {
            "Type": self.kind,
            "SerialNumber": self.serial,
            "ModelName": "N35-804-16-BL",
            "Status": {"Available": True, "Open": False},
            "Sensor": {"Size": [W, H]},
            "Link": {"Target": "", "Rotation": {"Angle": 0.0, "Axis": [0, 0, 1]}, "Translation": [0, 0, 0]},
            # By column, then row, as the SDK has it.
            "Calibration": {
                "Stereo": {"Left": {"Camera": [[0.9 * W, 0, 0], [0, 0.9 * W, 0], [W / 2 - 0.5, H / 2 - 0.5, 1]]}}
            },
            "Parameters": {"Capture": {"TriggerMode": "Continuous", "FlexView": False, "AutoExposure": False, "Exposure": 1.0}},
            "Images": {},
        }  # fmt: skip


class FakeNxLib:
    """An object with the functions of ``libNxLib64.so`` that nxlib calls.

    Parameters
    ----------
    cameras
        What is plugged in.
    """

    def __init__(self, *cameras: FakeCamera) -> None:
        self.cameras = {camera.serial: camera for camera in cameras}
        self.log: list[Any] = []
        self.tree: dict[str, Any] = {
            "Cameras": {camera.serial: camera.tree() for camera in cameras},
            "Execute": {},
        }
        self._slots = 0
        self._stage: dict[str, str] = {}
        self._keep: bytes = b""
        for name, function in self._functions().items():
            setattr(self, name, function)

    def _functions(self) -> dict[str, Callable[..., Any]]:
        """Plain functions, because nxlib hangs ctypes attributes on them."""

        def guarded(body: Callable[..., Any]) -> Callable[..., Any]:
            def function(code: Any, *arguments: Any) -> Any:
                try:
                    code._obj.value = 0
                    return body(*arguments)
                except _CodeError as err:
                    code._obj.value = err.code
                    return 0

            return function

        bodies: dict[str, Callable[..., Any]] = {
            "nxLibInitialize": lambda _wait: self.log.append("Initialize"),
            "nxLibFinalize": lambda: self.log.append("Finalize"),
            "nxLibGetType": self._type,
            "nxLibGetCount": lambda path: len(self._at(path)),
            "nxLibGetJson": lambda path, *_: self._hold(json.dumps(self._at(path))),
            "nxLibGetString": lambda path: self._hold(self._typed(path, str)),
            "nxLibGetName": lambda path: self._hold(str(_parts(path)[-1])),
            "nxLibGetBool": lambda path: int(self._typed(path, bool)),
            "nxLibGetInt": lambda path: int(self._typed(path, (int, float))),
            "nxLibGetDouble": lambda path: float(self._typed(path, (int, float))),
            "nxLibSetNull": lambda path: self._set(path, None),
            "nxLibSetString": lambda path, value: self._set(path, value.decode()),
            "nxLibSetBool": lambda path, value: self._set(path, bool(value)),
            "nxLibSetInt": self._set,
            "nxLibSetDouble": self._set,
            "nxLibSetJson": lambda path, value, _only: self._set(path, json.loads(value)),
            "nxLibErase": self._erase,
            "nxLibMakeUniqueItem": self._make_slot,
            "nxLibWaitForType": self._wait_for_type,
            "nxLibGetBinaryInfo": self._binary_info,
            "nxLibGetBinary": self._binary,
        }
        return {name: guarded(body) for name, body in bodies.items()}

    def _hold(self, text: str) -> bytes:
        self._keep = text.encode()
        return self._keep

    def _at(self, path: bytes) -> Any:
        node: Any = self.tree
        for part in _parts(path):
            try:
                node = node[part]
            except (KeyError, IndexError, TypeError) as err:
                raise _CodeError(_MISSING) from err
        return node

    def _typed(self, path: bytes, kind: type | tuple[type, ...]) -> Any:
        value = self._at(path)
        if not isinstance(value, kind):
            raise _CodeError(_WRONG_TYPE)
        return value

    def _type(self, path: bytes) -> int:
        try:
            return _TYPES.get(type(self._at(path)), 3)
        except _CodeError:
            return 0

    def _set(self, path: bytes, value: Any) -> None:
        parts = _parts(path)
        if parts[0] == "Execute" and parts[-1] == "Command" and isinstance(value, str):
            self._execute(self.tree["Execute"][parts[1]], value)
            return
        if parts[0] != "Execute":
            self.log.append(("Set", "/".join(str(p) for p in parts[2:]), value))
        node: Any = self.tree
        for part in parts[:-1]:
            node = node[part] if isinstance(node, list) else node.setdefault(part, {})
        node[parts[-1]] = value

    def _erase(self, path: bytes) -> None:
        parts = _parts(path)
        node: Any = self.tree
        for part in parts[:-1]:
            node = node.get(part, {})
        node.pop(parts[-1], None)

    def _make_slot(self, path: bytes, _name: bytes) -> bytes:
        self._slots += 1
        self.tree["Execute"][f"slot{self._slots}"] = {}
        return self._hold(f"{path.decode()}/slot{self._slots}")

    def _wait_for_type(self, path: bytes, kind: int, equal: int) -> None:
        if (self._type(path) == kind) != bool(equal):
            raise _CodeError(_TIMEOUT)  # commands end at once here; anything else would wait for ever

    def _execute(self, slot: dict[str, Any], name: str) -> None:
        """Run a command as the SDK would: at once, its error in Result."""
        parameters = dict(slot.get("Parameters") or {})
        self.log.append((name, parameters))
        symbol = self._run(name, self.cameras[parameters["Cameras"]])
        slot["Command"] = None
        slot["Result"] = {"ErrorSymbol": symbol, "ErrorText": f"{symbol} in {name}"} if symbol else {}

    def _run(self, name: str, camera: FakeCamera) -> str:
        """Give the error symbol, empty for success."""
        tree = self.tree["Cameras"][camera.serial]
        failures = camera.fail.get(name)
        if failures and (symbol := failures.popleft()):
            return symbol
        before = {"Capture": ("open", "captured", "disparity", "points"), "ComputeDisparityMap": ("captured",),
                  "ComputePointMap": ("disparity",)}.get(name)  # fmt: skip
        if before is not None and self._stage.get(camera.serial) not in before:
            return "WrongOrder"
        if name in ("Open", "Close"):
            tree["Status"]["Open"] = name == "Open"
        capture = tree["Parameters"]["Capture"]
        if name == "Capture" and capture["AutoExposure"]:
            capture["Exposure"] = camera.found_ms.popleft()
        if name == "ComputePointMap":
            tree["Images"]["PointMap"] = camera.points_mm
        self._stage[camera.serial] = {"Open": "open", "Close": "", "Capture": "captured", "ComputeDisparityMap": "disparity",
                                      "ComputePointMap": "points"}[name]  # fmt: skip
        return ""

    def _binary_info(self, path: bytes, *out: Any) -> None:
        data = self._at(path)
        H, W, C = data.shape
        values = (W, H, C, data.itemsize, int(data.dtype.kind == "f"), 13_400_000_000.0)
        for target, value in zip(out, values, strict=True):
            target._obj.value = value

    def _binary(self, path: bytes, buffer: Any, size: int, copied: Any, stamp: Any) -> None:
        data = np.ascontiguousarray(self._at(path))
        ctypes.memmove(buffer, data.ctypes.data, min(size, data.nbytes))
        copied._obj.value, stamp._obj.value = data.nbytes, 13_400_000_000.0


class _CodeError(Exception):
    """A return code other than zero."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def _parts(path: bytes) -> list[Any]:
    """Split an SDK path; a backslash marks an index."""
    return [int(p[1:]) if p.startswith("\\") else p for p in path.decode().split("/") if p]


@contextmanager
def installed(library: FakeNxLib) -> Iterator[FakeNxLib]:
    """Put a fake in the place of the shared library, and take it out before nxlib would unload it."""
    from nxlib import api

    before = api._nxlib
    api._nxlib = api._Nxlib()
    api._nxlib.lib_object = library
    try:
        yield library
    finally:
        api._nxlib.lib_object = None
        api._nxlib = before
