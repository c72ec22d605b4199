"""Every network that a configuration can name, behind one interface: build it, choose what learns, hold it against the truth."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tofcapture.errors import ConfigError
from tofcapture_model.config import Config, Losses
from tofcapture_model.frame import Estimate, Frame, Target
from tofcapture_model.geometry.maps import scale_intrinsics
from tofcapture_model.losses import Objective, objective
from tofcapture_model.networks.baselines import Baseline
from tofcapture_model.networks.baselines.coarse_fine import CoarseFine
from tofcapture_model.networks.baselines.guo2018 import MRM
from tofcapture_model.networks.baselines.su2018 import ToFNet
from tofcapture_model.networks.joint import CompactModel, JointModel, PaperModel
from tofcapture_model.networks.unet import UNet

Model = JointModel | Baseline
_LEAST_SHARE = 0.2  # of delta that a sensor's error is taken for
_WRAPPED = 0.3  # m by which a depth is wrong that was unwrapped wrongly

PARTS = {
    "depth": ("raw2depth", "error_map"),
    "normal": ("raw2normal",),
    "refine": ("refinement",),
    "joint": ("backbone", "raw2depth", "error_map", "raw2normal", "refinement"),
}


def build_model(config: Config) -> Model:
    """Build the model of a configuration, in channels-last memory order (a third faster on CPU)."""
    network = config.network
    build: dict[str, Callable[[], Model]] = {
        "paper": lambda: PaperModel(network),
        "compact": lambda: CompactModel(network),
        "su2018": lambda: ToFNet(network.width),
        "guo2018": MRM,
        "coarse-fine": CoarseFine,
    }
    return build[network.kind]().to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def compile_unets(model: Model, device: torch.device) -> None:
    """Compile the U-Nets of a model in place (``training.compile``); names and values of its weights stay.

    Plane fits and losses stay as they are: compiling a whole model was not done after 400 s.

    Raises :class:`ConfigError`: the model has no U-Net, or PyTorch would find no C++ compiler for a CPU.
    """
    compiler = os.environ.get("CXX", "g++")
    if device.type == "cpu" and shutil.which(compiler) is None:
        raise ConfigError(
            f"training.compile: expected the C++ compiler {compiler}, found none",
            hint="install g++, name one in CXX, or leave compile = false",
        )
    nets = [module for module in model.modules() if isinstance(module, UNet)]
    if not nets:
        raise ConfigError(
            f"training.compile: expected a network of U-Nets (paper, compact), got {type(model).__name__}",
            hint="leave compile = false",
        )
    for net in nets:
        net.compile()


def select_stage(model: Model, stage: str) -> list[nn.Parameter]:
    """Freeze all parameters but those that learn in ``stage``; return these. All of a baseline learn in its only stage."""
    for name, parameter in model.named_parameters():
        learns = isinstance(model, Baseline) or name.split(".")[0] in PARTS[stage]
        # A refinement of no rounds has empty gains
        parameter.requires_grad_(learns and parameter.numel() > 0)
    return [p for p in model.parameters() if p.requires_grad]


def training_loss(
    model: Model, weights: Losses, stage: str, estimate: Estimate, target: Target, frame: Frame
) -> Objective:
    """Compute what a step lowers: the paper's losses for our model, a baseline's own for a baseline.

    ``estimate`` and ``target`` are at (2H, 2W); ``frame`` (B, ., H, W) is what the model read.
    """
    if isinstance(model, Baseline):
        loss = model.loss(estimate, target, frame)
        return Objective(loss, {"depth": loss}, torch.zeros(7))
    target, inverse = _weighed(target, frame, weights.delta)
    share = None if weights.reweight else inverse  # lambda of eq. 1 is the paper's own weight
    return objective(weights, stage, estimate, target, scale_intrinsics(frame.intrinsics, 2), share)


def _weighed(target: Target, frame: Frame, delta: float) -> tuple[Target, Tensor]:
    """Leave out what was measured a wrap away, and let an image count by the inverse of its sensor's error, (B, 1, 1, 1).

    No network moves a depth by a wrap, and one such pixel outweighs hundreds. A camera of centimetres must not outweigh ten of
    millimetres: what counts is the share of its sensor's error that a network leaves.
    """
    decoded, valid = (F.interpolate(x, scale_factor=2, mode="nearest") for x in (frame.depth, frame.valid))
    wrong = (decoded - target.depth).abs()
    near = (valid == 0) | (wrong < _WRAPPED)
    good = target.good & near
    mean = (wrong.clamp_max(_WRAPPED) * good).sum((1, 2, 3), keepdim=True) / good.sum(
        (1, 2, 3), keepdim=True
    ).clamp_min(1)
    return target._replace(good=good, context=target.context & near), 1 / (mean / delta).clamp_min(
        _LEAST_SHARE
    )
