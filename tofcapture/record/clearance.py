"""Where the arm and the rig may be: :mod:`tofcapture.devices.clearance`, for those who plan with it."""

from tofcapture.devices.clearance import REASONS, Stage, is_clear, obstacles, route, stage_of

__all__ = ["REASONS", "Stage", "is_clear", "obstacles", "route", "stage_of"]
