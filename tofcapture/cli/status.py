"""``tofcapture status``: what a running daemon is doing."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tofcapture.command import Command, Outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--state", type=Path, metavar="FOLDER", help="the daemon's folder")
    parser.add_argument("--url", action="store_true", help="print the address of its page, token included")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.errors import ConfigError
    from tofcapture.record.daemon.client import ask

    found = ask("GET", "/v1/state", state=args.state)
    if args.url:
        page = ask("GET", "/v1/page", state=args.state)["url"]
        if page is None:
            raise ConfigError("the daemon does not listen on TCP", hint="start it with --http 127.0.0.1:8765")
        return Outcome(data={"ok": True, "url": page}, text=page)
    return Outcome(data={"ok": True, **found}, text="\n".join(_lines(found)))


def _lines(found: dict[str, Any]) -> list[str]:
    job, count, health = found["job"], found["progress"], found["health"]
    lines = [f"{found['phase']}{': ' + found['reason'] if found['reason'] else ''}"]
    if job:
        left = f", {count['eta_s']:.0f} s left" if count["eta_s"] else ""
        lines.append(
            f"job {job['id']}: {job['scene']} into {job['recording']}: {job['state']}, "
            f"{count['sealed']}/{count['total']} views, {count['failed']} failed{left}"
        )
        lines += [f"  {job['reason']}"] if job["reason"] else []
    if found["asks"]:
        lines.append(f"it waits for a person to place {found['asks']!r} and to confirm on the page")
    waiting = found["queue"].get("queued", 0)
    free = f", {health['disk_free_bytes'] / 1e9:.1f} GB free" if health["disk_free_bytes"] else ""
    lines.append(f"{waiting} waiting, recorder {health['recorder']}{free}")
    return lines


COMMAND = Command(
    help="what the daemon is doing",
    example="tofcapture status",
    configure=_configure,
    run=_run,
)
