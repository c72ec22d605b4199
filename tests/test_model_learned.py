"""What a checkpoint remembers of its training scenes, and what an evaluation makes of it."""

from __future__ import annotations

import shutil

import pytest

pytest.importorskip("torch")

from tests.analytic import make_dataset
from tofcapture.files.manifest import load_manifest
from tofcapture_model.networks.checkpoint import find_model, learned_from, load_checkpoint, not_new, sentence

TOLD = (["mug", "lid"], ["s001-bowl"], ["lid"])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two training scenes and a test scene with a lid that one of them holds, too."""
    folder = tmp_path_factory.mktemp("learned") / "dataset"
    return make_dataset(folder, views=1, frames=1, scale=8, objects=TOLD)


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """Other scenes: a bowl of the same number and another seed, a plate, a mug."""
    folder = tmp_path_factory.mktemp("learned") / "other"
    names = (["s001-bowl"], ["plate"], ["mug", "plate"])
    return make_dataset(folder, views=1, frames=1, scale=8, seed=50, objects=names, splits=("test",) * 3)


def test_objects_and_shards_of_the_training_split_are_remembered(dataset):
    """Names that a seed numbers say nothing in another dataset; digests do."""
    found = learned_from([dataset])
    assert found["objects"] == ["lid", "mug"]
    entries = load_manifest(dataset).split("train")
    assert found["shards"] == sorted(entry.sha256[:12] for entry in entries.values())


def test_the_same_object_is_found_in_another_dataset(dataset, other):
    """By its name; a new object and the bowl of another seed are new."""
    known = {"learned": learned_from([dataset])}
    assert not_new(known, other, "test") == {"scene-2": "object mug"}
    assert not_new(known, dataset, "test") == {"scene-2": "object lid"}
    assert not_new(known, dataset, "train") == dict.fromkeys(("scene-0", "scene-1"), "the same shard")


def test_what_the_first_weights_knew_stays_known(dataset, other):
    """Fine-tuning on another dataset forgets nothing."""
    first = learned_from([dataset])
    second = {"learned": learned_from([other], before=first)}  # has no train split
    assert second["learned"] == first
    assert not_new(second, dataset, "test") == {"scene-2": "object lid"}


def test_scenes_without_told_objects_go_by_their_names(dataset, tmp_path):
    """Recorded scenes: mug-1 and mug-2 are one object; so it is where only a cache is left of the shards."""
    recorded = make_dataset(tmp_path / "recorded", views=1, frames=1, scale=8, seed=9)
    assert learned_from([recorded])["objects"] == ["scene"]
    shutil.copytree(dataset, tmp_path / "packed", ignore=shutil.ignore_patterns("*.h5"))
    assert learned_from([tmp_path / "packed"])["objects"] == ["scene"]


def test_it_is_said_in_words(dataset):
    """Nothing about new scenes, the scene and the reason of others, and that it is not known where it is not."""
    assert sentence("ours", {}, 3) == ""
    assert (
        sentence("ours", {"scene-2": "object lid"}, 3)
        == "ours: 1 of 3 scenes are not new to it: scene-2 (object lid)"
    )
    assert "and 2 more" in sentence("ours", {f"s-{i}": "object x" for i in range(7)}, 9)
    assert not_new({}, dataset, "test") is None
    assert "not known" in sentence("ours", None, 3)


def test_the_bundled_network_tells_what_it_learned_from():
    """And those meshes that its card is measured on are not among it."""
    learned = load_checkpoint(None)[2]["learned"]
    assert {"ycb_036_wood_block", "ycb_029_plate"} <= set(learned["objects"])
    measured = {
        "ycb_016_pear",
        "ycb_055_baseball",
        "ycb_028_skillet_lid",
        "ycb_022_windex_bottle",
        "c3d_spot",
    }
    assert not measured & set(learned["objects"])
    card = (find_model(None).parent / "MODEL_CARD.md").read_text(encoding="utf-8")
    assert f"all {len(learned['shards'])} training shards and {len(learned['objects'])} shapes" in card
