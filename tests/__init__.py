"""What every file of tests may use: patience, for the machine may be busy, and whether a process lives."""

import time
from pathlib import Path

# s that a test waits for what must come; it fails on what comes wrongly, not on what comes late
PATIENCE = 240.0


def until(condition, every=0.02):
    """Wait until a condition holds, asked every so many seconds; its true value."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(every)
    return found


def alive(pid):
    """Whether a process runs; one that its parent has not waited for is dead all the same."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
