"""A laboratory's environment behind one interface: vectors in, vectors out, signals measured, pictures taken.

Observations are the environment's own, flattened, and behind them the action before and the share of the episode that
is over, which modes need (worker.domain.lab_modes). Actions are in [-1, 1], stretched to the environment's own range.
"""

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from app.installed_tasks.lab import LabDescription, Measured
from worker.domain.lab_modes import EPISODE_SHARE, PREVIOUS_ACTION
from worker.domain.spaces import Field, Space
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, Float32Array, FloatArray
from worker.sim.lab.errors import LabTaskBroken
from worker.sim.lab.found import columns_of
from worker.sim.lab.references import named_object
from worker.sim.quiet import few_repetitions

Picture = npt.NDArray[np.uint8]
UNBOUNDED = 1e6
"""Stands for the bound of an observation whose space has none."""
LARGEST_TABLE = 1000
"""Numbers of an observation that are no vector and are flattened; pictures have more."""
SMALLEST_PICTURE_PX = 64
NO_SCREEN = (
    "Without a screen MuJoCo draws by EGL: install libegl1 and libegl-mesa0 (Debian's names), or libosmesa6 and set "
    "MUJOCO_GL=osmesa in the worker's environment."
)


@dataclass(frozen=True)
class LabStep:
    """What functions of a lab.toml are given: everything about one control step."""

    observation: Any
    """after the step, as the environment gave it"""
    previous_observation: Any
    action: FloatArray
    """in the environment's own range"""
    info: Mapping[str, Any]
    reward: float
    environment: Any
    """unwrapped"""
    dt_s: float


