"""Configure a training run: frozen dataclasses, and TOML files that hold only differences from a preset.

``preset = "compact"`` in a TOML file names its starting point. A preset is a TOML file in ``presets/`` that differs from the
defaults below, which are the paper's.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from tofcapture.errors import ConfigError

STAGES = ("depth", "normal", "refine", "joint")
OURS, BASELINES = ("paper", "compact"), ("su2018", "guo2018", "coarse-fine")
SOURCES = {"raw": 8, "confidence": 1, "depth": 1}
# keys of old checkpoints, by what they had to be
_RETIRED = {"chamfer_softness": 0.0, "chamfer_distance": "point"}


def _require(fine: bool, where: str, expected: str, got: object) -> None:
    if not fine:
        raise ConfigError(
            f"{where}: expected {expected}, got {got}", hint="tofcapture_model/config.py lists every key"
        )


def _require_one(known: tuple[str, ...], where: str, got: str) -> None:
    _require(got in known, where, " or ".join(known), got)


@dataclass(frozen=True)
class Network:
    """Which network.

    ``paper`` is three U-Nets, ``compact`` one small U-Net with three heads on classical features. ``su2018``, ``guo2018`` and
    ``coarse-fine`` are published networks, of which ``su2018`` has a width and none has any of the other keys.
    """

    kind: str = "paper"
    width: int = 64  #: channels of the first level of every U-Net
    levels: int = 5  #: of every U-Net
    inputs: tuple[str, ...] = ("raw", "confidence", "depth")  #: of the paper's networks (table IV)
    windows: tuple[int, ...] = (2, 4)  #: radii, px, of the side-window plane fits that compact reads
    leak: float = 0.0  #: share of what is negative that compact's U-Net lets through; with none, units die
    max_residual: float = 0.0  #: m that a depth may move beyond its candidates; 0: any distance
    learned_upsampling: bool = True  #: of depth, convex x2; false: bilinear
    refine_iterations: int = 2  #: rounds of depth to normals to depth
    refine_radius: int = 2  #: taps to each side of the propagation window at twice the resolution

    def __post_init__(self) -> None:
        kinds, sources, compact = OURS + BASELINES, set(self.inputs), self.kind == "compact"
        _require(self.kind in kinds, "network.kind", ", ".join(kinds), self.kind)
        fine = self.width > 0 and 2 <= self.levels <= 6
        _require(fine, "network", "width > 0, 2 to 6 levels", (self.width, self.levels))
        fine = bool(sources) and sources <= set(SOURCES)
        _require(fine, "network.inputs", "some of raw, confidence, depth", self.inputs)
        fine = not compact or sources == set(SOURCES)
        _require(fine, "network.inputs", "all of them for compact", self.inputs)
        fine = all(w > 0 for w in self.windows) and (len(self.windows) > 0 or not compact)
        _require(fine, "network.windows", "positive radii, for compact one at least", self.windows)
        _require(0 <= self.leak < 1, "network.leak", "from 0 to less than 1", self.leak)
        _require(self.max_residual >= 0, "network.max_residual", "metres >= 0", self.max_residual)
        refine = (self.refine_iterations, self.refine_radius)
        _require(min(*refine, 0) == 0 < refine[1], "network.refine", "iterations >= 0, radius > 0", refine)


@dataclass(frozen=True)
class Losses:
    """Weights and constants of the losses."""

    delta: float = 0.020  #: m, threshold of eq. 1
    jitter: float = 0.010  #: m, of the robust Chamfer loss (eq. 2)
    reweight: bool = True  #: whether eq. 1 weighs pixels by lambda; false: plain smooth l1
    #: what the error map learns: l1, the expected absolute error (paper), or laplace, a Laplace distribution's scale,
    #: which is then calibrated on the val split to be one sigma
    uncertainty: str = "l1"
    normals: str = "cosine"  #: eq. 3 (paper), or angle, whose gradient does not fade with the angle
    depth: float = 1.0  #: weight of eq. 1
    chamfer: float = 0.01  #: weight of eq. 2, 1/mm^2
    error: float = 1.0  #: weight of the error map
    normal: float = 1.0  #: weight of the normals
    context: float = 0.0  #: weight of measured surface outside the object crop relative to the object

    def __post_init__(self) -> None:
        fine = self.delta > 0 and self.jitter >= 0
        _require(fine, "losses", "delta > 0, jitter >= 0", (self.delta, self.jitter))
        _require_one(("l1", "laplace"), "losses.uncertainty", self.uncertainty)
        _require_one(("cosine", "angle"), "losses.normals", self.normals)
        weights = (self.depth, self.chamfer, self.error, self.normal)
        fine = min(*weights, self.context) >= 0 and max(weights) > 0
        _require(fine, "losses", "weights >= 0, one of depth, chamfer, error, normal above", self)


@dataclass(frozen=True)
class Stage:
    """One stage of training: which parts learn (``depth``, ``normal``, ``refine``, ``joint``), how long, how fast."""

    name: str
    epochs: int
    learning_rate: float = 1e-4

    def __post_init__(self) -> None:
        _require(self.name in STAGES, "stage.name", ", ".join(STAGES), self.name)
        fine = self.epochs > 0 and self.learning_rate > 0
        _require(fine, f"stage {self.name}", "epochs and learning_rate > 0", self)


@dataclass(frozen=True)
class Training:
    """Tell how to train."""

    batch: int = 4  #: frames per step and process
    crop: tuple[int, ...] = ()  #: (height, width) at sensor resolution; () takes whole frames
    frames: int = 0  #: use the first so many of every view, which differ in noise only; 0: all
    #: recorded: frames as they were taken; drawn: the mean of each view's frames with fresh noise, so that none is seen twice
    noise: str = "recorded"
    phase_error: float = (
        0.0  #: rad; above 0 every crop gets the calibration error of another camera of the make
    )
    flip: bool = False  #: mirror at random: right as far as the light source stands near the lens
    schedule: str = "constant"  #: (paper) or cosine, down to zero over each stage
    validate_every: int = 0  #: epochs between validations, and one at the end of each stage; 0: none
    precision: str = "float32"  #: or bfloat16, of the convolutions, for GPUs with tensor cores
    compile: bool = False  #: the U-Nets (torch.compile): a minute at the start, somewhat faster steps after
    seed: int = 0  #: of weights, order and crops

    def __post_init__(self) -> None:
        _require(self.batch > 0, "training.batch", "> 0", self.batch)
        _require_one(("float32", "bfloat16"), "training.precision", self.precision)
        _require_one(("recorded", "drawn"), "training.noise", self.noise)
        _require_one(("constant", "cosine"), "training.schedule", self.schedule)
        for key in ("frames", "validate_every", "seed"):
            _require(getattr(self, key) >= 0, f"training.{key}", ">= 0", getattr(self, key))
        _require(0 <= self.phase_error < 0.5, "training.phase_error", "radians, 0 to 0.5", self.phase_error)
        fine = len(self.crop) in (0, 2) and all(c >= 32 for c in self.crop)
        _require(fine, "training.crop", "[] or [height, width] >= 32", self.crop)


PAPER_STAGES = (Stage("depth", 230), Stage("normal", 460), Stage("refine", 5))


@dataclass(frozen=True)
class Config:
    """A whole run; the default is the paper."""

    network: Network = field(default_factory=Network)
    losses: Losses = field(default_factory=Losses)
    training: Training = field(default_factory=Training)
    stages: tuple[Stage, ...] = PAPER_STAGES

    def __post_init__(self) -> None:
        shared = self.network.kind == "compact"
        split = [s.name for s in self.stages if s.name in ("depth", "normal")]
        _require(len(self.stages) > 0, "stages", "at least one", "none")
        _require(not (shared and split), "stages", "joint or refine, as compact shares its backbone", split)
        foreign = [s.name for s in self.stages if self.network.kind in BASELINES and s.name != "depth"]
        _require(not foreign, "stages", f"depth only, as {self.network.kind} answers with depth", foreign)
        own = self.network.kind not in BASELINES or self.losses == Losses()
        _require(own, "losses", f"none, as {self.network.kind} brings its own", self.losses)
        idle = self.network.refine_iterations == 0 and any(s.name == "refine" for s in self.stages)
        _require(not idle, "stages", "no refine stage without refine_iterations", "refine")


Part = TypeVar("Part", Network, Losses, Training, Stage)


def _changed(part: Part, table: Any, where: str) -> Part:
    """Apply a TOML table to a dataclass; the types of the defaults decide."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where}: expected a table, got {table!r}")
    known = {f.name for f in fields(part)}
    table = {key: value for key, value in table.items() if key in known or _RETIRED.get(key) != value}
    unknown = table.keys() - known
    if unknown:
        raise ConfigError(
            f"{where}: unknown key {', '.join(sorted(unknown))}", hint=f"known: {', '.join(sorted(known))}"
        )
    hints = get_type_hints(type(part))
    return replace(part, **{key: _typed(raw, hints[key], f"{where}.{key}") for key, raw in table.items()})


