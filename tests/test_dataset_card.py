"""The card says what the data tell; the Croissant description is valid JSON-LD of the same files."""

from __future__ import annotations

import json

import pytest

from tests.test_files_shard import write
from tofcapture.dataset.card import CONTEXT, card_text, write_card
from tofcapture.files.check import check
from tofcapture.files.manifest import Manifest, SceneEntry, load_manifest, manifest_path, write_manifest
from tofcapture.files.seal import sha256_of
from tofcapture.files.shard import ShardReader

SECTIONS = ("Motivation", "Composition", "Collection", "Preprocessing", "Uses", "Distribution", "Maintenance")


def make(folder, scenes=("box", "mug", "gear-2"), **kwargs):
    """A dataset of random arrays with card and description."""
    entries = {}
    for i, scene in enumerate(scenes):
        digest = write(folder / f"shards/{scene}.h5", (10 * i, 10 * i + 1), scene, **kwargs)
        entries[scene] = SceneEntry(f"shards/{scene}.h5", digest, 2, "test" if i == 0 else "train")
    manifest = Manifest(entries, {"far": 2.0}, {"tofcapture": "0"})
    write_manifest(folder, manifest)
    write_card(folder, manifest, None)
    return folder


def test_the_card_is_a_datasheet(tmp_path):
    """Every section, the counts, the manifest's digest; nothing left to fill in."""
    text = (make(tmp_path / "first") / "README.md").read_text(encoding="utf-8")
    assert [s for s in SECTIONS if f"\n## {s}\n" not in text] == []
    assert "6 views of 3 scenes, 3 ToF frames each" in text
    assert "| train | 2 | 4 |" in text
    assert sha256_of(manifest_path(tmp_path / "first")) in text
    assert "far = 2.0" in text
    assert "Simulated" in text
    assert "{" not in text.replace('ShardReader("shards/box.h5")', "")
    measured = make(tmp_path / "second", exact=False) / "README.md"
    assert "Simulated" not in measured.read_text(encoding="utf-8")


def test_the_numbers_of_the_card_are_those_of_the_data(tmp_path):
    """Sizes, channels, bytes, the error of ground truth and the share of good pixels are said as they are."""
    folder = make(tmp_path / "first")
    manifest = load_manifest(folder)
    gt = {"median_error_mm": 0.126, "p99_error_mm": 1.504, "coverage": 0.876}
    text = card_text(folder, manifest, gt)
    sizes, good, views = 0, 0, 0
    for entry in manifest.scenes.values():
        sizes += (folder / entry.path).stat().st_size
        with ShardReader(folder / entry.path) as shard:
            (H, W), (SH, SW) = shard.camera.shape, shard.rig.stereo.shape
            counted = [v["good_pixels"] for v in shard.provenance.get("views", ())]
            good, views = good + sum(counted), views + len(counted)
            hz = sorted(set(shard.info.modulation_hz))
            channels = f"{shard.frames} frames of {len(shard.info.modulation_hz)} phase images"
    assert f"({W} x {H})" in text
    assert f"({SW} x {SH})" in text
    assert f"{channels} at {hz[0] / 1e6:g} and {hz[1] / 1e6:g} MHz" in text
    assert f"{sizes / 1e6:.2f} MB in all; 3 objects by name" in text
    assert "median 0.13 mm, 99 % within 1.50 mm, good on 88% of the object's pixels" in text
    bare = {"median_error_mm": 0.126, "p99_error_mm": None, "coverage": None}
    assert "more than 1 % where there is no surface, no object is in it" in card_text(folder, manifest, bare)
    assert (f"{good / (4 * H * W * views):.0%}" if views else "An unknown share") in text
    assert "Its error is not known" in card_text(folder, manifest, None)


def test_card_and_description_name_the_scales(tmp_path):
    """Ground truth at 4x is listed where it was built, and only there."""
    for scales, words in (((1, 2), "1x and 2x"), ((1, 2, 4), "1x, 2x and 4x")):
        folder = make(tmp_path / f"{len(scales)}", scales=scales)
        text = (folder / "README.md").read_text(encoding="utf-8")
        assert f"`/gt/mask_*`: ground truth at {words}, and" in text
        assert f"onto the ToF plane at {words}." in text
        about = json.loads((folder / "croissant.json").read_text(encoding="utf-8"))["description"]
        assert ("ground truth at 1x, 2x and 4x (" in about) == (4 in scales)


def test_the_description_holds_the_manifest_and_every_shard(tmp_path):
    """Digests are those of the files; scenes and splits are rows of its record set; check finds nothing amiss in it."""
    folder = make(tmp_path / "data")
    table = json.loads((folder / "croissant.json").read_text(encoding="utf-8"))
    for entry in table["distribution"]:
        assert sha256_of(folder / entry["contentUrl"]) == entry["sha256"]
    assert {f["contentUrl"] for f in table["distribution"]} == {
        "manifest.json",
        *(f"shards/{s}.h5" for s in ("box", "mug", "gear-2")),
    }
    rows = {r["scenes/name"]: r["scenes/split"] for r in table["recordSet"][0]["data"]}
    assert rows == {"box": "test", "gear-2": "train", "mug": "train"}
    assert table["@context"] == CONTEXT
    assert not [p for p in check(folder) if p.path.name == "croissant.json"]


def test_croissants_own_library_takes_it(tmp_path):
    """mlcroissant finds no error, and reads the scenes back."""
    mlc = pytest.importorskip("mlcroissant", reason="mlcroissant is not installed")
    dataset = mlc.Dataset(make(tmp_path / "data") / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors
    names = {r["scenes/name"] for r in dataset.records("scenes")}
    assert names == {"box", "mug", "gear-2"}
