"""The simulated station: a robot arm, a ToF camera and a stereo camera in one seeded world. Shipped, first class."""

VERSION = 2
"""Raised whenever the same seed gives other arrays; stored in the provenance of what the simulator makes by itself."""
