"""Whatever schemathesis makes of the OpenAPI document is answered as the document says."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_daemon_api import running

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

if importlib.util.find_spec("schemathesis") is None:
    pytest.skip("schemathesis is not installed", allow_module_level=True)


def test_schemathesis(tmp_path):
    """All checks, stateful ones too; the stream of events has no end and is left to other tests."""
    with running(tmp_path) as daemon:
        daemon.ask("POST", "/v1/pause")
        command = [
            Path(sys.executable).with_name("schemathesis"),
            "run",
            daemon.url.partition("#")[0] + "openapi.json",
        ]
        options = ["--checks", "all", "--exclude-path", "/v1/events", "-n", "60", "--seed", "1", "--no-color"]
        head = ["-H", f"Authorization: Bearer {daemon.token}"]
        done = subprocess.run(
            [*command, *head, *options], capture_output=True, text=True, check=False, cwd=tmp_path
        )
        assert done.returncode == 0, done.stdout[-6000:]
        assert daemon.ask("GET", "/v1/state")["phase"] == "paused"
