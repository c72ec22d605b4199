"""Read JSON, TOML, YAML and XML of other programs, those of OpenCV's FileStorage too, as dictionaries and lists."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from tofcapture.errors import ConfigError, DataError, FormatError


def read_tree(path: Path) -> Any:
    """Read one file; matrices are dictionaries of ``rows``, ``cols`` and ``data``, several documents of YAML a list.

    Raises :class:`DataError` for no such file, :class:`FormatError` for anything that is not what its beginning says.
    """
    try:
        data = path.read_bytes()
    except OSError as err:
        raise DataError(f"{path}: cannot read it: {err}") from err
    try:
        text = decoded(data).strip()
        if path.suffix.lower() == ".toml":
            return tomllib.loads(text)
        if text[:1] in {"{", "["}:
            return json.loads(text)
        return parsed_xml(text, path) if text[:1] == "<" else yaml_tree(text, path)
    except (ValueError, ET.ParseError) as err:
        hint = "is it this file? a camera can be told in numbers: --camera fx,fy,cx,cy[,k1,k2,p1,p2,k3]"
        raise FormatError(f"{path}: expected JSON, TOML, YAML or XML, got {str(err)[:200]}", hint) from err


def decoded(data: bytes) -> str:
    """Decode UTF-8 or, as Windows' tools write it, UTF-16 with or without a mark."""
    if data[:2] in {b"\xff\xfe", b"\xfe\xff"}:
        return data.decode("utf-16")
    if data[1:2] == b"\0" and len(data) > 2:
        return data.decode("utf-16-le")
    return data.decode("utf-8-sig")


def parsed_xml(text: str, path: Path) -> Any:
    """Read OpenCV's XML: dictionaries, lists and matrices; :class:`FormatError` when it has entities."""
    if "<!ENTITY" in text:
        raise FormatError(f"{path}: expected OpenCV's XML, got entities")
    return _xml(ET.fromstring(text))  # noqa: S314  without entities nothing grows


def _xml(node: ET.Element) -> Any:
    """Dictionaries, lists and matrices of one element."""
    if node.get("type_id") == "opencv-matrix":
        held = {child.tag: (child.text or "").split() for child in node}
        return {"rows": held["rows"][0], "cols": held["cols"][0], "data": held["data"]}
    if not len(node):
        return (node.text or "").split()
    tags = [child.tag for child in node]
    if tags[0] == "_":
        return [_xml(child) for child in node]
    return {child.tag: _xml(child) for child in node}


def yaml_tree(text: str, path: Path) -> Any:
    """Read YAML, with OpenCV's header and matrices too; :class:`FormatError` for anything else."""
    try:
        import yaml
    except ImportError as err:
        raise ConfigError(
            f"{path}: reading YAML needs PyYAML", hint="pip install pyyaml, or convert to JSON"
        ) from err

    class Loader(yaml.SafeLoader):  # type: ignore[misc]
        """Knows the tag of OpenCV's matrices."""

    Loader.add_constructor(
        "tag:yaml.org,2002:opencv-matrix", lambda loader, node: loader.construct_mapping(node, deep=True)
    )
    try:
        documents = list(yaml.load_all(re.sub(r"^%YAML.*\n", "", text.lstrip()), Loader))
    except yaml.YAMLError as err:
        raise FormatError(f"{path}: expected YAML, got {str(err)[:200]}") from err
    documents = [d for d in documents if d is not None]
    return documents[0] if len(documents) == 1 else documents
