"""``tofcapture stop``: stop the arm now."""

from __future__ import annotations

import argparse
from pathlib import Path

from tofcapture.command import Command, Outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--state", type=Path, metavar="FOLDER", help="the daemon's folder")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.record.daemon.client import ask

    found = ask("POST", "/v1/stop", state=args.state)
    job = found["job"]
    what = (
        f"job {job['id']} ({job['scene']}) is given up"
        if job and job["state"] == "running"
        else "nothing was running"
    )
    return Outcome(
        data={"ok": True, **found},
        text=f"the daemon rests, {what}; sealed views stay. tofcapture status shows the rest.",
    )


COMMAND = Command(
    help="stop the arm now and give the daemon's job up; sealed views stay",
    example="tofcapture stop",
    configure=_configure,
    run=_run,
)
