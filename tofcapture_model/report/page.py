"""From files to one HTML page: reads what is there, says what is not."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from tofcapture import __version__
from tofcapture.errors import ConfigError, DataError, FormatError
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import Manifest, load_manifest, manifest_path
from tofcapture.files.seal import sha256_of
from tofcapture_model.report.alignment import alignment
from tofcapture_model.report.examples import choose, describe_shard, load_examples
from tofcapture_model.report.panels import panels
from tofcapture_model.report.rigs import camera_rows, drawing, range_rows, transforms
from tofcapture_model.report.scores import headline, sample, tables, tiles
from tofcapture_model.report.training import Network, load_network, loss_chart, validations
from tofcapture_model.training.learned import origin, sentence


@dataclass(frozen=True)
class Sources:
    """What the page is made from; a part that is None is reported as absent for the reason given.

    Attributes
    ----------
    dataset
        Folder, or None.
    manifest, manifest_sha256
        Of the dataset.
    results, evidence
        Parsed JSON.
    network
        With its weights.
    absent
        Reason by part: ``dataset``, ``results``, ``evidence``, ``weights``.
    """

    dataset: Path | None
    manifest: Manifest | None
    manifest_sha256: str
    results: Mapping[str, Any] | None
    evidence: Mapping[str, Any] | None
    network: Network | None
    absent: Mapping[str, str]


def read_json(
    path: Path | None, kind: str, keys: tuple[str, ...], option: str
) -> tuple[dict[str, Any] | None, str]:
    """Read one of the project's JSON files; None and a reason where there is none.

    Raises
    ------
    FormatError
        It is there and is something else, or a part is missing.
    """
    if path is None:
        return None, f"not given, name it with {option}"
    if not Path(path).is_file():
        return None, f"there is no file {path}"
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as err:
        raise FormatError(f"{path}: not JSON: {err}") from err
    if not isinstance(table, dict) or (table.get("format"), table.get("version")) != (kind, 1):
        raise FormatError(f"{path}: expected {kind} version 1")
    missing = [k for k in keys if k not in table]
    if missing:
        raise FormatError(f"{path}: missing {', '.join(missing)}")
    return table, ""


def read_sources(
    dataset: Path | None, results: Path | None, evidence: Path | None, weights: Path | None
) -> Sources:
    """Read all parts; at least a dataset or results must be there.

    Raises
    ------
    ConfigError
        Neither is given.
    DataError, FormatError
        A part that is given is damaged or foreign, or the dataset is missing.
    """
    if dataset is None and results is None:
        raise ConfigError("nothing to report", hint="--dataset DIR --results results.json")
    if results is not None and not Path(results).is_file():
        raise DataError(f"{results}: no such file", hint="tofcapture evaluate DATASET --out results.json")
    scores, no_results = read_json(results, "tofcapture-results", ("methods", "split"), "--results")
    keys = ("pairs", "spread", "standard_error", "used", "views", "backend", "T_tof_stereo")
    proof, no_evidence = read_json(evidence, "tofcapture-evidence", keys, "--evidence")
    network, no_weights = load_network(weights)
    manifest = None if dataset is None else load_manifest(dataset)
    absent = {
        "dataset": "" if manifest else "not given, name it with --dataset",
        "results": no_results,
        "evidence": no_evidence,
        "weights": no_weights,
    }
    digest = "" if dataset is None else sha256_of(manifest_path(dataset))
    return Sources(dataset, manifest, digest, scores, proof, network, absent)


def render_page(sources: Sources, views: int) -> str:
    """Render the HTML of a page with so many example views; same sources, same text."""
    try:
        import jinja2
        import matplotlib as mpl  # noqa: F401  its colour maps are needed further down
    except ImportError as err:
        raise ConfigError(f"the report needs {err.name}", hint="pip install 'tofcapture[report]'") from err
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    text = (files("tofcapture_model.report") / "report.html.j2").read_text(encoding="utf-8")
    page: str = environment.from_string(text).render(context(sources, views))
    return page + "\n"


def context(sources: Sources, views: int) -> dict[str, Any]:
    """Everything that the template says."""
    results, evidence, network = sources.results, sources.evidence, sources.network
    shard = _shard(sources)
    return {
        "absent": sources.absent,
        "headline": headline(results) if results else "",
        "sample": sample(results) if results else "",
        "tiles": tiles(results) if results else [],
        "results": results,
        "tables": tables(results) if results else [],
        "alignment": alignment(evidence) if evidence else None,
        "shard": shard,
        "rig": _rig(shard, evidence) if shard else None,
        "panels": _panels(sources, views),
        "split": _split(sources),
        "dataset": _dataset(sources),
        "network": network,
        "chart": loss_chart(network.rows) if network else None,
        "validations": validations(network.rows) if network else [],
        "doubts": doubts(sources),
        "versions": _versions(sources),
    }


def _split(sources: Sources) -> str:
    return str(sources.results["split"]) if sources.results else "test"


def _shard(sources: Sources) -> Mapping[str, Any] | None:
    """Description of the first scene of the split, or of the dataset where the split is empty."""
    if sources.dataset is None or sources.manifest is None or not sources.manifest.scenes:
        return None
    scenes = sources.manifest.split(_split(sources)) or dict(sorted(sources.manifest.scenes.items()))
    return describe_shard(sources.dataset, sources.manifest, next(iter(scenes)))


def _panels(sources: Sources, views: int) -> list[Any]:
    if sources.dataset is None or sources.manifest is None:
        return []
    chosen = choose(sources.manifest, _split(sources), views)
    model = sources.network.model if sources.network else None
    return panels(load_examples(sources.dataset, sources.manifest, chosen, model))


def _rig(shard: Mapping[str, Any], evidence: Mapping[str, Any] | None) -> dict[str, Any]:
    rig = shard["rig"]
    return {
        "transforms": transforms(rig, evidence),
        "cameras": camera_rows(rig),
        "illuminator": ", ".join(f"{1e3 * x:.1f}" for x in rig.illuminator),
        "ranges": range_rows(shard["tof"].range_errors),
        "drawing": drawing(rig),
    }


def _dataset(sources: Sources) -> dict[str, Any] | None:
    manifest = sources.manifest
    if manifest is None:
        return None
    splits = []
    for name in SPLITS:
        part = manifest.split(name)
        splits.append((name, ", ".join(part) or "–", len(part), sum(e.views for e in part.values())))
    shards = [
        (name, entry.split, entry.views, entry.sha256) for name, entry in sorted(manifest.scenes.items())
    ]
    config = json.dumps(dict(manifest.config), indent=1, sort_keys=True)
    return {"splits": splits, "shards": shards, "sha256": sources.manifest_sha256, "config": config}


def _versions(sources: Sources) -> list[tuple[str, str]]:
    """(library, version): of this page, of the dataset, of the alignment."""
    import torch

    rows = [("this page: tofcapture", __version__), ("this page: torch", str(torch.__version__))]
    if sources.manifest:
        rows += [(f"dataset: {k}", str(v)) for k, v in sorted(sources.manifest.versions.items())]
    if sources.evidence:
        made = sources.evidence.get("provenance", {}).get("versions", {})
        rows += [(f"alignment: {k}", str(v)) for k, v in sorted(made.items())]
    return rows


def doubts(sources: Sources) -> list[str]:
    """What a reader must know before believing that the parts of the page belong together."""
    out = []
    results, network = sources.results, sources.network
    if results and network and _other_weights(results, network):
        out.append("The pictures are made with other weights than the table.")
    trained_on = network.provenance.get("manifest_sha256") if network else None
    if trained_on and sources.manifest_sha256 and trained_on != sources.manifest_sha256:
        out.append(
            "The network is the bundled one: it was trained on other, simulated scenes."
            if network and network.bundled
            else "The network was trained on another dataset, or on another state of this one."
        )
    if results and sources.manifest and "scenes" in results:
        scenes = sources.manifest.split(str(results["split"]))
        some = set(results["scenes"])
        if some < set(scenes):
            out.append(
                f"The table was measured on {len(some)} of the {len(scenes)} scenes of this dataset's split."
            )
        elif some != set(scenes):
            out.append("The table was measured on other scenes than this dataset's split holds.")
    return out + (_not_new(results) if results else [])


def _runs(results: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """What is known of every network of a result: one without a suite, a suite's runs."""
    return dict(results["runs"]) if "runs" in results else {"The network": results}


def _other_weights(results: Mapping[str, Any], network: Network) -> bool:
    trainings = [run.get("training") for run in _runs(results).values()]
    return None not in trainings and origin(network.provenance) not in trainings


def _not_new(results: Mapping[str, Any]) -> list[str]:
    """A sentence for every network that has learned from some of the scenes, or may have."""
    out = []
    for who, run in _runs(results).items():
        if "not_new" in run:
            said = sentence(who, run["not_new"], len(results["scenes"]))
            out += [f"{said}."] if said else []
        elif results["split"] == "train":
            out.append(
                "The table may have been measured on what the network was trained on: the split train."
            )
    return out
