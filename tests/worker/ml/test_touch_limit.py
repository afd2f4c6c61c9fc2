"""How a step may reach the skin: what is learned from the reference policy, what of an action is taken back."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from worker.domain.trajectory import Trajectory
from worker.ml.filters.exported import filter_onnx
from worker.ml.filters.exported.filter_act import act_of, trace
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import untried
from worker.ml.filters.exported.touch_limit import (
    BESIDE_M,
    CLOSING,
    LEAST_STEPS,
    NAMES,
    NEAR_M,
    NO_LIMIT_M,
    TOUCH_N,
    USUAL,
    TouchLimit,
    described,
    touch_limits,
)

SPACE = invented.TASK.observation
FORCE, TO_TARGET, OUTWARD, JOINTS = (
    SPACE.slice_of(name) for name in ("force_on_person_n", "tool_to_target_m", "target_outward", "joint_positions_rad")
)
MOTION_M, TURNED_M = np.random.default_rng(5).uniform(-0.02, 0.02, (2, invented.A, 3))
"""Of the tool in one step, by the numbers of the action; the second times the angle of the first joint."""
UP = np.array([0.0, 0.0, 1.0])


def approach(seed: int, noise_m: float = 0.0, steps: int = 40) -> Trajectory:
    """An episode about the target, on the skin of a person who lies under the plane z = 0."""
    rng = np.random.default_rng(seed)
    episode = invented.trajectory(rng, steps=steps)
    actions, seen, tool = np.zeros((steps, invented.A)), episode.observations.copy(), np.array([0.0, 0.0, 0.02])
    for step in range(steps + 1):
        seen[step, TO_TARGET], seen[step, OUTWARD] = -tool, UP
        seen[step, FORCE] = 100.0 * max(0.0, -tool[2])
        if step < steps:
            some, motion_m = rng.uniform(-1, 1, (4, invented.A)), MOTION_M + seen[step, JOINTS][0] * TURNED_M
            actions[step] = some[np.linalg.norm(tool + some @ motion_m, axis=1).argmin()]
            tool = tool + actions[step] @ motion_m + noise_m * rng.standard_normal(3)
    return replace(episode, observations=seen.astype(np.float32), actions=actions.astype(np.float32))


def touched_anywhere(episode: Trajectory) -> Trajectory:
    """The same with touches that have nothing to do with the depth of a step."""
    seen = episode.observations.copy()
    seen[:, FORCE] = np.random.default_rng(episode.scenario).random((len(seen), 1)) < 0.1
    return replace(episode, observations=seen)


REFERENCE = [approach(seed) for seed in range(30)]
LIMITS = touch_limits(SPACE, REFERENCE)


def limited(
    height_m: float,
    action: np.ndarray,
    beside_m: float = 0.0,
    joints_rad: float = 0.0,
    mean: np.ndarray | None = None,
    limits: Mapping[str, np.ndarray] = LIMITS,
) -> tuple[np.ndarray, float]:
    """What is left of an action of which the tool is so high above the skin, and the share that was taken.

    ``mean``: the reference policy's action; the same if not said.
    """
    seen = np.zeros((1, SPACE.size), np.float32)
    seen[0, TO_TARGET], seen[0, OUTWARD], seen[0, JOINTS] = (beside_m, 0.0, -height_m), UP, joints_rad
    numbers = (seen, action[None] if mean is None else mean[None], action[None])
    left, share = TouchLimit(SPACE, limits)(*(torch.from_numpy(each.astype(np.float32)) for each in numbers))
    return left.numpy()[0].astype(np.float64), float(share)


def motion(action: np.ndarray, joints: np.ndarray | float = 0.0) -> np.ndarray:
    """Of the tool, as was learned; with all joints at zero if not said."""
    learned = LIMITS["touch_motion"].astype(np.float64)
    coefficients = np.einsum("j,jai->ai", np.append(np.broadcast_to(joints, invented.A), 1.0), learned)
    moved: np.ndarray = np.append(action, 1.0) @ coefficients
    return moved


INWARD = -np.sign(MOTION_M[:, 2])
"""The action that goes straight for the skin."""


def test_how_actions_move_the_tool_is_learned_for_every_posture_of_the_arm() -> None:
    learned = LIMITS["touch_motion"]
    np.testing.assert_allclose(learned[-1, :-1], MOTION_M, atol=2e-4)
    np.testing.assert_allclose(learned[0, :-1], TURNED_M, atol=1e-3)
    np.testing.assert_allclose(learned[1:-1], 0.0, atol=1e-3)


def test_depth_and_place_are_those_of_usual_touches() -> None:
    depths, places = [], []
    for episode in REFERENCE:
        seen = episode.observations.astype(np.float64)
        moved = [motion(*each) for each in zip(episode.actions, seen[:-1, JOINTS], strict=True)]
        ends = seen[:-1, TO_TARGET][:, 2] - np.array(moved)[:, 2]
        near = np.linalg.norm(seen[:-1, TO_TARGET], axis=1) <= NEAR_M
        touches = near & (seen[1:, FORCE.start] >= TOUCH_N)
        depths += [*ends[touches]]
        before = seen[:-1, TO_TARGET][touches]
        places += [*np.stack([-before[:, 2], np.linalg.norm(before, axis=1)], axis=1)]
    assert LIMITS["touch_depth"][0] == pytest.approx(np.quantile(depths, USUAL), abs=1e-5)
    np.testing.assert_allclose(LIMITS["touch_place"], np.quantile(places, USUAL, axis=0), atol=1e-5)


def test_of_a_blow_only_what_leads_too_deep_is_taken_back() -> None:
    deepest = float(LIMITS["touch_depth"][0])
    assert motion(INWARD)[2] < -deepest - 0.01, "a blow"
    left, share = limited(0.01, INWARD)
    assert -(0.01 + motion(left)[2]) == pytest.approx(deepest, abs=1e-5)
    away = LIMITS["touch_motion"][-1, :-1, 2] / np.linalg.norm(LIMITS["touch_motion"][-1, :-1, 2])
    taken = INWARD - left
    np.testing.assert_allclose(taken, away * (away @ taken), atol=1e-5)
    assert share == pytest.approx(np.linalg.norm(taken) / np.linalg.norm(INWARD), rel=1e-4)


@pytest.mark.parametrize(
    ("height_m", "action", "beside_m"), [(0.01, -INWARD, 0.0), (0.09, INWARD, 0.0), (0.01, INWARD, 0.16)]
)
def test_who_leaves_or_is_not_there_yet_is_let_alone(height_m: float, action: np.ndarray, beside_m: float) -> None:
    left, share = limited(height_m, action, beside_m)
    np.testing.assert_array_equal(left, action.astype(np.float32))
    assert share == 0.0


SKIN_M, AT_TARGET_M = LIMITS["touch_place"].tolist()
BESIDE_TARGET_M = AT_TARGET_M + BESIDE_M
NO_DEPTH = {**LIMITS, "touch_depth": np.array([NO_LIMIT_M])}


@pytest.mark.parametrize("above_m", [0.0, 0.01, 0.02])
def test_beside_the_target_a_step_leads_nearer_than_the_reference_policys_by_a_tenth_of_the_height(
    above_m: float,
) -> None:
    place = {"height_m": SKIN_M + above_m, "beside_m": BESIDE_TARGET_M, "limits": NO_DEPTH}
    left, share = limited(action=INWARD, mean=0.2 * INWARD, **place)
    assert motion(0.2 * INWARD)[2] - motion(left)[2] == pytest.approx(CLOSING * above_m, abs=1e-6)
    assert share == pytest.approx(np.linalg.norm(INWARD - left) / np.linalg.norm(INWARD), rel=1e-4)
    np.testing.assert_array_equal(limited(action=INWARD, mean=INWARD, **place)[0], INWARD)


@pytest.mark.parametrize(
    ("above_m", "beside_m"), [(0.0, 0.5 * AT_TARGET_M), (0.05, BESIDE_TARGET_M), (0.0, NEAR_M + 0.05)]
)
def test_at_the_target_high_up_or_far_away_it_leads_as_near_as_it_likes(above_m: float, beside_m: float) -> None:
    gentle = 0.05 * INWARD
    left, share = limited(SKIN_M + above_m, gentle, beside_m, mean=0.0 * INWARD, limits=NO_DEPTH)
    np.testing.assert_array_equal(left, gentle.astype(np.float32))
    assert share == 0.0


def test_limits_of_before_say_nothing_beside_the_target() -> None:
    before = {name: limit for name, limit in NO_DEPTH.items() if name != "touch_place"}
    assert limited(SKIN_M, INWARD, BESIDE_TARGET_M, mean=0.0 * INWARD, limits=before)[1] == 0.0


@pytest.mark.parametrize(("height_m", "joints_rad"), [(-0.05, 0.0), (0.01, 500.0), (-0.05, -0.9)])
def test_no_more_is_taken_than_there_is(height_m: float, joints_rad: float) -> None:
    """Deep in the person, or in postures for which nothing that was learned holds, a small step stays small."""
    for action in 0.05 * np.random.default_rng(1).standard_normal((50, invented.A)):
        left, share = limited(height_m, action, joints_rad=joints_rad)
        assert np.linalg.norm(action - left) <= np.linalg.norm(action) * (1 + 1e-5)
        assert 0.0 <= share <= 1.0


def test_nothing_is_limited_by_what_cannot_be_foretold() -> None:
    assert not touch_limits(SPACE, [approach(seed, noise_m=0.05) for seed in range(30)])
    assert not touch_limits(SPACE, [approach(1, steps=LEAST_STEPS - 1)])
    rim = touch_limits(SPACE, [touched_anywhere(episode) for episode in REFERENCE])
    assert rim["touch_depth"][0] == np.float32(NO_LIMIT_M), "as by the rim of a cup"


def test_the_exported_filter_does_the_same() -> None:
    """Any action: the shield of an untried filter has no other limits."""
    policy, family = invented.small_policy(), invented.TASK.modes
    mode = FilterWeights(mode=family.named([0.8, 0.6, 0.0, 0.0, 0.9]))
    seen = np.concatenate([episode.observations[:-1] for episode in REFERENCE[:4]])
    means = policy.mean(seen)
    shield = untried(SPACE, invented.A, REFERENCE)
    bare, (action, activity) = (
        act_of(family, policy, weights).exported.run(seen, means) for weights in (mode, mode.changed(shield=shield))
    )
    left, share = TouchLimit(SPACE, LIMITS)(*(torch.from_numpy(each) for each in (seen, means, bare[0])))
    assert 0.01 < (activity > 0).mean() < 0.9
    np.testing.assert_allclose(action, left.clamp(-1.0, 1.0).numpy(), atol=1e-5)
    np.testing.assert_allclose(activity, share.numpy(), atol=1e-4)


def test_nobody_waits_for_a_graph_with_or_without_this_limit() -> None:
    policy, family = invented.small_policy(), invented.TASK.modes
    trace(family, policy)
    known = len(filter_onnx._templates)
    limits = untried(SPACE, invented.A, REFERENCE)
    for shield in (limits, {name: limit for name, limit in limits.items() if name not in NAMES}):
        act_of(family, policy, FilterWeights(mode=family.named([0.5, 0.0, 0.0, 0.0, 0.1]), shield=shield))
    assert len(filter_onnx._templates) == known


def test_a_manifest_names_only_the_limits_that_there_are() -> None:
    assert described(LIMITS)["deepest_m"] == pytest.approx(float(LIMITS["touch_depth"][0]))
    assert "deepest_m" not in described(NO_DEPTH), "Drinking"
    before = {name: limit for name, limit in LIMITS.items() if name != "touch_place"}
    assert "beside_target" not in described(before), "filters of before"
