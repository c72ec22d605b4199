"""Fixtures that more than one file of tests uses."""

import os
import shutil
import signal

# Before numpy and torch are loaded: the tests' algebra is small, several processes share the cores, and idle threads that spin steal them.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# A shell that runs the tests in the background has them ignore Ctrl-C, and with them the processes that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

import pytest  # noqa: E402
from hypothesis import HealthCheck, settings  # noqa: E402

settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")


@pytest.fixture(scope="module")
def running():
    """One emulated UR controller for a file of tests."""
    from tests.ur_emulator.process import Emulator

    with Emulator() as emulator:
        yield emulator


@pytest.fixture
def emulator(running):
    """The emulator at rest, without faults."""
    running.calm()
    return running


@pytest.fixture(scope="session")
def sealed(tmp_path_factory):
    """A recording of two scenes and the dataset built from it."""
    from tests.sealed import simulate
    from tofcapture.dataset.build import build_dataset
    from tofcapture.files.view import view_path, write_view

    root = tmp_path_factory.mktemp("check")
    for scene in ("box", "gear"):
        write_view(view_path(root / "recording", scene, 0), simulate(scene, 0))
    build_dataset([root / "recording"], root / "dataset", true_rig=True, jobs=1)
    return root


@pytest.fixture
def here(sealed, tmp_path):
    """A copy to damage."""
    return shutil.copytree(sealed, tmp_path / "copy")


@pytest.fixture
def drawn(monkeypatch):
    """Pixels of the figures that matplotlib saves during a test, in their order."""
    pytest.importorskip("matplotlib")
    from tests.pictures import watch_matplotlib

    return watch_matplotlib(monkeypatch)
