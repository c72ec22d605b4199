"""Latency of one frame: decode and network, by backend, on two threads.

    python benchmarks/predict.py [--preset compact] [--weights RUN] [--repeats 20]

240 x 180 raw to 480 x 360 depth, normals and uncertainty, after loading. Wall and CPU time, medians, backends in turns.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from tofcapture.frames import TofInfo
from tofcapture_model.checkpoint import find_model, load_model, save_model
from tofcapture_model.config import preset
from tofcapture_model.data import batched, make_frame
from tofcapture_model.export import export
from tofcapture_model.frame import Estimate, Frame
from tofcapture_model.joint import JointModel
from tofcapture_model.onnx_backend import ask_onnx, open_onnx
from tofcapture_model.predict import has_bfloat16
from tofcapture_model.raw_input import NOMINAL_CAMERA
from tofcapture_model.zoo import build_model


def raw_frame() -> np.ndarray:
    """(8, 180, 240) uint16 of a wall at about a metre."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[0:180, 0:240]
    distance = 1.0 + 0.001 * u + 0.0005 * v
    phase = np.stack(
        [4 * np.pi * f * distance / 299792458.0 + k * np.pi / 2 for f in (20e6, 100e6) for k in range(4)]
    )
    return np.rint(600 + 300 * np.cos(phase) + rng.normal(0, 5, phase.shape)).astype(np.uint16)


def in_half(model: JointModel, frame: Frame) -> Estimate:
    """Answer as `predict` does with a network that was trained in bfloat16."""
    with torch.autocast("cpu", torch.bfloat16):
        return model(frame)


def main() -> None:
    """Print one line per stage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="compact")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    info, raw = TofInfo("benchmark", "", NOMINAL_CAMERA, np.zeros(3)), raw_frame()
    with tempfile.TemporaryDirectory() as folder:
        weights = args.weights
        if weights is None:
            config = preset(args.preset)
            weights = save_model(Path(folder) / "model.safetensors", build_model(config), config, {})
        model, _, _ = load_model(weights)
        frame = batched(make_frame(raw, info, NOMINAL_CAMERA))
        calls = {
            "decode and cues": lambda: make_frame(raw, info, NOMINAL_CAMERA),
            "network, torch": lambda: model(frame),
        }
        if has_bfloat16("cpu"):
            calls["network, torch, bfloat16"] = lambda: in_half(model, frame)
        try:
            out = Path(folder) / "model.onnx"
            export(find_model(weights), out)
            session = open_onnx(out)
            calls["network, onnx"] = lambda: ask_onnx(session, frame)
        except Exception as err:
            print(f"onnx: {err}")
        wall: dict[str, list[float]] = {name: [] for name in calls}
        cpu: dict[str, list[float]] = {name: [] for name in calls}
        with torch.inference_mode():
            for _ in range(args.repeats + 2):
                for name, call in calls.items():
                    started, used = time.perf_counter(), time.process_time()
                    call()
                    wall[name].append(1000 * (time.perf_counter() - started))
                    cpu[name].append(1000 * (time.process_time() - used))
    for name in calls:
        print(
            f"{name:16} {np.median(wall[name][2:]):7.1f} ms (fastest {min(wall[name]):.1f}; cpu {np.median(cpu[name][2:]):.1f})"
        )


if __name__ == "__main__":
    main()
