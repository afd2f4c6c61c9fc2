"""To which observation, units, rate and frame a bundle belongs: what ``run_filter.py --serve`` holds others to."""

import hashlib
import json
from typing import Any

from worker.domain.spaces import Space
from worker.domain.task import LabInterface, Task
from worker.ml.policies.asked_policy import AskedPolicy
from worker.ml.policies.reference import ReferencePolicy

ROBOT_FRAME = "robot base"
"""Of the studio's own tasks; see worker.domain.spaces."""


def interface_of(task: Task, policy: ReferencePolicy) -> dict[str, Any]:
    """Plain values, and a fingerprint of them."""
    lab = task.interface or _of_ours(task)
    own = own_observation(task)
    found = {
        "task": task.name,
        "frame": lab.frame,
        "control_rate_hz": round(1.0 / task.control_step_s, 6),
        "episode_steps": task.episode_steps,
        "observation": [
            {"name": field.name, "size": field.size, "unit": field.unit, "low": field.low, "high": field.high}
            for field in own.fields
        ],
        "adds_previous_action_and_share": task.interface is not None,
        "action": {
            "names": [field.name for field in task.action.fields],
            "unit": task.action.fields[0].unit if task.interface is None else "as the environment has it",
            "low": list(lab.low),
            "high": list(lab.high),
            "moving": list(lab.moving),
        },
        "policy": {
            "answers_from_a_server": isinstance(policy, AskedPolicy) and not lab.function,
            "gain": lab.gain,
            "inputs": {name: list(columns) for name, columns in lab.inputs},
            "prompt": lab.prompt,
            "execution_horizon": lab.execution_horizon,
            **({"function": lab.function} if lab.function else {}),
            **({"settings": dict(lab.settings)} if lab.settings else {}),
        },
    }
    written = json.dumps(found, sort_keys=True, separators=(",", ":")).encode()
    return found | {"fingerprint": hashlib.sha256(written).hexdigest()}


def own_observation(task: Task) -> Space:
    """What clients see, without what the loop adds to a laboratory's."""
    return Space(task.observation.fields[:-2] if task.interface else task.observation.fields)


def _of_ours(task: Task) -> LabInterface:
    """The studio's robots take the studio's own vectors."""
    size = task.action.size
    low, high = (
        tuple(getattr(field, end) for field in task.action.fields for _ in range(field.size)) for end in ("low", "high")
    )
    return LabInterface(ROBOT_FRAME, task.observation.size, low, high, tuple(range(size)), 1.0, (), None, 1)
