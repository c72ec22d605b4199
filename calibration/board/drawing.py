"""Drawings of a board at true scale: SVG and DXF in millimetres, STL by extrusion; and ``tofcapture calibrate board``."""

from __future__ import annotations

import argparse
import struct
from typing import Any
from xml.sax.saxutils import escape

import numpy as np

from calibration.board.geometry import Board, load_board, symmetries
from tofcapture.command import Outcome
from tofcapture.meshes import volume
from tofcapture.poses import Float64

MARGIN = 10.0  # mm of paper around the outline; the scale bar lies in it
SCALE_BAR = 100.0  # mm; measured with a ruler, it tells whether a printer scaled the page


def svg(board: Board) -> str:
    """Draw the front face as SVG, true scale: 1 user unit is 1 mm, y up as on the board.

    Returns
    -------
    str
        With a scale bar of 100 mm below the outline.
    """
    low, high = 1e3 * board.outline.min(axis=0), 1e3 * board.outline.max(axis=0)
    width, height = high - low + [2 * MARGIN, 3 * MARGIN]
    shapes = [_svg_polygon(board.outline, low, high)]
    for hole in board.holes:
        if hole.centre is None:
            shapes.append(_svg_polygon(hole.corners, low, high))
        else:
            x, y = _paper(np.array([hole.centre]), low, high)[0]
            shapes.append(f'<circle cx="{x:.4f}" cy="{y:.4f}" r="{1e3 * hole.radius:.4f}"/>')
    foot = height - MARGIN
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.4f}mm" height="{height:.4f}mm"'
        f' viewBox="0 0 {width:.4f} {height:.4f}">'
    )
    note = (
        f'<text x="{MARGIN + SCALE_BAR + 3}" y="{foot + 1.5:.4f}" font-size="5" stroke="none" fill="#00f">'
        f"{SCALE_BAR:g} mm; do not cut</text>"
    )
    return "\n".join(
        [
            head,
            f"<title>{escape(board.name)}, {1e3 * board.thickness:g} mm thick, front face</title>",
            '<g id="cut" fill="none" stroke="#000" stroke-width="0.1">',
            *shapes,
            "</g>",
            '<g id="note" fill="none" stroke="#00f" stroke-width="0.2">',
            f'<path d="M{MARGIN} {foot - 3:.4f}v6m0 -3h{SCALE_BAR}m0 -3v6"/>',
            note,
            "</g>",
            "</svg>\n",
        ]
    )


def dxf(board: Board) -> str:
    """Draw the front face as DXF R12 in ASCII, millimetres, board coordinates: POLYLINE and CIRCLE on the layer CUT."""
    pairs: list[tuple[int, Any]] = [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009")]
    pairs += [(0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES")]
    pairs += _dxf_polyline(board.outline)
    for hole in board.holes:
        if hole.centre is None:
            pairs += _dxf_polyline(hole.corners)
        else:
            x, y = 1e3 * np.array(hole.centre)
            pairs += [(0, "CIRCLE"), (8, "CUT"), (10, float(x)), (20, float(y)), (30, 0.0)]
            pairs += [(40, 1e3 * hole.radius)]
    pairs += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code:3d}\n{f'{v:.6f}' if isinstance(v, float) else v}\n" for code, v in pairs)


def stl(board: Board) -> bytes:
    """Extrude the board to a binary STL, millimetres, triangles winding outwards."""
    vertices, triangles = board.mesh()
    corners = (1e3 * vertices[triangles]).astype("<f4")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    records = np.zeros(len(triangles), dtype=[("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")])
    records["n"], records["v"] = normals, corners
    head = f"tofcapture board {board.name}, mm".encode("ascii", "replace")[:80].ljust(80)
    return head + struct.pack("<I", len(triangles)) + records.tobytes()


def run_board(args: argparse.Namespace) -> Outcome:
    """Check a board, describe it, and write the drawings that were asked for."""
    from tofcapture.files.seal import write_text

    board = load_board(args.board)
    written = {}
    for kind, draw in (("svg", svg), ("dxf", dxf)):
        if (out := getattr(args, kind)) is not None:
            write_text(out, draw(board))
            written[kind] = str(out)
    if args.stl is not None:
        args.stl.write_bytes(stl(board))
        written["stl"] = str(args.stl)
    data = {**describe(board), "written": written}
    return Outcome(data, "\n".join([_table(board), *written.values()]))


def describe(board: Board) -> dict[str, Any]:
    """Return name, size, holes and symmetries of a board as JSON types, metres."""
    return {
        "name": board.name,
        "size_m": np.ptp(board.outline, axis=0).tolist(),
        "thickness_m": board.thickness,
        "volume_m3": volume(board.mesh()),
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
    found = symmetries(board)
    lines.append(
        f"symmetric: {', '.join(found)}; its pose cannot be told"
        if found
        else "no symmetry: its pose is unique"
    )
    return "\n".join(lines)


def _paper(points: Float64, low: Float64, high: Float64) -> Float64:
    """Millimetres on paper, y down, of board points (M, 2) in metres."""
    mm = 1e3 * points
    return np.column_stack([mm[:, 0] - low[0] + MARGIN, high[1] - mm[:, 1] + MARGIN])


def _svg_polygon(ring: Float64, low: Float64, high: Float64) -> str:
    listed = " ".join(f"{x:.4f},{y:.4f}" for x, y in _paper(ring, low, high))
    return f'<polygon points="{listed}"/>'


def _dxf_polyline(ring: Float64) -> list[tuple[int, Any]]:
    pairs: list[tuple[int, Any]] = [
        (0, "POLYLINE"),
        (8, "CUT"),
        (66, 1),
        (70, 1),
        (10, 0.0),
        (20, 0.0),
        (30, 0.0),
    ]
    for x, y in 1e3 * ring:
        pairs += [(0, "VERTEX"), (8, "CUT"), (10, float(x)), (20, float(y)), (30, 0.0)]
    return [*pairs, (0, "SEQEND"), (8, "CUT")]
