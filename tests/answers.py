"""Numbers and words that commands and pages answer with stay what they were: golden/answers/NAME.json holds them.

An answer may say more than it did. What it said, it says still: the same words, and the same numbers to a hundredth, for sums and
iterations round differently on other machines. ``GOLDEN=keep python -m pytest tests/test_x.py`` writes an answer that is meant to
change: look at the difference.
"""

import json
import math
import os
import re
from pathlib import Path

import numpy as np

KNOWN = Path(__file__).with_name("golden") / "answers"
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def hold(name, answer, *, off=1e-2, least=1e-9, without=(), names=()):
    """Hold an answer, a dictionary of JSON types, against the known one.

    Numbers may be ``off`` by this share, by ``least``, and by a thousandth of the largest of their list. Keys of ``without`` are of this run alone. ``names`` are pairs of a text
    of this run, such as a folder, and what stands for it.
    """
    text = json.dumps(answer, default=_plain)
    for own, word in names:
        text = text.replace(json.dumps(str(own))[1:-1], word)
    found = _less(json.loads(text), set(without))
    path = KNOWN / f"{name}.json"
    name = f"GOLDEN=keep if this is meant: {name}"
    if os.environ.get("GOLDEN") == "keep":
        KNOWN.mkdir(exist_ok=True)
        lines = [f"{json.dumps(k)}: {json.dumps(v, sort_keys=True)}" for k, v in sorted(found.items())]
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    _same(json.loads(path.read_text(encoding="utf-8")), found, name, off, least)


def of_page(html):
    """Words of a page as an answer, charts, pictures and digests apart."""
    text = re.sub(r"<(style|svg)\b.*?</\1>", "", html, flags=re.DOTALL)
    words = [w.strip() for w in re.split(r"<[^>]*>", text)]
    return {"words": [re.sub(r"\b[0-9a-f]{10,64}\b", "DIGEST", " ".join(w.split())) for w in words if w]}


def _plain(value):
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def _less(value, without):
    if isinstance(value, dict):
        return {k: _less(v, without) for k, v in value.items() if k not in without}
    return [_less(v, without) for v in value] if isinstance(value, list) else value


def _same(known, found, where, off, least):
    if isinstance(known, dict):
        assert isinstance(found, dict), where
        for key, value in known.items():
            assert key in found, f"{where}: {key} is not told any more"
            _same(value, found[key], f"{where}: {key}", off, least)
    elif isinstance(known, list):
        assert isinstance(found, list), where
        assert len(found) == len(known), f"{where}: {known} became {found}"
        largest = max((abs(x) for x in known if isinstance(x, float)), default=0.0)
        for i, (a, b) in enumerate(zip(known, found, strict=True)):
            _same(a, b, f"{where}[{i}]", off, max(least, 1e-3 * largest))
    elif isinstance(known, str) and isinstance(found, str) and len(known) < 2000:
        assert _NUMBER.sub("#", known) == _NUMBER.sub("#", found), f"{where}: {known!r} became {found!r}"
        for a, b in zip(_NUMBER.findall(known), _NUMBER.findall(found), strict=True):
            last = 0 if a == b else 1.01 * 10.0 ** -len(a.partition(".")[2])
            assert _near(float(a), float(b), off, max(least, last)), f"{where}: {known!r} became {found!r}"
    elif isinstance(known, float) or (
        isinstance(known, int) and known > 100
    ):  # large counts are measurements
        assert _near(known, found, off, least), f"{where}: {known} became {found}"
    else:
        assert known == found, f"{where}: {known!r} became {found!r}"


def _near(a, b, off, least):
    return math.isclose(a, b, rel_tol=off, abs_tol=least)