def _typed(raw: Any, hint: Any, where: str) -> Any:
    """Check a TOML value against a field's type: int, finite float, bool, str, or a tuple of one of them."""
    of = get_args(hint)  # tuple[int, ...]
    if of:
        if not isinstance(raw, list):
            raise ConfigError(f"{where}: expected a list of {of[0].__name__}, got {raw!r}")
        return tuple(_typed(one, of[0], where) for one in raw)
    value = float(raw) if hint is float and type(raw) is int else raw
    if type(value) is not hint or (hint is float and not math.isfinite(value)):
        raise ConfigError(f"{where}: expected {hint.__name__}, got {raw!r}")
    return value


def config_from_dict(table: Mapping[str, Any], where: str = "config") -> Config:
    """Read a configuration from plain TOML types: differences from the preset it names, or from the paper.

    Raises :class:`ConfigError`: unknown keys, wrong types, values that contradict each other.
    """
    known = {"preset", "network", "losses", "training", "stage"}
    if table.keys() - known:
        unknown = ", ".join(sorted(table.keys() - known))
        raise ConfigError(f"{where}: unknown key {unknown}", hint=f"known: {', '.join(sorted(known))}")
    base = preset(str(table["preset"])) if "preset" in table else Config()
    stages = base.stages
    if "stage" in table:
        if not isinstance(table["stage"], list):
            raise ConfigError(f"{where}: stage: expected tables [[stage]], got {table['stage']!r}")
        for i, stage in enumerate(table["stage"]):
            if not isinstance(stage, Mapping) or not {"name", "epochs"} <= stage.keys():
                raise ConfigError(f"{where}: stage {i}: expected name and epochs, got {stage!r}")
        given = enumerate(table["stage"])
        stages = tuple(_changed(Stage("joint", 1), s, f"{where}: stage {i}") for i, s in given)
    parts = {
        name: _changed(getattr(base, name), table.get(name, {}), f"{where}: {name}")
        for name in ("network", "losses", "training")
    }
    return Config(**parts, stages=stages)


