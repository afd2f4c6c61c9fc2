"""The arrays of one episode, with their shapes checked, and how they are stored (.npz, never pickle)."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO, Protocol, Self

import numpy as np

from worker.domain.type_aliases import Float32Array

COSTS = ("C_d", "C_v", "C_f", "C_hf", "C_fd", "C_fdv")
"""The paper's six preference items (r^H), unweighted and non-negative, one column each."""

SIGNALS = (
    "distance_m",
    "speed_m_s",
    "speed_squared_m2_s2",
    "acceleration_squared_m2_s4",
    "near_speed_squared_m2_s2",
    "force_at_target_n",
    "force_away_n",
    "high_force_n",
    "spilled_on_person",
    "spilled",
    "intake_speed_m_s",
    "height_above_target_m",
    "lateral_offset_m",
    "tilt_rad",
    "undelivered",
    "action_change_squared",
    "force_squared_n2",
    "turn_speed_squared_rad2_s2",
    "strokes",
)
"""What a robot can measure about one control step; the structured reward model is linear in these columns.

Every task has all of them; a column that means nothing in a task is 0."""

BODIES = ("broad", "slim")
"""The two shapes of the person's body."""
SKIN_TONES = 6
"""Skin tones are numbered from 0, the lightest, to 5, the darkest."""


class Recorded(Protocol):
    """What preferences are learned from, wherever it was recorded: T steps of signals, observations and actions."""

    @property
    def signals(self) -> Float32Array:
        """(T, S) what was measured; the columns are the study's"""
        ...

    @property
    def observations(self) -> Float32Array:
        """(T + 1, D), D may be 0"""
        ...

    @property
    def actions(self) -> Float32Array:
        """(T, A), A may be 0"""
        ...

    @property
    def success(self) -> bool:
        """Whether the whole of it succeeded"""
        ...

    def __len__(self) -> int:
        """T"""
        ...


@dataclass(frozen=True)
class Recording:
    """An episode that was recorded elsewhere. Raises ValueError when arrays disagree about T, or are not finite."""

    signals: Float32Array
    observations: Float32Array
    actions: Float32Array
    success: bool

    def __post_init__(self) -> None:
        steps = len(self.signals)
        _require_shape("signals", self.signals, (steps, None))
        _require_shape("observations", self.observations, (steps + 1, None))
        _require_shape("actions", self.actions, (steps, None))
        for name in ("signals", "observations", "actions"):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f"{name} has values that are missing or not finite.")

    def __len__(self) -> int:
        return len(self.signals)

    def save(self, target: Path | IO[bytes]) -> None:
        """Write every array and value to one compressed .npz file."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        np.savez_compressed(target, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, source: Path | IO[bytes]) -> Self:
        """Read what save() wrote. Raises KeyError for another file."""
        with np.load(source, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in ("signals", "observations", "actions")}
            return cls(**arrays, success=bool(stored["success"]))


class OutdatedTrajectory(ValueError):
    """An older version of the studio recorded this, in another simulation: there is no way to complete it."""


@dataclass(frozen=True)
class Trajectory:
    """One episode of T control steps with D observations, S signals and P particles.

    Raises ValueError when an array's shape disagrees with the number of actions.
    """

    observations: Float32Array
    """(T + 1, D)"""
    actions: Float32Array
    """(T, 7) as executed, in [-1, 1]"""
    reference_actions: Float32Array
    """(T, 7) the frozen policy's mean action in the same states"""
    signals: Float32Array
    """(T, S) columns as in SIGNALS"""
    costs: Float32Array
    """(T, 6) columns as in COSTS"""
    task_rewards: Float32Array
    """(T,)"""
    joint_positions: Float32Array
    """(T + 1, 7) rad"""
    particles: Float32Array
    """(T + 1, P, 3) m in the world frame; NaN once a particle has been eaten or lost"""
    head_quaternions: Float32Array
    """(T + 1, 4) xyzw in the world frame"""
    arm_positions_rad: Float32Array
    """(T + 1, 2, 4) the person's right and left arm: shoulder flexion, abduction, rotation, and elbow flexion"""
    target_m: Float32Array
    """(T + 1, 3) mouth or itch in the world frame"""
    contact_force_n: Float32Array
    """(T,) summed normal force on the person"""
    success: bool
    scenario: int
    task: str
    body: str
    """one of BODIES; empty in a laboratory's own environment, in which there is no person of ours"""
    skin_tone: int

    def __post_init__(self) -> None:
        steps = len(self.actions)
        if not self.body:
            self._require_lab_shapes(steps)
            return
        expected = {
            "observations": (steps + 1, None),
            "actions": (steps, 7),
            "reference_actions": (steps, 7),
            "signals": (steps, len(SIGNALS)),
            "costs": (steps, len(COSTS)),
            "task_rewards": (steps,),
            "joint_positions": (steps + 1, 7),
            "particles": (steps + 1, None, 3),
            "head_quaternions": (steps + 1, 4),
            "arm_positions_rad": (steps + 1, 2, 4),
            "target_m": (steps + 1, 3),
            "contact_force_n": (steps,),
        }
        for name, shape in expected.items():
            _require_shape(name, getattr(self, name), shape)

    def _require_lab_shapes(self, steps: int) -> None:
        """A laboratory's own actions, signals and costs; nothing of our robot and person."""
        lab = {
            "observations": (steps + 1, None),
            "actions": (steps, None),
            "reference_actions": (steps, None),
            "signals": (steps, None),
            "costs": (steps, None),
            "task_rewards": (steps,),
            "contact_force_n": (steps,),
        }
        for name, shape in lab.items():
            _require_shape(name, getattr(self, name), shape)

    def __len__(self) -> int:
        return len(self.actions)

    def save(self, target: Path | IO[bytes]) -> None:
        """Write every array and value to one compressed .npz file."""
        arrays = {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}
        np.savez_compressed(target, allow_pickle=False, **arrays)

    @classmethod
    def load(cls, source: Path | IO[bytes]) -> Self:
        """Read what save() wrote. Raises ValueError for a file that holds anything but plain arrays, and
        OutdatedTrajectory for one that an older version wrote."""
        with np.load(source, allow_pickle=False) as stored:
            missing = [field.name for field in fields(cls) if field.name not in stored]
            if missing:
                raise OutdatedTrajectory(
                    f"This trajectory lacks {', '.join(missing)}: an older version of the studio recorded it. "
                    "Run its scenario again."
                )
            values = {field.name: stored[field.name] for field in fields(cls)}
        plain = {"success": bool, "scenario": int, "task": str, "body": str, "skin_tone": int}
        return cls(**{name: plain[name](value) if name in plain else value for name, value in values.items()})


def _require_shape(name: str, array: Float32Array, shape: tuple[int | None, ...]) -> None:
    matches = array.ndim == len(shape) and all(
        wanted in (None, got) for wanted, got in zip(shape, array.shape, strict=True)
    )
    if not matches:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}.")
