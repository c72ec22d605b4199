"""Train a model: one loop, no callbacks. ``torchrun`` makes it run on many processes; a killed run goes on bit by bit."""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tofcapture.errors import ConfigError, DataError
from tofcapture.files.manifest import load_manifest
from tofcapture.files.seal import sha256_of
from tofcapture_model.config import Config, Stage, Training, dumps_config
from tofcapture_model.data.frames import FrameDataset, collate, epoch_batches, spare_memory
from tofcapture_model.evaluation.evaluate import calibrate, model_method, score
from tofcapture_model.networks.joint import JointModel
from tofcapture_model.networks.zoo import Model, build_model, compile_unets
from tofcapture_model.training.checkpoint import (
    find_model,
    load_model,
    load_resume,
    load_strictly,
    save_model,
    save_resume,
)
from tofcapture_model.training.learned import learned_from
from tofcapture_model.training.learner import Group, Learner, processes, scheduled_rate
from tofcapture_model.training.run_card import write_card
from tofcapture_model.training.runlog import Log, Position

SAVE_EVERY = 60.0  # s between resume points
LOG_EVERY = 20  # steps
LEAST_SHARE = 0.1  # of a budget in minutes, for each stage
Report = Callable[[str, float, str], None]


@dataclass(frozen=True)
class Trained:
    """Result of :func:`train`: the checkpoint, steps done, whether all stages are finished, the last losses."""

    path: Path
    steps: int
    finished: bool
    losses: dict[str, float]


@dataclass
class _Run:
    """A run on its way: what it trains, where, how far it is.

    Attributes
    ----------
    config, model, group
        What is trained, and by which processes.
    out, key
        Its folder, and the digest of all that decides what it computes.
    minutes
        Budget of all stages together; ``None``: their epochs count.
    position, moments
        How far it is; the optimiser's state there, until a stage has taken it over.
    losses
        The last that were logged.
    """

    config: Config
    model: Model
    group: Group
    out: Path
    key: str
    minutes: float | None
    position: Position
    moments: dict[str, dict[str, Tensor]]
    losses: dict[str, float]

    def budget(self, stage: Stage) -> float | None:
        """Seconds of a stage; stages share the budget by their epochs, but none gets much less than a tenth.

        Five of the paper's 695 epochs are thousands of steps; as a share of some minutes they would be a handful.
        """
        if self.minutes is None:
            return None
        shares = {
            s: max(s.epochs / sum(t.epochs for t in self.config.stages), LEAST_SHARE)
            for s in self.config.stages
        }
        return 60 * self.minutes * shares[stage] / sum(shares[s] for s in self.config.stages)

    def save(self, learner: Learner) -> None:
        """Write the resume point."""
        state = {"key": self.key, "losses": self.losses, **self.position.__dict__}
        save_resume(self.out / "resume.safetensors", self.model, learner.optimizer, learner.names, state)

    def ended(self, *, finished: bool) -> Trained:
        """Say what has become of the run."""
        name = "model.safetensors" if finished else "resume.safetensors"
        return Trained(self.out / name, self.position.step, finished=finished, losses=self.losses)


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
        Budget of the whole run; stages share it by their epochs, with a tenth or so for the shortest; schedules follow the clock.
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
    datasets = [dataset, *also]
    for each in datasets:
        load_manifest(each)  # says what is wrong with it, before anything is started
    with processes(device) as group:
        torch.manual_seed(config.training.seed)
        model = build_model(config).to(group.place)
        source = _source(datasets, _begin_with(model, config, start) if start else None)
        run = _open_run(config, model, group, out, source, minutes)
        if run.position.stage == len(config.stages):
            return run.ended(finished=True)
        if config.training.compile:
            compile_unets(model, group.place)
        data = _training_data(config.training, datasets, cache, workers)
        with closing(data), closing(Log(out if group.rank == 0 else None)) as log:
            for stage in config.stages[run.position.stage :]:
                learner = Learner(model, config, stage, group, run.moments)
                if not _train_stage(run, learner, data, log, dataset, stop_after, workers, report):
                    return run.ended(finished=False)
        if group.rank == 0:
            _finish(run, dataset, source)
            run.save(learner)
        return run.ended(finished=True)


