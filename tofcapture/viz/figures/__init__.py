"""Draw figures for papers and slides from data: the same input gives the same bytes.

::

    write_figure("depth", Path("datasets/first"), Path("depth.pdf"), Choice(rows=3))
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tofcapture.errors import UsageError
from tofcapture.viz.page import METADATA, canvas, save


@dataclass(frozen=True)
class Choice:
    """Hold what of a path is drawn: scene and view (``None``: the first, or as many scenes as there may be rows).

    ``view`` is the number in the file's name or in the shard, ``prediction`` a folder that ``predict`` wrote or one of such
    folders named by scene, ``rig`` a ``rig.toml`` to use instead of the recording's.
    """

    scene: str | None = None
    view: int | None = None
    rows: int = 4
    prediction: Path | None = None
    rig: Path | None = None


def write_figure(kind: str, path: Path, out: Path, choice: Choice) -> str:
    """Draw a figure 1200 pixels wide; returns what is on it, in words.

    ``acquisition`` takes a recording, ``preprocessing`` a view file or a recording, ``depth`` and ``normals`` a dataset or a
    shard. A ``.png``, ``.pdf`` or ``.svg`` that exists is replaced, and left alone when drawing fails.

    Raises :class:`UsageError`: the ending is unknown; :class:`DataError`, :class:`FormatError`: the data are
    missing, damaged, or not what this kind of figure shows.
    """
    from tofcapture.viz.figures.acquisition import draw_acquisition
    from tofcapture.viz.figures.preprocessing import draw_preprocessing
    from tofcapture.viz.figures.scenes import draw_rows, read_rows

    form = out.suffix.removeprefix(".").lower()
    if form not in METADATA:
        raise UsageError(f"{out}: expected a name that ends in .png, .pdf or .svg", hint="--out figure.png")
    with canvas() as figure:
        if kind == "acquisition":
            words = draw_acquisition(figure, path, choice.scene, choice.view)
        elif kind == "preprocessing":
            words = draw_preprocessing(figure, path, choice.scene, choice.view, choice.rig)
        else:
            rows = read_rows(path, choice.scene, choice.view or 0, choice.rows, choice.prediction)
            words = draw_rows(figure, kind, rows)
        save(figure, out, form)
    return words
