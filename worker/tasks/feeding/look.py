"""How Feeding is filmed."""

from worker.sim.render.meshes.arm_mesh import Grip
from worker.sim.render.meshes.tool_mesh import ToolLook
from worker.sim.render.task_look import TaskLook
from worker.tasks.feeding.food import BALL_RADIUS_M
from worker.tasks.feeding.spoon_mesh import spoon

LOOK = TaskLook(particle_radius_m=lambda count: BALL_RADIUS_M, tool=ToolLook(spoon, Grip(0.0043)))
