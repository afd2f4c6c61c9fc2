"""What one control step is worth: measurements -> the columns of SIGNALS and COSTS and the task's reward."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from worker.trajectory import COSTS, SIGNALS

FloatArray = npt.NDArray[np.float64]
Array = npt.NDArray[np.float32]

NEAR_M = 0.20
"""Closer than this the speed counts as speed near the person."""
SIDE_VIEW_M = 0.30
"""Closer than this a sideways offset from the mouth's axis counts."""
APPROACHING_M = 0.08
"""Further than this the height above the mouth counts ..."""
LOW_ENTRY_M = 0.08
"""... and it counts from this far below the mouth upwards."""
HIGH_FORCE_N = 10.0


@dataclass(frozen=True)
class StepMeasures:
    """Everything measured during one control step of 0.1 s. World frame, SI units.

    Forces and speeds are averages over the physics sub-steps, not snapshots of the last one.
    """

    spoon_m: FloatArray
    spoon_up: FloatArray
    mouth_m: FloatArray
    face: FloatArray
    speed_m_s: float
    speed_squared_m2_s2: float
    acceleration_m_s2: FloatArray
    """(3,) change of the step's mean velocity over 0.1 s"""
    force_at_target_n: float
    """summed normal force of arm and spoon on the person within 6 cm of the mouth"""
    force_away_n: float
    """the same, everywhere else"""
    action: FloatArray
    previous_action: FloatArray
    eaten: int
    """balls that entered the mouth in this step"""
    intake_speed_m_s: float
    """their speeds, summed"""
    spilled: int
    """balls that left the spoon in this step and were not eaten"""
    on_person: int
    """balls that touched the person for the first time in this step"""
    undelivered: bool
    """whether less than three quarters of the portion has been eaten so far"""

    @property
    def distance_m(self) -> float:
        """From the centre of the spoon's bowl to the centre of the mouth."""
        return float(np.linalg.norm(self.mouth_m - self.spoon_m))

    @property
    def high_force_n(self) -> float:
        """Force at the target when it is too much, else 0."""
        return self.force_at_target_n if self.force_at_target_n >= HIGH_FORCE_N else 0.0

    @property
    def height_above_target_m(self) -> float:
        """How far the spoon is above a line 8 cm below the mouth while it is still approaching; 0 at the mouth."""
        if self.distance_m <= APPROACHING_M:
            return 0.0
        return max(0.0, float(self.spoon_m[2] - self.mouth_m[2]) + LOW_ENTRY_M)

    @property
    def lateral_offset_m(self) -> float:
        """Distance of the spoon from the axis that leaves the mouth along the face direction, when near."""
        if self.distance_m >= SIDE_VIEW_M:
            return 0.0
        offset = self.spoon_m - self.mouth_m
        return float(np.linalg.norm(offset - (offset @ self.face) * self.face))

    @property
    def tilt_rad(self) -> float:
        """Angle between the spoon's up axis and the vertical."""
        return math.acos(min(1.0, max(-1.0, float(self.spoon_up[2]))))

    def signals(self) -> Array:
        """(S,) one value per column of SIGNALS."""
        values = {
            "distance_m": self.distance_m,
            "speed_m_s": self.speed_m_s,
            "speed_squared_m2_s2": self.speed_squared_m2_s2,
            "acceleration_squared_m2_s4": float(self.acceleration_m_s2 @ self.acceleration_m_s2),
            "near_speed_squared_m2_s2": self.speed_squared_m2_s2 if self.distance_m < NEAR_M else 0.0,
            "force_at_target_n": self.force_at_target_n,
            "force_away_n": self.force_away_n,
            "high_force_n": self.high_force_n,
            "spilled_on_person": self.on_person,
            "spilled": self.spilled,
            "intake_speed_m_s": self.intake_speed_m_s,
            "height_above_target_m": self.height_above_target_m,
            "lateral_offset_m": self.lateral_offset_m,
            "tilt_rad": self.tilt_rad,
            "undelivered": float(self.undelivered),
            "action_change_squared": float(np.mean((self.action - self.previous_action) ** 2)),
        }
        return np.array([values[name] for name in SIGNALS], np.float32)

    def costs(self) -> Array:
        """(6,) the paper's preference items, unweighted, one value per column of COSTS."""
        values = {
            "C_d": self.distance_m,
            "C_v": self.speed_m_s,
            "C_f": self.force_away_n,
            "C_hf": self.high_force_n,
            "C_fd": self.on_person,
            "C_fdv": self.intake_speed_m_s,
        }
        return np.array([values[name] for name in COSTS], np.float32)


@dataclass(frozen=True)
class TaskReward:
    """What the reference policy is trained for. It knows nothing of anybody's preferences."""

    distance_per_m: float = -1.0
    action: float = -0.01
    per_eaten: float = 2.0
    per_spilled: float = -1.0
    speed_per_m_s: float = -0.05
    force_per_n: float = -0.03
    tilt: float = -0.3

    def of(self, step: StepMeasures) -> float:
        """The reward of one control step."""
        force = step.force_at_target_n + step.force_away_n
        return float(
            self.distance_per_m * step.distance_m
            + self.action * np.linalg.norm(step.action)
            + self.per_eaten * step.eaten
            + self.per_spilled * step.spilled
            + self.speed_per_m_s * step.speed_m_s
            + self.force_per_n * force
            + self.tilt * (1.0 - step.spoon_up[2])
        )
