"""The administration of a training run: its processes, its place, its log, its resume point.

``OUT/metrics.jsonl`` is the log, ``OUT/resume.safetensors`` what a killed run needs to go on bit by bit.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tofcapture.cli.kit import Report
from tofcapture.errors import ConfigError, DataError
from tofcapture.files.disk import NoLocksError, check_writable, hold_file
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config, Stage, dumps_config
from tofcapture_model.data import FrameDataset, collate, epoch_batches
from tofcapture_model.evaluation.evaluate import model_method, score
from tofcapture_model.frame import Frame, Target, frame_to, target_to
from tofcapture_model.losses import Objective
from tofcapture_model.networks import Model
from tofcapture_model.networks.checkpoint import (
    find_model,
    learned_from,
    load_checkpoint,
    load_strictly,
    read_tensors,
    write_tensors,
)

T = TypeVar("T")
Moments = dict[str, dict[str, Tensor]]  # of an optimiser, by the parameter's name
SAVE_EVERY = 60.0  # s between resume points
LOG_EVERY = 20  # steps
TELL_EVERY = 2.0  # s
LEAST_SHARE = 0.1  # of a budget in minutes, for each stage


class Group(NamedTuple):
    """Processes that train together: ``rank`` of ``world``, 0 of 1 for a single one, and this one's device."""

    rank: int
    world: int
    device: torch.device

    def shared(self, value: T) -> T:
        """Tell all processes what the first one says."""
        if self.world == 1:
            return value
        held = [value]
        torch.distributed.broadcast_object_list(held, src=0, device=self.device)
        return held[0]

    def slowest(self, seconds: float) -> float:
        """Return the most seconds of all processes, so that all of them stop at the same step."""
        if self.world == 1:
            return seconds
        most = torch.tensor(seconds, device=self.device, dtype=torch.float32)
        torch.distributed.all_reduce(most, torch.distributed.ReduceOp.MAX)
        return float(most)


@contextmanager
def processes(device: str) -> Iterator[Group]:
    """Join the group that ``torchrun`` announces in the environment; on ``cuda`` each process takes a GPU of its own.

    :class:`ConfigError`: there are more processes on this machine than GPUs.
    """
    world, own = int(os.environ.get("WORLD_SIZE", "1")), torch.device(device)
    if own.type == "cuda":
        own = _own_gpu(own, world)
    if world == 1:
        yield Group(0, 1, own)
        return
    torch.distributed.init_process_group("nccl" if own.type == "cuda" else "gloo")
    try:
        yield Group(torch.distributed.get_rank(), world, own)
    finally:
        torch.distributed.destroy_process_group()


@contextmanager
def held(out: Path, group: Group) -> Iterator[None]:
    """Hold the folder of a run, made when missing: two runs in one folder would overwrite each other.

    A disk that keeps no locks, as on some clusters, holds nobody off. :class:`BusyError`: another process trains there;
    :class:`ConfigError`: it cannot be written.
    """
    with ExitStack() as stack:
        if group.rank == 0:
            check_writable(out, "name another folder: --out")
            out.mkdir(parents=True, exist_ok=True)
            lock = hold_file(
                out / ".lock", f"{out}: another training is at work", "wait, or name another --out"
            )
            with suppress(NoLocksError):
                stack.enter_context(lock)
        yield


def _own_gpu(device: torch.device, world: int) -> torch.device:
    """The GPU of this process, made the current one: compiled kernels are launched there, wherever their tensors are."""
    index = int(os.environ["LOCAL_RANK"]) if world > 1 else device.index or 0
    if index >= torch.cuda.device_count():
        raise ConfigError(
            f"expected a GPU for every process, got process {index + 1} on {torch.cuda.device_count()}",
            hint="torchrun --nproc-per-node with the number of GPUs, or --device cpu",
        )
    torch.cuda.set_device(index)
    return torch.device("cuda", index)


