"""``evidence.html``: what an alignment rests on, on one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tofcapture.errors import ConfigError

if TYPE_CHECKING:
    from calibration.evidence.compare import OldRig

Progress = Callable[[str, int, int], None]


def write_page(
    recording: Path,
    old: OldRig | None = None,
    evidence: Mapping[str, Any] | None = None,
    progress: Progress = lambda _stage, _done, _total: None,
) -> Path:
    """Write ``RECORDING/evidence.html``.

    Residuals are computed anew from the views, at the transform that the evidence states. Same inputs, same bytes.

    Parameters
    ----------
    recording
        Folder with ``views/calibration`` and, unless given, ``evidence.json``.
    old
        An older alignment to compare with.
    evidence
        What ``align`` found.
    progress
        Called with a stage, steps done and steps in all.

    Returns
    -------
    Path of the page, written atomically.

    Raises
    ------
    ConfigError
        jinja2 is not installed.
    DataError
        No readable evidence or views.
    """
    from calibration.evidence import read_evidence
    from calibration.evidence.compare import drift
    from calibration.evidence.page.content import page_content
    from calibration.evidence.page.samples import sample_recording
    from tofcapture.files.seal import write_text

    render = _template()
    found = read_evidence(recording) if evidence is None else evidence
    moved = None if old is None else drift(found, old)
    samples = sample_recording(recording, found, progress)
    out = Path(recording) / "evidence.html"
    write_text(out, render(page_content(found, samples, moved, "" if old is None else old.name)))
    return out


def _template() -> Callable[[Mapping[str, Any]], str]:
    try:
        from jinja2 import Environment, FileSystemLoader, StrictUndefined
    except ImportError as err:
        raise ConfigError(
            f"jinja2 is needed for evidence.html and does not load: {err}",
            hint="pip install 'tofcapture[report]'",
        ) from err
    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder), autoescape=True, undefined=StrictUndefined, trim_blocks=True
    )
    template = environment.get_template("evidence.html.j2")
    return lambda content: template.render(**content)
