"""The action filter: identity where it must be, the same in NumPy, torch and ONNX, and learned within bounds."""

import json
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from tests.worker import invented
from worker.domain.modes import ApproachModes
from worker.ml.filters.encoders.action_encoder import REACH, ResidualAdapter
from worker.ml.filters.exported.filter_module import ActionFilter, FilterWeights, build, state_of
from worker.ml.filters.exported.filter_onnx import ExportDiffers, OnnxFilter, largest_difference, to_onnx
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.rewards.reward_models import stored_config

POLICY = invented.small_policy()
SEEN = invented.observations(40, np.random.default_rng(0))
MEANS = POLICY.mean(SEEN)
FAMILY = invented.TASK.modes
MODE = FAMILY.named([-0.5, 0.2, 0.6, -0.4, 0.8])


def adapter_state(seed: int = 0, *, untrained: bool = False) -> dict[str, np.ndarray]:
    """A residual adapter, its last layer random unless untrained."""
    torch.manual_seed(seed)
    adapter = ResidualAdapter(torch.from_numpy(POLICY.offset), torch.from_numpy(POLICY.scale))
    if not untrained:
        torch.nn.init.normal_(next(adapter.decoder[-1].parameters()))
    return state_of(adapter)


def filtered(weights: FilterWeights, means: np.ndarray = MEANS) -> np.ndarray:
    """What the torch module says."""
    with torch.no_grad():
        actions: np.ndarray = build(FAMILY, POLICY, weights)(torch.from_numpy(SEEN), torch.from_numpy(means)).numpy()
    return actions


def test_a_closed_gate_leaves_the_policy_untouched() -> None:
    weights = FilterWeights(mode=MODE, gate=0.0, encoder=adapter_state())
    np.testing.assert_array_equal(filtered(weights), MEANS)


def test_the_gate_blends_between_policy_and_person() -> None:
    open_gate, half = (filtered(FilterWeights(mode=MODE, gate=gate, encoder=adapter_state())) for gate in (1.0, 0.5))
    np.testing.assert_allclose(half, 0.5 * (open_gate + MEANS), atol=1e-6)
    assert np.abs(open_gate - MEANS).max() > 0.05


def test_the_mode_zero_is_the_policy_itself() -> None:
    np.testing.assert_allclose(filtered(FilterWeights()), MEANS, atol=1e-6)


def test_an_untrained_adapter_changes_nothing() -> None:
    alone = filtered(FilterWeights(mode=MODE))
    with_adapter = filtered(FilterWeights(mode=MODE, encoder=adapter_state(untrained=True)))
    np.testing.assert_array_equal(with_adapter, alone)


def test_the_residual_share_scales_the_residual() -> None:
    none, half, full = (
        filtered(FilterWeights(mode=MODE, residual_share=share, encoder=adapter_state())) for share in (0.0, 0.5, 1.0)
    )
    np.testing.assert_allclose(half, 0.5 * (none + full), atol=1e-6)
    assert np.abs(full - none).max() > 0.05


def test_the_residual_stays_within_the_policy_s_own_uncertainty() -> None:
    moved = filtered(FilterWeights(encoder=adapter_state()))
    assert (np.abs(moved - MEANS) <= REACH * POLICY.action_std(SEEN) + 1e-5).all()


def test_actions_stay_in_their_range_whatever_comes_in() -> None:
    rude = np.full_like(MEANS, 3.0)
    assert np.abs(filtered(FilterWeights(mode=MODE, gate=0.3, encoder=adapter_state()), rude)).max() <= 1.0


@pytest.mark.parametrize("seed", range(3))
def test_modes_in_torch_and_in_the_simulator_are_the_same(seed: int) -> None:
    mode = FAMILY.sample(1, np.random.default_rng(seed))[0].astype(np.float32)
    expected = np.clip(FAMILY.speed_factor(SEEN, mode) * POLICY.mean(FAMILY.perceived(SEEN, mode)), -1, 1)
    np.testing.assert_allclose(filtered(FilterWeights(mode=FAMILY.named(mode))), expected, atol=1e-5)


def test_a_refined_policy_is_executed_in_its_own_mode_and_not_in_the_one_that_the_frozen_policy_was_given() -> None:
    refined = invented.small_policy(5)
    alone, in_mode = FilterWeights(mode=MODE, refined=refined.weights), dict.fromkeys(FAMILY.names, 0.3)
    np.testing.assert_allclose(filtered(alone), refined.mean(SEEN), atol=1e-6)
    mode = np.full(len(FAMILY.axes), 0.3, np.float32)
    expected = np.clip(FAMILY.executed(SEEN, mode, refined.mean(FAMILY.perceived(SEEN, mode))), -1, 1)
    moved = filtered(alone.changed(refined_mode=in_mode))
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    assert np.abs(moved - filtered(alone)).max() > 0.05


