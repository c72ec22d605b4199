"""Train a model: one loop, no callbacks. ``torchrun`` makes it run on many processes; a killed run goes on bit by bit."""

from __future__ import annotations

import hashlib
import math
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from tofcapture.errors import ConfigError, DataError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import sha256_of
from tofcapture_model.augment import redraw_calibration, redraw_frame
from tofcapture_model.checkpoint import (
    find_model,
    load_model,
    load_resume,
    load_strictly,
    save_model,
    save_resume,
)
from tofcapture_model.config import Config, Stage, dumps_config
from tofcapture_model.data import FrameDataset, collate, epoch_batches, spare_memory
from tofcapture_model.evaluate import calibrate, model_method, score
from tofcapture_model.frame import Estimate, frame_to, target_to
from tofcapture_model.joint import JointModel
from tofcapture_model.run_card import write_card
from tofcapture_model.runlog import Log, Position
from tofcapture_model.zoo import Model, build_model, compiled, select_stage, training_loss

SAVE_EVERY = 60.0  # s between resume points
LOG_EVERY = 20  # steps


@dataclass(frozen=True)
class Trained:
    """Result of :func:`train`: the checkpoint, steps done, whether all stages are finished, the last losses."""

    path: Path
    steps: int
    finished: bool
    losses: dict[str, float]


@contextmanager
def _processes() -> Iterator[tuple[int, int]]:
    """Join the group that ``torchrun`` announces in the environment; (rank, world)."""
    world = int(os.environ.get("WORLD_SIZE", "1"))
    if world == 1:
        yield 0, 1
        return
    torch.distributed.init_process_group("nccl" if torch.cuda.is_available() else "gloo")
    try:
        yield torch.distributed.get_rank(), world
    finally:
        torch.distributed.destroy_process_group()


