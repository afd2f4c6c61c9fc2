"""The reference policy without torch, and its torch twin."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from worker.ml.policies.gaussian import ACTION_STD_FLOOR, GaussianPolicy
from worker.ml.policies.torch_module import FrozenPolicy
from worker.tasks.registry import checkpoint

CHECKPOINT = checkpoint("feeding") / "policy.safetensors"


@pytest.fixture(scope="module")
def policy() -> GaussianPolicy:
    return GaussianPolicy.load(CHECKPOINT)


@pytest.fixture(scope="module")
def observations(policy: GaussianPolicy) -> np.ndarray:
    noise = np.random.default_rng(0).standard_normal((50, 28))
    return (policy.offset + noise / policy.scale).astype(np.float32)


def test_the_torch_twin_gives_the_same_actions_and_deviations(policy: GaussianPolicy, observations: np.ndarray) -> None:
    action, deviation = policy.mean_and_std(observations)
    twin_action, twin_log_std = FrozenPolicy(policy.weights)(torch.from_numpy(observations))
    np.testing.assert_allclose(twin_action.numpy(), action, atol=2e-6)
    np.testing.assert_allclose(twin_log_std.exp().numpy(), deviation, rtol=2e-5)


def test_the_torch_twin_is_frozen(policy: GaussianPolicy) -> None:
    assert list(FrozenPolicy(policy.weights).parameters()) == []


def test_leading_axes_do_not_matter(policy: GaussianPolicy, observations: np.ndarray) -> None:
    one_by_one = np.array([policy.mean(observation) for observation in observations])
    np.testing.assert_allclose(policy.mean(observations), one_by_one, atol=4e-6)
    folded = policy.mean(observations.reshape(5, 10, 28))
    np.testing.assert_allclose(folded.reshape(50, 7), one_by_one, atol=4e-6)


def test_samples_spread_around_the_mean_as_the_deviation_says(policy: GaussianPolicy, observations: np.ndarray) -> None:
    calmest = observations[np.abs(policy.mean(observations)).max(axis=1).argmin()]
    action, deviation = policy.mean_and_std(calmest)
    drawn = policy.sample(np.tile(calmest, (20_000, 1)), np.random.default_rng(1))
    raw = np.arctanh(np.clip(drawn / policy.action_limit, -0.999999, 0.999999))
    np.testing.assert_allclose(np.median(drawn, 0), action, atol=0.02)
    free = np.abs(action) < 0.6 * policy.action_limit
    assert free.any()
    np.testing.assert_allclose(raw.std(0)[free], deviation[free], rtol=0.05)


def test_the_spread_in_action_units_has_a_floor_and_shrinks_where_the_tanh_is_flat(
    policy: GaussianPolicy, observations: np.ndarray
) -> None:
    action, deviation = policy.mean_and_std(observations)
    spread = policy.action_std(observations)
    assert spread.min() >= np.float32(ACTION_STD_FLOOR)
    free = spread > ACTION_STD_FLOOR
    slope = policy.action_limit * (1 - (action / policy.action_limit) ** 2)
    np.testing.assert_allclose(spread[free], (deviation * slope)[free], rtol=1e-5)


def test_the_exported_policy_leaves_room_to_be_quicker(policy: GaussianPolicy, observations: np.ndarray) -> None:
    assert policy.action_limit == pytest.approx(0.7)
    assert np.abs(policy.mean(observations)).max() <= policy.action_limit


def test_the_checkpoint_is_small_and_survives_saving_and_pickling(
    policy: GaussianPolicy, observations: np.ndarray, tmp_path: Path
) -> None:
    assert CHECKPOINT.stat().st_size < 200_000
    policy.save(tmp_path / "policy.safetensors")
    for copy in (GaussianPolicy.load(tmp_path / "policy.safetensors"), pickle.loads(pickle.dumps(policy))):  # noqa: S301
        np.testing.assert_array_equal(copy.mean(observations), policy.mean(observations))
