"""From a trajectory at 10 Hz to the poses of every frame of a clip."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from worker.domain.spaces import CONTROL_STEP_S
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import FloatArray
from worker.sim.arm import RobotArm, Tool, transform
from worker.sim.geometry import rotation_of
from worker.sim.human import BODY_SHAPES, FACE_IN_HEAD, BodyShape
from worker.sim.render.meshes.distance_fields import smooth_step

SWALLOWING_S = 0.22
SWALLOWED_WITHIN_M = 0.06
THROAT_DEPTH_M = 0.035
STILL_RAD = 2e-3
"""Arms and head that turn by less than this during a clip are drawn as standing still: a fifth of a pixel."""
STILL_M = 4e-4
"""A picture is shown until something in it has moved by this since it was drawn: half a pixel in the close-up."""
REACH_M, ARM_M = 0.2, 0.7
"""How far from where it turns what is drawn of a link, the tool or the head reaches, and a person's arm."""
STILL_N = 0.05
"""A force that changes by less looks the same."""
_GONE_M = 100.0


@dataclass(frozen=True)
class ClipMotion:
    """Everything that changes during a clip of N frames, with L moving parts and P pieces of food or water."""

    body: BodyShape
    skin_tone: int
    frames: FloatArray
    """(N, L, 4, 4) of the robot's links and its tool, in the world"""
    particles_m: FloatArray
    """(N, P, 3); NaN when gone"""
    force_n: FloatArray
    """(N,)"""
    head_quaternions: FloatArray
    """(N, 4) xyzw"""
    arms_rad: FloatArray
    """(N, 2, 4) right and left arm as in human.py"""
    target_m: FloatArray
    """(N, 3)"""

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def head_moves(self) -> bool:
        """Whether the head turns visibly during the clip."""
        return float(np.abs(self.head_quaternions - self.head_quaternions[0]).max()) > STILL_RAD / 2

    def arm_moves(self, side: int) -> bool:
        """Whether the person's right or left arm moves visibly during the clip."""
        return float(np.abs(self.arms_rad[:, side] - self.arms_rad[0, side]).max()) > STILL_RAD

    def stretches(self) -> list[range]:
        """The frames in runs that look alike, so that one picture of the first is enough for each."""
        moved, starts = self._places_m(), [0]
        for index in range(1, len(self)):
            if np.abs(moved[index] - moved[starts[-1]]).max() > STILL_M:
                starts.append(index)
        return [range(*ends) for ends in pairwise([*starts, len(self)])]

    def _places_m(self) -> FloatArray:
        """(N, X) whatever can be seen to change, as places of points."""
        parts = (
            self.frames[:, :, :3, 3],
            REACH_M * self.frames[:, :, :3, :3],
            np.nan_to_num(self.particles_m, nan=_GONE_M),
            2 * REACH_M * self.head_quaternions,
            ARM_M * self.arms_rad,
            self.target_m,
            STILL_M / STILL_N * self.force_n,
        )
        return np.concatenate([each.reshape(len(self), -1) for each in parts], axis=1)


def clip_motion(
    trajectory: Trajectory, robot: RobotArm, tool: Tool, first_step: int, n_steps: int, fps: int
) -> ClipMotion:
    """The motion of steps first_step to first_step + n_steps.

    Raises ValueError when the trajectory does not hold these steps.
    """
    if first_step < 0 or n_steps < 1 or first_step + n_steps > len(trajectory):
        raise ValueError(
            f"Steps {first_step} to {first_step + n_steps} are not within a trajectory of {len(trajectory)} steps."
        )
    count = frame_count(n_steps, fps)
    place = first_step + np.arange(count) / (fps * CONTROL_STEP_S)
    joints, heads, arms, target, particles = (
        np.asarray(values, dtype=np.float64)
        for values in (
            trajectory.joint_positions,
            trajectory.head_quaternions,
            trajectory.arm_positions_rad,
            trajectory.target_m,
            trajectory.particles,
        )
    )
    force = np.concatenate([[0.0], np.asarray(trajectory.contact_force_n, dtype=float)])
    body = BODY_SHAPES[trajectory.body]
    return ClipMotion(
        body=body,
        skin_tone=trajectory.skin_tone,
        frames=np.asarray(transform(robot.mount_m, robot.mount_rpy) @ robot.link_frames(smoothly(joints, place), tool)),
        particles_m=_particles(particles, place, *_mouth_and_throat(body, heads)),
        force_n=np.interp(place, np.arange(len(force)), force),
        head_quaternions=_unit_quaternions(smoothly(_same_sign(heads), place)),
        arms_rad=smoothly(arms.reshape(len(arms), -1), place).reshape(count, 2, -1),
        target_m=smoothly(target, place),
    )


