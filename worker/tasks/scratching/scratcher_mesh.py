"""How the back scratcher looks, in its own frame: origin at the middle of the tip, the handle along -x, z up."""

import numpy as np

from worker.sim.render.meshes.arm_mesh import Detail
from worker.sim.render.meshes.mesh import Mesh, curve, joined, tube
from worker.tasks.scratching.environment import SCRATCHER_LENGTH_M, TIP_RADIUS_M


def scratcher(detail: Detail) -> Mesh:
    """A wooden stick with a soft grip and a little rake, whose round teeth end where the simulated ball touches."""
    end, up = -SCRATCHER_LENGTH_M, 0.006
    line = curve([(-0.016, 0, 0.009), (-0.034, 0, 0.011), (-0.07, 0, up), (-0.13, 0, up), (end, 0, up)], 13)
    place = np.linspace(0, 1, len(line))
    grip = place > 0.48
    width = np.where(grip, np.interp(place, [0.48, 0.56, 0.9, 1.0], [0.0046, 0.0062, 0.0066, 0.0036]), 0.0040)
    colours = np.where(grip[1:], detail.at("grip"), detail.at("bamboo", 0.3))
    parts = [tube(line, np.column_stack([1.15 * width, width]), max(6, detail.sides // 2), colours)]
    for y in (-0.0126, -0.0042, 0.0042, 0.0126):
        tip = (0.0035, y, -0.75 * TIP_RADIUS_M + 6.0 * y * y)
        bend = [(-0.024, 0.4 * y, 0.0105), (-0.008, 0.9 * y, 0.0095), (0.0025, y, 0.0035), tip]
        thick = np.array([0.0034, 0.0034, 0.0033, 0.0032, 0.0030, 0.0028, 0.0024])
        parts.append(tube(curve(bend, 7), thick, 6, np.full(6, detail.at("bamboo"))))
    return joined(*parts)
