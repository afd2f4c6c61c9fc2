"""The shield inside the filter: idle where all is as tested, the reference policy beyond, and one in torch and ONNX."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from tests.worker import invented
from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights, build
from worker.ml.filters.exported.filter_onnx import OnnxFilter, largest_difference, to_onnx
from worker.ml.filters.exported.shield import FORCE_RAMP_N, described, limits_of, widened

POLICY = invented.small_policy()
TASK = invented.TASK
MODE = TASK.modes.named([-0.5, 0.2, 0.6, -0.4, 0.8])
FORCE = TASK.observation.slice_of("force_on_person_n").start
TO_TARGET = TASK.observation.slice_of("tool_to_target_m")


def driven(number: int, weights: FilterWeights | None) -> Trajectory:
    """An episode of noise in which the filter, or the reference policy, has acted."""
    episode = invented.trajectory(np.random.default_rng(number), scenario=number)
    seen = episode.observations[:-1]
    means = POLICY.mean(seen)
    actions = means if weights is None else act_of(TASK.modes, POLICY, weights).exported.batch(seen, means)
    return replace(episode, actions=actions, reference_actions=means)


BARE = FilterWeights(mode=MODE)
REFERENCE = [driven(number, None) for number in range(4)]
SEEN = np.concatenate([each.observations[:-1] for each in REFERENCE])
MEANS = POLICY.mean(SEEN)


@cache
def limits() -> Mapping[str, np.ndarray]:
    """What four episodes of the bare filter have shown: noise, so the same observations as the reference policy's."""
    tested = [driven(number, BARE) for number in range(4)]
    return limits_of(TASK.observation, TASK.action, tested, REFERENCE)


def shielded() -> FilterWeights:
    return replace(BARE, shield=limits())


def said(weights: FilterWeights, seen: np.ndarray = SEEN, means: np.ndarray = MEANS) -> list[np.ndarray]:
    return act_of(TASK.modes, POLICY, weights).exported.run(seen, means)


def far_out(column: int, value: float) -> np.ndarray:
    moved = SEEN.copy()
    moved[:, column] = value
    return moved


def test_where_everything_was_tested_nothing_is_changed() -> None:
    usual = SEEN[:, FORCE] <= limits()["observation_high"][FORCE]
    action, activity = said(shielded())
    np.testing.assert_allclose(activity[usual], 0.0, atol=1e-9)  # on the limit, one row is rounded otherwise than many
    np.testing.assert_allclose(action[usual], said(BARE)[0][usual], atol=1e-6)


@pytest.mark.parametrize("column", [0, 8, 15, FORCE])
def test_where_nobody_has_been_the_reference_policy_acts(column: int) -> None:
    seen = far_out(column, 40.0)
    means = POLICY.mean(seen)
    action, activity = said(shielded(), seen, means)
    np.testing.assert_array_equal(activity, 1.0)
    np.testing.assert_allclose(action, means, atol=1e-6)


def test_where_the_reference_policy_alone_has_been_the_filter_acts_too() -> None:
    def with_(column: int, value: float) -> Trajectory:
        seen = REFERENCE[0].observations.copy()
        seen[:, column] = value
        return replace(REFERENCE[0], observations=seen)

    low, high = limits()["observation_low"], limits()["observation_high"]
    further = [with_(0, high[0] + 1.0), with_(8, low[8] - 1.0), with_(FORCE, high[FORCE] + 9.0)]
    wide = widened(limits(), TASK.observation, further)
    assert (wide["observation_high"][0], wide["observation_low"][8]) == (high[0] + 1.0, low[8] - 1.0)
    assert (wide["observation_high"][FORCE], wide["observation_ramp"][FORCE]) == (high[FORCE] + 9.0, FORCE_RAMP_N)
    for name in limits().keys() - {"observation_low", "observation_high", "observation_ramp"}:
        np.testing.assert_array_equal(wide[name], limits()[name])
    seen = far_out(0, high[0] + 1.0)
    seen[:, FORCE] = 0.0
    narrow, further_on = (said(replace(BARE, shield=each), seen, POLICY.mean(seen))[1] for each in (limits(), wide))
    assert (further_on <= narrow + 1e-6).all()
    assert np.mean(narrow > 0.1) == 1.0
    assert np.mean(further_on < 1e-6) > 0.5


