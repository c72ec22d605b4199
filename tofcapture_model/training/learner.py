"""What learns in one stage of a training, and how it takes a step."""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from tofcapture.errors import ConfigError
from tofcapture_model.config import Config, Stage
from tofcapture_model.data.augment import BurstNoise, redraw_calibration, redraw_frame
from tofcapture_model.data.frame import Estimate, Frame, Target, frame_to, target_to
from tofcapture_model.losses.losses import Objective
from tofcapture_model.networks.zoo import Model, select_stage, training_loss
from tofcapture_model.training.runlog import Position

T = TypeVar("T")
WARM_UP = 0.02  # of a stage, with a cosine schedule
MAX_NORM = 1.0  # of the gradient


class Group(NamedTuple):
    """Which of the processes that train together this is, and the device that it has.

    Attributes
    ----------
    rank, world
        Of ``torchrun``; 0 and 1 for a single process.
    place
        Its device.
    """

    rank: int
    world: int
    place: torch.device

    def shared(self, value: T) -> T:
        """What the first process says, on all of them."""
        if self.world == 1:
            return value
        held = [value]
        torch.distributed.broadcast_object_list(held, src=0, device=self.place)
        return held[0]

    def slowest(self, seconds: float) -> float:
        """Most seconds of all processes, so that all of them stop at the same step."""
        if self.world == 1:
            return seconds
        most = torch.tensor(seconds, device=self.place, dtype=torch.float32)
        torch.distributed.all_reduce(most, torch.distributed.ReduceOp.MAX)
        return float(most)


@contextmanager
def processes(device: str) -> Iterator[Group]:
    """Join the group that ``torchrun`` announces in the environment; on ``cuda`` each process takes a GPU of its own.

    Raises
    ------
    ConfigError
        More processes on this machine than GPUs.
    """
    world, place = int(os.environ.get("WORLD_SIZE", "1")), torch.device(device)
    if place.type == "cuda":
        place = _own_gpu(place, world)
    if world == 1:
        yield Group(0, 1, place)
        return
    torch.distributed.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield Group(torch.distributed.get_rank(), world, place)
    finally:
        torch.distributed.destroy_process_group()


def _own_gpu(place: torch.device, world: int) -> torch.device:
    """The GPU of this process, made the current one: compiled kernels are launched there, wherever their tensors are."""
    index = int(os.environ["LOCAL_RANK"]) if world > 1 else place.index or 0
    if index >= torch.cuda.device_count():
        raise ConfigError(
            f"expected a GPU for every process, got process {index + 1} on {torch.cuda.device_count()}",
            hint="torchrun --nproc-per-node with the number of GPUs, or --device cpu",
        )
    torch.cuda.set_device(index)
    return torch.device("cuda", index)


class Learner:
    """The part of a model that learns in a stage, with its optimiser.

    Parameters
    ----------
    model, config, stage
        What is trained, and how.
    group
        The processes that train together.
    moments
        Adam's, by the parameter's name, of a run that goes on; empty at the start of a stage.
    """

    def __init__(
        self,
        model: Model,
        config: Config,
        stage: Stage,
        group: Group,
        moments: Mapping[str, dict[str, Tensor]],
    ) -> None:
        self.model, self.config, self.stage, self.group = model, config, stage, group
        self.parameters = select_stage(model, stage.name)
        self.names = {id(p): n for n, p in model.named_parameters()}
        self.optimizer = torch.optim.Adam(self.parameters, lr=stage.learning_rate)
        self._restore(moments)
        self._answer = nn.parallel.DistributedDataParallel(model) if group.world > 1 else model

    def _restore(self, moments: Mapping[str, dict[str, Tensor]]) -> None:
        for parameter in self.parameters:
            saved = moments.get(self.names[id(parameter)])
            if saved:
                self.optimizer.state[parameter] = {
                    k: v if k == "step" else torch.empty_like(parameter).copy_(v) for k, v in saved.items()
                }

    def loss(self, frame: Frame, target: Target, burst: BurstNoise | None, position: Position) -> Objective:
        """Answer a batch and hold it against the truth.

        Parameters
        ----------
        frame, target
            On any device.
        burst
            Of whose frames each item is the mean; their noise is drawn again then. ``None``: items are single frames and stay as they are.
        position
            Seeds what is drawn: a resumed run draws what an unbroken one would have.
        """
        training, place = self.config.training, self.group.place
        frame, target = frame_to(frame, place), target_to(target, place)
        drawn = self._generator(position)
        if burst:
            frame = redraw_frame(frame, drawn, burst)
        if training.phase_error:
            frame = redraw_calibration(frame, drawn, training.phase_error)
        with torch.autocast(place.type, torch.bfloat16, enabled=training.precision == "bfloat16"):
            estimate = self._answer(frame, self.stage.name)
        estimate = Estimate(*(x.float() for x in estimate))
        return training_loss(self.model, self.config.losses, self.stage.name, estimate, target, frame)

    def _generator(self, position: Position) -> torch.Generator:
        seed = f"{self.config.training.seed}/{position.stage}/{position.step}/{self.group.rank}"
        return torch.Generator(self.group.place).manual_seed(zlib.crc32(seed.encode()))

    def gradient(self, loss: Objective) -> float:
        """Gradient of a loss, clipped; returns the norm that it had."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.total.backward()  # type: ignore[no-untyped-call]
        return float(nn.utils.clip_grad_norm_(self.parameters, MAX_NORM))

    def step(self, rate: float) -> None:
        """Follow the gradient."""
        for parameters in self.optimizer.param_groups:
            parameters["lr"] = rate
        self.optimizer.step()


def scheduled_rate(stage: Stage, schedule: str, progress: float) -> float:
    """Learning rate at a fraction of a stage: constant, or a cosine to zero after a short warm-up."""
    if schedule != "cosine":
        return stage.learning_rate
    cosine = max(0.5 * (1 + math.cos(math.pi * progress)), 1e-3)
    return stage.learning_rate * min(1.0, 0.1 + progress / WARM_UP) * cosine
