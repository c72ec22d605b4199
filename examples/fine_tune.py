"""Go on from given weights on data of your own: ``python fine_tune.py dataset weights.safetensors out 200``."""

import sys
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from tofcapture_model.checkpoint import load_model, save_model
from tofcapture_model.data import FrameDataset, collate, epoch_batches
from tofcapture_model.zoo import select_stage, training_loss

RATE = 1e-4  # a tenth of what training from nothing starts with
STAGE = "joint"


def main(dataset: str, weights: str, out: str, steps: str = "200") -> None:
    """Train all parts for some steps and write a checkpoint for evaluate and predict."""
    model, config, provenance = load_model(Path(weights))
    model.train()
    optimizer = torch.optim.Adam(select_stage(model, STAGE), lr=RATE)
    training = config.training
    data = FrameDataset(Path(dataset), "train", training.crop, flip=training.flip, seed=training.seed)
    step = epoch = 0
    while step < int(steps):
        batches = epoch_batches(len(data), training.batch, training.seed, epoch)
        for frame, target in DataLoader(data, batch_sampler=batches, collate_fn=collate):
            loss = training_loss(model, config.losses, STAGE, model(frame, STAGE), target, frame)
            optimizer.zero_grad(set_to_none=True)
            loss.total.backward()
            optimizer.step()
            step += 1
            if step >= int(steps):
                break
        epoch += 1
    Path(out).mkdir(parents=True, exist_ok=True)
    path = save_model(
        Path(out) / "model.safetensors", model.eval(), config, {**provenance, "fine_tuned_on": dataset}
    )
    print(f"{step} steps, loss {float(loss.total):.4f}: {path}")


if __name__ == "__main__":
    main(*sys.argv[1:])
