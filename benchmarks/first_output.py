"""Print when every command first says something, and how long it is ever silent: ``python benchmarks/first_output.py``.

Each runs under a pseudo-terminal of 80 columns, one after the other, on what those before it made. The second column is the
time of ``--help`` over that of a bare Python, medians of five. The daemon is told to end after five seconds. Of
``stop`` only the help is asked for: it would stop every recorder of this user.
"""

from __future__ import annotations

import argparse
import os
import pty
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

COMMANDS = """
doctor
config show
completion bash
calibrate board --svg board.svg
record --calibration --views 4 --frames 2 --out rec
record --scene mug --views 2 --frames 2 --out rec
record --scene bottle --views 2 --frames 2 --out rec
status
stop --help
import raw.npy --camera 190,190,119.5,89.5 --out imported
align rec
rig show rec/rig.toml
calibrate coverage rec
build-dataset rec --out data
check data
stats data
view data --png sheet.png
figure depth data --out depth.png
pack data --out cache
export-dataset data --format ply --out ply
train data --out run --preset demo --minutes 0.3
evaluate data --weights run
predict rec/views/mug/view-000.h5 --weights run
export --weights run --out model.onnx
report --dataset data --results results.json
simulate {world} --out simulated.h5
simulate-dataset --scenes 1 --views 1 --frames 1 --out simulated
daemon --root daemon --http 127.0.0.1:8799
demo --out demo-out
""".strip().splitlines()
DAEMON_SECONDS = 5.0
WORLD = Path(__file__).parents[1] / "examples" / "world.toml"
PROGRAM = [sys.executable, "-m", "tofcapture"]


def watched(words: list[str], folder: Path) -> tuple[float, float, float, int]:
    """Run a command; seconds to its first byte, its longest silence, its whole time, and its exit code."""
    main, side = pty.openpty()
    began = last = time.monotonic()
    env = {**os.environ, "COLUMNS": "80", "TERM": "xterm"}
    done = subprocess.Popen([*PROGRAM, *words], stdin=side, stdout=side, stderr=side, cwd=folder, env=env)
    os.close(side)
    first, silence = None, 0.0
    while True:
        ready, _, _ = select.select([main], [], [], 0.05)
        now = time.monotonic()
        try:
            said = bool(ready and os.read(main, 65536))
        except OSError:  # the other side is closed: the command has ended
            break
        if words[0] == "daemon" and now - began > DAEMON_SECONDS:
            done.send_signal(signal.SIGINT)
            words = ["ending"]
        if said:
            first = now - began if first is None else first
            silence, last = max(silence, now - last), now
    code, now = done.wait(), time.monotonic()
    os.close(main)
    return first if first is not None else now - began, max(silence, now - last), now - began, code


def seconds(words: list[str]) -> float:
    """Time a process that ends by itself, the median of five."""
    taken = []
    for _ in range(5):
        began = time.perf_counter()
        subprocess.run(words, capture_output=True, check=True)
        taken.append(time.perf_counter() - began)
    return statistics.median(taken)


def ramp() -> np.ndarray:
    """(8, 180, 240) raw words of a wall that leans from 0.6 to 1.2 m, 20 then 100 MHz."""
    metres = np.broadcast_to(np.linspace(0.6, 1.2, 240), (180, 240))
    turns = [np.pi * (4 * mhz * 1e6 * metres / 299_792_458 + k / 2) for mhz in (20, 100) for k in range(4)]
    return np.round(1500 + 800 * np.cos(turns)).astype(np.uint16)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="commands that begin so (those before them run too)")
    only = parser.parse_args().only
    bare = seconds([sys.executable, "-c", "pass"])
    print(f"bare Python starts and ends in {1e3 * bare:.0f} ms")
    print(f"{'command':<18} {'--help/python':>13} {'first s':>8} {'silent s':>9} {'whole s':>8}  exit")
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "raw.npy", ramp())
        for line in COMMANDS:
            words = line.format(world=WORLD).split()
            first, silence, whole, code = watched(words, Path(folder))
            if words[0].startswith(only):
                ratio = seconds([*PROGRAM, words[0], "--help"]) / bare
                print(f"{words[0]:<18} {ratio:>13.1f} {first:>8.2f} {silence:>9.2f} {whole:>8.1f}  {code}")


if __name__ == "__main__":
    main()
