"""Drawings of a board at true scale: SVG and DXF in millimetres, STL by extrusion; and ``tofcapture calibrate board``."""

from __future__ import annotations

import argparse
import logging
from io import StringIO
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from calibration.board.geometry import Board, load_board, symmetries
from tofcapture.cli.kit import Outcome
from tofcapture.errors import ConfigError
from tofcapture.files.seal import replacing
from tofcapture.meshes import extrude, signed_area
from tofcapture.poses import Float64

MARGIN = 10.0  # mm of paper around the outline; the scale bar lies in it
SCALE_BAR = 100.0  # mm; measured with a ruler, it tells whether a printer scaled the page


def svg(board: Board) -> str:
    """Draw the front face as SVG, true scale: 1 user unit is 1 mm, y up as on the board, a scale bar of 100 mm below."""
    low, high = 1e3 * board.outline.min(axis=0), 1e3 * board.outline.max(axis=0)
    width, height = high - low + [2 * MARGIN, 3 * MARGIN]
    foot = height - MARGIN

    def paper(points: Float64) -> Float64:
        """Millimetres on paper, y down, of board points (M, 2) in metres."""
        return np.column_stack([1e3 * points[:, 0] - low[0] + MARGIN, high[1] - 1e3 * points[:, 1] + MARGIN])

    def polygon(ring: Float64) -> str:
        return f'<polygon points="{" ".join(f"{x:.4f},{y:.4f}" for x, y in paper(ring))}"/>'

    shapes = [polygon(board.outline)]
    for hole in board.holes:
        if hole.centre is None:
            shapes.append(polygon(hole.corners))
        else:
            x, y = paper(np.array([hole.centre]))[0]
            shapes.append(f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{1e3 * hole.radius:.4f}"/>')
    size = f'width="{width:.4f}mm" height="{height:.4f}mm" viewBox="0 0 {width:.4f} {height:.4f}"'
    at = f'x="{MARGIN + SCALE_BAR + 3}" y="{foot + 1.5:.4f}"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" {size}>',
            f"<title>{escape(board.name)}, {1e3 * board.thickness:g} mm thick, front face</title>",
            '<g id="cut" fill="none" stroke="#000" stroke-width="0.1">',
            *shapes,
            "</g>",
            '<g id="note" fill="none" stroke="#00f" stroke-width="0.2">',
            f'<path d="M{MARGIN} {foot - 3:.4f}v6m0 -3h{SCALE_BAR}m0 -3v6"/>',
            f'<text {at} font-size="5" stroke="none" fill="#00f">{SCALE_BAR:g} mm; do not cut</text>',
            "</g>",
            "</svg>\n",
        ]
    )


def dxf(board: Board) -> str:
    """Draw the front face as DXF R12 in ASCII, millimetres, board coordinates: POLYLINE and CIRCLE on the layer CUT."""
    try:
        from ezdxf.filemanagement import new
    except ImportError as err:
        raise ConfigError(
            f"ezdxf is needed for DXF and does not load: {err}", hint="pip install 'tofcapture[capture]'"
        ) from err
    logging.getLogger("ezdxf").setLevel(logging.ERROR)  # R12 cannot say that its unit is the millimetre
    drawing = new("R12")
    drawing.layers.add("CUT")
    space = drawing.modelspace()
    for hole in (None, *board.holes):
        if hole is not None and hole.centre is not None:
            space.add_circle(1e3 * np.array(hole.centre), 1e3 * hole.radius, dxfattribs={"layer": "CUT"})
        else:
            ring = board.outline if hole is None else hole.corners
            space.add_polyline2d(1e3 * ring, close=True, dxfattribs={"layer": "CUT"})
    out = StringIO()
    drawing.write(out)
    return out.getvalue()


def stl(board: Board) -> bytes:
    """Extrude the board to a binary STL, millimetres, triangles winding outwards."""
    import trimesh

    vertices, triangles = extrude(board.outline, board.thickness, board.rings[1:])
    mesh = trimesh.Trimesh(1e3 * vertices, triangles, process=False)
    return bytes(mesh.export(file_type="stl"))


def configure_board(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "--board",
        default="default",
        metavar="BOARD",
        help="packaged board (default, second) or a TOML file, see docs/board.md (default: default)",
    )
    for kind, words in (("svg", "to print"), ("dxf", "to cut"), ("stl", "to print in 3-D")):
        parser.add_argument(
            f"--{kind}", type=Path, metavar=f"FILE.{kind}", help=f"write the drawing {words}, true scale"
        )


def run_board(args: argparse.Namespace) -> Outcome:
    """Check a board, describe it, and write the drawings that were asked for."""
    board = load_board(args.board)
    written = {}
    for kind, draw in (("svg", svg), ("dxf", dxf), ("stl", stl)):
        if (out := getattr(args, kind)) is not None:
            with replacing(out) as partial:
                drawn = draw(board)
                partial.write_bytes(drawn if isinstance(drawn, bytes) else drawn.encode())
            written[kind] = str(out)
    data = {**describe(board), "written": written}
    return Outcome(data, "\n".join([_table(board), *written.values()]))


def describe(board: Board) -> dict[str, Any]:
    """Return name, size, holes and symmetries of a board as JSON types, metres."""
    return {
        "name": board.name,
        "size_m": np.ptp(board.outline, axis=0).tolist(),
        "thickness_m": board.thickness,
        "volume_m3": (signed_area(board.outline) - sum(map(signed_area, board.rings[1:]))) * board.thickness,
        "holes": [
            {"name": h.name, "radius_m": h.radius or None, "corners": len(h.corners)} for h in board.holes
        ],
        "symmetries": symmetries(board),
    }


def _table(board: Board) -> str:
    x, y = 1e3 * np.ptp(board.outline, axis=0)
    lines = [f"board {board.name}: {x:g} x {y:g} x {1e3 * board.thickness:g} mm, {len(board.holes)} holes"]
    for h in board.holes:
        size = f"radius {1e3 * h.radius:g}" if h.centre else f"{len(h.corners)} corners"
        cx, cy = 1e3 * np.array(h.centre or h.corners.mean(axis=0))
        lines.append(f"  {h.name:16}{size:12} at {cx:.1f} {cy:.1f} mm")
    found = ", ".join(symmetries(board))
    lines.append(
        f"symmetric: {found}; its pose cannot be told" if found else "no symmetry: its pose is unique"
    )
    return "\n".join(lines)
