"""Checkpoints: weights in safetensors, configuration (TOML) and provenance in the header. No pickle.

``OUT/model.safetensors`` is the model, ``OUT/model.toml`` the same configuration for people. The provenance remembers which
shards and objects a network has learned from: splits keep objects apart inside one dataset only.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from tofcapture.errors import ConfigError, DataError, FormatError, TofError
from tofcapture.files.manifest import COMBINATIONS, SceneEntry, load_manifest, object_of
from tofcapture.files.seal import replacing, write_text
from tofcapture.files.shard import ShardReader
from tofcapture_model.config import Config, dumps_config, loads_config
from tofcapture_model.networks import Model, build_model

FORMAT, VERSION = "tofcapture-model", 2
DIGITS = 12  # of a shard's SHA-256 that are enough to recognise it
_BUNDLED = Path("bundled")  # what a user may write where a path is asked for
_SHOWN = 5
# simulate-dataset numbers the objects that it makes up: s003-bowl of another seed is another bowl
_NUMBERED = re.compile(rf"[a-z]\d{{3}}-|({'|'.join(COMBINATIONS)})-\d+$")

Learned = Mapping[str, Sequence[str]]


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a safetensors file atomically."""
    from safetensors.torch import save

    data = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, dict(header))
    with replacing(path) as partial:
        partial.write_bytes(data)


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file and its header; :class:`FormatError` where it is missing, damaged, or something else."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="pt") as file:
            return {k: file.get_tensor(k) for k in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118
    except (OSError, SafetensorError) as err:
        raise FormatError(
            f"{path}: cannot read the checkpoint: {err}", hint="tofcapture train DATASET --out DIR"
        ) from err


def save_model(
    path: Path,
    model: Model,
    config: Config,
    provenance: Mapping[str, Any],
    *,
    precision: Literal["float32", "float16"] = "float32",
) -> Path:
    """Write weights, configuration and provenance, any JSON object, to a ``.safetensors``; the configuration also beside it as ``.toml``.

    ``float16`` halves the file and rounds every weight to 11 bits; :func:`load_checkpoint` computes in float32 all the same.

    Raises :class:`DataError`: a weight that float16 cannot hold.
    """
    text, weights = dumps_config(config), model.state_dict()
    if precision == "float16":
        weights = {k: v.half() if v.is_floating_point() else v for k, v in weights.items()}
        lost = [k for k, v in weights.items() if not torch.isfinite(v).all()]
        if lost:
            raise DataError(
                f"{lost[0]}: expected weights within +-65504 for float16", hint="save it in float32"
            )
    header = {"format": FORMAT, "version": str(VERSION), "config": text}
    write_tensors(path, weights, {**header, "provenance": json.dumps(provenance, sort_keys=True)})
    write_text(path.with_suffix(".toml"), text)
    return path


def names_bundled(path: str | Path | None) -> bool:
    """Tell whether a user means the bundled weights: nothing, or ``bundled`` where no file of that name lies."""
    return path is None or (Path(path) == _BUNDLED and not _BUNDLED.exists())


def find_model(path: str | Path | None) -> Path:
    """Resolve what a user calls a model: a file, the folder of a run, or, by :func:`names_bundled`, the bundled weights."""
    if path is None or names_bundled(path):
        bundled = Path(str(files("tofcapture_model") / "weights" / "model.safetensors"))
        if not bundled.exists():
            raise ConfigError(
                "no weights are bundled with this installation", hint="name a checkpoint with --weights"
            )
        return bundled
    return Path(path) / "model.safetensors" if Path(path).is_dir() else Path(path)


def load_checkpoint(path: str | Path | None = None) -> tuple[Model, Config, dict[str, Any]]:
    """Load a file, a run's folder or, with ``None`` or ``bundled``, the bundled weights; strictly, and to compute in float32.

    Returns model (in evaluation mode), its configuration, its provenance.

    Raises :class:`FormatError`: not a checkpoint of this version, or its weights do not fit its
    configuration.
    """
    path = find_model(path)
    tensors, header = read_tensors(path)
    if header.get("format") != FORMAT or header.get("version") != str(VERSION):
        raise FormatError(
            f"{path}: expected {FORMAT} version {VERSION}, got {header.get('format')} {header.get('version')}",
            hint="version 1 read other inputs: train again, or take the bundled network",
        )
    config = loads_config(header.get("config", ""), str(path))
    model = build_model(config)
    load_strictly(model, tensors, path)
    return model.eval(), config, json.loads(header.get("provenance", "{}"))


def load_strictly(model: Model, tensors: Mapping[str, Tensor], path: Path) -> None:
    """Copy tensors into a model, whatever their precision; names and shapes must agree exactly."""
    try:
        model.load_state_dict(dict(tensors), strict=True)
    except RuntimeError as err:
        raise FormatError(f"{path}: the weights do not fit the configuration: {err}") from err


def budget(provenance: Mapping[str, Any]) -> dict[str, float]:
    """Return the minutes and steps that trained a checkpoint; what is not known is left out."""
    return {key: float(provenance[key]) for key in ("minutes", "steps") if provenance.get(key)}


def origin(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance for results and pages: all but the long lists of what was learned from."""
    return {key: value for key, value in provenance.items() if key != "learned"}


def learned_from(datasets: Sequence[Path], before: Learned | None = None) -> dict[str, list[str]]:
    """Collect what a checkpoint remembers of the ``train`` splits of datasets, and of the weights that it started from.

    Returns ``objects``: names, sorted; ``shards``: the first twelve digits of their SHA-256, sorted.
    """
    objects, shards = set((before or {}).get("objects", ())), set((before or {}).get("shards", ()))
    for dataset in datasets:
        for name, entry in load_manifest(dataset).split("train").items():
            objects |= _objects(Path(dataset), name, entry)
            shards.add(entry.sha256[:DIGITS])
    return {"objects": sorted(objects), "shards": sorted(shards)}


def not_new(provenance: Mapping[str, Any], dataset: Path, split: str) -> dict[str, str] | None:
    """Find the scenes of a split that a network has learned from, by the provenance of its checkpoint.

    Returns ``the same shard`` or ``object NAME`` by scene; ``None`` where the checkpoint does not tell what
    it was trained on.
    """
    if "learned" not in provenance:
        return None
    objects, shards = set(provenance["learned"]["objects"]), set(provenance["learned"]["shards"])
    found: dict[str, str] = {}
    for name, entry in load_manifest(dataset).split(split).items():
        if entry.sha256[:DIGITS] in shards:
            found[name] = "the same shard"
        elif both := objects & _objects(Path(dataset), name, entry):
            found[name] = f"object {', '.join(sorted(both))}"
    return found


def _objects(dataset: Path, name: str, entry: SceneEntry) -> set[str]:
    """Names that mean the same object in every dataset: as the shard says, else that of the scene."""
    try:
        with ShardReader(dataset / entry.path, entry.sha256) as shard:
            said = shard.provenance.get("objects")
    except (OSError, TofError):  # training from a packed cache may go without the shards
        said = None
    names = [object_of(name)] if said is None else map(str, said)
    return {thing for thing in names if not _NUMBERED.match(thing)}


def sentence(who: str, found: Mapping[str, str] | None, scenes: int) -> str:
    """Tell people what :func:`not_new` found; nothing where all scenes are new."""
    if found is None:
        return f"{who}: its checkpoint does not tell what it was trained on; whether these scenes are new to it is not known"
    if not found:
        return ""
    some = "; ".join(f"{scene} ({why})" for scene, why in sorted(found.items())[:_SHOWN])
    more = f" and {len(found) - _SHOWN} more" if len(found) > _SHOWN else ""
    return f"{who}: {len(found)} of {scenes} scenes are not new to it: {some}{more}"
