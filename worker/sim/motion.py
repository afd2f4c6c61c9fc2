"""From a trajectory at 10 Hz to the poses of every frame of a clip."""

from dataclasses import dataclass

import numpy as np

from worker.sim import jaco
from worker.sim.human import FACE_IN_HEAD, MOUTH_FROM_NECK_M, NECK_PIVOT_M
from worker.sim.solids import Array, smooth_step
from worker.spaces import CONTROL_STEP_S
from worker.trajectory import Trajectory

SWALLOWING_S = 0.22
SWALLOWED_WITHIN_M = 0.06
THROAT_DEPTH_M = 0.035


@dataclass(frozen=True)
class Motion:
    """Everything that changes during a clip of N frames, with L moving parts and P pieces of food."""

    frames: Array
    """(N, L, 4, 4) of links 1 to 7 and the spoon, in the world"""
    food_m: Array
    """(N, P, 3); NaN when gone"""
    force_n: Array
    """(N,)"""
    head_quaternion: Array
    """(4,) xyzw"""
    mouth_m: Array
    """(3,)"""

    def __len__(self) -> int:
        return len(self.frames)


def clip_motion(trajectory: Trajectory, first_step: int, n_steps: int, fps: int) -> Motion:
    """The motion of steps first_step to first_step + n_steps.

    Raises ValueError when the trajectory does not hold these steps.
    """
    if first_step < 0 or n_steps < 1 or first_step + n_steps > len(trajectory):
        raise ValueError(
            f"Steps {first_step} to {first_step + n_steps} are not within a trajectory of {len(trajectory)} steps."
        )
    count = round(n_steps * CONTROL_STEP_S * fps)
    place = first_step + np.arange(count) / (fps * CONTROL_STEP_S)
    joints = smoothly(np.asarray(trajectory.joint_positions, dtype=float), place)
    in_base = jaco.link_frames(joints)
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = jaco.rotation(jaco.ROBOT_BASE_RPY), jaco.ROBOT_BASE_M
    turn = rotation_of(np.asarray(trajectory.head_quaternion, dtype=float))
    mouth: Array = np.asarray(NECK_PIVOT_M) + turn @ np.asarray(MOUTH_FROM_NECK_M)
    throat = mouth - THROAT_DEPTH_M * turn @ np.asarray(FACE_IN_HEAD)
    force = np.concatenate([[0.0], np.asarray(trajectory.contact_force_n, dtype=float)])
    return Motion(
        frames=np.asarray(base @ in_base),
        food_m=_food(np.asarray(trajectory.particles, dtype=float), place, mouth, throat),
        force_n=np.interp(place, np.arange(len(force)), force),
        head_quaternion=np.asarray(trajectory.head_quaternion, dtype=float),
        mouth_m=mouth,
    )


def smoothly(values: Array, place: Array) -> Array:
    """Values (T, D) at fractional indices place (N,), by Catmull-Rom so that velocity has no kinks."""
    last = len(values) - 1
    index = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    t = np.clip(place - index, 0.0, 1.0)[:, None]
    p0, p1, p2, p3 = (values[np.clip(index + shift, 0, last)] for shift in (-1, 0, 1, 2))
    return np.asarray(
        0.5 * (2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t**2 + (3 * p1 - p0 - 3 * p2 + p3) * t**3)
    )


def _food(positions: Array, place: Array, mouth_m: Array, throat_m: Array) -> Array:
    """Food (T, P, 3) at fractional indices (N, P, 3), in straight lines between control steps.

    The simulation takes food away as soon as it is close to the mouth; here it then goes on into the mouth.
    """
    last = len(positions) - 1
    index = np.clip(np.floor(place).astype(int), 0, max(last - 1, 0))
    share = np.clip(place - index, 0.0, 1.0)[:, None, None]
    food: Array = positions[index] + share * (positions[np.minimum(index + 1, last)] - positions[index])
    for piece in range(positions.shape[1]):
        seen = np.flatnonzero(~np.isnan(positions[:, piece, 0]))
        if not len(seen) or seen[-1] == last:
            continue
        final = positions[seen[-1], piece]
        if np.linalg.norm(final - mouth_m) < SWALLOWED_WITHIN_M:
            progress = (place - seen[-1]) * CONTROL_STEP_S / SWALLOWING_S
            going = (progress >= 0.0) & (progress < 1.0)
            food[going, piece] = final + smooth_step(progress[going], 0.0, 1.0)[:, None] * (throat_m - final)
    return food


def rotation_of(quaternion: Array) -> Array:
    """The rotation matrix (3, 3) of an xyzw quaternion (4,)."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternions(rotations: Array) -> Array:
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
