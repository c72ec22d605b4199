"""The formats are pinned: what they say, and what a file of each held when it was written."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from tofcapture.errors import FormatError
from tofcapture.files.check import check
from tofcapture.files.layout import MASK_DOCS, SHARD, VIEW, MaskBit, formats_markdown
from tofcapture.files.seal import digest_path, sha256_of
from tofcapture.files.shard import ShardReader
from tofcapture.frames import TofFlag
from tofcapture.ops.phase import Decoder

GOLDEN = Path(__file__).parent / "golden"


def contents(path):
    """Digest of every dataset's bytes, by name."""
    found = {}

    def visit(name, thing):
        if isinstance(thing, h5py.Dataset):
            found[name] = hashlib.sha256(thing[()].tobytes()).hexdigest()[:16]

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


def test_a_golden_shard_holds_what_it_held():
    """Plain h5py opens it; datasets and bytes are those that were pinned, by the layout's names; check finds nothing."""
    path = GOLDEN / "shard-v1/mug.h5"
    assert contents(path) == json.loads((GOLDEN / "shard.json").read_text(encoding="utf-8"))
    fields = {f.path for f in SHARD if not f.path.endswith("_4x")}
    assert contents(path).keys() == {path for path in fields if not path.startswith("fused/")}
    with h5py.File(path) as file:
        assert (file.attrs["format"], file.attrs["version"]) == (SHARD.format, SHARD.version)
        assert {name for name, _, _ in SHARD.attrs} == set(file.attrs)
    assert path.stat().st_size < 100_000
    assert check(path) == []


def test_a_golden_burst_decodes_to_its_flags():
    """What the shard says of its pixels is what the decoder says of its burst.

    Its frequencies contradict each other by half a wrap: which pixels fly then depends on what neighbours decide.
    """
    with ShardReader(GOLDEN / "shard-v1/mug.h5") as shard:
        frames = range(shard.frames)
        for view in range(shard.views):
            raw = np.stack([shard.raw(view, f) for f in frames])
            celsius = float(np.mean([shard.celsius(view, f) for f in frames]))
            stored, found = shard.tof(view).flags, Decoder(shard.info).burst(raw, celsius).flags
            np.testing.assert_array_equal(stored | TofFlag.FLYING, found | TofFlag.FLYING)


def test_another_version_is_refused_with_advice(tmp_path):
    """A file of a version that this one does not know is not guessed at."""
    for name in ("mug.h5", "mug.sha256"):
        shutil.copy(GOLDEN / "shard-v1" / name, tmp_path / name)
    path = tmp_path / "mug.h5"
    path.chmod(0o644)
    with h5py.File(path, "a") as file:
        file.attrs["version"] = 2
    digest_path(path).write_text(f"{sha256_of(path)}  {path.name}\n")
    with pytest.raises(FormatError, match="expected tofcapture-shard version 1, got 2") as info:
        ShardReader(path).views  # noqa: B018
    assert "upgrade" in info.value.hint
    assert [(p.where, p.hint) for p in check(path)] == [("version", "upgrade tofcapture")]


def test_the_formats_page_is_fresh():
    """docs/formats.md is what the layouts print."""
    page = Path(__file__).parents[1] / "docs/formats.md"
    assert page.read_text(encoding="utf-8") == formats_markdown(), (
        "python -m tofcapture.files.layout > docs/formats.md"
    )


def test_the_layouts_are_pinned():
    """Changing a dataset's path, dtype or shape needs a new version number; a new optional one, as an older reader passes over it, a new line here."""

    def summary(layout):
        return {f.path: f"{'|'.join(f.dtypes)} {' '.join(f.dims)}{' ?' * f.optional}".strip() for f in layout}

    arm = {"joints": "float64 J", "T_base_flange": "float64 4 4", "time_ns": "int64"}
    assert (VIEW.format, VIEW.version) == ("tofcapture-view", 1)
    assert summary(VIEW) == {
        "tof/raw": "uint16|int16|float64 F K H W",
        "tof/time_ns": "int64 F",
        "tof/celsius": "float64 F",
        "stereo/points": "float32 SH SW 3",
        "stereo/time_ns": "int64",
        **{f"arm/{when}/{name}": text for when in ("before", "after") for name, text in arm.items()},
        "truth/depth": "float32 2H 2W ?",
        "truth/normals": "float32 2H 2W 3 ?",
        "truth/target": "bool 2H 2W ?",
        "truth/T_tof_stereo": "float64 4 4 ?",
        "truth/T_flange_tof": "float64 4 4 ?",
    }
    assert (SHARD.format, SHARD.version) == ("tofcapture-shard", 1)
    assert summary(SHARD) == {
        "tof/raw": "uint16|int16|float64 N F K H W",
        "tof/celsius": "float64 N F",
        "tof/time_ns": "int64 N F",
        "tof/depth": "float32 N H W",
        "tof/confidence": "float32 N H W",
        "tof/flags": "uint8 N H W",
        "gt/native_depth": "float32 N SH SW",
        "gt/depth_1x": "float32 N H W",
        "gt/normals_1x": "float32 N H W 3",
        "gt/mask_1x": "uint8 N H W",
        "gt/depth_2x": "float32 N 2H 2W",
        "gt/normals_2x": "float32 N 2H 2W 3",
        "gt/mask_2x": "uint8 N 2H 2W",
        "gt/depth_4x": "float32 N 4H 4W ?",
        "gt/normals_4x": "float32 N 4H 4W 3 ?",
        "gt/mask_4x": "uint8 N 4H 4W ?",
        **{f"fused/sigma_{s}x": f"float32 N {d}H {d}W ?" for s, d in ((1, ""), (2, "2"), (4, "4"))},
        **{f"fused/views_{s}x": f"int8 N {d}H {d}W ?" for s, d in ((1, ""), (2, "2"), (4, "4"))},
        "views/T_base_tof": "float64 N 4 4",
        "views/index": "int64 N",
        "truth/depth_2x": "float32 N 2H 2W ?",
        "truth/normals_2x": "float32 N 2H 2W 3 ?",
    }
    assert {b.name: b.value for b in MaskBit} == {
        "NOT_HIT": 1,
        "OCCLUDED": 2,
        "GRAZING": 4,
        "EDGE": 8,
        "OUTSIDE": 16,
    }
    assert set(MASK_DOCS) == set(MaskBit)
