"""The simulated station: a robot arm, a ToF camera and a stereo camera in one seeded world. Shipped, first class."""

import hashlib

import numpy as np

VERSION = 2
"""Raised whenever the same seed gives other arrays; stored in the provenance of what the simulator makes by itself."""


def hashed_generator(name: bytes) -> np.random.Generator:
    """Make a generator of its own for everything that has a name; the same on every machine."""
    digest = hashlib.sha256(name).digest()
    return np.random.default_rng(np.frombuffer(digest, dtype="<u4").tolist())