@dataclass
class Position:
    """Tell where a run is; everything in it goes into the resume point."""

    stage: int = 0  #: with epoch and batch: the next batch to take
    epoch: int = 0
    batch: int = 0
    step: int = 0  #: steps done, over all stages
    elapsed: float = 0.0  #: s of training in this stage, over all sittings
    before: float = 0.0  #: s of the stages before this one

    def next_stage(self) -> None:
        """Go to the start of the next stage."""
        self.stage, self.epoch, self.batch = self.stage + 1, 0, 0
        self.before, self.elapsed = self.before + self.elapsed, 0.0


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read a ``metrics.jsonl`` by step; a line that a kill cut short is skipped, of two for a step the later counts."""
    if not path.is_file():
        return []
    rows: dict[tuple[int, bool], dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
            rows[int(row["step"]), "total" in row] = row
        except (ValueError, KeyError, TypeError):
            continue
    return [rows[key] for key in sorted(rows)]


class Log:
    """``metrics.jsonl`` always, TensorBoard where it is installed; silent without a folder."""

    def __init__(self, out: Path | None) -> None:
        self._file, self._board = None, None
        if out is None:
            return
        out.mkdir(parents=True, exist_ok=True)
        self._file = (out / "metrics.jsonl").open("a", encoding="utf-8")
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._board = SummaryWriter(str(out / "tensorboard"))

    def write(self, step: int, row: Mapping[str, Any]) -> None:
        """Add a row; its floats are drawn."""
        if self._file is not None:
            self._file.write(json.dumps({"step": step, **row}) + "\n")
            self._file.flush()
        for name, value in row.items():
            if isinstance(value, float) and self._board is not None:
                self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Close the files."""
        for file in (self._file, self._board):
            if file is not None:
                file.close()


@dataclass(frozen=True)
class Trained:
    """Result of a training: the checkpoint, steps done, whether all stages are finished, the last losses."""

    path: Path
    steps: int
    finished: bool
    losses: dict[str, float]


