"""What stands about on the stand-in's table and is nobody's task: a mug and a can, z up."""

import numpy as np

from bridge.task.meshes import solids
from bridge.task.meshes.solids import Distances, Points
from bridge.task.meshes.toys import DESIGNS, Design


def mug_solid(p: Points) -> Distances:
    """A mug with one handle."""
    wall = solids.cylinder(p, 0.040, -0.047, 0.047)
    handle = solids.ring(p, (0.0, -0.043, 0.0), 0, 0.024, 0.0065)
    handle = np.maximum(handle, -solids.cylinder(p, 0.038, -0.06, 0.06))
    whole = solids.blend(wall, handle, 0.006)
    return solids.cut(whole, solids.cylinder(p, 0.035, -0.040, 0.080), 0.003)


def mug_paint(p: Points) -> Points:
    """Petrol with white dots outside, off-white inside."""
    colors = np.tile([0.12, 0.40, 0.44], (len(p), 1))
    turn = np.arctan2(p[:, 1], p[:, 0]) * 6 / np.pi
    row = p[:, 2] / 0.021
    dot = np.hypot((turn + 0.5 * np.floor(row)) % 1.0 - 0.5, row % 1.0 - 0.5) < 0.27
    colors[dot] = [0.93, 0.92, 0.88]
    colors[(np.hypot(p[:, 0], p[:, 1]) < 0.0375) & (p[:, 2] > -0.043)] = [0.90, 0.88, 0.82]
    return colors


def can_solid(p: Points) -> Distances:
    """A tin with a bead at either end."""
    body = solids.cylinder(p, 0.036, -0.054, 0.054)
    beads = [solids.ring(p, (0.0, 0.0, end * 0.053), 2, 0.0355, 0.0022) for end in (-1.0, 1.0)]
    return solids.blend_all([body, *beads], 0.002)


def can_paint(p: Points) -> Points:
    """Tin ends, a red label with a cream band and a row of squares."""
    colors = np.tile([0.66, 0.67, 0.69], (len(p), 1))
    label = (np.abs(p[:, 2]) < 0.049) & (np.hypot(p[:, 0], p[:, 1]) > 0.0352)
    colors[label] = [0.68, 0.12, 0.10]
    band = label & (np.abs(p[:, 2] - 0.006) < 0.018)
    colors[band] = [0.93, 0.88, 0.74]
    turn = (np.arctan2(p[:, 1], p[:, 0]) * 5 / np.pi) % 1.0
    colors[band & (np.abs(p[:, 2] - 0.006) < 0.010) & (turn < 0.55)] = [0.16, 0.34, 0.22]
    return colors


CLUTTER: dict[str, Design] = {
    **DESIGNS,
    "mug": Design(
        solid=mug_solid,
        paint=mug_paint,
        low_m=(-0.052, -0.088, -0.060),
        high_m=(0.052, 0.052, 0.060),
        spacing_m=0.0035,
    ),
    "can": Design(
        solid=can_solid,
        paint=can_paint,
        low_m=(-0.048, -0.048, -0.068),
        high_m=(0.048, 0.048, 0.068),
        spacing_m=0.0040,
    ),
}
"""By the shape that a cell file names; toys may stand about, too."""
