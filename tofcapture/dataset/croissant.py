"""A dataset's Croissant 1.0 description (JSON-LD, http://mlcommons.org/croissant/1.0)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tofcapture.files.layout import SHARD
from tofcapture.files.manifest import Manifest, manifest_path
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ShardReader, scales_text

CONFORMS = "http://mlcommons.org/croissant/1.0"

# The context that the specification prints; validators compare with it.
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def _file(identity: str, name: str, description: str, path: Path, mime: str, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": identity,
        "name": name,
        "description": description,
        "contentUrl": path.as_posix(),
        "encodingFormat": mime,
        "sha256": sha256,
    }


def croissant(dataset: Path, manifest: Manifest) -> dict[str, Any]:
    """Describe a dataset whose manifest is written.

    Parameters
    ----------
    dataset
        The folder.
    manifest
        Its content.

    Returns
    -------
    JSON-LD: the manifest and every shard as file objects with their SHA-256, the splits and their scenes as a record set. What
    the data do not tell (licence, authors, citation) is left out, never invented. Croissant has no reader for HDF5, so arrays are
    not fields; ``docs/formats.md`` describes them.
    """
    about = "Raw time-of-flight phase images with stereo ground truth"
    entry = manifest.scenes[min(manifest.scenes)]
    with ShardReader(dataset / entry.path, entry.sha256) as shard:
        if 4 in shard.scales:
            about += f" at {scales_text(shard.scales)}"
    files = [
        _file(
            "manifest",
            "manifest.json",
            "splits, and the digest of every shard and of itself",
            Path("manifest.json"),
            "application/json",
            sha256_of(manifest_path(dataset)),
        )
    ]
    files += [
        _file(
            f"shard-{name}",
            name,
            f"{entry.views} views, split {entry.split}",
            Path(entry.path),
            "application/x-hdf5",
            entry.sha256,
        )
        for name, entry in sorted(manifest.scenes.items())
    ]
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS,
        "name": dataset.resolve().name,
        "description": f"{about} ({SHARD.format} {SHARD.version}).",
        "keywords": ["time-of-flight", "depth", "surface normals"],
        "distribution": files,
        "recordSet": [_scenes(manifest)],
    }


def _scenes(manifest: Manifest) -> dict[str, Any]:
    """Record set that says which scene is in which split, as data of the description itself."""
    kinds = {"name": "sc:Text", "split": "sc:Text", "views": "sc:Integer", "shard": "sc:Text"}
    rows = [
        {"scenes/name": n, "scenes/split": e.split, "scenes/views": e.views, "scenes/shard": e.path}
        for n, e in sorted(manifest.scenes.items())
    ]
    fields = [
        {"@type": "cr:Field", "@id": f"scenes/{name}", "name": f"scenes/{name}", "dataType": kind}
        for name, kind in kinds.items()
    ]
    return {
        "@type": "cr:RecordSet",
        "@id": "scenes",
        "name": "scenes",
        "description": "one row per scene",
        "key": {"@id": "scenes/name"},
        "field": fields,
        "data": rows,
    }
