"""Procedural objects: families of watertight meshes, each a function of a random generator."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tofcapture.devices.sim.shapes import made, turned
from tofcapture.devices.sim.shapes.mesh import Mesh

FAMILIES: Mapping[str, Callable[[np.random.Generator], Mesh]] = {
    "blob": turned.blob,
    "board": made.board,
    "bottle": turned.bottle,
    "bowl": turned.bowl,
    "box": made.box,
    "bracket": made.bracket,
    "cone": turned.cone,
    "cup": turned.cup,
    "dumbbell": turned.dumbbell,
    "gear": made.gear,
    "lathe": turned.lathe,
    "mug": turned.mug,
    "plate": made.plate,
    "sphere": turned.sphere,
    "stack": made.stack,
    "steps": made.steps,
    "text": made.text,
    "tool": made.tool,
    "wedge": made.wedge,
}
"""Name -> generator of ``(vertices (N, 3) float64 m, triangles (M, 3) int64)``, resting on z = 0, centred in x and y,
4 to 30 cm large, triangles wound outwards. The one exception in size is ``board``, the 0.5 x 0.4 m calibration board."""
