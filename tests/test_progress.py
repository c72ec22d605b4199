"""Progress: a word at once, a guess that falls, one line on any terminal, a line now and then in a pipe."""

from __future__ import annotations

import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import time
from itertools import pairwise

import numpy as np
import pytest

from tofcapture.cli import kit

SHORT = """
import sys, time
from tofcapture.cli.kit import at_work, progress
with at_work("count"):
    time.sleep(0.7)
    with progress() as report:
        for i in range(6):
            report("sheep", i, 6, "a word that is far too long for a narrow terminal")
            time.sleep(0.2)
        print("a wolf")
        time.sleep(0.7)
        report("sheep", 6, 6)
print("done")
"""


def on_a_terminal(code, columns):
    """What a script writes to a terminal of some columns, in pieces with the time of each."""
    main, side = pty.openpty()
    fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    began = time.monotonic()
    done = subprocess.Popen([sys.executable, "-c", code], stdin=side, stdout=side, stderr=side)
    os.close(side)
    pieces = []
    while True:
        try:
            piece = os.read(main, 65536)
        except OSError:
            break
        if not piece:
            break
        pieces.append((time.monotonic() - began, piece.decode()))
    os.close(main)
    assert done.wait() == 0
    return pieces


@pytest.mark.parametrize("columns", [20, 200])
def test_one_line_on_a_terminal_of_any_width(columns):
    """Nothing wraps, the command says that it is at work, what others print stands alone, and nothing remains but results."""
    text = "".join(piece for _, piece in on_a_terminal(SHORT, columns))
    drawn = [line for line in re.split(r"[\r\n]+", text) if line]
    assert max(map(len, drawn)) < columns
    assert drawn[0].startswith("count")
    assert any("of 6" in line for line in drawn)
    screen = [line.split("\r")[-1].rstrip() for line in text.replace("\r\n", "\n").split("\n")]
    assert [line for line in screen if line] == [
        "a wolf", next(s for s in screen if s.startswith("sheep: 6 of 6")), "done"
    ]  # fmt: skip


def test_a_question_is_not_written_over():
    """A line that somebody began without ending it is left alone until it ends."""
    code = (
        "import sys, time\nfrom tofcapture.cli.kit import progress\nwith progress() as report:\n"
        "    report('ask', 0, 2)\n    print('ready? ', end='', flush=True)\n    time.sleep(1.5)\n    print('yes')\n"
    )
    text = "".join(piece for _, piece in on_a_terminal(code, 80))
    assert "ready? yes" in text


def test_in_a_pipe_silence_is_broken_now_and_then(monkeypatch, capsys):
    """Also while nothing is reported; what ended is told once."""
    monkeypatch.setattr(kit, "QUIET", 0.2)
    monkeypatch.setattr(kit, "BEAT", 0.05)
    with kit.progress() as report:
        report("wait", 0, 0)
        time.sleep(1.0)
        report("steps", 3, 3)
        report("steps", 3, 3)
    lines = capsys.readouterr().err.splitlines()
    assert 2 <= sum(line.startswith("wait") for line in lines) <= 6
    assert lines.count("steps: 3 of 3") == 1


def test_a_fast_task_in_a_pipe_says_no_more_than_its_end(capsys):
    """No line for each step."""
    with kit.progress() as report:
        for i in range(100):
            report("steps", i + 1, 100)
    assert capsys.readouterr().err == "steps: 100 of 100\n"


def test_a_notebook_gets_one_line_that_is_drawn_over(monkeypatch):
    """Its stderr is no terminal, but knows a carriage return; no escape sequence."""
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with kit.progress() as report:
        for i in range(5):
            report("train", i, 4)
    text = stream.getvalue()
    assert "\x1b" not in text
    assert text.count("\n") == 1
    assert text.count("\rtrain") + text.count("\r#") + text.count("\r-") >= 4


def test_time_left_falls_and_is_right():
    """However the pace wavers; a slow first step is not taken for the pace; only what was far too low is raised."""
    rng = np.random.default_rng(0)
    now, pace, said = 0.0, kit.Pace(), []
    pace.left(now, 0, 100)
    now += 40.0  # loading and compiling
    for done in range(1, 100):
        said.append((now, pace.left(now, done, 100)))
        now += rng.uniform(0.5, 1.5)
    left = np.array([(now - at, guess) for at, guess in said if guess is not None])
    assert len(left) > 80
    assert (np.diff(left[left[:, 1] > 5, 1]) <= 0.5).all()
    assert (np.abs(left[:, 1] - left[:, 0]) <= 0.3 * left[:, 0] + 6).all()
    assert pace.left(now + 3, 99, 100) < pace.left(now, 99, 100) + 1e-9
    slow = kit.Pace()
    for at, done in enumerate(range(12)):
        first = slow.left(at, done, 13)
    assert slow.left(66, 12, 13) > first  # thirty times slower than said: the truth is told


def test_time_left_creeps_nowhere():
    """A pace that slows down by little shows no 69, 72, 74, 77."""
    pace, said = kit.Pace(), []
    now = 0.0
    for done in range(40):
        said.append(pace.left(now, done, 60))
        now += 1.0 + 0.004 * done
    known = [s for s in said if s is not None]
    assert all(b <= a for a, b in pairwise(known))
