"""Load late: the only doors to numba and open3d, and the public names of packages.

Loops that numpy cannot fuse are compiled when they are first called and kept on disk.

Neither ``fastmath`` nor ``parallel``: every run on every machine adds in the same order.

open3d links ``libusb-1.0.so.0``, which a fresh Debian lacks and which needs root to install. The wheel ``libusb-package`` carries it:
loading that copy globally first satisfies the dynamic linker.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import sys
import threading
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any, TypeVar, cast

from tofcapture.errors import ConfigError

F = TypeVar("F", bound=Callable[..., Any])
_LOCK = threading.RLock()


class _Kernel:
    """A function that becomes machine code with its first call, and with it the kernels that it calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._machine = function, None
        functools.update_wrapper(self, function)

    def __call__(self, *args: Any) -> Any:
        return self.machine()(*args)

    def machine(self) -> Any:
        with _LOCK:
            if self._machine is None:
                self._machine = _njit(self._function)
                names = self._function.__globals__
                # numba looks names up when it compiles: there it must find machine code.
                for name, kernel in [(n, k) for n, k in names.items() if isinstance(k, _Kernel)]:
                    names[name] = kernel.machine()
            return self._machine


def compiled(function: F) -> F:
    """Compile a function of arrays and numbers to machine code at its first call.

    Raises :class:`ConfigError`: at that call, when numba is not installed or does not load.
    """
    return cast("F", _Kernel(function))


def _njit(function: Callable[..., Any]) -> Any:
    try:
        from numba import njit
    except ImportError as err:
        raise ConfigError(
            f"numba is needed here and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    try:
        return njit(cache=True, error_model="numpy", nogil=True)(function)
    except RuntimeError:  # no folder where machine code could be kept: it is made anew by every process
        return njit(error_model="numpy", nogil=True)(function)


def keeps_kernels() -> bool:
    """Tell whether there is a folder where machine code can be kept."""
    from numba import njit

    try:
        njit(cache=True)(_njit)
    except RuntimeError:
        return False
    return True


def _preload_libusb() -> None:
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        path = importlib.import_module("libusb_package").get_library_path()
        if path is not None:
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


def load_open3d() -> ModuleType:
    """Import open3d; :class:`ConfigError` when it is not installed or does not load."""
    if "open3d" not in sys.modules and sys.platform == "linux":
        # Where this fails, open3d's own error names the library that is missing.
        with contextlib.suppress(ImportError, OSError):
            _preload_libusb()
    try:
        return importlib.import_module("open3d")
    except (ImportError, OSError) as err:
        raise ConfigError(
            f"open3d is needed here and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err


def face(package: str, homes: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Make the ``__getattr__`` and the ``__dir__`` of a package whose public names are imported when they are asked for.

    ``homes`` says by public name where it is defined: ``room.module``, or ``room.module:Name`` where it has another name there.
    """

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, thing = homes[name].partition(":")
        return getattr(importlib.import_module(f"{package}.{module}"), thing or name)

    return found, lambda: sorted({*vars(sys.modules[package]), *homes})


def called(module: str, home: str) -> None:
    """Let a module that is being imported be called as a public function of its name: importing the one would hide the other.

    ``home`` is ``tofcapture.record.recorder:record`` for ``tofcapture.record``.
    """
    where, _, name = home.partition(":")

    def call(_module: ModuleType, *given: Any, **named: Any) -> Any:
        return getattr(importlib.import_module(where), name)(*given, **named)

    sys.modules[module].__class__ = type("CalledModule", (ModuleType,), {"__call__": call})