class Run:
    """A run in its folder: begun, or gone on with, in which case its weights are loaded into the model.

    It validates on the split ``val`` of ``dataset``; ``source`` is what it is trained on and from (:func:`source_of`). With
    ``minutes`` these are shared by all stages, without them their epochs count. :class:`ConfigError`: the folder holds another run.
    """

    def __init__(
        self,
        config: Config,
        model: Model,
        group: Group,
        dataset: Path,
        out: Path,
        source: Mapping[str, Any],
        minutes: float | None,
        report: Report,
    ) -> None:
        self.config, self.model, self.group, self.dataset, self.out = config, model, group, dataset, out
        self.minutes, self.report, self.progress = minutes, report, 0.0
        self.key = _key(config, source, minutes, group.world)
        # the first process reads and tells the others, who may be on machines that do not see the folder
        weights, self.moments, state = group.shared(self._resume_point() if group.rank == 0 else ({}, {}, {}))
        if state:
            load_strictly(model, weights, out / "resume.safetensors")
        self.losses: dict[str, float] = state.pop("losses", {})
        self.position = Position(**state)
        self._log, self._told = Log(None), (0.0, 1.0)  # done and all, of the stage
        self._started = self._saved = self._said = time.monotonic()
        self._usual: dict[int, Any] = {}  # what signals did before
        self._asked: int | None = None

    def __enter__(self) -> Self:
        """Open the log; from here on Ctrl-C and SIGTERM wait for the end of a step, a second one does not."""
        self._log = Log(self.out if self.group.rank == 0 else None)
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if callable(usual := signal.getsignal(number)):
                    self._usual[number] = usual
                    signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()
        self._log.close()

    def _note(self, number: int, _: object) -> None:
        """Remember a signal."""
        self._asked = number
        signal.signal(number, self._usual[number])

    def _restore(self) -> None:
        while self._usual:
            signal.signal(*self._usual.popitem())

    def batches(self, data: FrameDataset, stage: Stage, workers: int) -> Iterator[tuple[Frame, Target]]:
        """Yield the stage's batches, on the device, from where the run is to its end; validates after epochs."""
        position, training, budget = self.position, self.config.training, self.budget(stage)
        self._started, self._saved = time.monotonic() - position.elapsed, time.monotonic()
        self._told = (0.0, budget or 0.0)
        self._tell(stage, "reads its first frames")
        while not self._done(stage):
            keys = epoch_batches(
                data.kinds, training.batch, training.seed, position.epoch, self.group.rank, self.group.world
            )
            left = keys[position.batch :]
            for frame, target in DataLoader(
                data, batch_sampler=left, num_workers=workers, collate_fn=collate
            ):
                steps = position.epoch * len(keys) + position.batch, stage.epochs * len(keys)
                self._told = (position.elapsed, budget) if budget else steps
                self.progress = min(self._told[0] / self._told[1], 1.0)
                yield frame_to(frame, self.group.device), target_to(target, self.group.device)
                if budget is not None and position.elapsed >= budget:
                    break
            position.epoch, position.batch = position.epoch + 1, 0
            every = training.validate_every
            if self.group.rank == 0 and every and (self._done(stage) or position.epoch % every == 0):
                self._validate(stage)
        position.next_stage()
        self.moments = {}

    def stepped(self, stage: Stage, loss: Objective, rate: float) -> None:
        """Count a step that was taken; log and tell about some."""
        position = self.position
        position.step, position.batch = position.step + 1, position.batch + 1
        position.elapsed = self.group.slowest(time.monotonic() - self._started)
        due = position.step % LOG_EVERY == 1
        if not due and time.monotonic() - self._said < TELL_EVERY:
            return
        self._tell(stage, f"step {position.step} loss {float(loss.total.detach()):.3f}")
        if not due:
            return
        self.losses = {k: float(v.detach()) for k, v in {"total": loss.total, **loss.parts}.items()}
        row: dict[str, Any] = {
            "stage": stage.name, "epoch": position.epoch, "seconds": position.elapsed, "rate": rate
        }  # fmt: skip
        if "chamfer" in loss.parts:
            row["winners"] = loss.winners.tolist()
        self._log.write(position.step, row | self.losses)

    def _tell(self, stage: Stage, text: str) -> None:
        """Say how far the stage is: in seconds of its budget, or in steps."""
        self._said, (done, total) = time.monotonic(), self._told
        if (budget := self.budget(stage)) is None:
            self.report(stage.name, done, total, text)
        else:
            self.report(
                f"{stage.name}, seconds", round(min(self.position.elapsed, budget)), round(budget), text
            )

    def save_now_and_then(self, moments: Moments, *, now: bool = False) -> None:
        """Write the resume point once a minute, or at once: everything that the next step depends on.

        A signal that came since the last step has it written too, and then its usual effect.
        """
        due = now or self._asked is not None or time.monotonic() - self._saved > SAVE_EVERY
        if due and self.group.rank == 0:
            self._save(moments)
        if self._asked is not None:
            self._restore()
            signal.raise_signal(self._asked)

    def _save(self, moments: Moments) -> None:
        tensors = {f"model/{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"adam/{name}/{k}": v for name, values in moments.items() for k, v in values.items()}
        state = {"key": self.key, "losses": self.losses, **self.position.__dict__}
        write_tensors(self.out / "resume.safetensors", tensors, {"state": json.dumps(state)})
        self._saved = time.monotonic()

    def ended(self) -> Trained:
        """Tell what has become of the run."""
        finished = self.position.stage == len(self.config.stages)
        name = "model.safetensors" if finished else "resume.safetensors"
        return Trained(self.out / name, self.position.step, finished=finished, losses=self.losses)

    def expect_finite(self, what: str, value: float) -> None:
        """Stop before a step that would spoil the weights."""
        if not math.isfinite(value):
            raise DataError(
                f"{self.out}: expected a finite {what}, got {value} at step {self.position.step + 1}",
                hint="check the dataset (tofcapture check); if it is sound, take a lower learning_rate and another --out",
            )

    def budget(self, stage: Stage) -> float | None:
        """Share the seconds of the run among its stages by their epochs, but none gets much less than a tenth.

        Five of the paper's 695 epochs are thousands of steps; as a share of some minutes they would be a handful.
        """
        if self.minutes is None:
            return None
        epochs = sum(s.epochs for s in self.config.stages)
        shares = [max(s.epochs / epochs, LEAST_SHARE) for s in self.config.stages]
        return 60 * self.minutes * max(stage.epochs / epochs, LEAST_SHARE) / sum(shares)

    def _done(self, stage: Stage) -> bool:
        budget = self.budget(stage)
        return self.position.epoch >= stage.epochs if budget is None else self.position.elapsed >= budget

    def _validate(self, stage: Stage) -> None:
        """Log MAE (m) and mean angle (deg) on the first frames of the ``val`` split, if there is one."""
        if not load_manifest(self.dataset).split("val"):
            return
        data = FrameDataset(self.dataset, "val", frames=1)
        self.model.eval()
        with eagerly():
            methods = {"model": model_method(self.model)}
            table = score(methods, data, self.group.device)[0]["model"].table()
        self.model.train()
        data.close()
        if table["depth"]["pixel"]["pixels"]:
            row: dict[str, Any] = {"stage": stage.name, "epoch": self.position.epoch}
            row["val_mae"] = table["depth"]["pixel"]["mae"]
            row["val_angle_deg"] = table["normal"]["pixel"]["mean_deg"]
            self._log.write(self.position.step, row)

    def _resume_point(self) -> tuple[dict[str, Tensor], Moments, dict[str, Any]]:
        """Weights, Adam's moments and state of a run that is to go on; nothing where none was begun."""
        path = self.out / "resume.safetensors"
        if not path.exists():
            return {}, {}, {}
        tensors, header = read_tensors(path)
        state = json.loads(header.get("state", "{}"))
        if state.pop("key", None) != self.key:
            raise ConfigError(
                f"{self.out}: holds a run with another configuration, dataset, budget or number of processes",
                hint="choose another --out, or delete it",
            )
        weights = {k.removeprefix("model/"): v for k, v in tensors.items() if k.startswith("model/")}
        moments: Moments = {}
        for key in tensors.keys() - {f"model/{k}" for k in weights}:
            name, kind = key.removeprefix("adam/").rsplit("/", 1)
            moments.setdefault(name, {})[kind] = tensors[key]
        return weights, moments, state


def eagerly() -> AbstractContextManager[object]:
    """Answer whole frames without compiled U-Nets, which would be compiled for that size anew."""
    return torch.compiler.set_stance("force_eager")  # type: ignore[no-any-return]


def source_of(model: Model, config: Config, datasets: Sequence[Path], start: Path | None) -> dict[str, Any]:
    """Name what a run is trained on and from; with ``start`` the model is given that checkpoint's weights, of the same network."""
    first, *also = datasets
    source: dict[str, Any] = {"dataset": str(first), "manifest_sha256": _digest(first)}
    known: dict[str, Any] | None = None
    if start:
        other, its, known = load_checkpoint(start)
        if its.network != config.network:
            raise ConfigError(
                f"{start}: expected weights of the configuration's network ({config.network.kind}), got {its.network.kind} with other sizes or kind",
                hint=f"--config {find_model(start).with_suffix('.toml')} has its configuration",
            )
        load_strictly(model, other.state_dict(), start)
        source |= {"start": str(start), "start_sha256": sha256_of(find_model(start))}
    if also:
        source["also"] = {str(d): _digest(d) for d in also}
    if known is None or "learned" in known:
        source["learned"] = learned_from(datasets, (known or {}).get("learned"))
    if known and "seen" in known:
        source["seen"] = known["seen"]
    return source


def _digest(dataset: Path) -> str:
    return sha256_of(dataset / "manifest.json")


def _key(config: Config, source: Mapping[str, Any], minutes: float | None, world: int) -> str:
    """Digest of all that decides what a run computes; a resume point of another run is refused."""
    begun = source.get("start_sha256", "") + "".join(source.get("also", {}).values())
    several = f"|{world} processes" if world > 1 else ""
    text = f"{dumps_config(config)}|{source['manifest_sha256']}|{minutes}{begun}{several}"
    return hashlib.sha256(text.encode()).hexdigest()
