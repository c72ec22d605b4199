"""Splits by object."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.files.manifest import TINY, assign_splits, object_of

STEMS = st.sampled_from(
    ["mug", "box", "gear", "random", "text", "blob", "tool", "plate", "cup", "bowl", "steps", "stack"]
)
NAMES = st.lists(
    st.builds("{}-{}".format, STEMS, st.integers(1, 3)) | STEMS, min_size=2, max_size=25, unique=True
)


@given(NAMES)
@settings(max_examples=60)
def test_no_object_is_in_two_splits_and_both_ends_exist(names):
    """Scenes of one object share a split; with two objects or more there is something to train and to test on."""
    splits = assign_splits(names)
    objects = {}
    for name, split in splits.items():
        assert objects.setdefault(object_of(name), split) == split
    if len(objects) > 1:
        assert {"train", "test"} <= set(splits.values())
    assert assign_splits(reversed(names)) == splits


@given(NAMES, NAMES)
@settings(max_examples=30)
def test_adding_scenes_moves_nobody(names, more):
    """From ten objects on, a scene stays where it is whatever is added, unless the test set was empty."""
    base = [f"{n}{i}x" for i in range(30) for n in ("aa", "bb")] + names
    before, after = assign_splits(base), assign_splits({*base, *more})
    assert all(after[name] == split for name, split in before.items())


def test_the_shares_are_as_promised():
    """Of 2000 objects 80, 10 and 10 % go to train, val and test."""
    splits = list(assign_splits(f"o{i}x" for i in range(2000)).values())
    assert abs(splits.count("train") / 2000 - 0.8) < 0.03
    assert abs(splits.count("test") / 2000 - 0.1) < 0.03


def test_tiny_datasets_have_one_object_to_test_on():
    """Three objects: two train, one tests; the same ones every time. One object trains."""
    splits = assign_splits(["mug", "box", "gear", "gear-2"])
    assert splits == assign_splits(["gear-2", "gear", "box", "mug"])
    assert sorted(splits[n] for n in ("mug", "box", "gear")) == ["test", "train", "train"]
    assert splits["gear"] == splits["gear-2"]
    assert assign_splits(["mug", "mug-2"]) == {"mug": "train", "mug-2": "train"}
    assert TINY == 10


SETS = st.dictionaries(
    st.builds("{}-{}x".format, STEMS, st.integers(1, 30)),
    st.lists(STEMS, max_size=3),
    min_size=2,
    max_size=25,
)


@given(SETS)
@settings(max_examples=60)
def test_scenes_that_share_an_object_share_a_split(sets):
    """No object that a scene is known to show is in two splits, whatever chains of scenes tie objects together."""
    splits = assign_splits(sets, sets)
    homes = {}
    for scene, names in sets.items():
        for name in names:
            assert homes.setdefault(name, splits[scene]) == splits[scene]
    assert assign_splits(sorted(sets, reverse=True), sets) == splits


def test_adding_scenes_with_objects_moves_few():
    """Of 500 scenes with two objects out of 800 each, 50 more move only those whose group got a new first object."""
    sets = {f"s{i}x": [f"o{i}y", f"o{i + (i % 5 == 0)}y"] for i in range(550)}
    few = dict(list(sets.items())[:500])
    before, after = assign_splits(few, few), assign_splits(sets, sets)
    assert sum(before[s] != after[s] for s in few) <= 2
    assert set(after.values()) == {"train", "val", "test"}


def test_without_objects_names_decide_as_before():
    """A scene whose objects are not known is split by its name, beside others whose objects are."""
    names = [f"o{i}x" for i in range(40)]
    assert assign_splits(names, {names[0]: []}) == assign_splits(names)
    tied = assign_splits(names, {names[0]: ["cup"], names[1]: ["cup"], names[2]: ["o0x"]})
    assert tied[names[0]] == tied[names[1]] == tied[names[2]]
