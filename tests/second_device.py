"""A second device on a machine that has none: its tensors hold the host's data, and whoever mixes the two is told, as on a GPU.

``python -m tests.second_device DATASET OUT`` trains, validates, evaluates and measures there. It has no autocast and no random numbers of
its own; both are taken away before. What it shows is that nothing stays behind on the host.
"""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "gpu"
_COPIES = {"_to_copy", "copy_", "_copy_from", "set_"}
_INDEXING = {
    "index",
    "index_put",
    "index_put_",
    "_unsafe_index",
}  # of the device's tensors, may be by the host's


class There(torch.Tensor):
    """A tensor of the second device."""

    @staticmethod
    def __new__(cls, held):
        return torch.Tensor._make_wrapper_subclass(
            cls,
            held.size(),
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=torch.device(NAME, 0),
            requires_grad=False,
        )

    def __init__(self, held):
        self.held = held

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class Watched(TorchDispatchMode):
    """Sees factories, too, which take no tensor."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


class Here(torch.Generator):
    """Draws on the host: the second device draws no numbers of its own."""

    def __new__(cls, _device=None):
        return super().__new__(cls)


def _run(func, args, kwargs):
    leaves = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there = any(isinstance(x, There) for x in leaves)
    here = any(not isinstance(x, There) and x.dim() > 0 for x in leaves)  # numbers may come from anywhere
    name = func.overloadpacket.__name__
    if there and here and name not in _COPIES and not (name in _INDEXING and isinstance(args[0], There)):
        raise RuntimeError(f"{name}: expected all tensors on one device, got {NAME}:0 and cpu")
    kwargs = dict(kwargs)
    goes_there = there
    if kwargs.get("device") is not None:
        goes_there = torch.device(kwargs["device"]).type == NAME
        kwargs["device"] = torch.device("cpu")
    if "pin_memory" in kwargs:
        kwargs["pin_memory"] = False
    known = {}

    def unwrap(x):
        if isinstance(x, There):
            known[id(x.held)] = x
            return x.held
        return x

    def wrap(x):
        if not isinstance(x, torch.Tensor) or isinstance(x, There):
            return x
        return known.get(id(x), There(x) if goes_there else x)  # what works in place returns its own

    return tree_map(wrap, func(*tree_map(unwrap, args), **tree_map(unwrap, kwargs)))


def main(dataset: Path, out: Path) -> None:
    """Train with validation and drawn noise, evaluate, measure a suite."""
    _setup_privateuseone_for_python_backend(NAME)
    torch.autocast = lambda *_, **__: nullcontext()

    from tofcapture_model.config import Stage, preset
    from tofcapture_model.evaluation.evaluate import evaluate
    from tofcapture_model.evaluation.suite import run_suite
    from tofcapture_model.training.train import train

    torch.Generator = Here
    demo = preset("demo")
    drawn = replace(demo.training, batch=1, crop=(48, 64), noise="drawn", phase_error=0.003, validate_every=1)
    weights = {}
    with Watched():
        for kind in ("compact", "su2018", "guo2018", "coarse-fine"):
            config = preset(kind)
            small = replace(config.network, width=4, levels=2) if kind == "compact" else config.network
            stages = (Stage("joint" if kind == "compact" else "depth", 1, 1e-3),)
            config = replace(config, network=small, training=drawn, stages=stages)
            weights[kind] = [train(config, dataset, out / kind, device=NAME).path]
        evaluate(dataset, weights["compact"][0], out / "results.json", device=NAME)
        run_suite(dataset, "main", weights, out / "suite" / "results.json", frames=1, device=NAME)
    print("all on one device")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