def train(
    config: Config,
    dataset: Path,
    out: Path,
    *,
    epochs: int | None = None,
    minutes: float | None = None,
    stop_after: int | None = None,
    device: str = "cpu",
    workers: int = 0,
    cache: Path | None = None,
    start: Path | None = None,
    also: Sequence[Path] = (),
    report: Callable[[str, float, str], None] = lambda _what, _done, _text: None,
) -> Trained:
    """Train all stages of a configuration on the ``train`` split of a dataset.

    Running it again in the same folder goes on where it stopped; on one device, and without ``minutes``, to the same bits.

    Parameters
    ----------
    config
        Network, losses, stages.
    dataset
        Folder with ``manifest.json``.
    out
        Folder of the run: ``model.safetensors``, ``model.toml``, ``resume.safetensors``, ``metrics.jsonl``, TensorBoard events.
    epochs
        Of every stage, instead of the configuration's.
    minutes
        Budget of the whole run; stages share it by their epochs, schedules follow the clock.
    stop_after
        Stop, resumable, after so many steps in all.
    device
        Torch device; under ``torchrun`` with CUDA each process takes its own.
    workers
        Processes that read data; 0 keeps decoded frames in memory, up to half of what is free: best where they fit.
    cache
        Folder that ``tofcapture pack`` filled with the ``train`` split; ``None`` reads the shards.
    start
        Checkpoint to start from instead of random weights (fine-tuning); its network must be the configuration's.
    also
        Further datasets whose ``train`` splits are learned from; validation stays with the first.
    report
        Called with (stage, fraction done, one line of text).

    Returns
    -------
    Trained
    """
    if epochs is not None:
        config = replace(config, stages=tuple(replace(s, epochs=epochs) for s in config.stages))
    for each in (dataset, *also):
        load_manifest(each)  # says what is wrong with it, before anything is started
    with _processes() as (rank, world):
        place = torch.device(
            f"cuda:{os.environ['LOCAL_RANK']}" if world > 1 and torch.cuda.is_available() else device
        )
        torch.manual_seed(config.training.seed)
        model = build_model(config).to(place)
        source: dict[str, Any] = {"dataset": str(dataset), "manifest_sha256": _digest(dataset)}
        if also:
            source["also"] = {str(d): _digest(d) for d in also}  # and the digests of their manifests
        if start is not None:
            source |= {"start": str(start), "start_sha256": _begin_with(model, config, start)}
        key = _key(config, source, minutes)
        position, moments = _resume(out, model, key)
        if position.stage == len(config.stages):
            return Trained(out / "model.safetensors", position.step, finished=True, losses={})
        data = FrameDataset(
            [dataset, *also],
            "train",
            config.training.crop,
            flip=config.training.flip,
            seed=config.training.seed,
            frames=config.training.frames,
            mean=config.training.noise == "drawn",
            cache_bytes=0 if workers else spare_memory(),
            cache=cache,
        )
        log = Log(out if rank == 0 else None)
        losses: dict[str, float] = {}
        total_epochs = sum(s.epochs for s in config.stages)
        for position.stage in range(position.stage, len(config.stages)):  # noqa: B020  the position is the loop's state
            stage = config.stages[position.stage]
            budget = None if minutes is None else 60 * minutes * stage.epochs / total_epochs
            learning = select_stage(model, stage.name)
            names = {id(p): n for n, p in model.named_parameters()}
            optimizer = torch.optim.Adam(learning, lr=stage.learning_rate)
            _restore(optimizer, names, moments)
            wrapped = nn.parallel.DistributedDataParallel(model) if world > 1 else model
            half = torch.autocast(place.type, torch.bfloat16, enabled=config.training.precision == "bfloat16")
            called = compiled(wrapped, place) if config.training.compile else wrapped
            started, saved = time.monotonic() - position.elapsed, time.monotonic()
            while not _done(position, stage, budget):
                batches = epoch_batches(
                    len(data), config.training.batch, config.training.seed, position.epoch, rank, world
                )
                loader = DataLoader(
                    data, batch_sampler=batches[position.batch :], num_workers=workers, collate_fn=collate
                )
                for frame, target in loader:
                    progress = _progress(position, stage, len(batches), budget)
                    rate = _learning_rate(optimizer, stage, config.training.schedule, progress)
                    frame, target = frame_to(frame, place), target_to(target, place)  # noqa: PLW2901
                    drawn = _noise(position, config, place)
                    if data.mean:
                        frame = redraw_frame(frame, drawn, averaged=data.averaged)  # noqa: PLW2901
                    if config.training.phase_error:
                        frame = redraw_calibration(frame, drawn, config.training.phase_error)  # noqa: PLW2901
                    with half:
                        estimate = called(frame, stage.name)
                    estimate = Estimate(*(x.float() for x in estimate))
                    loss = training_loss(model, config.losses, stage.name, estimate, target, frame)
                    _expect_finite(float(loss.total.detach()), position, out)
                    optimizer.zero_grad(set_to_none=True)
                    loss.total.backward()  # type: ignore[no-untyped-call]
                    nn.utils.clip_grad_norm_(learning, 1.0)
                    optimizer.step()

                    position.step, position.batch = position.step + 1, position.batch + 1
                    position.elapsed = _elapsed(started, place, world)
                    if position.step % LOG_EVERY == 1:
                        losses = log.step(position, stage, loss, rate)
                        report(stage.name, progress, f"step {position.step} loss {losses['total']:.3f}")
                    stop = stop_after is not None and position.step >= stop_after
                    if rank == 0 and (stop or time.monotonic() - saved > SAVE_EVERY):
                        save_resume(
                            out / "resume.safetensors", model, optimizer, names, _state(position, key)
                        )
                        saved = time.monotonic()
                    if stop:
                        return Trained(
                            out / "resume.safetensors", position.step, finished=False, losses=losses
                        )
                    if budget is not None and position.elapsed >= budget:
                        break
                position.epoch, position.batch = position.epoch + 1, 0
                every = config.training.validate_every
                if rank == 0 and every and (_done(position, stage, budget) or position.epoch % every == 0):
                    log.validation(position, stage, _validate(model, dataset, place))
            position.before += position.elapsed
            position.epoch, position.elapsed, moments = 0, 0.0, {}
        position.stage = len(config.stages)
        data.close()
        if rank == 0:
            provenance: dict[str, Any] = {
                **source,
                "steps": position.step,
                "minutes": round(position.before / 60, 2),
                "losses": losses,
            }
            if isinstance(model, JointModel) and config.losses.uncertainty == "laplace":
                provenance["uncertainty"] = calibrate(model, dataset, place)
            provenance |= write_card(out, config, model, dataset, place, provenance, minutes)
            save_model(out / "model.safetensors", model, config, provenance)
            save_resume(out / "resume.safetensors", model, optimizer, names, _state(position, key))
        log.close()
        return Trained(out / "model.safetensors", position.step, finished=True, losses=losses)


def _expect_finite(loss: float, position: Position, out: Path) -> None:
    """Stop before a step that would spoil the weights."""
    if not math.isfinite(loss):
        raise DataError(
            f"{out}: expected a finite loss, got {loss} at step {position.step + 1}",
            hint="the last resume point is sound: check the dataset (tofcapture check), or lower the learning rate",
        )


