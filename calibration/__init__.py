"""Calibrate a rig: align the two cameras, and say how well they are aligned."""
