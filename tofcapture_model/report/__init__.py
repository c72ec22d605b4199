"""Write one HTML file that shows what was captured, how it was aligned, and what the network makes of it.

No script, no address of another file: pictures are inside, lengths are millimetres. Same inputs, same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tofcapture.cli.kit import Outcome

VIEWS = 3  # example views: what fits into a few megabytes


def write_report(
    dataset: Path | None,
    results: Path | None,
    evidence: Path | None,
    weights: Path | None,
    out: Path,
    *,
    views: int = VIEWS,
) -> Path:
    """Write the page.

    Raises :class:`ConfigError`: neither a dataset nor results are given, or jinja2 or matplotlib is missing;
    :class:`DataError`, :class:`FormatError`: a part that is given is damaged or foreign.

    Parameters
    ----------
    dataset
        Folder that ``build-dataset`` wrote: example views, rig, digests.
    results, evidence
        ``results.json`` of ``evaluate``, ``evidence.json`` of ``align``. Sections of what is None or missing say so.
    weights
        Checkpoint or folder of a run; None: the bundled weights. Where there are none, pictures show the sensor alone.
    out
        The HTML file, written atomically.
    views
        Number of example views, taken evenly from the split that ``results`` names, otherwise from ``test``.
    """
    from tofcapture.viz.page import write_page
    from tofcapture_model.report.content import content
    from tofcapture_model.report.sources import read_sources

    sources = read_sources(dataset, results, evidence, weights)
    return write_page(Path(__file__).with_name("report.html.j2"), Path(out), content(sources, views))


def run(args: argparse.Namespace) -> Outcome:
    """Run the command ``report``: ``args`` are its ``dataset``, ``results``, ``evidence``, ``weights`` and ``out``."""
    out = write_report(args.dataset, args.results, args.evidence, args.weights, args.out)
    size = out.stat().st_size
    data = {"report": str(out), "bytes": size}
    return Outcome(data, f"{out}: {size / 1e6:.1f} MB, opens in any browser")