def _training_data(
    training: Training, datasets: Sequence[Path], cache: Path | None, workers: int
) -> FrameDataset:
    return FrameDataset(
        datasets,
        "train",
        training.crop,
        flip=training.flip,
        seed=training.seed,
        frames=training.frames,
        mean=training.noise == "drawn",
        cache_bytes=0 if workers else spare_memory(),
        cache=cache,
    )


def _train_stage(
    run: _Run,
    learner: Learner,
    data: FrameDataset,
    log: Log,
    dataset: Path,
    stop_after: int | None,
    workers: int,
    report: Report,
) -> bool:
    """Train the stage that the run is in, from where it is to its end; false if ``stop_after`` came first."""
    position, group, stage, training = run.position, run.group, learner.stage, run.config.training
    budget = run.budget(stage)
    started, saved = time.monotonic() - position.elapsed, time.monotonic()
    while not _done(position, stage, budget):
        batches = epoch_batches(
            len(data), training.batch, training.seed, position.epoch, group.rank, group.world
        )
        left = batches[position.batch :]
        for frame, target in DataLoader(data, batch_sampler=left, num_workers=workers, collate_fn=collate):
            progress = _progress(position, stage, len(batches), budget)
            rate = scheduled_rate(stage, training.schedule, progress)
            loss = learner.loss(frame, target, data.burst, position)
            _expect_finite("loss", float(loss.total.detach()), position, run.out)
            _expect_finite("gradient", learner.gradient(loss), position, run.out)
            learner.step(rate)

            position.step, position.batch = position.step + 1, position.batch + 1
            position.elapsed = group.slowest(time.monotonic() - started)
            if position.step % LOG_EVERY == 1:
                run.losses = log.step(position, stage, loss, rate)
                report(stage.name, progress, f"step {position.step} loss {run.losses['total']:.3f}")
            stop = stop_after is not None and position.step >= stop_after
            if group.rank == 0 and (stop or time.monotonic() - saved > SAVE_EVERY):
                run.save(learner)
                saved = time.monotonic()
            if stop:
                return False
            if budget is not None and position.elapsed >= budget:
                break
        position.epoch, position.batch = position.epoch + 1, 0
        every = training.validate_every
        if group.rank == 0 and every and (_done(position, stage, budget) or position.epoch % every == 0):
            log.validation(position, stage, _validate(run.model, dataset, group.place))
    position.next_stage()
    run.moments = {}
    return True


def _finish(run: _Run, dataset: Path, source: Mapping[str, Any]) -> None:
    """Calibrate the uncertainty, write the run's card and the model."""
    place = run.group.place
    provenance: dict[str, Any] = {
        **source,
        "steps": run.position.step,
        "minutes": round(run.position.before / 60, 2),
        "losses": run.losses,
    }
    if isinstance(run.model, JointModel) and run.config.losses.uncertainty == "laplace":
        with _eagerly():
            provenance["uncertainty"] = calibrate(run.model, dataset, place)
    provenance |= write_card(run.out, run.config, run.model, dataset, place, provenance, run.minutes)
    save_model(run.out / "model.safetensors", run.model, run.config, provenance)


def _expect_finite(what: str, value: float, position: Position, out: Path) -> None:
    """Stop before a step that would spoil the weights."""
    if not math.isfinite(value):
        raise DataError(
            f"{out}: expected a finite {what}, got {value} at step {position.step + 1}",
            hint="check the dataset (tofcapture check); if it is sound, take a lower learning_rate and another --out",
        )


def _begin_with(model: Model, config: Config, start: Path) -> dict[str, Any]:
    """Give the model the weights of a checkpoint; returns where they are from, and what they have learned from."""
    other, its, provenance = load_model(start)
    if its.network != config.network:
        raise ConfigError(
            f"{start}: expected weights of the configuration's network ({config.network.kind}), got {its.network.kind} with other sizes or kind",
            hint=f"--config {find_model(start).with_suffix('.toml')} has its configuration",
        )
    load_strictly(model, other.state_dict(), start)
    begun = {"start": str(start), "start_sha256": sha256_of(find_model(start))}
    return begun | ({"learned": provenance["learned"]} if "learned" in provenance else {})