@dataclass
class LabEnvironment:
    """One environment and how it is measured. Raises LabTaskBroken wherever it is not as it must be."""

    description: LabDescription
    folder: Path
    _made: Any = field(default=None, init=False)

    def __post_init__(self) -> None:
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            os.environ.setdefault("MUJOCO_GL", "egl")  # MuJoCo reads it when it is imported, by what follows
        with few_repetitions():
            self._signals = {
                name: self._measure(f"signals.{name}", each) for name, each in self.description.signals.items()
            }
            self._success = self._measure("success", self.description.success)
            self._build()
        space = self._made.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise LabTaskBroken(
                "environment",
                f"its action space is {space}. Actions must be one vector of continuous numbers, a Box of shape (A,); "
                "wrap the environment so that they are.",
            )
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            raise LabTaskBroken("environment", "its actions have no bounds. Wrap it with RescaleAction or state them.")
        self._low, self._high = space.low.astype(np.float64), space.high.astype(np.float64)
        names = self.description.environment.action_names or tuple(str(index) for index in range(len(self._low)))
        if len(names) != len(self._low):
            raise LabTaskBroken(
                "environment.action_names", f"{len(names)} names for {len(self._low)} actions; give one for each."
            )
        if any(index >= len(names) for index in self.description.environment.moving):
            raise LabTaskBroken("environment.moving", f"actions are numbered from 0 to {len(names) - 1}.")
        for index in self.description.environment.moving or range(len(names)):
            if not np.isclose(self._low[index], -self._high[index]):
                raise LabTaskBroken(
                    "environment.moving",
                    f"action {names[index]} goes from {self._low[index]:g} to {self._high[index]:g}, so its middle is "
                    "no standstill and a part of it no slower way. Name the other actions there, if it does not move "
                    "the robot, or wrap the environment so that it goes as far below 0 as above.",
                )
        self.action_names = names
        self.observation = self._described_observation()
        self.own_size = gymnasium.spaces.flatdim(self._made.observation_space)
        self.tip = self._columns("fields.tip", self.description.fields.tip)
        self.goal = self._columns("fields.goal", self.description.fields.goal)
        if self.tip and self.goal and len(self.tip) != len(self.goal):
            raise LabTaskBroken("fields", f"tip has {len(self.tip)} columns and goal {len(self.goal)}.")

    @property
    def action(self) -> Space:
        """The actions as the studio has them."""
        return Space(
            tuple(
                Field(name, 1, "1", -1.0, 1.0, f"-1 is {low:g} and 1 is {high:g} in the environment's own unit")
                for name, low, high in zip(self.action_names, self._low, self._high, strict=True)
            )
        )

    @property
    def action_bounds(self) -> tuple[FloatArray, FloatArray]:
        """(A,), (A,) in the environment's own unit."""
        return self._low, self._high

    def episode(
        self,
        act: Act,
        scenario: int,
        reference: Act | None = None,
        take: Callable[[int], Callable[[Picture], None] | None] | None = None,
    ) -> Trajectory:
        """One whole episode, from reset(seed=scenario). ``take`` says of every step, from 0 on, who
        is given its picture; None: nobody."""
        described = self.description
        if described.environment.reset == "rebuild":
            self._build()
        given, _ = self._made.reset(seed=scenario)
        previous = np.zeros(len(self._low), np.float32)
        seen = [self._vector(given, previous, 0)]
        actions, rows, costs, rewards = [], [], [], []
        velocity = np.zeros(len(self.tip))
        succeeded = False
        for step in range(described.episode_steps):
            asked = np.asarray(act(seen[-1]), np.float32)
            if asked.shape != previous.shape or not np.isfinite(asked).all():
                raise LabTaskBroken(
                    "policy", f"at step {step} it said {asked}, instead of {len(previous)} finite actions."
                )
            action = np.clip(asked, -1.0, 1.0)
            executed = self._low + (action.astype(np.float64) + 1.0) / 2.0 * (self._high - self._low)
            before = given
            given, reward, terminated, truncated, info = self._made.step(executed.astype(self._made.action_space.dtype))
            happened = LabStep(given, before, executed, info, float(reward), self._made.unwrapped, self._dt)
            seen.append(self._vector(given, action, step + 1))
            last = step + 1 == described.episode_steps
            succeeded = (last or self._says_success(info)) and bool(self._success(happened))
            measured = {name: self._number(f"signals.{name}", read(happened)) for name, read in self._signals.items()}
            velocity, moved = self._motion(seen[-2], seen[-1], velocity)
            change = (action - previous).astype(np.float64)
            builtin = {
                "undelivered": float(not succeeded),
                "action_change_squared": float(change @ change) / len(change),
            }
            everything = {**builtin, **moved, **measured}
            rows.append([everything[name] for name in described.signal_names])
            costs.append([measured[name] for name in described.cost_names])
            actions.append(action)
            rewards.append(float(reward))
            previous = action
            if take is not None and (keep := take(step)):
                keep(self.picture())
            if not last and (truncated or (terminated and not described.environment.ignore_terminated)):
                raise LabTaskBroken(
                    "episode_steps" if truncated else "environment.ignore_terminated",
                    f"the environment ended an episode after {step + 1} of {described.episode_steps} steps. "
                    + ("Lower episode_steps." if truncated else "Set it to true to go on to the last step."),
                )
        count = len(actions)
        observations, taken = np.array(seen, np.float32), np.array(actions, np.float32)
        nothing = np.empty((count + 1, 0), np.float32)
        return Trajectory(
            observations=observations,
            actions=taken,
            reference_actions=taken if reference is None else reference(observations[:-1]),
            signals=np.array(rows, np.float32),
            costs=np.array(costs, np.float32).reshape(count, -1),
            task_rewards=np.array(rewards, np.float32),
            joint_positions=nothing,
            particles=nothing,
            head_quaternions=nothing,
            arm_positions_rad=nothing,
            target_m=nothing,
            contact_force_n=np.zeros(count, np.float32),
            success=succeeded,
            scenario=scenario,
            task=described.name,
            body="",
            skin_tone=0,
        )

    def first_observation(self, scenario: int) -> Float32Array:
        """(D,) With which an episode begins."""
        given, _ = self._made.reset(seed=scenario)
        return self._vector(given, np.zeros(len(self._low), np.float32), 0)

    def picture(self) -> Picture:
        """(height, width, 3) as the environment draws itself; sides are even, as videos want them."""
        try:
            drawn = np.asarray(self._made.render())
        except Exception as error:  # whatever code from elsewhere may do
            raise LabTaskBroken(
                "environment",
                f"render() failed ({type(error).__name__}: {error}). {NO_SCREEN}",
            ) from error
        if drawn.ndim != 3 or drawn.shape[2] != 3 or drawn.dtype != np.uint8:
            raise LabTaskBroken(
                "environment",
                f"render() gave {drawn.dtype} of shape {drawn.shape}; rgb_array must give uint8 of "
                "shape (height, width, 3).",
            )
        height, width = drawn.shape[0] // 2 * 2, drawn.shape[1] // 2 * 2
        if min(height, width) < SMALLEST_PICTURE_PX:
            raise LabTaskBroken(
                "environment.kwargs",
                f"pictures of {drawn.shape[1]} x {drawn.shape[0]} pixels are too small to judge by; give sizes there.",
            )
        return np.ascontiguousarray(drawn[:height, :width])

    def close(self) -> None:
        """Free what it holds."""
        self._made.close()

    # Private

    def _says_success(self, info: Mapping[str, Any]) -> bool:
        """Some environments say it at the end alone: it has not succeeded before."""
        return self.description.success.info is None or self.description.success.info in info

    @property
    def _dt(self) -> float:
        return 1.0 / self.description.environment.rate_hz

    def _build(self) -> None:
        if self._made is not None:
            self._made.close()
        said = self.description.environment
        key = "environment.id" if said.id else "environment.factory"
        arguments = {"render_mode": "rgb_array", **said.kwargs}
        make = gymnasium.make if said.id else named_object(self.folder, key, str(said.factory))
        first = (said.id,) if said.id else ()
        try:
            self._made = make(*first, **arguments)
        except LabTaskBroken:
            raise
        except Exception as error:  # whatever code from elsewhere may do
            raise LabTaskBroken(key, _not_made(error, said.id or str(said.factory))) from error
        if not isinstance(self._made, gymnasium.Env):
            raise LabTaskBroken(key, f"gave a {type(self._made).__name__}, which is no gymnasium.Env.")
        if self._made.render_mode != "rgb_array":
            raise LabTaskBroken(
                key,
                "has no render_mode 'rgb_array', so nobody can be shown what it does. Give it one (see Env.render).",
            )

    def _described_observation(self) -> Space:
        space = self._made.observation_space
        parts = space.spaces if isinstance(space, gymnasium.spaces.Dict) else {"observation": space}
        fields = []
        for name, part in parts.items():
            if not isinstance(part, gymnasium.spaces.Box):
                raise LabTaskBroken(
                    "environment",
                    f"its observation {name!r} is {part}. Observations must be a Box or a Dict of them; wrap the "
                    "environment with gymnasium.wrappers.FlattenObservation or your own.",
                )
            size = gymnasium.spaces.flatdim(part)
            if len(part.shape) > 1 and (part.dtype == np.uint8 or size > LARGEST_TABLE):
                raise LabTaskBroken(
                    "environment",
                    f"its observation {name!r} is a picture {part.shape}; only numbers are known. Leave it out.",
                )
            low, high = float(np.min(part.low)), float(np.max(part.high))
            fields.append(Field(name, size, "as the environment has it", _finite(low), _finite(high), "of the lab"))
        count = len(self._low)
        return Space(
            (
                *fields,
                Field(PREVIOUS_ACTION, count, "1", -1.0, 1.0, "the action executed in the step before, 0 at the start"),
                Field(EPISODE_SHARE, 1, "1", 0.0, 1.0, "share of the episode's steps that are over"),
            )
        )

    def _columns(self, key: str, said: str | None) -> tuple[int, ...]:
        if said is None:
            return ()
        return columns_of(Space(self.observation.fields[:-2]), key, said)

    def _measure(self, key: str, said: Measured) -> Callable[[LabStep], Any]:
        if said.function is not None:
            return self._guarded(key, named_object(self.folder, f"{key}.function", said.function))

        def read(step: LabStep) -> Any:
            key_of_info = str(said.info)
            if key_of_info not in step.info:
                known = ", ".join(sorted(map(str, step.info))) or "nothing"
                raise LabTaskBroken(f"{key}.info", f"the environment's info has no {said.info!r}; it has {known}.")
            return step.info[key_of_info]

        return read

    def _guarded(self, key: str, function: Callable[[LabStep], Any]) -> Callable[[LabStep], Any]:
        def call(step: LabStep) -> Any:
            try:
                return function(step)
            except Exception as error:  # whatever code from elsewhere may do
                raise LabTaskBroken(f"{key}.function", f"failed with {type(error).__name__}: {error}") from error

        return call

    def _number(self, key: str, value: Any) -> float:
        if np.size(value) != 1:
            raise LabTaskBroken(key, f"is of length {np.size(value)}; it must be one number at every step.")
        number = float(np.asarray(value, np.float64).reshape(()))
        if not math.isfinite(number):
            raise LabTaskBroken(key, f"was {number}; it must be a finite number at every step.")
        return number

    def _vector(self, given: Any, previous: Float32Array, step: int) -> Float32Array:
        own = np.asarray(gymnasium.spaces.flatten(self._made.observation_space, given), np.float32)
        if not np.isfinite(own).all():
            raise LabTaskBroken(
                "environment", f"its observation before step {step} has values that are missing or not finite (NaN)."
            )
        share = np.float32(step / self.description.episode_steps)
        return np.concatenate([own, previous, [share]]).astype(np.float32)

    def _motion(
        self, before: Float32Array, after: Float32Array, earlier: FloatArray
    ) -> tuple[FloatArray, dict[str, float]]:
        if not self.tip:
            return earlier, {}
        tip = after[list(self.tip)].astype(np.float64)
        velocity = (tip - before[list(self.tip)]) / self._dt
        acceleration = (velocity - earlier) / self._dt
        square = float(velocity @ velocity)
        found = {
            "speed_m_s": square**0.5,
            "speed_squared_m2_s2": square,
            "acceleration_squared_m2_s4": float(acceleration @ acceleration),
        }
        if self.goal:
            found["distance_m"] = float(np.linalg.norm(after[list(self.goal)] - tip))
        return velocity, found


def _finite(bound: float) -> float:
    return float(np.clip(bound, -UNBOUNDED, UNBOUNDED))


def _not_made(error: Exception, what: str) -> str:
    said = f"{what!r} could not be made ({type(error).__name__}: {error})."
    if isinstance(error, ModuleNotFoundError):
        return f"{said} Install its package into the studio's environment."
    if isinstance(error, gymnasium.error.NameNotFound | gymnasium.error.NamespaceNotFound):
        return f"{said} Name the module that registers it before a colon, as in panda_gym:PandaReach-v3."
    if "egl" in str(error).lower():
        return f"{said} {NO_SCREEN}"
    if isinstance(error, TypeError):
        return f"{said} Check environment.kwargs; it must take render_mode='rgb_array'."
    return (
        f"{said} Make it without the studio first, by the Python of .venv with the same kwargs and "
        "render_mode='rgb_array': a package may not fit another that is installed."
    )
