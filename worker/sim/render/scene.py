"""What there is to draw: the room, the person in parts, the robot with its tool, made once and shared by all clips."""

import math
from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim import human
from worker.sim.arm import RobotArm, Tool
from worker.sim.geometry import rotation_of
from worker.sim.human import BodyShape
from worker.sim.render.interpolation import quaternions
from worker.sim.render.mesh_set import MeshSet, Paints, corners_around
from worker.sim.render.meshes import arm_mesh, body_mesh, chair_mesh, head_mesh, limb_mesh, room_mesh
from worker.sim.render.meshes.arm_mesh import Grip
from worker.sim.render.meshes.distance_fields import union
from worker.sim.render.meshes.head_mesh import Mouth
from worker.sim.render.meshes.mesh import Mesh, ball
from worker.sim.render.meshes.tool_mesh import plain_look
from worker.sim.render.task_look import TaskLook

UPPER_LINKS = 3
"""So many of the robot's links are drawn apart from the rest, which is nearer to the person and smaller."""


class Sitter:
    """One body in its chair: the trunk stands still, head and arms are posed."""

    def __init__(self, body: BodyShape, stages: "Stages") -> None:
        self.body, self._stages = body, stages
        self.head_names = ("", "")
        """head and neck; the head's, once somebody sits, by how open the mouth is"""
        palette, chair = stages.paints.palette, chair_mesh.chair(body)
        trunk, cloth = body_mesh.trunk(body), body_mesh.BUILDS[body.name].cloth
        self._trunk = self._named(
            {
                "trunk": body_mesh.trunk_mesh(body, palette, chair),
                "chair": chair_mesh.chair_mesh(body, palette, trunk),
            }
        )
        self._arms = self._named(limb_mesh.arm_meshes(body, palette, cloth, union(trunk, chair)))
        self._heads = self._named({"neck": body_mesh.neck_mesh(body, palette)})
        stages.still.add({**self._trunk, **self._arms, **self._heads})

    def _named(self, meshes: Mapping[str, Mesh]) -> dict[str, Mesh]:
        return {f"{self.body.name}_{name}": mesh for name, mesh in meshes.items()}

    def sit(self, skin_tone: int, mouth: Mouth, base: str) -> None:
        """Take the place of any other sitter, beside this base of a robot; head and arms are still out of sight."""
        self.head_names = f"{self.body.name}_head_{mouth.name}", f"{self.body.name}_neck"
        if self.head_names[0] not in self._heads:
            head = {self.head_names[0]: head_mesh.head_mesh(self.body, mouth, self._stages.paints.palette)}
            self._heads.update(head)
            self._stages.still.add(head)
        shown = [*self._stages.room, base, *self._trunk]
        for stage in (self._stages.still, *self._stages.if_made("alive")):
            stage.hide_all_but(shown)
            stage.repaint(skin_tone)
        for name in shown:
            self._stages.still.place(name)
        self._skin_tone = skin_tone

    def turn_head(self, stage: MeshSet, quaternion: Sequence[float] | FloatArray) -> FloatArray:
        """Turn it, and give the corners (1, 8, 3) in the world of a box that holds head and neck."""
        head, neck = self.head_names
        stage.place(head, self.body.neck_pivot_m, quaternion)
        stage.place(neck)
        turned = stage.corners_m(head) @ rotation_of(quaternion).T + np.array(self.body.neck_pivot_m)
        return corners_around(np.concatenate([turned, stage.corners_m(neck)]))[None]

    def pose_arm(self, stage: MeshSet, side: int, arm_rad: FloatArray) -> FloatArray:
        """Pose the right or left arm, and give the corners (2, 8, 3) in the world of boxes around its two segments."""
        boxes = []
        for name, origin, turn in zip(
            self.arm_names(side), *limb_mesh.segment_frames(self.body, arm_rad, side), strict=True
        ):
            stage.place(name, origin, quaternions(turn))
            boxes.append(stage.corners_m(name) @ turn.T + origin)
        return np.array(boxes)

    def arm_names(self, side: int) -> tuple[str, str]:
        """Upper arm and forearm."""
        prefix = f"{self.body.name}_{('right', 'left')[side]}"
        return f"{prefix}_upper_arm", f"{prefix}_forearm"

    def alive(self, names: Sequence[str]) -> MeshSet:
        """The stage for what moves of persons during a clip, with these parts on it."""
        stage, parts = self._stages.alive, {**self._arms, **self._heads}
        stage.add({name: parts[name] for name in names})
        stage.repaint(self._skin_tone)
        return stage


