"""JSON that carries its own digest, so that a changed character anywhere in it is found.

The text is a function of the table (sorted keys, one indent): what is read is compared with what would be written, byte for byte.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from tofcapture.errors import DataError
from tofcapture.files.hdf import dumps

KEY = "sha256"


def _pretty(table: Mapping[str, Any]) -> str:
    return json.dumps(json.loads(dumps(table)), indent=1, sort_keys=True) + "\n"


def signed_text(table: Mapping[str, Any]) -> str:
    """Text of a table with the SHA-256 of its text without that entry under ``sha256``."""
    body = {name: value for name, value in table.items() if name != KEY}
    digest = hashlib.sha256(_pretty(body).encode()).hexdigest()
    return _pretty({**body, KEY: digest})


def parse_signed(data: bytes, where: str, hint: str) -> dict[str, Any]:
    """Read what :func:`signed_text` wrote, without its digest.

    Raises
    ------
    DataError
        It is not JSON, or any byte of it was changed.
    """
    table = parse_json(data, where, hint)
    if signed_text(table).encode() != data:
        raise DataError(f"{where}: its sha256 is not that of its text: changed after it was written", hint)
    del table[KEY]
    return table


def parse_json(data: bytes, where: str, hint: str) -> dict[str, Any]:
    """Read a JSON object.

    Raises
    ------
    DataError
        It is not one.
    """
    try:
        table = json.loads(data.decode())
    except (ValueError, RecursionError) as err:
        raise DataError(f"{where}: not JSON: {err}", hint) from err
    if not isinstance(table, dict):
        raise DataError(f"{where}: not a JSON object but {type(table).__name__}", hint)
    return table
