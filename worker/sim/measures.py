"""What one control step was like, in every task: measurements -> the columns of SIGNALS and COSTS."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from worker.domain.type_aliases import FloatArray

NEAR_M = 0.20
"""Closer than this the speed counts as speed near the person."""
SIDE_VIEW_M = 0.30
"""Closer than this a sideways offset from the target's axis counts."""
APPROACHING_M = 0.08
"""Further than this the height above the target counts ..."""
LOW_ENTRY_M = 0.08
"""... and it counts from this far below the target upwards."""
HIGH_FORCE_N = 10.0


class StepOutcome(NamedTuple):
    """What happened to the task's objects during one control step. Counts are of this step alone."""

    delivered: int = 0
    """pieces of food or water that entered the mouth"""
    intake_speed_m_s: float = 0.0
    """their speeds, summed"""
    spilled: int = 0
    """pieces that left the tool and were not delivered"""
    on_person: int = 0
    """pieces that touched the person for the first time"""
    strokes: int = 0
    """strokes of the scratcher over the itch"""


@dataclass(frozen=True)
class StepMeasures:
    """Everything measured during one control step of 0.1 s. World frame, SI units.

    Forces and speeds are averages over the physics sub-steps, not snapshots of the last one.
    """

    tool_m: FloatArray
    """working point of the tool"""
    tool_up: FloatArray
    target_m: FloatArray
    """mouth or itch"""
    outward: FloatArray
    """unit vector out of the person at the target"""
    speed_m_s: float
    speed_squared_m2_s2: float
    acceleration_m_s2: FloatArray
    """(3,) change of the step's mean velocity over 0.1 s"""
    turn_speed_rad_s: float
    """of the tool, about any axis"""
    force_at_target_n: float
    """summed normal force of arm and tool on the person near the target"""
    force_squared_n2: float
    """mean square of the same"""
    force_away_n: float
    """summed normal force everywhere else"""
    action: FloatArray
    previous_action: FloatArray
    outcome: StepOutcome
    undelivered: bool
    """whether the task has not succeeded so far"""

    @cached_property
    def distance_m(self) -> float:
        """From the tool's working point to the target."""
        return math.dist(self.tool_m.tolist(), self.target_m.tolist())

    @property
    def high_force_n(self) -> float:
        """Force at the target when it is too much, else 0."""
        return self.force_at_target_n if self.force_at_target_n >= HIGH_FORCE_N else 0.0

    @property
    def height_above_target_m(self) -> float:
        """How far the tool is above a line 8 cm below the target while it is still approaching; 0 at the target."""
        if self.distance_m <= APPROACHING_M:
            return 0.0
        return max(0.0, float(self.tool_m[2] - self.target_m[2]) + LOW_ENTRY_M)

    @property
    def lateral_offset_m(self) -> float:
        """Distance of the tool from the axis that leaves the person at the target, when near."""
        if self.distance_m >= SIDE_VIEW_M:
            return 0.0
        offset = self.tool_m - self.target_m
        along = float(offset @ self.outward)
        return math.sqrt(max(0.0, float(offset @ offset) - along * along))

    @property
    def tilt_rad(self) -> float:
        """Angle between the tool's up axis and the vertical."""
        return math.acos(min(1.0, max(-1.0, float(self.tool_up[2]))))

    def signals(self) -> dict[str, float]:
        """One value per column of SIGNALS, in that order."""
        change = self.action - self.previous_action
        return {
            "distance_m": self.distance_m,
            "speed_m_s": self.speed_m_s,
            "speed_squared_m2_s2": self.speed_squared_m2_s2,
            "acceleration_squared_m2_s4": float(self.acceleration_m_s2 @ self.acceleration_m_s2),
            "near_speed_squared_m2_s2": self.speed_squared_m2_s2 if self.distance_m < NEAR_M else 0.0,
            "force_at_target_n": self.force_at_target_n,
            "force_away_n": self.force_away_n,
            "high_force_n": self.high_force_n,
            "spilled_on_person": self.outcome.on_person,
            "spilled": self.outcome.spilled,
            "intake_speed_m_s": self.outcome.intake_speed_m_s,
            "height_above_target_m": self.height_above_target_m,
            "lateral_offset_m": self.lateral_offset_m,
            "tilt_rad": self.tilt_rad,
            "undelivered": float(self.undelivered),
            "action_change_squared": float(change @ change) / len(change),
            "force_squared_n2": self.force_squared_n2,
            "turn_speed_squared_rad2_s2": self.turn_speed_rad_s**2,
            "strokes": self.outcome.strokes,
        }

    def costs(self) -> dict[str, float]:
        """The paper's preference items, unweighted, one per column of COSTS and in that order."""
        return {
            "C_d": self.distance_m,
            "C_v": self.speed_m_s,
            "C_f": self.force_away_n,
            "C_hf": self.high_force_n,
            "C_fd": self.outcome.on_person,
            "C_fdv": self.outcome.intake_speed_m_s,
        }


@dataclass(frozen=True)
class TaskReward:
    """What a reference policy is trained for. It knows nothing of anybody's preferences."""

    distance_per_m: float = -1.0
    action: float = -0.01
    per_delivered: float = 0.0
    per_spilled: float = 0.0
    per_stroke: float = 0.0
    speed_per_m_s: float = -0.05
    force_per_n: float = -0.03
    tilt: float = 0.0
    """times 1 - cos(tilt)"""

    def __call__(self, step: StepMeasures) -> float:
        """The reward of one control step."""
        force = step.force_at_target_n + step.force_away_n
        return float(
            self.distance_per_m * step.distance_m
            + self.action * math.sqrt(float(step.action @ step.action))
            + self.per_delivered * step.outcome.delivered
            + self.per_spilled * step.outcome.spilled
            + self.per_stroke * step.outcome.strokes
            + self.speed_per_m_s * step.speed_m_s
            + self.force_per_n * force
            + self.tilt * (1.0 - step.tool_up[2])
        )