class Kit:
    """The robot with the tool of one task and what the tool carries."""

    def __init__(self, task: str, robot: RobotArm, tool: Tool, look: TaskLook, stages: "Stages") -> None:
        self._task, self._look, held = task, look, look.tool or plain_look(tool.shapes)
        self._palette = stages.paints.palette
        detail, coarse = arm_mesh.Detail(self._palette, sides=14), arm_mesh.Detail(self._palette, sides=6)
        self.upper, self.casters = stages.upper, stages.small
        self.forearm = stages.forearm(robot, held.grip)
        links = arm_mesh.arm_meshes(detail, robot, held.grip)
        # The shadows of two grips must not be mixed up either.
        gripping = [f", {held.grip}" if index >= UPPER_LINKS else "" for index in range(len(links))]
        self.names = (*(f"{robot.name} {link}{grip}" for link, grip in zip(links, gripping, strict=True)), tool.name)
        """the moving parts, in the order of their frames"""
        named = dict(zip(self.names, links.values(), strict=False))
        far = self.names[:UPPER_LINKS]
        self.base = f"{robot.name}_base"
        stages.still.add({self.base: arm_mesh.base_mesh(detail, robot)})
        self.upper.add({name: named[name] for name in far})
        self.forearm.add({**{name: named[name] for name in named if name not in far}, tool.name: held.solid(detail)})
        shadows = arm_mesh.arm_meshes(coarse, robot, held.grip)
        self.casters.add(dict(zip(self.names, (*shadows.values(), held.solid(coarse)), strict=True)))
        self.particles = stages.small if look.water else self.forearm
        self.glass = f"{tool.name} glass" if held.glass else None
        if self.glass and held.glass:
            self.particles.add({self.glass: held.glass(detail)})
        self._particles: list[str] = []
        self.radius_m = 0.0
        """of the particles as drawn"""

    @cached_property
    def corners_m(self) -> FloatArray:
        """(L, 8, 3) corners of the moving parts' boxes in their own frames."""
        return np.array([(self.upper if name in self.upper else self.forearm).corners_m(name) for name in self.names])

    def take(self, particle_count: int) -> None:
        """Take up this tool instead of any other, with so many particles."""
        look, colours = self._look, self._look.particle_colours
        self.radius_m = look.particle_scale * look.particle_radius_m(particle_count)
        self._particles = [f"{self._task}_{index}_of_{self.radius_m:.5f}_m" for index in range(particle_count)]
        for index, name in enumerate(self._particles):
            if name not in self.particles:
                colour = self._palette.at(colours[index % len(colours)])
                self.particles.add({name: ball(self.radius_m, colour, halvings=0 if look.water else 1)})
        for stage in (self.upper, self.forearm, self.casters, self.particles):
            stage.hide_all_but(self.names)

    def place(self, part: int, position_m: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put one of the moving parts somewhere, on every stage that shows it."""
        name = self.names[part]
        (self.upper if part < UPPER_LINKS else self.forearm).place(name, position_m, quaternion)
        self.casters.place(name, position_m, quaternion)

    def show_casters(self) -> None:
        """Be ready to draw the shadow of robot, tool and water."""
        if self.glass:
            self.particles.hide(self.glass)

    def show_water(self) -> None:
        """Be ready to draw the water alone; the casters come back when they are placed."""
        self.show_casters()
        for name in self.names:
            self.casters.hide(name)

    def place_glass(self, position_m: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put what one sees through in front of the water."""
        if self.glass:
            self.particles.place(self.glass, position_m, quaternion)

    def place_particles(self, positions_m: FloatArray) -> None:
        """Put the particles at positions (P, 3), out of sight where NaN."""
        for name, place in zip(self._particles, positions_m.tolist(), strict=True):
            if any(map(math.isnan, place)):
                self.particles.hide(name)
            else:
                self.particles.place(name, place)


class Stages:
    """The few stages that all bodies and tasks share, each made when it is first needed."""

    def __init__(self) -> None:
        self.paints = Paints()
        self._made: dict[str, MeshSet] = {}
        room = room_mesh.room_meshes(self.paints.palette, chair_mesh.chair(human.BROAD))
        self.room = tuple(room)
        self.still.add(room)

    @property
    def still(self) -> MeshSet:
        """Room, robot bases, chairs and persons: what is drawn at the start of a clip."""
        return self._stage("still", with_skin=True)

    @property
    def alive(self) -> MeshSet:
        """Arms and heads of persons that move during a clip."""
        return self._stage("alive", with_skin=True)

    @property
    def upper(self) -> MeshSet:
        """The thick links of robots."""
        return self._stage("upper")

    @property
    def small(self) -> MeshSet:
        """What is quickly drawn: coarse robots and tools for the shadows they cast; water, and what holds it."""
        return self._stage("small")

    def if_made(self, name: str) -> list[MeshSet]:
        """A stage by name, or nothing if no clip has needed it yet."""
        return [self._made[name]] if name in self._made else []

    def forearm(self, robot: RobotArm, grip: Grip) -> MeshSet:
        """The thin links of one robot, its hand in one grip, and every tool that is held with it."""
        return self._stage(f"forearm of {robot.name}, {grip}")

    def close(self) -> None:
        """Free every client."""
        for stage in self._made.values():
            stage.close()
        self.paints.close()

    def _stage(self, name: str, with_skin: bool = False) -> MeshSet:
        if name not in self._made:
            self._made[name] = MeshSet(self.paints, with_skin)
        return self._made[name]


class Scene:
    """Everything there is to draw, made when it is first needed and shared by all clips."""

    def __init__(self) -> None:
        self.stages = Stages()
        self._sitters: dict[str, Sitter] = {}
        self._kits: dict[str, Kit] = {}

    def sitter(self, body: BodyShape) -> Sitter:
        """One of the bodies."""
        if body.name not in self._sitters:
            self._sitters[body.name] = Sitter(body, self.stages)
        return self._sitters[body.name]

    def kit(self, task: str, robot: RobotArm, tool: Tool, look: TaskLook) -> Kit:
        """The robot as it is equipped for a task."""
        if task not in self._kits:
            self._kits[task] = Kit(task, robot, tool, look, self.stages)
        return self._kits[task]

    def close(self) -> None:
        """Free every client."""
        self.stages.close()
