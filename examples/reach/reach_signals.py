"""What the example measures beside the studio's own signals. Each function is given one step (worker.sim.lab)."""

from typing import Any


def height_m(step: Any) -> float:
    """Height of the hand above the table."""
    return float(step.observation["achieved_goal"][2])


def sideways_m(step: Any) -> float:
    """How far the hand is to one side."""
    return abs(float(step.observation["achieved_goal"][1]))
