"""The only door to numba: loops that numpy cannot fuse, compiled on first use and kept on disk.

Neither ``fastmath`` nor ``parallel``: every run on every machine adds in the same order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from tofcapture.errors import ConfigError

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a function of arrays and numbers to machine code.

    Used as a decorator in modules that are themselves imported lazily.

    Raises
    ------
    ConfigError
        When numba is not installed or does not load.
    """
    try:
        from numba import njit
    except ImportError as err:
        raise ConfigError(
            f"numba is needed here and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    return cast("F", njit(cache=True, error_model="numpy", nogil=True)(function))