def _source(datasets: Sequence[Path], begun: Mapping[str, Any] | None) -> dict[str, Any]:
    """Name the datasets by their folders and the digests of their manifests, and all that is learned from, as far as it is known."""
    first, *also = datasets
    source: dict[str, Any] = {"dataset": str(first), "manifest_sha256": _digest(first), **(begun or {})}
    if also:
        source["also"] = {str(d): _digest(d) for d in also}
    if begun is None or "learned" in begun:
        source["learned"] = learned_from(datasets, source.get("learned"))
    return source


def _digest(dataset: Path) -> str:
    return sha256_of(Path(dataset) / "manifest.json")


def _key(config: Config, source: Mapping[str, Any], minutes: float | None, world: int) -> str:
    """Digest of all that decides what a run computes; a resume point of another run is refused."""
    begun = source.get("start_sha256", "") + "".join(source.get("also", {}).values())
    several = f"|{world} processes" if world > 1 else ""
    text = f"{dumps_config(config)}|{source['manifest_sha256']}|{minutes}{begun}{several}"
    return hashlib.sha256(text.encode()).hexdigest()


def _open_run(
    config: Config, model: Model, group: Group, out: Path, source: Mapping[str, Any], minutes: float | None
) -> _Run:
    """Begin a run, or go on with the one in its folder: loads its weights into the model.

    The first process reads it and tells the others, who may be on machines that do not see the folder.
    """
    out = Path(out)
    key = _key(config, source, minutes, group.world)
    weights, moments, state = group.shared(_resume_point(out, key) if group.rank == 0 else ({}, {}, {}))
    if not state:
        return _Run(config, model, group, out, key, minutes, Position(), {}, {})
    load_strictly(model, weights, out / "resume.safetensors")
    losses = state.pop("losses", {})
    return _Run(config, model, group, out, key, minutes, Position(**state), moments, losses)


def _resume_point(
    out: Path, key: str
) -> tuple[dict[str, Tensor], dict[str, dict[str, Tensor]], dict[str, Any]]:
    """Weights, Adam's moments and state of a run that is to go on; nothing where none was begun."""
    path = out / "resume.safetensors"
    if not path.exists():
        return {}, {}, {}
    weights, moments, state = load_resume(path)
    if state.pop("key", None) != key:
        raise ConfigError(
            f"{out}: holds a run with another configuration, dataset, budget or number of processes",
            hint="choose another --out, or delete it",
        )
    return weights, moments, state


def _done(position: Position, stage: Stage, budget: float | None) -> bool:
    return position.epoch >= stage.epochs if budget is None else position.elapsed >= budget


def _progress(position: Position, stage: Stage, batches: int, budget: float | None) -> float:
    """Fraction of the stage that is done, by steps, or by the clock where there is a budget."""
    if budget is not None:
        return min(position.elapsed / budget, 1.0)
    return (position.epoch + position.batch / batches) / stage.epochs


def _eagerly() -> AbstractContextManager[object]:
    """Answer whole frames without compiled U-Nets, which would be compiled for that size anew."""
    return torch.compiler.set_stance("force_eager")  # type: ignore[no-any-return]


def _validate(model: Model, dataset: Path, place: torch.device) -> dict[str, float]:
    """MAE (m) and mean angle (deg) on the first frames of the ``val`` split; empty where there is no such split."""
    if not load_manifest(dataset).split("val"):
        return {}
    data = FrameDataset(dataset, "val", frames=1)
    model.eval()
    with _eagerly():
        table = score({"model": model_method(model)}, data, place)[0]["model"].table()
    model.train()
    data.close()
    if not table["depth"]["pixel"]["pixels"]:
        return {}
    return {"val_mae": table["depth"]["pixel"]["mae"], "val_angle_deg": table["normal"]["pixel"]["mean_deg"]}
