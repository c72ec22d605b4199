"""``tofcapture daemon``: the recorder behind a local API and a web page."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from tofcapture.cli.config import station_path
from tofcapture.command import Command, Outcome


def _configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--root", type=Path, required=True, metavar="FOLDER", help="where recordings go")
    parser.add_argument(
        "--http",
        metavar="127.0.0.1:PORT",
        help="listen on loopback TCP too, for the page; port 0 takes a free one",
    )
    parser.add_argument(
        "--station", type=Path, metavar="TOML", help="devices to use (default: all simulated)"
    )
    parser.add_argument(
        "--state", type=Path, metavar="FOLDER", help="the daemon's own folder: queue, token, socket"
    )
    parser.add_argument(
        "--allow-motion", action="store_true", help="let a real arm move, for as long as this daemon runs"
    )
    parser.add_argument("--print-unit", action="store_true", help="print a systemd unit and end")


def _run(args: argparse.Namespace) -> Outcome:
    from tofcapture.record.daemon.settings import Settings, open_folder

    state = open_folder(args.state)
    if args.print_unit:
        from tofcapture.record.daemon.server import unit

        text = unit(args.root, state.root)
        return Outcome(data={"ok": True, "unit": text}, text=text)
    from tofcapture.devices.station import read_station
    from tofcapture.record.daemon.server import serve, tcp_address

    http = tcp_address(args.http) if args.http else None
    named = station_path(args.station)[0]
    station = named.resolve() if named else None
    read_station(station)
    args.root.mkdir(parents=True, exist_ok=True)
    settings = Settings(args.root.resolve(), state, station, args.allow_motion)
    serve(settings, http, lambda url: _announce(state.socket, url))
    return Outcome(data={"ok": True, "state": str(state.root)})


def _announce(socket: Path, url: str | None) -> None:
    """Say where the daemon listens; the token is for a person's eyes, not for systemd's log."""
    if url and "JOURNAL_STREAM" in os.environ:
        url = f"{url.partition('#')[0]} (tofcapture status --url shows the token)"
    for where in filter(None, (f"unix:{socket}", url)):
        print(f"listening on {where}", file=sys.stderr, flush=True)


COMMAND = Command(
    help="record scenes in the background, behind a local API and a web page",
    example="tofcapture daemon --root recordings --http 127.0.0.1:8765",
    configure=_configure,
    run=_run,
)