def test_what_has_never_been_done_is_not_done() -> None:
    means = np.clip(MEANS + 0.9, -1, 1)
    action, activity = said(shielded(), SEEN, means)
    wild = activity[:, 0] == 1.0
    assert wild.any()
    np.testing.assert_allclose(action[wild], means[wild], atol=1e-6)


def test_near_the_person_no_action_is_larger_than_tested() -> None:
    timid, lax = ({**limits(), "near_action": np.array(each, np.float32)} for each in ((0.0, 0.01), (9.0, 1.0)))

    def activities(distance_m: float) -> list[np.ndarray]:
        seen = SEEN.copy()
        seen[:, TO_TARGET] = (distance_m, 0.0, 0.0)
        return [said(replace(BARE, shield=each), seen, POLICY.mean(seen))[1] for each in (timid, lax)]

    near, far = activities(0.1), activities(0.26)
    np.testing.assert_array_equal(near[0], 1.0)
    assert near[1].mean() < 1.0
    np.testing.assert_array_equal(far[0], far[1])


def test_it_sets_in_smoothly() -> None:
    """Along a growing force neither the activity nor its slope jumps."""
    start = float(limits()["observation_high"][FORCE])
    forces = np.linspace(start - 0.5, start + FORCE_RAMP_N + 0.5, 3001)
    seen = np.repeat(SEEN[:1], len(forces), axis=0)
    seen[:, FORCE] = forces
    (_, activity) = said(shielded(), seen, POLICY.mean(seen))
    steps = np.diff(activity[:, 0].astype(np.float64))
    assert (activity[0], activity[-1]) == (0.0, 1.0)
    assert steps.min() >= -1e-6
    assert steps.max() <= 1.6 / FORCE_RAMP_N * (forces[1] - forces[0])


@pytest.mark.parametrize("scale", [1.0, 1.2, 2.0])
def test_torch_and_onnx_agree_inside_at_and_outside_the_limits(scale: float) -> None:
    seen = (scale * SEEN).astype(np.float32)
    module, means = build(TASK.modes, POLICY, shielded()), POLICY.mean(seen)
    assert largest_difference(to_onnx(module, seen, means), module, seen, means) <= 1e-5
    with torch.no_grad():
        action, activity = module(torch.from_numpy(seen), torch.from_numpy(means))
    exported = said(shielded(), seen, means)
    np.testing.assert_allclose(exported[0], action.numpy(), atol=1e-5)
    np.testing.assert_allclose(exported[1], activity.numpy(), atol=1e-5)


def test_limits_are_stored_with_the_filter_and_older_filters_have_none() -> None:
    again = FilterWeights.from_bytes(shielded().to_bytes())
    assert again.encoder == {}
    np.testing.assert_array_equal(again.shield["observation_high"], limits()["observation_high"])
    assert FilterWeights.from_bytes(BARE.to_bytes()).shield == {}
    exported = [act_of(TASK.modes, POLICY, each).exported for each in (BARE, shielded())]
    assert [OnnxFilter(each.stored).is_shielded for each in exported] == [False, True]


def test_limits_are_told_by_the_names_of_the_fields() -> None:
    told = described(TASK.observation, TASK.action, limits())
    force = next(each for each in told["observation"] if each["name"] == "force_on_person_n")
    assert force["high"] == [pytest.approx(float(limits()["observation_high"][FORCE]))]
    assert force["ramp"] == [FORCE_RAMP_N]
    assert len(told["change_of_action"][0]["low"]) == 7
    assert told["size_of_action_near_person"]["high"] > 0