def _mouth_and_throat(body: BodyShape, heads: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where they are at every control step (T + 1, 3)."""
    turns = np.array([rotation_of(quaternion) for quaternion in heads])
    mouth = np.asarray(body.neck_pivot_m) + turns @ np.asarray(body.mouth_from_neck_m)
    throat: FloatArray = mouth - THROAT_DEPTH_M * turns @ np.asarray(FACE_IN_HEAD)
    return mouth, throat


def _same_sign(heads: FloatArray) -> FloatArray:
    """A quaternion and its negative are the same turn; neighbours must not differ by their sign."""
    flips = np.where((heads[1:] * heads[:-1]).sum(axis=1) < 0.0, -1.0, 1.0)
    return np.asarray(heads * np.concatenate([[1.0], np.cumprod(flips)])[:, None])


def _unit_quaternions(values: FloatArray) -> FloatArray:
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


def frame_count(n_steps: int, fps: int) -> int:
    """How many frames show so many control steps."""
    return round(n_steps * CONTROL_STEP_S * fps)


def smoothly(values: FloatArray, place: FloatArray) -> FloatArray:
    """Values (T, D) at fractional indices place (N,), by Catmull-Rom so that velocity has no kinks."""
    last = len(values) - 1
    index = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    t = np.clip(place - index, 0.0, 1.0)[:, None]
    p0, p1, p2, p3 = (values[np.clip(index + shift, 0, last)] for shift in (-1, 0, 1, 2))
    return np.asarray(
        0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
    )


def _particles(positions: FloatArray, place: FloatArray, mouth_m: FloatArray, throat_m: FloatArray) -> FloatArray:
    """Particles (T + 1, P, 3) at fractional indices (N, P, 3), in straight lines between control steps.

    The simulation takes food and water away as soon as they are close to the mouth; here they go on into it.
    """
    last = len(positions) - 1
    index = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    share = np.clip(place - index, 0.0, 1.0)[:, None, None]
    drawn: FloatArray = positions[index] + share * (positions[np.minimum(index + 1, last)] - positions[index])
    for particle in range(positions.shape[1]):
        seen = np.flatnonzero(~np.isnan(positions[:, particle, 0]))
        if not len(seen) or seen[-1] == last:
            continue
        final, step = positions[seen[-1], particle], seen[-1]
        if np.linalg.norm(final - mouth_m[step]) < SWALLOWED_WITHIN_M:
            progress = (place - step) * CONTROL_STEP_S / SWALLOWING_S
            going = (progress >= 0.0) & (progress < 1.0)
            way = throat_m[step] - final
            drawn[going, particle] = final + smooth_step(progress[going], 0.0, 1.0)[:, None] * way
    return drawn


def quaternions(rotations: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) as xyzw quaternions (..., 4)."""
    m = rotations
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    trace = diagonal.sum(axis=-1, keepdims=True)
    sizes = np.sqrt(np.maximum(np.concatenate([1 + 2 * diagonal - trace, 1 + trace], axis=-1), 0.0)) / 2
    x, y, z, w = (sizes[..., k] for k in range(4))
    off = np.stack(
        [
            m[..., 2, 1] - m[..., 1, 2],
            m[..., 0, 2] - m[..., 2, 0],
            m[..., 1, 0] - m[..., 0, 1],
            m[..., 1, 0] + m[..., 0, 1],
            m[..., 0, 2] + m[..., 2, 0],
            m[..., 2, 1] + m[..., 1, 2],
        ],
        axis=-1,
    )
    wx, wy, wz, xy, xz, yz = (off[..., k] / 4 for k in range(6))
    # Four formulas, each exact; the one divided by the largest component is the accurate one.
    candidates = np.stack(
        [
            np.stack([x * x, xy, xz, wx], -1),
            np.stack([xy, y * y, yz, wy], -1),
            np.stack([xz, yz, z * z, wz], -1),
            np.stack([wx, wy, wz, w * w], -1),
        ],
        axis=-2,
    )
    best = np.argmax(np.stack([x, y, z, w], -1), axis=-1)
    chosen = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=-1, keepdims=True))
