"""The only door to open3d.

open3d links ``libusb-1.0.so.0``, which a fresh Debian or Ubuntu lacks and which needs root to install. The wheel
``libusb-package`` carries it: loading that copy globally first satisfies the dynamic linker.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import sys
from types import ModuleType

from tofcapture.errors import ConfigError


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