@pytest.fixture(scope="module")
def exported() -> bytes:
    return to_onnx(build(FAMILY, POLICY, FilterWeights(mode=MODE, gate=0.7, encoder=adapter_state())), SEEN, MEANS)


def test_the_exported_filter_computes_the_same(exported: bytes) -> None:
    module = build(FAMILY, POLICY, FilterWeights(mode=MODE, gate=0.7, encoder=adapter_state()))
    assert largest_difference(exported, module, SEEN, MEANS) <= 1e-5


@pytest.mark.parametrize("batch", [1, 2, 33])
def test_the_exported_filter_takes_any_batch(exported: bytes, batch: int) -> None:
    actions = OnnxFilter(exported).batch(SEEN[:batch], MEANS[:batch])
    np.testing.assert_allclose(actions, OnnxFilter(exported).batch(SEEN, MEANS)[:batch], atol=1e-6)
    assert actions.dtype == np.float32


def test_the_export_is_the_same_every_time(exported: bytes) -> None:
    module = build(FAMILY, POLICY, FilterWeights(mode=MODE, gate=0.7, encoder=adapter_state()))
    assert to_onnx(module, SEEN, MEANS) == exported


def test_the_export_tells_nothing_of_where_it_was_made(exported: bytes) -> None:
    assert b".py" not in exported, "tracing notes the lines of code, with the folders of this machine"
    assert b"+cpu" not in exported


def test_filters_of_tasks_of_the_same_sizes_can_be_exported_at_once_each_by_its_own_rules() -> None:
    """The worker traces graphs while people answer, and somebody's filter may be due meanwhile. A task that a lab adds
    may have as many axes and observations as another and still mean other things by them."""
    assert isinstance(FAMILY, ApproachModes)
    modules = [build(replace(FAMILY, detour_m=each), POLICY, FilterWeights(mode=MODE)) for each in (0.2, 0.3)]
    with ThreadPoolExecutor(2) as threads:
        stored = list(threads.map(lambda module: to_onnx(module, SEEN, MEANS), modules))
    for module, own, other in zip(modules, stored, reversed(stored), strict=True):
        assert largest_difference(own, module, SEEN, MEANS) <= 1e-5
        assert largest_difference(other, module, SEEN, MEANS) > 0.01


def test_an_export_that_differs_is_not_published(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("worker.ml.filters.exported.filter_onnx.LARGEST_DIFFERENCE", -1.0)
    with pytest.raises(ExportDiffers, match="largest difference"):
        to_onnx(build(FAMILY, POLICY, FilterWeights(mode=MODE)), SEEN, MEANS)


def test_the_exported_filter_can_be_sent_to_another_process(exported: bytes) -> None:
    copy = pickle.loads(pickle.dumps(OnnxFilter(exported)))  # noqa: S301
    np.testing.assert_array_equal(copy(SEEN[0], MEANS[0]), OnnxFilter(exported)(SEEN[0], MEANS[0]))


@pytest.mark.parametrize("encoder", [{}, adapter_state()])
def test_weights_survive_storage(encoder: dict[str, np.ndarray]) -> None:
    weights = FilterWeights(mode=MODE, gate=0.4, residual_share=0.5, encoder=encoder)
    loaded = FilterWeights.from_bytes(weights.to_bytes())
    assert loaded.mode == pytest.approx(weights.mode)
    np.testing.assert_array_equal(filtered(loaded), filtered(weights))


def test_a_refined_policy_and_its_mode_survive_storage() -> None:
    weights = FilterWeights(mode=MODE, refined=invented.small_policy(5).weights, refined_mode={"speed_near": 0.4})
    np.testing.assert_array_equal(filtered(FilterWeights.from_bytes(weights.to_bytes())), filtered(weights))


def test_refined_filters_that_were_stored_before_these_had_a_mode_do_what_they_did() -> None:
    weights = FilterWeights(mode=MODE, refined=invented.small_policy(5).weights)
    config, tensors = stored_config(weights.to_bytes()), load(weights.to_bytes())
    del config["refined_mode"]
    earlier = save(tensors, metadata={"config": json.dumps(config)})
    np.testing.assert_array_equal(filtered(FilterWeights.from_bytes(earlier)), filtered(weights))


def test_a_mode_of_another_task_is_refused_by_the_names_of_its_axes() -> None:
    with pytest.raises(ValueError, match="no mode axis pour_haste; it has speed_far"):
        build(FAMILY, POLICY, FilterWeights(mode={"speed_far": 0.1, "pour_haste": 0.3}))


def test_the_frozen_policy_stays_frozen_inside_the_filter() -> None:
    module = build(FAMILY, POLICY, FilterWeights(mode=MODE, encoder=adapter_state()))
    assert isinstance(module, ActionFilter)
    assert not any(parameter.requires_grad for parameter in module.parameters())
    assert isinstance(module.transform.policy, FrozenPolicy)
