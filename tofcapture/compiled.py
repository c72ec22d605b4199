"""The only door to numba: loops that numpy cannot fuse, compiled when they are first called and kept on disk.

Neither ``fastmath`` nor ``parallel``: every run on every machine adds in the same order.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
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
    return njit(cache=True, error_model="numpy", nogil=True)(function)
