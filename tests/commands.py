"""Commands as functions: what they hand back, without a process."""

from __future__ import annotations

import argparse

from calibration.cli import CALIBRATE


def calibrate(*words):
    """Run ``tofcapture calibrate`` with these words."""
    parser = argparse.ArgumentParser()
    CALIBRATE.configure(parser)
    return CALIBRATE.run(parser.parse_args([str(w) for w in words]))
