"""Train a model: forward, loss, backward, step. ``torchrun`` makes it run on many processes."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from tofcapture.cli.kit import Report
from tofcapture.files.manifest import load_manifest
from tofcapture_model.config import Config, Stage, preset
from tofcapture_model.data import FrameDataset, batched, spare_memory
from tofcapture_model.data.augment import redraw_calibration, redraw_frame
from tofcapture_model.data.conditions import seen_by
from tofcapture_model.evaluation.evaluate import calibrate
from tofcapture_model.frame import Estimate, Frame, frame_to
from tofcapture_model.losses import Objective
from tofcapture_model.networks import Model, build_model, compile_unets, select_stage, training_loss
from tofcapture_model.networks.checkpoint import find_model, save_model
from tofcapture_model.networks.joint import CompactModel, JointModel
from tofcapture_model.training import (
    Group,
    Moments,
    Position,
    Run,
    Trained,
    eagerly,
    held,
    processes,
    source_of,
)
from tofcapture_model.training.card import write_card

WARM_UP = 0.02  # of a stage, with a cosine schedule
MAX_NORM = 1.0  # of the gradient
_UNCALIBRATED = 0.15  # share of frames of a camera that nobody calibrated
_UNCALIBRATED_RAD = (0.01, 0.1)  # its error, from a sine's to a square wave's
_CONVOLUTION = 4  # axes of its weight
_FULL_PACE = 288  # inputs: two maps of compact's width under 3 x 3 weights
_REMEMBERED = 300  # samples whose values a network remembers as familiar


def train(
    config: Config | str,
    dataset: str | Path,
    out: str | Path,
    *,
    epochs: int | None = None,
    minutes: float | None = None,
    stop_after: int | None = None,
    device: str = "cpu",
    workers: int = 0,
    cache: str | Path | None = None,
    start: str | Path | None = None,
    also: Sequence[str | Path] = (),
    report: Report = lambda _what, _done, _total, _text="": None,
) -> Trained:
    """Train all stages of a configuration on the ``train`` split of a dataset.

    Running it again in the same folder goes on where it stopped; on one device, and without ``minutes``, to the same bits.

    Raises :class:`ConfigError`: the folder holds another run or cannot be written, or ``start`` another
    network; :class:`BusyError`: another process trains in the folder; :class:`DataError`: a split is empty,
    or a loss is not finite: no step is taken then.

    Parameters
    ----------
    config
        Network, losses, stages; or the name of a preset.
    dataset, also
        Folders with ``manifest.json``: the first, which also validates, and further ones to learn from.
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
        Checkpoint, or ``bundled``, to start from instead of random weights (fine-tuning); its network must be the configuration's.
    report
        Called with the stage, what is done of it, all of it, and one line of text.
    """
    config = preset(config) if isinstance(config, str) else config
    if epochs is not None:
        config = replace(config, stages=tuple(replace(s, epochs=epochs) for s in config.stages))
    datasets = [Path(dataset), *map(Path, also)]
    for each in datasets:
        load_manifest(each)  # says what is wrong with it, before anything is started
    out = Path(out)
    with processes(device) as group, held(out, group):
        torch.manual_seed(config.training.seed)
        model = build_model(config).to(group.device)
        source = source_of(model, config, datasets, None if start is None else find_model(start))
        run = Run(config, model, group, datasets[0], out, source, minutes, report)
        if run.position.stage == len(config.stages):
            return run.ended()
        if config.training.compile:
            compile_unets(model, group.device)
        training = config.training
        data = FrameDataset(
            datasets, "train", training.crop, flip=training.flip, seed=training.seed, frames=training.frames,
            mean=training.noise == "drawn", cache_bytes=0 if workers else spare_memory(), cache=None if cache is None else Path(cache),
        )  # fmt: skip
        with closing(data), run:
            if source.get("start") is None or source.get(
                "seen"
            ):  # else nobody knows what the first weights had seen
                source["seen"] = seen_by(data, source.get("seen"))
            for stage in config.stages[run.position.stage :]:
                learner = Learner(model, config, stage, group, run.moments)
                for frame, target in run.batches(data, stage, workers):
                    seen = learner.augmented(frame, run.position)
                    estimate = learner.forward(seen)
                    loss = training_loss(model, config.losses, stage.name, estimate, target, seen)
                    run.expect_finite("loss", float(loss.total.detach()))
                    run.expect_finite("gradient", learner.backward(loss))
                    rate = scheduled_rate(stage, training.schedule, run.progress)
                    learner.step(rate)
                    run.stepped(stage, loss, rate)
                    stop = stop_after is not None and run.position.step >= stop_after
                    run.save_now_and_then(learner.moments(), now=stop)
                    if stop:
                        return run.ended()
            if isinstance(model, CompactModel):
                _remember(model, data, group.device)
        if group.rank == 0:
            _finish(run, {**source, "idle": learner.idle()})
            run.save_now_and_then(learner.moments(), now=True)
        return run.ended()


class Learner:
    """The part of a model that learns in a stage, with its optimiser and, of a run that goes on, Adam's moments."""

    def __init__(
        self, model: Model, config: Config, stage: Stage, group: Group, moments: Moments | None = None
    ) -> None:
        self.training, self.stage, self.group = config.training, stage, group
        self.parameters = select_stage(model, stage.name)
        groups = [{"params": [p], "pace": _pace(model, p)} for p in self.parameters]
        self.optimizer = torch.optim.Adam(groups, lr=stage.learning_rate)
        self._names = {id(p): n for n, p in model.named_parameters()}
        self._network = nn.parallel.DistributedDataParallel(model) if group.world > 1 else model
        for parameter in self.parameters:
            if saved := (moments or {}).get(self._names[id(parameter)]):
                self.optimizer.state[parameter] = {
                    k: v if k == "step" else torch.empty_like(parameter).copy_(v) for k, v in saved.items()
                }

    def augmented(self, frame: Frame, position: Position) -> Frame:
        """Draw the noise of means of bursts anew, and another calibration where the configuration asks for it.

        The position seeds what is drawn: a resumed run draws what an unbroken one would have.
        """
        seed = f"{self.training.seed}/{position.stage}/{position.step}/{self.group.rank}"
        drawn = torch.Generator(self.group.device).manual_seed(zlib.crc32(seed.encode()))
        if self.training.noise == "drawn":
            frame = redraw_frame(frame, drawn)
        if self.training.phase_error:
            size = (len(frame.depth), 1, 1, 1)
            nobody = torch.rand(size, generator=drawn, device=self.group.device) < _UNCALIBRATED
            low, high = map(math.log, _UNCALIBRATED_RAD)
            error = (low + (high - low) * torch.rand(size, generator=drawn, device=self.group.device)).exp()
            radians = torch.where(nobody, error, self.training.phase_error)
            frame = redraw_calibration(frame, drawn, radians)
        return frame

    def forward(self, frame: Frame) -> Estimate:
        """Answer a batch, in float32 whatever the precision of the convolutions."""
        reduced = self.training.precision == "bfloat16"
        with torch.autocast(self.group.device.type, torch.bfloat16, enabled=reduced):
            estimate = self._network(frame, self.stage.name)
        return Estimate(*(x.float() for x in estimate[:-1]))  # no loss asks for trust

    def backward(self, loss: Objective) -> float:
        """Compute the gradient of a loss and clip it; returns the norm that it had."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        return float(nn.utils.clip_grad_norm_(self.parameters, MAX_NORM))

    def step(self, rate: float) -> None:
        """Follow the gradient."""
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = rate * parameters["pace"]
        self.optimizer.step()

    def idle(self) -> list[str]:
        """Name the weights of the stage that no gradient reached in the last step: a layer whose units died learns nothing more."""
        still = [p for p in self.parameters if p.grad is None or not bool(p.grad.any())]
        return [self._names[id(p)] for p in still]

    def moments(self) -> Moments:
        """Return Adam's moments by the parameter's name."""
        return {self._names[id(p)]: values for p, values in self.optimizer.state.items()}


def _pace(model: Model, parameter: Tensor) -> float:
    """Tell by how much slower a weight learns: Adam moves all by as much, and the sum of many should not move by more.

    By the inverse of how many inputs are summed, after Yang and Hu (2021); a transposed convolution is taken by its outputs. The published networks
    have one rate, as published.
    """
    if not isinstance(model, CompactModel) or parameter.ndim < _CONVOLUTION:
        return 1.0
    return min(1.0, _FULL_PACE / parameter[0].numel())


def scheduled_rate(stage: Stage, schedule: str, progress: float) -> float:
    """Return the learning rate at a fraction of a stage: constant, or a cosine to zero after a short warm-up."""
    if schedule != "cosine":
        return stage.learning_rate
    cosine = max(0.5 * (1 + math.cos(math.pi * progress)), 1e-3)
    return stage.learning_rate * min(1.0, 0.1 + progress / WARM_UP) * cosine


def _remember(model: CompactModel, data: FrameDataset, device: torch.device) -> None:
    """Show a network once more some of what it learned from, so that it knows what is strange to it."""
    some = range(0, len(data), math.ceil(len(data) / _REMEMBERED))
    frames = (frame_to(batched(data[(0, i)][0]), device) for i in some)
    model.inputs.remember(model.inputs(frame).image for frame in frames)


def _finish(run: Run, source: Mapping[str, Any]) -> None:
    """Calibrate the uncertainty, write the run's card and the model."""
    minutes = round(run.position.before / 60, 2)
    known: dict[str, Any] = {**source, "steps": run.position.step, "minutes": minutes, "losses": run.losses}
    if isinstance(run.model, JointModel) and run.config.losses.uncertainty == "laplace":
        with eagerly():
            known["uncertainty"] = calibrate(run.model, run.dataset, run.group.device)
    known |= write_card(run.out, run.config, run.model, run.dataset, run.group.device, known, run.minutes)
    save_model(run.out / "model.safetensors", run.model, run.config, known)
