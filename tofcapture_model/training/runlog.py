"""Where a training run is, and what it says on the way: ``metrics.jsonl`` and TensorBoard."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tofcapture_model.config import Stage
from tofcapture_model.losses.losses import Objective


@dataclass
class Position:
    """Where a run is; everything in it goes into the resume point.

    Attributes
    ----------
    stage, epoch, batch
        The next batch to take.
    step
        Steps done, over all stages.
    elapsed
        Seconds of training in this stage, over all sittings.
    before
        Seconds of the stages before this one.
    """

    stage: int = 0
    epoch: int = 0
    batch: int = 0
    step: int = 0
    elapsed: float = 0.0
    before: float = 0.0

    def next_stage(self) -> None:
        """Go to the start of the next stage."""
        self.stage, self.epoch, self.batch = self.stage + 1, 0, 0
        self.before, self.elapsed = self.before + self.elapsed, 0.0


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Rows of a ``metrics.jsonl`` by step; a line that a kill cut short is skipped, of two for a step the later counts."""
    if not path.is_file():
        return []
    rows: dict[tuple[int, bool], dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
            rows[int(row["step"]), "total" in row] = row
        except (ValueError, KeyError, TypeError):
            continue
    return [rows[key] for key in sorted(rows)]


class Log:
    """``metrics.jsonl`` always, TensorBoard where it is installed; silent for processes that are not the first."""

    def __init__(self, out: Path | None) -> None:
        self._file, self._board = None, None
        if out is None:
            return
        out.mkdir(parents=True, exist_ok=True)
        self._file = (out / "metrics.jsonl").open("a", encoding="utf-8")
        try:
            from torch.utils.tensorboard import SummaryWriter
        except ImportError:
            return
        self._board = SummaryWriter(str(out / "tensorboard"))

    def _write(self, step: int, row: Mapping[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps({"step": step, **row}) + "\n")
            self._file.flush()
        for name, value in row.items():
            if isinstance(value, float) and self._board is not None:
                self._board.add_scalar(name, value, step)

    def step(self, position: Position, stage: Stage, loss: Objective, rate: float) -> dict[str, float]:
        """Log one step; return its losses."""
        losses = {
            "total": float(loss.total.detach()),
            **{k: float(v.detach()) for k, v in loss.parts.items()},
        }
        row: dict[str, Any] = {
            "stage": stage.name,
            "epoch": position.epoch,
            "seconds": position.elapsed,
            "rate": rate,
        }
        if "chamfer" in losses:
            row["winners"] = loss.winners.tolist()
        self._write(position.step, row | losses)
        return losses

    def validation(self, position: Position, stage: Stage, values: Mapping[str, float]) -> None:
        """Log a validation."""
        if values:
            self._write(position.step, {"stage": stage.name, "epoch": position.epoch, **values})

    def close(self) -> None:
        """Close the files."""
        if self._file is not None:
            self._file.close()
        if self._board is not None:
            self._board.close()
