"""A laboratory's own task, as one ``lab.toml`` describes it: a Gymnasium environment, a policy, and what is measured.

Only the file is read here. What it names (modules, policies) is loaded in the worker's processes.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from app.installed_tasks.description import (
    NAMED,
    DescribedTask,
    InstalledTask,
    LanguageCode,
    Reference,
    TaskRefused,
    Text,
    Word,
    Words,
    like,
    parsed,
)

NO_PACKAGE = ""
"""Of an installed task that a lab.toml describes."""
LARGEST_RATE_HZ = 100.0

FOUND_FILE, SURFACE_FILE = "found.json", "response_surface.safetensors"
"""In a task's checkpoint/: the ways that were found; how they do, which is written last."""

ANY_FRAME = "the environment's own"
REFERENCE = "reference"
"""What the frozen policy is called among those of which one is chosen."""

_Columns = Annotated[
    str, like(r"(?=.)([^\[\]]+)?(\[\d+:\d+\])?", 'a key of the observation, columns as in "[0:3]", or both, "key[0:3]"')
]
"""Columns of an observation: a key of a Dict, a range of columns as in [0:3], or both."""


_ActionName = Annotated[
    str,
    like("[a-z][a-z0-9_]{0,19}", "at most 20 small letters, digits and underscores, and begin with a letter"),
]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


def _scales(said: Any) -> Any:
    if said not in ("delta", "velocity"):
        raise ValueError(
            "must be 'delta' or 'velocity': half of a torque or of a position is no slower way. Wrap the environment "
            "(examples/reacher does), and let the policy say changes or speeds"
        )
    return said


class LabEnvironment(_Table):
    """Which environment it is and how it is used."""

    id: str | None = None
    """as gymnasium.make() takes it, with the module that registers it: module:Name-v0"""
    factory: Reference | None = None
    """module:function that returns the environment"""
    kwargs: dict[str, Any] = {}
    """given to either, sizes and cameras of pictures among them"""
    rate_hz: float = Field(gt=0.0, le=LARGEST_RATE_HZ)
    """control steps per second"""
    actions: Annotated[Literal["delta", "velocity"], BeforeValidator(_scales)]
    """what an action is: a change of position or a speed. Only of these is a part also a slower way."""
    action_names: tuple[_ActionName, ...] = ()
    """one for each action; empty: numbers"""
    moving: tuple[int, ...] = ()
    """the actions that move the robot, from 0; empty: all. The others, a gripper's, are left as they are."""
    ignore_terminated: bool = False
    """go on to the last step although the environment says that the episode is over"""
    reset: Literal["seed", "rebuild"] = "seed"
    """rebuild: a new environment for every episode, where reset(seed) alone does not repeat an episode exactly"""
    frame: Annotated[str, Field(min_length=1, max_length=80)] = ANY_FRAME
    """in which frame observations and actions are; bundles say so, and refuse who says otherwise"""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.id is None) == (self.factory is None):
            raise ValueError("needs either id (a Gymnasium id) or factory (module:function)")
        return self


WHERE = ("file", "url", "function")
"""Where a policy is."""


