"""What the program has found out about a laboratory's task: sizes, ranges of its modes, how long its way is.

Kept in a file beside the lab.toml, so that whoever learns knows the task without running any code of the laboratory.
"""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

from app.installed_tasks.lab import LabDescription, LabPolicy
from worker.domain.lab_modes import LabModes, PolicyChoice
from worker.domain.modes import Axis, ModeFamily
from worker.domain.spaces import Field, Space
from worker.domain.task import Answered, LabInterface, Task
from worker.sim.lab.errors import LabTaskBroken
from worker.whole_files import written_whole

_OF_FILES = {"file", "gain", "activation"}
_WORDS = {"title", "summary", "words", "instructions", "sliders", "hints", "usual_clip_steps"}
"""Nothing that was found depends on these."""
_OF_ASKED = {"function", "inputs", "prompt", "execution_horizon"}


def mark_of(described: LabDescription, folder: Path) -> str:
    """A fingerprint of what was found depends on: everything but names and words, and the policy itself.

    Where a policy server stands says nothing about the policy; it is known again by an answer (Found.answered).
    """
    kept = described.model_dump(mode="json", exclude=_WORDS)
    kept["environment"].pop("frame")
    kept["policy"] = _kept(described.policy)
    if not described.modes.groups:
        kept["modes"].pop("groups")
    others = kept.pop("policies")
    for name, each in described.policies.items():
        others[name] = {**_kept(each), "bytes": _hash_of(each, folder)}
    if others:
        kept["policies"] = others
    return hashlib.sha256(
        f"{json.dumps(kept, sort_keys=True)} {_hash_of(described.policy, folder)}".encode()
    ).hexdigest()


def _kept(policy: LabPolicy) -> dict[str, Any]:
    of_files = policy.model_dump(mode="json", include=_OF_FILES)
    return of_files | policy.model_dump(mode="json", include={*_OF_ASKED, "settings"}, exclude_defaults=True)


def _hash_of(policy: LabPolicy, folder: Path) -> str:
    """Of the file that it is, or that its function is in, if that lies beside lab.toml."""
    if policy.url is not None:
        return "of a server"
    file = folder / (policy.file or f"{str(policy.function).partition(':')[0]}.py")
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else "of a package"


@dataclass(frozen=True)
class Found:
    """Plain values."""

    mark: str
    """mark_of() the description it was found for"""
    observation: tuple[Field, ...]
    action: tuple[Field, ...]
    own_size: int
    """of the environment's own part of the observation"""
    bounds: tuple[tuple[float, ...], tuple[float, ...]]
    """of the actions in the environment's own unit"""
    moving: tuple[int, ...]
    tip: tuple[int, ...]
    goal: tuple[int, ...]
    start_distance_m: float
    axes: tuple[Axis, ...]
    dropped: dict[str, str]
    """which axes, or ends of them, were left out, and why"""
    notes: tuple[str, ...]
    reference: dict[str, float]
    """of the frozen policy's episodes: success, share of actions at their limit"""
    answered: Answered | None = None
    """what a policy server said when the task was explored"""
    witness: tuple[float, ...] = ()
    """(S,) of the signals, summed over the frozen policy's episode of one scenario: by it the environment, the lab's
    own functions and installed packages are known again, of which the mark knows nothing"""

    chooses: bool = False
    """whether the ways are policies of which one is chosen, and not a filter's"""
    answered_others: dict[str, Answered] = field(default_factory=dict)
    """as ``answered``, by the other policies' names"""
    groups: tuple[tuple[str, tuple[int, ...]], ...] = ()
    """names of groups of actions that have a gain of their own, each with its actions, from 0"""

    def modes(self, axes: tuple[Axis, ...] | None = None) -> ModeFamily:
        """The ways to do the task."""
        if self.chooses:
            return PolicyChoice(Space(self.observation), self.axes if axes is None else axes)
        return LabModes(
            Space(self.observation),
            self.axes if axes is None else axes,
            tuple(each.name for each in self.action),
            self.moving,
            self.tip,
            self.goal,
            self.start_distance_m,
            self.groups,
        )

    def task(self, described: LabDescription) -> Task:
        """What learning knows of the task."""
        return Task(
            name=described.name,
            title=described.title,
            observation=Space(self.observation),
            modes=self.modes(),
            calibrated_speed_weight=0.0,
            episode_steps=described.episode_steps,
            action=Space(self.action),
            control_step_s=1.0 / described.environment.rate_hz,
            signals=described.signal_names,
            costs=described.cost_names,
            is_a_labs=True,
            interface=self.interface(described),
        )

    def interface(self, described: LabDescription, policy: str = "") -> LabInterface:
        """What runs beside the robot has to know; ``policy``: by its name among several."""
        low, high = self.bounds
        said = described.policy_named(policy)
        return LabInterface(
            frame=described.environment.frame,
            own_size=self.own_size,
            low=low,
            high=high,
            moving=self.moving,
            gain=said.gain,
            inputs=inputs_of(described, self.observation, policy),
            prompt=said.prompt,
            execution_horizon=said.execution_horizon,
            function=said.function or "",
            settings=tuple(said.settings.items()),
        )

    def save(self, file: Path) -> None:
        """Write a JSON file that is either complete or absent."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with written_whole(file) as draft:
            draft.write_text(json.dumps(asdict(self), indent=2) + "\n")

    @classmethod
    def load(cls, file: Path) -> Self:
        """Read what save() wrote."""
        stored: dict[str, Any] = json.loads(file.read_text())
        kinds = {"observation": Field, "action": Field, "axes": Axis}
        for name, kind in kinds.items():
            stored[name] = tuple(kind(**each) for each in stored[name])
        for name in ("moving", "tip", "goal", "notes", "witness"):
            stored[name] = tuple(stored.get(name, ()))
        stored["groups"] = tuple((name, tuple(members)) for name, members in stored.get("groups", ()))
        stored["bounds"] = tuple(map(tuple, stored["bounds"]))
        if stored.get("answered"):
            stored["answered"] = _answered(stored["answered"])
        stored["answered_others"] = {name: _answered(each) for name, each in stored.get("answered_others", {}).items()}
        return cls(**stored)


def _answered(stored: dict[str, Any]) -> Answered:
    return Answered(tuple(stored["observation"]), tuple(map(tuple, stored["actions"])))


def inputs_of(
    described: LabDescription, observation: tuple[Field, ...], policy: str = ""
) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """What a policy server is sent: names with columns of the observation; without policy.inputs its own parts.

    Raises LabTaskBroken.
    """
    own, inputs = Space(observation[:-2]), described.policy_named(policy).inputs
    if not inputs:
        return tuple((field.name, tuple(range(own.size)[place])) for field, place in own.slices())
    key = f"policies.{policy}" if policy else "policy"
    return tuple((name, columns_of(own, f'{key}.inputs."{name}"', said)) for name, said in inputs.items())


def columns_of(own: Space, key: str, said: str) -> tuple[int, ...]:
    """The columns that a lab.toml names as "part", "[0:3]" or "part[0:3]". Raises LabTaskBroken."""
    name, _, rest = said.partition("[")
    try:
        whole = range(own.size) if not name else range(*own.slice_of(name).indices(own.size))
    except KeyError as error:
        raise LabTaskBroken(key, str(error.args[0])) from error
    found = re.fullmatch(r"(\d+):(\d+)\]", rest)
    columns = tuple(whole)[int(found[1]) : int(found[2])] if found else tuple(whole)
    if not columns:
        raise LabTaskBroken(key, f"{said} has no columns; the observation has {own.size}.")
    return columns
