"""Behaviours: the ways in which a study's pool executes a scenario, so that people have something to disagree about.

Most are execution modes of the frozen policy. Some are the policy's own samples, some are disturbed, some come from an
earlier, clumsier stage of its training. All of it derives from the scenario's number.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from worker.domain.lab_modes import PolicyChoice
from worker.domain.spaces import CONTROL_STEP_S
from worker.domain.task import Task

DIFFERENT_ENOUGH = 0.45
"""Two modes of one scenario differ by at least this share of some axis' range, so that a person can see it."""
PATIENCE = 100
"""So many random modes are tried before modes may be more alike."""
PLAIN_SHARE = 0.8
"""Share of the behaviours that are a mode and nothing else; the others are equally often sampled, disturbed, early."""
TEMPERATURES = (0.5, 1.0, 1.5)
DISTURBANCES = (0.1, 0.2)
"""Largest deviations in action units: about the policy's own spread and twice that."""


@dataclass(frozen=True)
class Behaviour:
    """One way of executing a scenario. Plain values: travels between processes and is stored with the rollout."""

    mode: dict[str, float] = field(default_factory=dict)
    """by the names of the task's axes"""
    temperature: float = 0.0
    """of the policy's samples; 0: its mean action"""
    disturbance: float = 0.0
    """amplitude of slow waves added to the action"""
    checkpoint: str = ""
    """an early policy's name; empty: the reference policy"""
    seed: tuple[int, ...] = ()
    """of whatever is random about it"""

    def described(self) -> dict[str, Any]:
        """As it is stored: only what differs from the reference policy."""
        return {name: value for name, value in asdict(self).items() if value}


def draw_behaviours(
    task: Task, scenario: int, count: int, checkpoints: Sequence[str] = (), sampled: bool = True
) -> list[Behaviour]:
    """Random behaviours of one scenario, no two of them alike. ``checkpoints``: the early policies there are;
    ``sampled``: whether the policy can draw actions at random. Where one of several policies is chosen, behaviours are
    those policies and nothing else; raises ValueError for more than there are."""
    rng = np.random.default_rng([scenario, 1])
    if isinstance(task.modes, PolicyChoice):
        if count > len(task.modes.axes) + 1:
            raise ValueError(f"{task.name} has {len(task.modes.axes) + 1} policies, not {count}.")
        return [Behaviour(task.modes.named(mode)) for mode in _different_modes(task, count, rng)]
    modes = _different_modes(task, count, rng)
    return [_dressed(task, mode, (scenario, index), checkpoints, rng, sampled) for index, mode in enumerate(modes)]


def _different_modes(task: Task, count: int, rng: np.random.Generator) -> list[npt.NDArray[np.float64]]:
    width = np.array([axis.high - axis.low for axis in task.modes.axes])
    chosen: list[npt.NDArray[np.float64]] = []
    apart = DIFFERENT_ENOUGH
    while len(chosen) < count:
        for mode in task.modes.sample(PATIENCE, rng):
            if len(chosen) < count and all((np.abs(mode - other) / width).max() >= apart for other in chosen):
                chosen.append(mode)
        apart *= 0.9  # many behaviours on few axes have to stand closer
    return chosen


def _dressed(
    task: Task,
    mode: npt.NDArray[np.float64],
    seed: tuple[int, ...],
    checkpoints: Sequence[str],
    rng: np.random.Generator,
    sampled: bool,
) -> Behaviour:
    """The mode itself, or with something else on top: modes keep the behaviours of a scenario apart."""
    plain, kind, which = rng.random(3)
    named = task.modes.named(mode)
    if plain < PLAIN_SHARE:
        return Behaviour(named)
    if kind < 1 / 3 and sampled:
        return Behaviour(named, temperature=TEMPERATURES[int(which * len(TEMPERATURES))], seed=seed)
    if kind < 2 / 3 or not checkpoints:
        return Behaviour(named, disturbance=DISTURBANCES[int(which * len(DISTURBANCES))], seed=seed)
    return Behaviour(named, checkpoint=checkpoints[int(which * len(checkpoints))])


class SlowWaves:
    """Two slow sine waves per joint with random phases: a calm but visible deviation of at most the amplitude."""

    def __init__(self, amplitude: float, rng: np.random.Generator, actions: int = 7) -> None:
        self._amplitude = amplitude
        self._hertz = rng.uniform(0.2, 0.6, (2, actions))
        self._phase = rng.uniform(0.0, 2 * np.pi, (2, actions))
        self._step = 0

    def __call__(self) -> npt.NDArray[np.float32]:
        """The deviation of the next control step."""
        angle = 2 * np.pi * self._hertz * self._step * CONTROL_STEP_S + self._phase
        self._step += 1
        wave: npt.NDArray[np.float32] = (self._amplitude * np.sin(angle).mean(axis=0)).astype(np.float32)
        return wave
