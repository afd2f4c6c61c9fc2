"""How Itch Scratching is filmed: from the person's right, where the itch is; the robot comes from the front."""

from worker.sim.render.meshes.arm_mesh import Grip
from worker.sim.render.meshes.head_mesh import CLOSED
from worker.sim.render.meshes.tool_mesh import ToolLook
from worker.sim.render.task_look import TaskLook
from worker.tasks.scratching.scratcher_mesh import scratcher

LOOK = TaskLook(
    eye_m=(-1.62, -0.12, 1.58),
    target_m=(-0.22, -0.33, 0.96),
    inset_from=(0.5, 0.85, 0.45),
    inset_span_m=0.20,
    inset_offset_m=(0.0, 0.0, 0.0),
    inset_on_right=True,
    itch=True,
    mouth=CLOSED,
    tool=ToolLook(scratcher, Grip(0.0043)),
)
