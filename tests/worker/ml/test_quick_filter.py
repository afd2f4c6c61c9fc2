"""What somebody who still answers gets in a minute: an archived policy as it is, or a mode where that is better."""

from dataclasses import replace

import numpy as np
import pytest

from tests.worker import invented
from tests.worker.ml.test_pbarl import POLICY, World, problem, reference, surface
from worker.domain.scenarios import GATE, first_of
from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement.archived_policy import ArchivedPolicy
from worker.ml.reinforcement.quick_filter import quick_filter
from worker.ml.rewards.reward_models import StructuredReward

__all__ = ["reference", "surface"]


def times(size: float, *, success: bool = True) -> ArchivedPolicy:
    """A policy whose mean actions are so many times as large before they are squashed, and so its speed."""
    weights = {name: array.copy() for name, array in POLICY.weights.items()}
    for name in ("weight_2", "bias_2"):
        weights[name] *= size
    policy = GaussianPolicy(weights)
    driven = World().collect(policy.mean, first_of(GATE, 6), 0.0, 0)
    return ArchivedPolicy(policy, [replace(each, success=success) for each in driven])


def quick(
    weight: float, archived: list[ArchivedPolicy], reference: list[Trajectory], surface: ResponseSurface
) -> tuple[FilterDraft, World]:
    world = World()
    asked = problem(weight, reference)
    return quick_filter(asked, surface, Pool(), archived, reference, world.collect), world


def test_nothing_is_driven_where_an_archived_policy_is_better_than_any_mode_that_is_foreseen(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    slow, slower, failing = times(0.3), times(0.03), times(0.0, success=False)
    found, world = quick(-1.0, [slow, slower, failing], reference, surface)
    assert found.weights.refined is slower.policy.weights
    assert not world.asked
    assert found.trials[-1].refined
    driven = World().collect(act_of(invented.TASK.modes, POLICY, found.weights), first_of(GATE, 6), 0.0, 0)
    for mine, theirs in zip(driven, slower.driven, strict=True):
        np.testing.assert_allclose(mine.actions, theirs.actions, atol=1e-6)


def test_an_archived_policy_in_an_archived_mode_is_executed_in_it(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    slow = times(0.3)
    mode = dict.fromkeys(invented.TASK.modes.names, 0.0) | {"speed_far": -0.9, "speed_near": -0.9}
    weights = FilterWeights(refined=slow.policy.weights, refined_mode=mode)
    driven = World().collect(act_of(invented.TASK.modes, POLICY, weights), first_of(GATE, 6), 0.0, 0)
    in_mode = ArchivedPolicy(slow.policy, [replace(each, success=True) for each in driven], mode=mode)
    found, world = quick(-1.0, [slow, in_mode], reference, surface)
    assert not world.asked
    assert (found.weights.refined, found.weights.refined_mode) == (slow.policy.weights, mode)
    assert not quick(-1.0, [slow], reference, surface)[0].weights.refined_mode


def test_a_mode_is_taken_where_it_is_better_than_what_is_archived(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    alone, _ = quick(-1.0, [], reference, surface)
    found, world = quick(-1.0, [times(0.97)], reference, surface)
    assert world.asked
    assert not found.weights.refined
    assert found.weights.mode == alone.weights.mode
    assert any(found.weights.mode.values())


def test_what_is_archived_is_taken_where_more_was_foreseen_of_a_mode_than_came_of_it(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    hopeful = replace(surface, coefficients=100.0 * surface.coefficients)
    slower = times(0.03)
    found, world = quick(-1.0, [slower], reference, hopeful)
    assert world.asked
    assert found.weights.refined is slower.policy.weights
    assert [each.refined for each in found.trials] == [False] * len(world.asked) + [True]


@pytest.mark.parametrize("archived", [[], [times(0.03)]], ids=["none", "one"])
def test_a_policy_that_is_archived_goes_too_far_for_whoever_has_said_little(
    archived: list[ArchivedPolicy], reference: list[Trajectory], surface: ResponseSurface
) -> None:
    asked, world = problem(-1.0, reference), World()
    members = np.outer([1.0, -0.9, 1.0, -0.9], asked.reward.signal_weights(reference)[0])
    unsure = replace(asked, reward=StructuredReward(members))
    found = quick_filter(unsure, surface, Pool(), archived, reference, world.collect)
    assert not found.weights.refined
    assert found.notes
