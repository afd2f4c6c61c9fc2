"""What a task is to those who learn it: the pure description that simulation, learning and bundles share.

Each task's own description lives beside its environment in worker/sim/<task>.py and travels from there as an argument.
"""

from dataclasses import dataclass

from worker.modes import ModeFamily
from worker.spaces import Space


@dataclass(frozen=True)
class Task:
    """One thing the robot does for a person."""

    name: str
    """as stored in studies, trajectories and bundles"""
    title: str
    observation: Space
    modes: ModeFamily
    calibrated_speed_weight: float
    """Weight of the calibrated speed cost with which the reference person (omega = 1) is content with the shipped
    policy's own speed; measured by tests/benchmarks/speed_cost_weight.py, to be repeated for a new policy."""
    speed_counts_near: bool = True
    """Whether the calibrated speed cost counts within 20 cm of the target; not where motion there is the service."""
    episode_steps: int = 100
    pieces: int = 8
    """of food or water in the usual portion"""
