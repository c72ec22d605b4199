"""Look at a source before it is imported: how every array is read, and a first ``import.toml``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofcapture.channels import channels_in_words
from tofcapture.errors import TofError
from tofcapture.frames import View
from tofcapture.importing.overlap import Overlap
from tofcapture.importing.plan import Planned, plan
from tofcapture.importing.rules import SATURATION, metres
from tofcapture.importing.said import Facts, Said
from tofcapture.importing.views import make_view
from tofcapture.meshes import UNITS


@dataclass(frozen=True)
class Looked:
    """Say how one view would be imported."""

    planned: Planned
    view: View
    overlap: Overlap

    def row(self) -> tuple[str, ...]:
        """Say it in the cells of a table: view, raw, size, ground truth, its kind, overlap, difference."""
        raw, truth = self.planned.pieces[0].name, self.overlap.model
        several = len(self.planned.pieces) - (self.planned.truth is not None)
        frames, K, H, W = self.view.tof.raw.shape
        return (
            f"{self.view.scene} {self.view.index}",
            raw if several == 1 else f"{raw} and {several - 1} more",
            f"{frames} x {K} x {H} x {W} {self.view.tof.raw.dtype}",
            self.planned.pieces[-1].name if self.planned.truth else "-",
            truth,
            f"{self.overlap.share:.0%}",
            "-" if np.isnan(self.overlap.difference) else f"{1e3 * self.overlap.difference:+.1f}",
        )


def look(source: Path, said: Said) -> list[Looked]:
    """Read a source as an import would, and write nothing; raises as :func:`tofcapture.importing.views.import_data` does."""
    return [Looked(view, *make_view(view, said)) for view in plan(source, said)]


def guess(source: Path) -> str:
    """Write a first ``import.toml`` from what a source shows; what it does not show stands there to be filled in."""
    found: list[Planned] = []
    trouble = ""
    try:
        found = plan(source, Said())
    except TofError as err:
        trouble = f"# {err.message}\n# try: {err.hint}\n"
    raw = found[0].raw() if found else None
    H, W = raw.shape[-2:] if raw is not None else (0, 0)
    facts = found[0].facts if found else Facts()
    hz, phases = Said().channels(facts)
    known = facts.camera
    pixels = (
        "".join(f"{k} = {getattr(known, k)}\n" for k in ("fx", "fy", "cx", "cy"))
        if known
        else f"# the lens is not in these files: replace the numbers\n# fx = {W}.0\n# fy = {W}.0\n# cx = {(W - 1) / 2}\n# cy = {(H - 1) / 2}\n"
    )
    most = float(np.abs(raw).max()) if raw is not None else 0.0
    bits = max(int(np.ceil(np.log2(most + 1))), 1) if most > 1 else 12
    saturation = SATURATION if most <= SATURATION else 2.0**bits - 1
    head = f"# {len(found)} views in {len({v.scene for v in found})} scenes\n" if found else trouble
    tof = (
        f"[tof]\n{f'width = {W}{chr(10)}height = {H}{chr(10)}' if H else ''}{pixels}"
        f"# {channels_in_words(hz, phases)}\n"
        f"modulation_mhz = {[round(f / 1e6, 6) for f in hz]}\n"
        f"phase_deg = {[round(float(p), 6) for p in np.degrees(phases)]}\n"
        f"saturation = {facts.saturation or saturation:g}\n"
    )
    return f"{head}\n{tof}\n{_guessed_truth(found)}"


def _guessed_truth(found: list[Planned]) -> str:
    """Guess the unit of ground truth: the first in which its median is one of a room."""
    if not found:
        return '# [truth]\n# kind = "depth"\n# unit = "m"\n'
    target = next((v for v in found if v.truth is not None), None)
    if target is None or target.truth is None:
        return '[truth]\nkind = "none"\n'
    values = target.truth()
    depth = values[..., 2] if values.ndim == 3 and values.shape[-1] == 3 else values
    for unit in ("m", "mm", "cm"):
        try:
            middle = float(np.nanmedian(metres(depth, unit, (), target.pieces[-1].name)))
        except TofError:
            continue
        if middle < 10:
            kind = "points" if values.ndim == 3 else "depth"
            return f'# {target.pieces[-1].name}: {values.dtype} {values.shape}, a median of {middle:.3g} m\n[truth]\nkind = "{kind}"\nunit = "{unit}"\n'
    return f'[truth]\n# {target.pieces[-1].name}: {values.dtype} {values.shape}\nunit = "m"  # one of {", ".join(UNITS)}\n'
