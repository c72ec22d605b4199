"""The result of a calibrate command as a JSON file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tofcapture.command import Outcome


def written(data: dict[str, Any], text: str, out: Path | None) -> Outcome:
    """Outcome of a command, written to ``out`` as JSON where a path was given."""
    if out is not None:
        from tofcapture.files.seal import write_text

        write_text(out, json.dumps(data, indent=1, allow_nan=False) + "\n")
        data, text = {**data, "out": str(out)}, f"{text}\n{out}"
    return Outcome(data=data, text=text)