def config_to_dict(config: Config) -> dict[str, Any]:
    """Write the resolved configuration as plain TOML types; the inverse of :func:`config_from_dict`."""
    table = asdict(config)
    table["stage"] = list(table.pop("stages"))
    return {k: _plain(v) for k, v in table.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def dumps_config(config: Config) -> str:
    """Write the resolved configuration as TOML."""
    import tomli_w

    return str(tomli_w.dumps(config_to_dict(config)))


def loads_config(text: str, where: str = "config") -> Config:
    """Read the text of a configuration."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as err:
        raise ConfigError(f"{where}: not TOML: {err}") from err
    return config_from_dict(table, where)


def load_config(path: Path) -> Config:
    """Read a configuration file."""
    try:
        return loads_config(Path(path).read_text(encoding="utf-8"), str(path))
    except (OSError, UnicodeDecodeError) as err:
        raise ConfigError(f"{path}: cannot read the configuration: {err}") from err


def presets() -> tuple[str, ...]:
    """Names of the shipped presets."""
    folder = files("tofcapture_model") / "presets"
    return tuple(sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml")))


def preset(name: str) -> Config:
    """Load a shipped preset, one of :func:`presets`."""
    if name not in presets():
        raise ConfigError(f"expected a preset of {', '.join(presets())}, got {name!r}")
    text = (files("tofcapture_model") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    return loads_config(text, f"preset {name}")
