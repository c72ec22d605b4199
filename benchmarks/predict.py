"""Latency of one frame: decode and network, by backend, on two threads or a GPU; throughput of batches.

    python benchmarks/predict.py [--preset NAME | --weights RUN] [--repeats 20] [--batch 8] [--device cuda]

240 x 180 raw to 480 x 360 depth, normals and uncertainty, after loading, by the bundled network, a run's or an untrained preset's. Wall
and CPU time, medians, backends in turns. Throughput comes with its share of peak: operations of convolutions and matrix products
per second, over those of one large matrix product in the same precision, run beside it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from tofcapture.frames import TofInfo
from tofcapture_model.config import preset
from tofcapture_model.data import batched, frame_decoder, make_frame
from tofcapture_model.data.raw_input import NOMINAL_CAMERA, RawInput
from tofcapture_model.frame import Frame, frame_to
from tofcapture_model.inference.export import ask_onnx, export, open_onnx
from tofcapture_model.inference.predict import Ask, has_bfloat16, predict_raw, recorded, torch_model
from tofcapture_model.networks import build_model
from tofcapture_model.networks.checkpoint import find_model, load_checkpoint, save_model


def raw_frame() -> np.ndarray:
    """(8, 180, 240) uint16 of a wall at about a metre."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[0:180, 0:240]
    distance = 1.0 + 0.001 * u + 0.0005 * v
    phase = np.stack(
        [4 * np.pi * f * distance / 299792458.0 + k * np.pi / 2 for f in (20e6, 100e6) for k in range(4)]
    )
    return np.rint(600 + 300 * np.cos(phase) + rng.normal(0, 5, phase.shape)).astype(np.uint16)


def seconds(call, device: str, repeats: int) -> float:
    """Median time of a call, after three that do not count."""
    times = []
    for _ in range(repeats + 3):
        started = time.perf_counter()
        call()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - started)
    return float(np.median(times[3:]))


def throughput(ask: Ask, frame: Frame, batch: int, device: str, repeats: int) -> str:
    """Frames per second through the network as `predict` runs it, of a batch that lies on the device with its cues, and the share of peak."""
    kind = torch.device(device).type
    many = frame_to(Frame(*(x.expand(batch, *x.shape[1:]).contiguous() for x in frame)), torch.device(device))
    half = has_bfloat16(kind)
    with FlopCounterMode(display=False) as counter:
        ask(many)
    launch = ask if kind == "cpu" else recorded(ask, many)
    taken = seconds(lambda: launch(many), device, repeats)
    side, precision = 2048 if kind == "cpu" else 8192, torch.bfloat16 if half else torch.float32
    a, b = torch.randn(2, side, side, device=device).to(precision)
    peak = 2 * side**3 / seconds(lambda: a @ b, device, repeats)
    operations = counter.get_total_flops()
    return (
        f"batch of {batch}: {batch / taken:.1f} frames/s, {operations / batch / 1e9:.1f} GFLOP each, "
        f"{operations / taken / 1e12:.2f} of {peak / 1e12:.2f} TFLOP/s that a matrix product of {side} reaches: "
        f"{operations / taken / peak:.1%} of peak ({precision})"
    )


def main() -> None:
    """Print one line per stage."""
    parser = argparse.ArgumentParser(description=__doc__)
    network = parser.add_mutually_exclusive_group()
    network.add_argument("--preset")
    network.add_argument("--weights", type=Path)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    info, raw = TofInfo("benchmark", "", NOMINAL_CAMERA, np.zeros(3)), raw_frame()
    with tempfile.TemporaryDirectory() as folder:
        weights = args.weights
        if args.preset:
            config = preset(args.preset)
            weights = save_model(Path(folder) / "model.safetensors", build_model(config), config, {})
        model, _, _ = load_checkpoint(weights)
        ask, *_ = torch_model(weights, args.device)
        decoder = frame_decoder(info, NOMINAL_CAMERA)
        frame = batched(make_frame(raw, info, NOMINAL_CAMERA, decoder=decoder))
        if args.device != "cpu":
            burst = RawInput(raw[None], np.full(1, np.nan), info, NOMINAL_CAMERA)
            found = predict_raw(burst, 0, weights, args.device, timed=True)
            print(
                f"{args.device}: copy of the taps {found.decode_ms:.2f} ms, decoding, cues and network {found.inference_ms:.2f} ms"
            )
            with torch.inference_mode():
                print(throughput(ask, frame, args.batch, args.device, args.repeats))
            return
        calls = {
            "decode and cues": lambda: make_frame(raw, info, NOMINAL_CAMERA, decoder=decoder),
            "network, float32": lambda: model(frame),
        }
        if has_bfloat16("cpu"):
            calls["network as predict runs it"] = lambda: ask(frame)
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
            print(throughput(ask, frame, args.batch, "cpu", 3))
    for name in calls:
        print(
            f"{name:26} {np.median(wall[name][2:]):7.1f} ms (fastest {min(wall[name]):.1f}; cpu {np.median(cpu[name][2:]):.1f})"
        )


if __name__ == "__main__":
    main()
