"""What 200 event streams and 50 requests a second cost a recording: its cadence with and without them, in turns.

    python benchmarks/daemon_load.py [--replay RECORDING --scene NAME --views 25 --repeats 3]

The station is one of arrays at full size whose devices take their time (``--delay``), or a recording that is replayed as fast as it can
be read. Load is switched on and off every few views of one recording, so that both halves see the same machine. Medians of the
time from view to view.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import aiohttp

from tofcapture.devices.replay import write_station
from tofcapture.record.daemon.client import ask

STATION = Path(__file__).with_name("daemon_station.py")


async def _stream(session: aiohttp.ClientSession, url: str, tally: dict[str, int]) -> None:
    async with session.get(f"{url}/v1/events", timeout=aiohttp.ClientTimeout(total=None)) as answer:
        async for line in answer.content:
            tally["events"] += line.startswith(b"event:")


async def _requests(session: aiohttp.ClientSession, url: str, rate: float, tally: dict[str, int]) -> None:
    paths = ("/v1/state", "/v1/views", "/v1/preview/depth", "/v1/jobs", "/metrics")
    start = time.monotonic()
    for number in range(10**9):
        await asyncio.sleep(max(0.0, start + number / rate - time.monotonic()))
        begun = time.monotonic()
        async with session.get(url + paths[number % len(paths)]) as answer:
            await answer.read()
            tally["requests"] += answer.status in {200, 404}
        tally["slowest_ms"] = max(tally["slowest_ms"], round(1e3 * (time.monotonic() - begun)))


async def _load(url: str, token: str, streams: int, rate: float) -> None:
    """Load the daemon until stdin ends; print what was answered."""
    tally = {"events": 0, "requests": 0, "slowest_ms": 0}
    loop = asyncio.get_running_loop()
    head = {"Authorization": f"Bearer {token}"}
    async with aiohttp.ClientSession(headers=head, connector=aiohttp.TCPConnector(limit=0)) as session:
        work = [asyncio.create_task(_stream(session, url, tally)) for _ in range(streams)]
        work += [asyncio.create_task(_requests(session, url, rate, tally))]
        await loop.run_in_executor(None, sys.stdin.read)
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)
    print(json.dumps(tally), flush=True)


def _cpu(pid: int) -> float:
    """Seconds of processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _daemon(folder: Path, args: argparse.Namespace) -> tuple[subprocess.Popen[str], str, str]:
    """Start a daemon; with it, its address and its token."""
    env = {**os.environ, "BENCH_DELAY": str(args.delay), "BENCH_LARGE": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, STATION, "daemon", folder / "root", folder / "st"]
    if args.replay:
        station = write_station(args.replay, folder / "replayed")
        command = [sys.executable, "-m", "tofcapture", "daemon", "--root", folder / "root"]
        command += ["--state", folder / "st", "--station", station]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    daemon = subprocess.Popen([*command, "--http", "127.0.0.1:0"], text=True, env=env, **pipes)
    assert daemon.stdout is not None
    for line in daemon.stdout:
        if "/#token=" in line:
            url, _, token = line.strip().removeprefix("listening on ").partition("/#token=")
            return daemon, url, token
    raise SystemExit("the daemon ended before it said where it listens")


def _measure(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    state = folder / "st"
    daemon, url, token = _daemon(folder, args)
    load: subprocess.Popen[str] | None = None
    spans: dict[str, list[float]] = {"calm": [], "load": []}
    told: list[dict[str, int]] = []
    try:
        wish = {"scene": args.scene, "recording": "r", "views": args.views, "frames": 10}
        ask("POST", "/v1/jobs", wish, state)
        seen, last, mode, begun = 0, 0.0, "calm", 0
        while True:
            found = ask("GET", "/v1/state", state=state)
            sealed, now = found["progress"]["sealed"], time.monotonic()
            if sealed > seen:
                # The first view after a switch belongs to neither half.
                if sealed - seen == 1 and sealed - begun > 1 and last:
                    spans[mode].append(now - last)
                seen, last = sealed, now
                if sealed - begun > args.block:
                    mode, begun = ("load" if mode == "calm" else "calm"), sealed
                    load = _switch(load, url, token, args, told)
            if found["queue"].get("done"):
                break
            time.sleep(0.005)
        cpu = _cpu(daemon.pid)
    finally:
        if load is not None:
            _switch(load, url, token, args, told)
        daemon.terminate()
        daemon.wait(10)
    return {"spans": spans, "daemon_cpu_s": round(cpu, 2), "load": told}


def _summary(runs: list[dict[str, Any]], args: argparse.Namespace) -> dict[str, Any]:
    spans = {mode: [span for run in runs for span in run["spans"][mode]] for mode in ("calm", "load")}
    calm, loaded = (statistics.median(spans[mode]) for mode in ("calm", "load"))
    return {
        "streams": args.streams,
        "requests_per_s": args.rate,
        "views": {mode: len(found) for mode, found in spans.items()},
        "calm_s": round(calm, 4),
        "load_s": round(loaded, 4),
        "ratio": round(loaded / calm, 4),
        "daemon_cpu_s": [run["daemon_cpu_s"] for run in runs],
        "load": [told for run in runs for told in run["load"]],
    }


def _switch(
    load: subprocess.Popen[str] | None,
    url: str,
    token: str,
    args: argparse.Namespace,
    told: list[dict[str, int]],
) -> subprocess.Popen[str] | None:
    """Start the load, or end it and note what it got."""
    if load is None:
        command = [sys.executable, __file__, "--load", url, "--streams", args.streams, "--rate", args.rate]
        env = {**os.environ, "LOAD_TOKEN": token}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return subprocess.Popen([str(x) for x in command], text=True, env=env, **pipes)
    out, _ = load.communicate("")
    with contextlib.suppress(ValueError):
        told.append(json.loads(out))
    return None


def main() -> None:
    """Run the benchmark, or the load."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--streams", type=int, default=200)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--block", type=int, default=8, help="views between switches of the load")
    parser.add_argument("--delay", type=float, default=0.5, help="seconds that each device step takes")
    parser.add_argument("--replay", type=Path, metavar="RECORDING", help="replay it instead")
    parser.add_argument("--scene", default="mug")
    parser.add_argument("--repeats", type=int, default=1, help="recordings, one after the other")
    parser.add_argument("--load", metavar="URL", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.load:
        asyncio.run(_load(args.load, os.environ["LOAD_TOKEN"], args.streams, args.rate))
        return
    runs = []
    for _ in range(args.repeats):
        with tempfile.TemporaryDirectory(prefix="load-") as name:
            runs.append(_measure(Path(name), args))
    print(json.dumps(_summary(runs, args)))


if __name__ == "__main__":
    main()