def _noise(position: Position, config: Config, place: torch.device) -> torch.Generator:
    """Generator of a step: a resumed run draws what an unbroken one would have."""
    rank = int(os.environ.get("RANK", "0"))
    seed = f"{config.training.seed}/{position.stage}/{position.step}/{rank}"
    return torch.Generator(place).manual_seed(zlib.crc32(seed.encode()))


def _begin_with(model: Model, config: Config, start: Path) -> str:
    """Give the model the weights of a checkpoint; returns the checkpoint's digest."""
    other, its, _ = load_model(start)
    if its.network != config.network:
        raise ConfigError(
            f"{start}: expected weights of the configuration's network ({config.network.kind}), got {its.network.kind} with other sizes or kind",
            hint=f"--config {find_model(start).with_suffix('.toml')} has its configuration",
        )
    load_strictly(model, other.state_dict(), start)
    return sha256_of(find_model(start))


def _digest(dataset: Path) -> str:
    return sha256_of(Path(dataset) / "manifest.json")


def _key(config: Config, source: Mapping[str, Any], minutes: float | None) -> str:
    """Digest of all that decides what a run computes; a resume point of another run is refused."""
    begun = source.get("start_sha256", "") + "".join(source.get("also", {}).values())
    text = f"{dumps_config(config)}|{source['manifest_sha256']}|{minutes}{begun}"
    return hashlib.sha256(text.encode()).hexdigest()


def _state(position: Position, key: str) -> dict[str, Any]:
    return {"key": key, **position.__dict__}


def _resume(out: Path, model: Model, key: str) -> tuple[Position, dict[str, dict[str, Tensor]]]:
    """Load the resume point of a folder into the model, if there is one."""
    path = Path(out) / "resume.safetensors"
    if not path.exists():
        return Position(), {}
    weights, moments, state = load_resume(path)
    if state.pop("key", None) != key:
        raise ConfigError(
            f"{out}: holds a run with another configuration, dataset or budget",
            hint="choose another --out, or delete it",
        )
    load_strictly(model, weights, path)
    return Position(**state), moments


def _restore(
    optimizer: torch.optim.Adam, names: Mapping[int, str], moments: Mapping[str, dict[str, Tensor]]
) -> None:
    """Give Adam its moments back."""
    for group in optimizer.param_groups:
        for parameter in group["params"]:
            saved = moments.get(names[id(parameter)])
            if saved:
                kept = {
                    k: v if k == "step" else torch.empty_like(parameter).copy_(v) for k, v in saved.items()
                }
                optimizer.state[parameter] = kept


def _done(position: Position, stage: Stage, budget: float | None) -> bool:
    return position.epoch >= stage.epochs if budget is None else position.elapsed >= budget


def _elapsed(started: float, place: torch.device, world: int) -> float:
    """Seconds in this stage: those of the slowest process, so that all of them stop at the same step."""
    seconds = time.monotonic() - started
    if world == 1:
        return seconds
    slowest = torch.tensor(seconds, device=place, dtype=torch.float32)
    torch.distributed.all_reduce(slowest, torch.distributed.ReduceOp.MAX)
    return float(slowest)


def _progress(position: Position, stage: Stage, batches: int, budget: float | None) -> float:
    """Fraction of the stage that is done, by steps, or by the clock where there is a budget."""
    if budget is not None:
        return min(position.elapsed / budget, 1.0)
    return (position.epoch + position.batch / batches) / stage.epochs


def _learning_rate(optimizer: torch.optim.Adam, stage: Stage, schedule: str, progress: float) -> float:
    """Set and return the rate: constant, or a cosine to zero after a short warm-up (2 % of the stage)."""
    rate = stage.learning_rate
    if schedule == "cosine":
        rate *= min(1.0, 0.1 + progress / 0.02) * max(0.5 * (1 + math.cos(math.pi * progress)), 1e-3)
    for group in optimizer.param_groups:
        group["lr"] = rate
    return rate


def _validate(model: Model, dataset: Path, place: torch.device) -> dict[str, float]:
    """MAE (m) and mean angle (deg) on the first frames of the ``val`` split; empty where there is no such split."""
    if not load_manifest(dataset).split("val"):
        return {}
    data = FrameDataset(dataset, "val", frames=1)
    model.eval()
    table = score({"model": model_method(model)}, data, place)[0]["model"].table()
    model.train()
    data.close()
    if not table["depth"]["pixel"]["pixels"]:
        return {}
    return {"val_mae": table["depth"]["pixel"]["mae"], "val_angle_deg": table["normal"]["pixel"]["mean_deg"]}
