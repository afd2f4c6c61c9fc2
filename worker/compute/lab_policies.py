"""A laboratory's frozen policy, from a file or behind a websocket."""

from pathlib import Path

import numpy as np

from app.installed_tasks.lab import LabDescription
from worker.ml.policies import lab_policy
from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.remote_policy import Asking, RemotePolicy
from worker.sim.lab.found import Found, inputs_of


def policy_of(described: LabDescription, folder: Path, found: Found, name: str = "") -> OnnxPolicy | RemotePolicy:
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
        url=str(said.url),
        answer_s=said.answer_s,
        inputs=inputs_of(described, found.observation, name),
        prompt=said.prompt,
        execution_horizon=said.execution_horizon,
        episode_steps=described.episode_steps,
        bounds=found.bounds,
        gain=tuple(gain.tolist()),
        name=name,
    )
    return RemotePolicy(asking, size, found.answered_others.get(name) if name else found.answered)
