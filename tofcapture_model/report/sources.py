"""Read what the report is made from; what is not there is told, and what does not belong together is doubted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.manifest import Manifest, load_manifest, manifest_path
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config
from tofcapture_model.evaluation.evaluate import FORMAT, VERSION
from tofcapture_model.networks import Model
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint, origin, sentence
from tofcapture_model.training import read_metrics


@dataclass(frozen=True)
class Network:
    """A loaded network, what its checkpoint says, name and digest of the file, and the lines of ``metrics.jsonl`` beside it."""

    model: Model
    config: Config
    provenance: Mapping[str, Any]
    name: str
    sha256: str
    rows: list[dict[str, Any]]
    bundled: bool = False


@dataclass(frozen=True)
class Sources:
    """Hold what the page is made from: folder and manifest of the dataset, parsed JSON, the network.

    A part that is None is reported as absent for the reason in ``absent``: ``dataset``, ``results``, ``evidence``, ``weights``.
    """

    dataset: Path | None
    manifest: Manifest | None
    manifest_sha256: str
    results: Mapping[str, Any] | None
    evidence: Mapping[str, Any] | None
    network: Network | None
    absent: Mapping[str, str]

    @property
    def split(self) -> str:
        """Split that the results were measured on; ``test`` without results."""
        return str(self.results["split"]) if self.results else "test"


def read_sources(
    dataset: Path | None, results: Path | None, evidence: Path | None, weights: Path | None
) -> Sources:
    """Read all parts; at least a dataset or results must be there.

    Raises :class:`ConfigError`: neither is given; :class:`DataError`, :class:`FormatError`: a part that is
    given is damaged or foreign, or the dataset is missing.
    """
    if dataset is None and results is None:
        raise ConfigError("nothing to report", hint="--dataset DIR --results results.json")
    if results is not None and not Path(results).is_file():
        raise DataError(f"{results}: no such file", hint="tofcapture evaluate DATASET --out results.json")
    scores, no_results = _read_json(
        results, (FORMAT, VERSION), ("methods", "split"), "--results", "evaluate DATASET --out results.json"
    )
    keys = ("pairs", "used", "views", "backend", "T_tof_stereo")
    proof, no_evidence = _read_json(
        evidence, ("tofcapture-evidence", 1), keys, "--evidence", "align RECORDING"
    )
    network, no_weights = _read_network(weights)
    absent = {
        "dataset": "" if dataset else "not given, name it with --dataset",
        "results": no_results,
        "evidence": no_evidence,
        "weights": no_weights,
    }
    if dataset is None:
        return Sources(None, None, "", scores, proof, network, absent)
    digest = sha256_of(manifest_path(dataset))
    return Sources(dataset, load_manifest(dataset), digest, scores, proof, network, absent)


def _read_json(
    path: Path | None, kind: tuple[str, int], keys: tuple[str, ...], option: str, writer: str
) -> tuple[dict[str, Any] | None, str]:
    """Read one of the project's JSON files; None and a reason where there is none."""
    if path is None:
        return None, f"not given, name it with {option}"
    if not Path(path).is_file():
        return None, f"there is no file {path}"
    hint = f"tofcapture {writer} writes it"
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise FormatError(f"{path}: not JSON: {err}", hint=hint) from err
    if not isinstance(table, dict) or (table.get("format"), table.get("version")) != kind:
        stated = isinstance(table, dict) and "format" in table
        got = f"{table['format']} version {table.get('version')}" if stated else "other JSON"
        raise FormatError(f"{path}: expected {kind[0]} version {kind[1]}, got {got}", hint=hint)
    missing = [k for k in keys if k not in table]
    if missing:
        raise FormatError(f"{path}: missing {', '.join(missing)}", hint=hint)
    return table, ""


def _read_network(weights: Path | None) -> tuple[Network | None, str]:
    """Load a network; None and a reason where there is none."""
    try:
        path = find_model(weights)
    except ConfigError as err:
        return None, f"{err.message}; {err.hint}"
    if not path.is_file():
        return None, f"there is no checkpoint at {path}"
    rows = read_metrics(path.parent / "metrics.jsonl")
    return Network(*load_checkpoint(path), path.name, sha256_of(path), rows, weights is None), ""


def doubts(sources: Sources) -> list[str]:
    """Tell what a reader must know before believing that the parts of the page belong together."""
    out = []
    results, network = sources.results, sources.network
    runs = {} if results is None else dict(results.get("runs", {"The network": results}))
    trainings = [run.get("training") for run in runs.values()]
    if results and network and None not in trainings and origin(network.provenance) not in trainings:
        out.append("The pictures are made with other weights than the table.")
    trained_on = network.provenance.get("manifest_sha256") if network else None
    if trained_on and sources.manifest_sha256 and trained_on != sources.manifest_sha256:
        out.append(
            "The network is the bundled one: it was trained on other, simulated scenes."
            if network and network.bundled
            else "The network was trained on another dataset, or on another state of this one."
        )
    if results and sources.manifest and "scenes" in results:
        scenes, some = set(sources.manifest.split(sources.split)), set(results["scenes"])
        if some < scenes:
            out.append(
                f"The table was measured on {len(some)} of the {len(scenes)} scenes of this dataset's split."
            )
        elif some != scenes:
            out.append("The table was measured on other scenes than this dataset's split holds.")
    for who, run in runs.items():
        if "not_new" in run and (
            said := sentence(who, run["not_new"], len(results["scenes"]) if results else 0)
        ):
            out.append(f"{said}.")
        elif "not_new" not in run and sources.split == "train":
            out.append(
                "The table may have been measured on what the network was trained on: the split train."
            )
    return out
