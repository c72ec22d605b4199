"""Pictures that people look at stay what they were: small copies lie in golden/pictures, and no part may differ visibly.

A copy is the picture's mean over squares of eight pixels, so other versions of libraries pass, and a line or a word that has moved
does not. Where a picture is meant to change, ``GOLDEN=keep python -m pytest tests/test_x.py`` writes its copies anew: look at them.
"""

import base64
import os
import re
from pathlib import Path

import cv2
import numpy as np

KNOWN = Path(__file__).with_name("golden") / "pictures"
SQUARE = 8  # pixels
TOLERANCE = 12  # of 255; an edge that moves by a pixel changes 32


def small(image):
    """Means over squares of a picture (H, W) or (H, W, 3), uint8."""
    image = np.asarray(image, dtype=np.float64)[..., : (3 if np.ndim(image) == 3 else None)]
    fill = [(0, -size % SQUARE) for size in image.shape[:2]]
    padded = np.pad(image, [*fill, (0, 0)][: image.ndim], mode="edge")
    H, W = padded.shape[0] // SQUARE, padded.shape[1] // SQUARE
    return np.rint(padded.reshape(H, SQUARE, W, SQUARE, *padded.shape[2:]).mean(axis=(1, 3))).astype(np.uint8)


def hold(name, images):
    """Hold pictures against their small copies, or write these."""
    paths = [KNOWN / f"{name}-{i}.png" for i in range(len(images))]
    copies = [small(image) for image in images]
    if os.environ.get("GOLDEN") == "keep":
        KNOWN.mkdir(exist_ok=True)
        for path in KNOWN.glob(f"{name}-[0-9]*.png"):
            path.unlink()
        for path, copy in zip(paths, copies, strict=True):
            assert cv2.imwrite(str(path), copy[..., ::-1] if copy.ndim == 3 else copy)
    assert sorted(KNOWN.glob(f"{name}-[0-9]*.png")) == sorted(paths), f"another number of pictures: {name}"
    for path, copy in zip(paths, copies, strict=True):
        known = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        known = known[..., ::-1] if known.ndim == 3 else known
        assert known.shape == copy.shape, path.name
        apart = np.abs(known.astype(int) - copy)
        row, column = np.unravel_index(apart.argmax(), apart.shape)[:2]
        assert apart.max() <= TOLERANCE, (
            f"GOLDEN=keep if this is meant: {path.name} differs at {SQUARE * column}, {SQUARE * row}"
        )


def of_page(html):
    """Pictures inside a page, as pixels."""
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    decoded = [
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR) for data in found
    ]
    return [image[..., ::-1] for image in decoded]


def watch_matplotlib(monkeypatch):
    """List the pixels of every figure that is saved from now on, in whatever format."""
    from matplotlib.figure import Figure

    seen, save = [], Figure.savefig

    def watched(figure, *args, **kwargs):
        save(figure, *args, **kwargs)
        figure.canvas.draw()
        seen.append(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())

    monkeypatch.setattr(Figure, "savefig", watched)
    return seen
