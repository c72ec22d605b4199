"""What a sub-command of ``tofcapture`` is.

Every package adds its commands through the entry-point group ``tofcapture.commands``; each entry point names one
:class:`Command`. The module that holds it must be light to import: heavy libraries are imported inside ``run``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """What a command hands back."""

    #: JSON-serialisable result, printed as one object on stdout under ``--json``.
    data: dict[str, Any] = field(default_factory=dict)
    text: str = ""  #: What a person reads on stdout without ``--json``.
    exit_code: int = 0  #: 0 unless the command succeeded in finding something wrong (``check``).


@dataclass(frozen=True)
class Command:
    """One sub-command: a line of help, a runnable example, its arguments and its function."""

    help: str
    example: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], Outcome]
