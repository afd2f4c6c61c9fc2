"""A laboratory's frozen policy: from a file, behind a websocket, or a function of the laboratory's."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.installed_tasks.lab import LabDescription
from worker.ml.policies import lab_policy
from worker.ml.policies.asked_policy import AskedPolicy, Asking, AtAddress
from worker.ml.policies.onnx_policy import NotAPolicy, OnnxPolicy
from worker.ml.policies.policy_client import PolicyFunction
from worker.sim.lab.errors import LabTaskBroken
from worker.sim.lab.found import Found, inputs_of
from worker.sim.lab.references import named_object


@dataclass(frozen=True)
class CalledFunction:
    """A policy that is a function of the laboratory's: see Where."""

    folder: Path
    named: str
    """module:function"""

    @property
    def who(self) -> str:
        """See Where."""
        return f"the function {self.named}"

    def connected(self) -> PolicyFunction:
        """See Where; imported in the process that asks."""
        try:
            return PolicyFunction(self.named, named_object(self.folder, "policy.function", self.named))
        except LabTaskBroken as error:
            raise NotAPolicy(error.what) from error


def policy_of(described: LabDescription, folder: Path, found: Found, name: str = "") -> OnnxPolicy | AskedPolicy:
    """The policy that a lab.toml in a folder names, or another of its policies, by name.

    Raises NotAPolicy, and LabTaskBroken for its inputs.
    """
    said, size = described.policy_named(name), sum(each.size for each in found.observation)
    gain = np.where(np.isin(np.arange(len(found.action)), found.moving), said.gain, 1.0)
    if said.file is not None:
        low, high = (np.array(each) for each in found.bounds)
        kept = {each.name: place for place, each in enumerate(found.action)}
        settings = {kept[action]: value for action, value in said.settings.items()}
        return lab_policy.load(folder / said.file, found.own_size, size, (low, high), gain, said.activation, settings)
    asking = Asking(
        at=CalledFunction(folder, said.function) if said.function else AtAddress(str(said.url), said.answer_s),
        inputs=inputs_of(described, found.observation, name),
        prompt=said.prompt,
        execution_horizon=said.execution_horizon,
        episode_steps=described.episode_steps,
        bounds=found.bounds,
        gain=tuple(gain.tolist()),
        name=name,
    )
    return AskedPolicy(asking, size, found.answered_others.get(name) if name else found.answered)
