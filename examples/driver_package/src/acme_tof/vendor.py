"""Stands for the vendor's library: returns made-up frames, raises codes."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray


class AcmeError(Exception):
    """What the library raises: a number."""

    def __init__(self, code: int) -> None:
        super().__init__(f"ACME_STATUS {code}")
        self.code = code


class Handle:
    """An open camera."""

    def burst(self, frames: int) -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
        """Raw phase images and their times, monotonic ns."""
        start = time.monotonic_ns()
        time.sleep(frames / 300)
        raw = np.random.default_rng(0).integers(200, 3000, (frames, 8, 24, 32), dtype=np.uint16)
        return raw, start + np.arange(frames, dtype=np.int64) * 1_000_000

    def close(self) -> None:
        """Let go of the camera."""


def open_camera(serial: str) -> Handle:
    """Open a camera by its serial number."""
    if not serial.startswith("A-"):
        raise AcmeError(-1)
    return Handle()
