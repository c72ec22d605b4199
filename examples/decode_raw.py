"""From phase images to depth, step by step: ``python decode_raw.py dataset/shards/mug.h5``."""

import sys

import numpy as np

import tofcapture
from tofcapture.ops.phase import Decoder, ambiguity, frequencies, mean_phasors, wrapped_range


def main(path: str) -> None:
    """Decode the first view's burst and compare with the depth in the shard."""
    with tofcapture.open_shard(path) as shard:
        info, view = shard.info, shard[0]
    raw, celsius, stored = view.raw, float(view.celsius.mean()), view.tof.depth  # (F, K, H, W)

    phasor = mean_phasors(
        raw, info.modulation_hz, info.phase_rad
    )  # (2, H, W): A exp(i phi), averaged as phasors
    for hz, P in zip(frequencies(info.modulation_hz), phasor, strict=True):
        span = wrapped_range(P, hz)
        print(f"{hz / 1e6:.0f} MHz: unique up to {ambiguity(hz):.2f} m, median range {np.median(span):.3f} m")

    depth = Decoder(info).burst(raw, celsius).depth
    both = np.isfinite(depth) & np.isfinite(stored)
    print(
        f"depth {np.median(depth[both]):.4f} m, median difference to the shard {1e3 * np.median(np.abs(depth - stored)[both]):.4f} mm"
    )


if __name__ == "__main__":
    main(sys.argv[1])
