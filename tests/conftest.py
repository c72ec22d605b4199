"""Fixtures that more than one file of tests uses."""

import pytest


@pytest.fixture(scope="module")
def running():
    """One emulated UR controller for a file of tests."""
    from tofcapture.testing.ur_emulator.process import Emulator

    with Emulator() as emulator:
        yield emulator


@pytest.fixture
def emulator(running):
    """The emulator at rest, without faults."""
    running.calm()
    return running
