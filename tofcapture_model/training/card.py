"""Write the card of a training run: ``README.md`` beside the weights says what was trained on what, and how well it went."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from tofcapture.errors import TofError
from tofcapture.files.layout import SPLITS
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import write_text
from tofcapture.files.shard import ShardReader
from tofcapture_model.config import Config, config_to_dict, preset, presets
from tofcapture_model.networks import Model
from tofcapture_model.networks.checkpoint import DIGITS
from tofcapture_model.training import read_metrics

ROWS = 12  # of a curve


def write_card(
    out: Path,
    config: Config,
    model: Model,
    dataset: Path,
    device: torch.device,
    provenance: Mapping[str, Any],
    minutes: float | None = None,
) -> dict[str, Any]:
    """Write ``OUT/README.md`` at the end of a run, from its ``metrics.jsonl`` and what else is known of it.

    ``provenance`` has ``steps``, ``minutes``, ``losses``, ``manifest_sha256`` and where the run started; ``minutes`` is the budget
    that it was given, ``None``: its epochs. Returns what the checkpoint should remember besides: ``device``, ``torch``.
    """
    facts = {"device": _device_name(device), "torch": torch.__version__}
    rows = read_metrics(out / "metrics.jsonl")
    parts = [
        f"# {out.resolve().name}: {config.network.kind}",
        _about(config, model, {**provenance, **facts}),
        "## Data\n\n" + _data(dataset, provenance),
        "## Configuration\n\n" + _configuration(config),
        "## Curves\n\n" + _curves(rows),
        "## Go on\n\n" + _commands(out, dataset, provenance, minutes),
    ]
    write_text(out / "README.md", "\n\n".join(parts) + "\n")
    return facts


def _device_name(device: torch.device) -> str:
    """Name a device as people know it, with the threads or processes that worked on it."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    name = f"{device.type}, {_count(torch.get_num_threads(), 'thread')}"
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
    return name if world == 1 else f"{world} x {name}"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def _about(config: Config, model: Model, known: Mapping[str, Any]) -> str:
    begun = f"`{known['start']}` (sha256 {known['start_sha256'][:DIGITS]})" if "start" in known else "nothing"
    losses = ", ".join(f"{name} {value:.4g}" for name, value in known.get("losses", {}).items())
    rows = [
        ("network", f"{config.network.kind}, {sum(p.numel() for p in model.parameters()):,} parameters"),
        ("trained from", begun),
        ("training", f"{_count(int(known.get('steps', 0)), 'step')}, {known['minutes']:.1f} minutes"),
        ("device", f"{known['device']}, {config.training.precision}, PyTorch {known['torch']}"),
        ("last logged losses", losses or "none"),
    ]
    if "uncertainty" in known:
        fitted = known["uncertainty"]
        rows.append(
            ("error map", f"times {fitted['factor']:.3g}, fitted on {_count(fitted['views'], 'view')}")
        )
    if idle := known.get("idle"):
        rows.append(("**learned nothing at the end**", f"{_count(len(idle), 'weight')}, as `{idle[0]}`"))
    return _table(("", ""), rows)


def _data(dataset: Path, known: Mapping[str, Any]) -> str:
    manifest = load_manifest(dataset)
    rows = []
    for split in SPLITS:
        entries = manifest.split(split).values()
        frames = _frames([dataset / entry.path for entry in entries])
        rows.append((split, str(len(entries)), str(sum(entry.views for entry in entries)), frames))
    said = f"`{dataset}`, sha256 of its manifest {known.get('manifest_sha256', 'unknown')}"
    for other, digest in known.get("also", {}).items():
        said += f"; the split train of `{other}`, {digest}, was learned from, too"
    return f"{said}\n\n{_table(('split', 'scenes', 'views', 'frames'), rows)}"


def _frames(shards: Sequence[Path]) -> str:
    """Tell how many frames shards hold; a run on a packed cache may go without them."""
    total = 0
    try:
        for path in shards:
            with ShardReader(path) as shard:
                total += shard.views * shard.frames
    except (OSError, TofError):
        return "not here"
    return f"{total}"


def closest_preset(config: Config) -> tuple[str, dict[str, tuple[Any, Any]]]:
    """Find the preset that differs least from a configuration, and where: key, the preset's value, the configuration's."""
    mine = dict(_flat(config_to_dict(config)))
    found = []
    for name in presets():
        theirs = dict(_flat(config_to_dict(preset(name))))
        keys = sorted(mine.keys() | theirs.keys())
        changed = {k: (theirs.get(k), mine.get(k)) for k in keys if theirs.get(k) != mine.get(k)}
        found.append((len(changed), name, changed))
    _, name, changed = min(found, key=lambda f: f[:2])
    return name, changed


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for i, item in enumerate(value):
                yield from _flat(item, f"{prefix}{key} {i + 1}: ")
        else:
            yield prefix + key, value


def _configuration(config: Config) -> str:
    name, changed = closest_preset(config)
    if not changed:
        return f"The preset `{name}`; `model.toml` spells it out."
    rows = [(key, _value(theirs), _value(mine)) for key, (theirs, mine) in changed.items()]
    return f"`model.toml`; differences from the preset `{name}`:\n\n{_table(('key', 'preset', 'here'), rows)}"


def _value(value: Any) -> str:
    return "-" if value is None else f"`{json.dumps(value)}`"


def _curves(rows: Sequence[Mapping[str, Any]]) -> str:
    steps, checks = ([row for row in rows if key in row] for key in ("total", "val_mae"))
    losses = [(str(r["step"]), r["stage"], f"{r['rate']:.2g}", f"{r['total']:.4g}") for r in _thinned(steps)]
    tables = [_table(("step", "stage", "rate", "loss"), losses)]
    if checks:
        found = [
            (str(r["step"]), r["stage"], f"{1e3 * r['val_mae']:.2f}", f"{r['val_angle_deg']:.2f}")
            for r in _thinned(checks)
        ]
        tables.append(_table(("step", "stage", "val MAE mm", "val normals deg"), found))
    tables.append("Every logged step is in `metrics.jsonl`; `tensorboard --logdir .` draws them.")
    return "\n\n".join(tables)


def _thinned(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """At most ``ROWS`` of them, evenly, the first and the last included."""
    if len(rows) <= ROWS:
        return list(rows)
    return [rows[round(i * (len(rows) - 1) / (ROWS - 1))] for i in range(ROWS)]


def _commands(out: Path, dataset: Path, known: Mapping[str, Any], minutes: float | None) -> str:
    datasets = " ".join([str(dataset), *known.get("also", {})])
    again = f"tofcapture train {datasets} --out {out}.again --config {out}/model.toml"
    again += f" --from {known['start']}" if "start" in known else ""
    again += f" --minutes {minutes:g}" if minutes else ""
    return (
        "The run is finished; a killed one goes on when its command is run again in the same folder.\n\n"
        f"```sh\n{again}   # the same run\n"
        f"tofcapture train OTHER --out tuned --from {out}   # fine-tune on another dataset\n"
        f"tofcapture evaluate {dataset} --weights {out} --out {out}/results.json\n"
        f"tofcapture report --dataset {dataset} --results {out}/results.json --weights {out} --out {out}/report.html\n"
        "```"
    )
