"""Gymnasium's Reacher-v5, moved by joint velocities instead of torques, and what the example measures.

A part of a torque is no slower way to do the same, a part of a velocity is; so an inner loop, as robots have one, turns
velocities into torques.
"""

import os
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")  # draws without a screen; before MuJoCo is imported

import gymnasium
import numpy as np

FASTEST_RAD_S = 2.0
INNER_STEPS = 4
"""of 0.02 s for each action: 12.5 actions a second"""
SUCCESS_M = 0.02
INNER_STEP_S, INERTIA, DAMPING, GEAR = 0.02, 1.0, 1.0, 200.0
"""of the joints in Reacher's model"""


class VelocityReacher(gymnasium.Wrapper):
    """joints: cosines, sines (shoulder, elbow) and velocities in rad/s; target and tip: places on the table in m."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.action_space = gymnasium.spaces.Box(-FASTEST_RAD_S, FASTEST_RAD_S, (2,))
        bounds = {"joints": (6, 20.0), "target": (2, 0.3), "tip": (2, 0.3)}
        self.observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-bound, bound, (size,)) for name, (size, bound) in bounds.items()}
        )
        self.effort = 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation, info = self.env.reset(seed=seed, options=options)
        return self._named(observation), info

    def step(self, action: np.ndarray) -> Any:
        self.effort = 0.0
        for _ in range(INNER_STEPS):
            speed = self.unwrapped.data.qvel[:2]
            torque = (INERTIA * (action - speed) / INNER_STEP_S + DAMPING * action) / GEAR
            torque = np.clip(torque, -1.0, 1.0)
            self.effort += float(torque @ torque) / INNER_STEPS
            observation, reward, terminated, truncated, info = self.env.step(torque)
        named = self._named(observation)
        near = float(np.linalg.norm(named["tip"] - named["target"])) < SUCCESS_M
        return named, reward, terminated, truncated, {**info, "is_success": near, "effort": self.effort}

    def _named(self, seen: np.ndarray) -> dict[str, np.ndarray]:
        joints, target, tip = np.concatenate([seen[:4], seen[6:8]]), seen[4:6], seen[8:10] + seen[4:6]
        return {name: each.astype(np.float32) for name, each in (("joints", joints), ("target", target), ("tip", tip))}


def velocity_reacher(**arguments: Any) -> gymnasium.Env:
    """Reacher-v5 without its own end after 50 inner steps."""
    return VelocityReacher(gymnasium.make("Reacher-v5", max_episode_steps=100_000, **arguments))


def elbow_rad(step: Any) -> float:
    """How far the elbow is bent."""
    _, cosine, _, sine = step.observation["joints"][:4]
    return abs(float(np.arctan2(sine, cosine)))


def effort(step: Any) -> float:
    """Mean squared torque of the step, as a share of the largest."""
    return float(step.info["effort"])
