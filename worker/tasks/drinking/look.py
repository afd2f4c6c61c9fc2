"""How Drinking is filmed."""

from worker.sim.render.meshes.colours import WATER
from worker.sim.render.meshes.head_mesh import SIPPING
from worker.sim.render.meshes.tool_mesh import ToolLook
from worker.sim.render.task_look import TaskLook
from worker.tasks.drinking.cup_mesh import CUP_GRIP, cup, cup_glass
from worker.tasks.drinking.environment import pellet_radius_m

LOOK = TaskLook(
    inset_from=(1.0, -0.72, 0.10),
    inset_span_m=0.19,
    inset_offset_m=(0.0, -0.03, 0.02),
    particle_colours=WATER,
    particle_radius_m=pellet_radius_m,
    particle_scale=1.22,
    water=True,
    mouth=SIPPING,
    tool=ToolLook(cup, CUP_GRIP, cup_glass),
)
