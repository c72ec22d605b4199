"""What a camera said of itself when it was first opened, kept beside ``station.toml`` so that it can be described unopened."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError
from tofcapture.files.seal import write_text


def read_contact(path: Path) -> dict[str, Any] | None:
    """Read a contact file; ``None`` when there is none yet.

    Raises
    ------
    ConfigError
        It cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as err:
        raise ConfigError(
            f"{path}: cannot read what the camera said of itself: {err}",
            hint="delete it; opening writes it anew",
        ) from err


def write_contact(path: Path, table: Mapping[str, Any]) -> None:
    """Write a contact file whole or not at all; the same content again writes nothing.

    Raises
    ------
    ConfigError
        The folder cannot be written.
    """
    import tomli_w

    text = tomli_w.dumps(table)
    try:
        if path.exists() and path.read_text(encoding="utf-8") == text:
            return
        write_text(path, text)
    except OSError as err:
        raise ConfigError(
            f"{path}: cannot write what the camera said of itself: {err}",
            hint='name a writable file: contact = "..."',
        ) from err
