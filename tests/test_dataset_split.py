"""Splits by object."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from tofcapture.dataset.split import TINY, assign_splits
from tofcapture.files.manifest import object_of

STEMS = st.sampled_from(
    ["mug", "box", "gear", "random", "text", "blob", "tool", "plate", "cup", "bowl", "steps", "stack"]
)
NAMES = st.lists(
    st.builds("{}-{}".format, STEMS, st.integers(1, 3)) | STEMS, min_size=2, max_size=25, unique=True
)


@given(NAMES)
@settings(max_examples=60, deadline=None)
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
@settings(max_examples=30, deadline=None)
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
