"""Who and what is filmed in one clip: the person posed, at rest or moving, and the robot frame by frame."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from worker.domain.type_aliases import FloatArray
from worker.sim.human import LEFT, RIGHT
from worker.sim.render.camera import lamp
from worker.sim.render.compositing import MOVING_LAMP_SIZE, STILL_LAMP_SIZE
from worker.sim.render.interpolation import ClipMotion, quaternions
from worker.sim.render.mesh_set import CUBE, MeshSet
from worker.sim.render.passes import BODY_LIGHT, DEPTH_ONLY, Depth, Part
from worker.sim.render.scene import UPPER_LINKS, Kit, Sitter
from worker.sim.render.task_look import TaskLook

HOLD_RAD = 0.0025
"""An arm that has turned by less than this since it was last drawn stays as it is: half a pixel."""


@dataclass(frozen=True)
class Shoot:
    """Who and what is filmed in one clip."""

    look: TaskLook
    kit: Kit
    sitter: Sitter
    motion: ClipMotion


class FilmedPerson:
    """The person's head and arms during one clip: each rests in the still picture, or moves frame by frame."""

    def __init__(self, shoot: Shoot, stage: MeshSet) -> None:
        """Hides everything else on the still stage and poses the first frame."""
        self._shoot, self._stage, sitter, motion = shoot, stage, shoot.sitter, shoot.motion
        self._moving = [side for side in (RIGHT, LEFT) if motion.arm_moves(side)]
        self._held: FloatArray | None = None
        self._pose = 0
        stage.hide_all_but(())
        self._arms = [sitter.pose_arm(stage, side, motion.arms_rad[0, side]) for side in (RIGHT, LEFT)]
        self._head = sitter.turn_head(stage, motion.head_quaternions[0])

    def lamp_depth(self) -> Depth:
        """What the lamp sees of head and arms in the first frame; their own shadows stay where they are."""
        return still_lamp_depth(self._stage)

    def resting(self) -> list[Part]:
        """What rests during the clip. Everything else is out of sight from now on."""
        shoot, sitter = self._shoot, self._shoot.sitter
        shown: list[str] = []
        corners_m: list[FloatArray] = []
        for side in (RIGHT, LEFT):
            if side not in self._moving:
                shown += sitter.arm_names(side)
                corners_m.append(self._arms[side])
        if not shoot.motion.head_moves:
            shown += sitter.head_names
            corners_m.append(self._head)
        self._stage.hide_all_but(shown)
        if not corners_m:
            return []
        head_m = self._head[0].mean(axis=0)
        return [Part(self._stage, np.concatenate(corners_m), BODY_LIGHT, alive=True, head_m=head_m)]

    def moving(self, index: int) -> list[Part]:
        """What of the person moves, posed for a frame."""
        motion, sitter = self._shoot.motion, self._shoot.sitter
        names: list[str] = []
        if not self._moving and not motion.head_moves:
            return []
        state = np.concatenate([motion.arms_rad[index, self._moving].ravel(), motion.head_quaternions[index]])
        for side in self._moving:
            names += sitter.arm_names(side)
        if motion.head_moves:
            names += sitter.head_names
        stage = sitter.alive(names)
        if self._held is None or np.abs(state - self._held).max() > HOLD_RAD:
            self._held, self._pose = state, self._pose + 1
            stage.hide_all_but(names)
            corners_m = [sitter.pose_arm(stage, side, motion.arms_rad[index, side]) for side in self._moving]
            if motion.head_moves:
                corners_m.append(sitter.turn_head(stage, motion.head_quaternions[index]))
            self._corners_m = np.concatenate(corners_m)
        return [Part(stage, self._corners_m, BODY_LIGHT, alive=True, pose=self._pose)]


def moving_parts(shoot: Shoot, frames: Iterable[int]) -> Iterator[list[Part]]:
    """The robot, its tool and the particles, posed for one frame after the other."""
    kit, motion = shoot.kit, shoot.motion
    turned = np.einsum("nlij,lcj->nlci", motion.frames[..., :3, :3], kit.corners_m)
    links_m = turned + motion.frames[:, :, None, :3, 3]
    turns = quaternions(motion.frames[..., :3, :3]).tolist()
    places = motion.frames[..., :3, 3].tolist()
    for index in frames:
        for part in range(len(kit.names)):
            kit.place(part, places[index][part], turns[index][part])
        kit.place_particles(motion.particles_m[index])
        upper, near_m = Part(kit.upper, links_m[index, :UPPER_LINKS]), links_m[index, UPPER_LINKS:]
        particles_m = _around(motion.particles_m[index], kit.radius_m)
        if shoot.look.water:
            show_glass = partial(kit.place_glass, places[index][-1], turns[index][-1])
            water = Part(kit.particles, particles_m, prepare=kit.show_water, drops_m=kit.radius_m)
            glass = Part(kit.particles, links_m[index, -1:], prepare=show_glass, glass=True)
            yield [upper, Part(kit.forearm, near_m), water, *([glass] if kit.glass else [])]
        else:
            yield [upper, Part(kit.forearm, np.concatenate([near_m, particles_m]))]


def _around(centres_m: FloatArray, radius_m: float) -> FloatArray:
    """Corners (P, 8, 3) of boxes around balls (P, 3), with room for water's blur."""
    return np.asarray(centres_m[:, None] + 1.5 * radius_m * CUBE)


def moving_lamp_depth(kit: Kit) -> Depth:
    """Depth of the robot, its tool and water as the lamp sees them."""
    kit.show_casters()
    return kit.casters.draw_raw(lamp(MOVING_LAMP_SIZE), None, MOVING_LAMP_SIZE, MOVING_LAMP_SIZE, DEPTH_ONLY)[1]


def still_lamp_depth(stage: MeshSet) -> Depth:
    """Depth of a still stage as the lamp sees it."""
    size = STILL_LAMP_SIZE
    return stage.draw(lamp(size), None, size, size, DEPTH_ONLY).depth
