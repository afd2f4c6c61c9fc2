"""What a task is to those who learn it: what simulation, learning and bundles share of it.

Each task's own stands beside its environment in the task's folder and travels from there as an argument.
"""

from dataclasses import dataclass, field

from worker.domain.modes import ModeFamily
from worker.domain.spaces import CONTROL_STEP_S, JOINT_ACTION, Space
from worker.domain.trajectory import COSTS, SIGNALS


@dataclass(frozen=True)
class Answered:
    """What a policy server said of one observation when the task was explored, by which it is known again."""

    observation: tuple[float, ...]
    """(D,)"""
    actions: tuple[tuple[float, ...], ...]
    """(H, A) in [-1, 1]"""


@dataclass(frozen=True)
class LabInterface:
    """What whoever runs a filter beside a laboratory's robot has to know, and learning has not."""

    frame: str
    own_size: int
    """of the environment's own part of the observation, which comes first"""
    low: tuple[float, ...]
    """(A,) of the actions in the environment's own unit"""
    high: tuple[float, ...]
    moving: tuple[int, ...]
    """the actions that are speeds or changes of position, from 0"""
    gain: float
    """by which the policy's actions that move the robot are multiplied"""
    inputs: tuple[tuple[str, tuple[int, ...]], ...]
    """what a policy is sent: names with columns of the observation"""
    prompt: str | None
    execution_horizon: int
    function: str = ""
    """module:name of a policy that is a function; empty: it is none"""
    settings: tuple[tuple[str, float], ...] = ()
    """actions that stay at a value, in the environment's own unit: the policy's file says the others"""


@dataclass(frozen=True)
class Task:
    """One thing the robot does for a person."""

    name: str
    """as stored in studies, trajectories and bundles"""
    title: str = field(default="", kw_only=True)
    """Pages read task.toml. This one belongs to the mark under which rollouts and benchmark results of the first tasks
    are kept (policy_mark)."""
    observation: Space
    modes: ModeFamily
    calibrated_speed_weight: float
    """Weight of the calibrated speed cost with which the reference person (omega = 1) is content with the shipped
    policy's own speed; the worker's command speed-weight measures it, to be repeated for a new policy."""
    speed_counts_near: bool = True
    """Whether the calibrated speed cost counts within 20 cm of the target; not where motion there is the service."""
    printed_betas: tuple[float, float, float, float] = field(default=(1.0, 1.5, 0.1, 1.0), repr=False)
    """Weights of the printed method's losses Rec, Pref, KL and Dyn (paper, Implementation Details). No rollout depends
    on them, so they are no part of its mark."""
    episode_steps: int = 100
    """as in the folder's task.toml"""
    pieces: int = 8
    """of food or water in the usual portion"""
    can_spill: bool = field(default=True, repr=False)
    """whether there is anything to be spilled"""
    action: Space = field(default=JOINT_ACTION, repr=False)
    control_step_s: float = field(default=CONTROL_STEP_S, repr=False)
    signals: tuple[str, ...] = field(default=SIGNALS, repr=False)
    """columns of the signals of its trajectories"""
    costs: tuple[str, ...] = field(default=COSTS, repr=False)
    """columns of the costs of its trajectories"""
    is_a_labs: bool = field(default=False, repr=False)
    """A laboratory's own environment and policy: filters act on what the policy says, which is not looked into."""
    interface: LabInterface | None = field(default=None, repr=False)
    """of a laboratory's"""