class LabPolicy(_Table):
    """The frozen policy."""

    file: str | None = Field(default=None, min_length=1)
    """.onnx, .zip (Stable-Baselines3) or .safetensors (ours), beside the lab.toml"""
    url: Annotated[str, like(r"wss?://[^\s/]+.*", "the address of a websocket, such as ws://localhost:8000")] | None = (
        None
    )
    """ws://host:port of a policy server, as openpi's"""
    function: Reference | None = None
    """module:function, which is given what a server would be sent and returns an action or a chunk of them"""
    answer_s: float = Field(default=10.0, gt=0.0, le=600.0)
    """how long the server may take for an answer"""
    inputs: dict[Annotated[str, Field(min_length=1, max_length=80)], _Columns] = {}
    """what the server is sent: names, each with columns of the observation; empty: its parts by their own names"""
    prompt: str | None = Field(default=None, max_length=1000)
    """sent along with every observation"""
    execution_horizon: int = Field(default=1, ge=1, le=1000)
    """of every chunk of actions so many are executed before the next is asked for"""
    gain: float = Field(default=1.0, gt=0.0, le=1.0)
    """its actions that move the robot are multiplied by this, so that somebody may also want it quicker"""
    activation: Literal["relu", "tanh", "elu"] | None = None
    """of a Stable-Baselines3 network; None: what its algorithm uses unless told otherwise"""
    settings: dict[str, float] = {}
    """actions, by name, that stay at a value in the environment's own unit, as a controller's stiffness does"""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if sum(getattr(self, where) is not None for where in WHERE) != 1:
            raise ValueError(
                "needs either file, url (ws://host:port of a policy server) or function (module:function), and one of "
                "them alone"
            )
        if self.file and (asked := {"inputs", "prompt", "execution_horizon"} & self.model_fields_set):
            raise ValueError(f"{min(asked)} is for policy servers (url) and functions, and this policy is a file")
        if not self.url and "answer_s" in self.model_fields_set:
            raise ValueError("answer_s is for policy servers (url)")
        if not self.file and self.settings:
            raise ValueError("settings are for policies in files; a server or function says every action itself")
        return self


class Measured(_Table):
    """Where a number comes from at every step: a key of info, or a function of the step."""

    info: str | None = None
    function: Reference | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.info is None) == (self.function is None):
            raise ValueError("needs either info (a key of the environment's info) or function (module:function)")
        return self


class LabSignal(Measured):
    """Something that is measured at every step and that people may judge by."""

    unit: str = Field(max_length=20)
    words: dict[LanguageCode, Word]
    """what people call it; en is needed"""
    cost: bool = False
    """nobody wants more of it"""

    @model_validator(mode="after")
    def _in_english(self) -> Self:
        if "en" not in self.words:
            raise ValueError("needs words.en, for the experimenters' pages")
        return self


class LabFields(_Table):
    """Where the observation says what moves and where to, in metres; without them ways differ by time alone."""

    tip: _Columns | None = None
    goal: _Columns | None = None


class LabModes(_Table):
    """Which ways to do it differently are tried."""

    leave_out: tuple[str, ...] = ()
    groups: dict[Annotated[str, NAMED], tuple[str, ...]] = Field(default_factory=dict, max_length=4)
    """actions that are quicker or slower together, apart from all others: by names that lab.toml gives, their names"""


def _like(policy: dict[str, Any], own: Any) -> Any:
    """What an entry of ``policies`` says, and for the rest what ``policy`` says."""
    if not isinstance(own, dict):
        return own
    elsewhere = WHERE if own.keys() & {*WHERE} else ()
    return {**{key: value for key, value in policy.items() if key not in elsewhere}, **own}


