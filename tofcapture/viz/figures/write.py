"""Figures for papers and slides, drawn from data by matplotlib: the same input gives the same bytes.

::

    write_figure("depth", Path("datasets/first"), Path("depth.pdf"), Choice(rows=3))
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from tofcapture.errors import UsageError
from tofcapture.files.seal import replacing
from tofcapture.viz.figures.table import DPI, Kind

KINDS: tuple[str, ...] = get_args(Kind)
METADATA: dict[str, dict[str, None]] = {
    "png": {"Software": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    "svg": {"Date": None, "Creator": None},
}
"""What matplotlib would write of the day and of itself, by format."""


@dataclass(frozen=True)
class Choice:
    """What of a path is drawn.

    Attributes
    ----------
    scene
        Name; ``None``: the first one, or as many as there are rows.
    view
        In a recording the number in the view's file name; in a shard the number in the shard. ``None``: the first.
    rows
        Largest number of scenes.
    prediction
        Folder that ``predict`` wrote, or one of such folders, named by scene.
    rig
        ``rig.toml`` to use instead of the recording's.
    """

    scene: str | None = None
    view: int | None = None
    rows: int = 4
    prediction: Path | None = None
    rig: Path | None = None


def write_figure(kind: str, path: Path, out: Path, choice: Choice) -> str:
    """Draw a figure 1200 pixels wide.

    Parameters
    ----------
    kind
        ``acquisition``, ``preprocessing``, ``depth`` or ``normals``.
    path
        Recording for the first, view file or recording for the second, dataset or shard for the others.
    out
        Of the figure: ``.png``, ``.pdf`` or ``.svg``; replaced when it exists, and left alone when drawing fails.
    choice
        What of it.

    Returns
    -------
    What is on it, in words.

    Raises
    ------
    UsageError
        Kind or ending is unknown.
    DataError, FormatError
        The data are missing, damaged, or not what this kind of figure shows.
    """
    form = out.suffix.removeprefix(".").lower()
    if form not in METADATA:
        raise UsageError(f"{out}: expected a name that ends in .png, .pdf or .svg", hint="--out figure.png")
    with _canvas() as figure:
        words = _draw(kind, figure, path, choice)
        with replacing(out) as partial:
            packed = {"pil_kwargs": {"compress_level": 9}} if form == "png" else {}
            figure.savefig(partial, dpi=DPI, format=form, metadata=METADATA[form], **packed)
    return words


@contextmanager
def _canvas() -> Iterator[Any]:
    """Give an empty figure; nobody's matplotlibrc and no random mark of an SVG change its bytes."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams["svg.hashsalt"] = "tofcapture"
        figure = Figure(dpi=DPI, layout=None, facecolor="white")
        FigureCanvasAgg(figure)
        yield figure


def _draw(kind: str, figure: Any, path: Path, choice: Choice) -> str:
    if kind == "acquisition":
        from tofcapture.viz.figures.acquisition import draw_acquisition

        return draw_acquisition(figure, path, choice.scene, choice.view)
    if kind == "preprocessing":
        from tofcapture.viz.figures.preprocessing import draw_preprocessing

        return draw_preprocessing(figure, path, choice.scene, choice.view, choice.rig)
    if kind not in KINDS:
        raise UsageError(f"{kind}: expected {', '.join(KINDS)}")
    from tofcapture.viz.figures.rows import draw_rows, read_rows

    rows = read_rows(path, choice.scene, choice.view or 0, choice.rows, choice.prediction)
    return draw_rows(figure, kind, rows)
