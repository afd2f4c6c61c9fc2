"""What was made for a task beforehand: policies refined for somebody else, as they are and in archived modes.

A mode that is good for one person is good for people like them, so that a few of them, each driven once for everybody,
hold for most people what a search of their own would find.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from worker.compute import simulation
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import untried
from worker.ml.policies.gaussian import GaussianPolicy
from worker.tasks import registry

if TYPE_CHECKING:
    from worker.ml.filters.fitting.response_surface import ResponseSurface


@dataclass(frozen=True)
class Archived:
    """A policy that was refined beforehand, and the mode in which it is executed."""

    task: str
    name: str
    """the policy's; in a mode with the mode's number behind it"""
    policy: GaussianPolicy
    mode: Mapping[str, float] = field(default_factory=dict)
    """by the names of its axes; none: as it is"""
    around: "ResponseSurface | None" = None
    """of other modes, beside the policy as it is; None where this is in a mode, and where none were explored"""

    def exported(self, reference: Sequence[Trajectory]) -> Act:
        """The policy, or where it is in a mode a filter that does the same behind the shield of one that is untried.

        ``reference``: the frozen policy's rollouts in the gate's scenarios, of which that shield is made.
        """
        if not self.mode:
            return self.policy.mean
        task, frozen = registry.task(self.task), simulation.reference_policy(self.task)
        shield = untried(task.observation, frozen.action_size, reference)
        weights = FilterWeights(refined=self.policy.weights, refined_mode=self.mode, shield=shield)
        return act_of(task.modes, frozen, weights)


def everything_archived(task: str) -> Sequence[Archived]:
    """Policies as they are, then policies in modes; none where nothing was made for the task."""
    policies = simulation.archived_policies(task)
    as_they_are = [
        Archived(task, name, policy, around=simulation.surface_around(task, name)) for name, policy in policies.items()
    ]
    in_modes = [
        Archived(task, f"{name} {number}", policies[name], mode)
        for number, (name, mode) in enumerate(archived_modes(task), start=1)
    ]
    return [*as_they_are, *in_modes]


def archived_modes(task: str) -> list[tuple[str, dict[str, float]]]:
    """Which policy in which mode; none: ``python -m worker archive-policies-in-modes`` was not run.

    Modes of policies that are gone, and of axes that the task has no more, are left out.
    """
    file = simulation.archived_modes_file(task)
    if not file.exists():
        return []
    policies, axes = simulation.archived_policies(task), set(registry.task(task).modes.names)
    tried = json.loads(file.read_text())["modes"]
    kept = [(each["policy"], each["mode"]) for each in tried if each["kept"]]
    return [(policy, mode) for policy, mode in kept if policy in policies and set(mode) <= axes]