class LabDescription(DescribedTask):
    """What ``lab.toml`` says."""

    name: Annotated[str, NAMED]
    """as stored in studies, trajectories and bundles"""
    words: Words = Words(tool="robot", target="goal")
    instructions: dict[LanguageCode, Text] = Field(default_factory=dict)
    """as in DescribedTask; a language without them reads neutral words"""
    environment: LabEnvironment
    policy: LabPolicy
    policies: dict[Annotated[str, NAMED], LabPolicy] = Field(default_factory=dict, max_length=7)
    """Others among which one is chosen for a person, instead of a filter; what is not said is as in ``policy``."""
    success: Measured
    """Whether the task has succeeded so far; what it says at the last step counts."""
    signals: dict[Annotated[str, NAMED], LabSignal] = Field(default_factory=dict)
    fields: LabFields = LabFields()
    modes: LabModes = LabModes()

    @model_validator(mode="before")
    @classmethod
    def _policies_are_like_the_policy(cls, said: Any) -> Any:
        policy, policies = (said.get(key) for key in ("policy", "policies")) if isinstance(said, dict) else (None, None)
        if not (isinstance(policy, dict) and isinstance(policies, dict)):
            return said
        return {**said, "policies": {name: _like(policy, own) for name, own in policies.items()}}

    @model_validator(mode="after")
    def _policies_can_be_told_apart(self) -> Self:
        for name, each in self.policies.items():
            if name == REFERENCE:
                raise ValueError(f"policies.{name} is what the one under policy is called; choose another name")
            if each == self.policy:
                raise ValueError(f"policies.{name} is the same as policy; give it another file, url, gain or settings")
        for each in (self.policy, *self.policies.values()):
            if unknown := sorted(set(each.settings) - set(self.environment.action_names)):
                raise ValueError(f"settings has {unknown[0]}, which is not among environment.action_names")
        return self

    @model_validator(mode="after")
    def _not_measured_already(self) -> Self:
        taken = sorted(set(self.signals) & set(BUILT_IN_SIGNALS))
        if taken:
            raise ValueError(f"signals.{taken[0]} is measured by the studio already; choose another name")
        if not (self.signals or self.fields.tip):
            raise ValueError("signals is empty and fields.tip is not given: there is nothing people could judge by")
        return self

    @model_validator(mode="after")
    def _hints_at_what_is_measured(self) -> Self:
        for name, hint in self.hints.items():
            unknown = sorted({*hint.less, *hint.more} - set(self.signal_names))
            if unknown:
                raise ValueError(f"hints.{name} is about {unknown[0]}, which is not among its signals")
        return self

    def policy_named(self, name: str) -> LabPolicy:
        """One of ``policies``; the empty name is the frozen policy's."""
        return self.policies[name] if name else self.policy

    @property
    def most_behaviours(self) -> int | None:
        """Policies to choose from; filters have no end of ways."""
        return len(self.policies) + 1 if self.policies else None

    @property
    def policy_is_looked_into(self) -> bool:
        """Never: whatever it is, a lab's policy is only asked what it does."""
        return False

    @property
    def policy_is_packed(self) -> bool:
        """Not what answers over a websocket, nor a function."""
        return all(each.file is not None for each in (self.policy, *self.policies.values()))

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Columns of the signals: what is measured in every lab, what fields allow for, what the lab declares."""
        tip = ("speed_m_s", "speed_squared_m2_s2", "acceleration_squared_m2_s4") if self.fields.tip else ()
        distance = ("distance_m",) if self.fields.tip and self.fields.goal else ()
        return ("undelivered", "action_change_squared", *tip, *distance, *self.signals)

    @property
    def cost_names(self) -> tuple[str, ...]:
        """The declared signals of which nobody wants more."""
        return tuple(name for name, signal in self.signals.items() if signal.cost)


BUILT_IN_SIGNALS = (
    "undelivered",
    "action_change_squared",
    "speed_m_s",
    "speed_squared_m2_s2",
    "acceleration_squared_m2_s4",
    "distance_m",
)


def read(file: Path) -> InstalledTask:
    """A lab.toml as a task; what the studio finds out about it lies in checkpoint/ beside it. Raises TaskRefused."""
    if not file.is_file():
        raise TaskRefused(f"There is no file {file}.")
    description = parsed(LabDescription, file)
    for key, said in {"policy": description.policy, **_by_key(description.policies)}.items():
        if said.file is None:
            continue
        policy = file.parent / said.file
        if not policy.is_file():
            raise TaskRefused(f"{file}: {key}.file names {policy}, which does not exist.")
        if policy.suffix not in {".onnx", ".zip", ".safetensors"}:
            raise TaskRefused(f"{file}: {key}.file must end in .onnx, .zip (Stable-Baselines3) or .safetensors.")
    return InstalledTask(description.name, NO_PACKAGE, file.parent.resolve(), description, picture="")


def whole(installed: InstalledTask) -> bool:
    """Whether the exploration came to its end: what is written last is there."""
    of_policies = isinstance(installed.description, LabDescription) and installed.description.policies
    return (installed.checkpoint / (FOUND_FILE if of_policies else SURFACE_FILE)).exists()


def _by_key(policies: dict[str, LabPolicy]) -> dict[str, LabPolicy]:
    return {f"policies.{name}": each for name, each in policies.items()}
