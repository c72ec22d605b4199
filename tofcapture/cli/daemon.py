"""``tofcapture daemon``, ``status`` and ``stop``: the recorder behind a local API and a web page."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from tofcapture.cli.kit import Command, Outcome
from tofcapture.cli.setup import station_path
from tofcapture.errors import ConfigError, DeviceError, TofError


def _configure_daemon(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--root", type=Path, required=True, metavar="DIR", help="where recordings go")
    address = "listen on loopback TCP too, for the page; port 0 takes a free one"
    add("--http", metavar="127.0.0.1:PORT", help=address)
    add("--station", type=Path, metavar="STATION.toml", help="devices to use (default: all simulated)")
    add("--state", type=Path, metavar="DIR", help="the daemon's own folder: queue, token, socket")
    add("--allow-motion", action="store_true", help="let a real arm move, while this daemon runs")
    add("--print-unit", action="store_true", help="print a systemd unit and end")


def _run_daemon(args: argparse.Namespace) -> Outcome:
    from tofcapture.devices.station import read_station
    from tofcapture.record.daemon.server import serve, tcp_address, unit
    from tofcapture.record.daemon.settings import Settings, open_folder

    state = open_folder(args.state)
    if args.print_unit:
        text = unit(args.root, state.root)
        return Outcome(data={"ok": True, "unit": text}, text=text)
    http = tcp_address(args.http) if args.http else None
    named = station_path(args.station)[0]
    station = named.resolve() if named else None
    read_station(station)
    args.root.mkdir(parents=True, exist_ok=True)
    settings = Settings(args.root.resolve(), state, station, args.allow_motion)
    serve(settings, http, lambda url: _announce(state.socket, url))
    return Outcome(data={"ok": True, "state": str(state.root)})


def _announce(socket: Path, url: str | None) -> None:
    """Say where the daemon listens; the token is for a person's eyes, not for a log."""
    if url and not sys.stderr.isatty():
        url = f"{url.partition('#')[0]} (tofcapture status --url shows the token)"
    for where in filter(None, (f"unix:{socket}", url)):
        print(f"listening on {where}", file=sys.stderr, flush=True)


def _configure_status(parser: argparse.ArgumentParser) -> None:
    _configure_state(parser)
    parser.add_argument("--url", action="store_true", help="print the address of its page, token included")


def _run_status(args: argparse.Namespace) -> Outcome:
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


def _configure_state(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--state", type=Path, metavar="DIR", help="the daemon's folder")


def _run_stop(args: argparse.Namespace) -> Outcome:
    from tofcapture.record.daemon.client import ask
    from tofcapture.record.daemon.settings import state_folder
    from tofcapture.record.resources import holder
    from tofcapture.record.stopping import Told, stop_all

    try:
        told = stop_all()
    except OSError as err:
        told = [Told(os.getpid(), "recorders", f"cannot be found on this system: {err}")]
    state = state_folder(args.state)
    # A daemon in a container of its own shares nothing but its folder with us.
    if (daemon := holder(state.lock)) is not None and daemon not in {one.pid for one in told}:
        try:
            found = ask("POST", "/v1/stop", state=args.state)
            told.append(Told(found["pid"], f"the daemon over {found['root']}, which rests", ""))
        except TofError as err:
            told.append(Told(daemon, f"the daemon of {state.root}", err.message))
    lines = [str(one) for one in told] or ["no recorder and no daemon of this user runs"]
    if not told or any(one.problem for one in told):
        raise DeviceError(
            "; ".join(["NOT STOPPED" if told else "nothing was stopped", *lines]),
            hint="if an arm moves, press the red button: the emergency stop on its teach pendant",
        )
    lines.append("sealed views stay")
    return Outcome(data={"ok": True, "stopped": [vars(one) for one in told]}, text="\n".join(lines))


DAEMON = Command(
    help="record scenes in the background, behind a local API and a web page",
    example="tofcapture daemon --root recordings --http 127.0.0.1:8765",
    configure=_configure_daemon,
    run=_run_daemon,
)
STATUS = Command(
    help="what the daemon is doing",
    example="tofcapture status",
    configure=_configure_status,
    run=_run_status,
)
STOP = Command(
    help="stop every recorder of this user now, with or without a daemon; sealed views stay",
    example="tofcapture stop",
    configure=_configure_state,
    run=_run_stop,
)
