"""A laboratory's frozen policy, from a file or behind a websocket."""

from pathlib import Path

import numpy as np

from app.installed_tasks.lab import LabDescription
from worker.ml.policies import lab_policy
from worker.ml.policies.onnx_policy import OnnxPolicy
from worker.ml.policies.remote_policy import Asking, RemotePolicy
from worker.sim.lab.found import Found, inputs_of


def policy_of(described: LabDescription, folder: Path, found: Found) -> OnnxPolicy | RemotePolicy:
    """The policy that a lab.toml in a folder names. Raises NotAPolicy, and LabTaskBroken for policy.inputs."""
    said, size = described.policy, sum(each.size for each in found.observation)
    if said.file is not None:
        low, high = (np.array(each) for each in found.bounds)
        return lab_policy.load(folder / said.file, found.own_size, size, (low, high), said.gain, said.activation)
    asking = Asking(
        url=str(said.url),
        answer_s=said.answer_s,
        inputs=inputs_of(described, found.observation),
        prompt=said.prompt,
        execution_horizon=said.execution_horizon,
        episode_steps=described.episode_steps,
        bounds=found.bounds,
        gain=said.gain,
    )
    return RemotePolicy(asking, size, found.answered)
