"""The paper's method as printed, and the errata that a test can pin."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.worker import invented
from worker.domain.trajectory import SIGNALS
from worker.ml.filters.encoders import pbarl_printed
from worker.ml.filters.encoders.pbarl_printed import PrintedConfig, PrintedEncoder, reconstruction_loss
from worker.ml.filters.exported.filter_module import build
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.printed_filter import fit_printed
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.rewards.network_training import MlpTraining, TransformerTraining
from worker.ml.rewards.reward_models import StructuredReward
from worker.ml.rewards.reward_training import fit

POLICY = invented.small_policy()


def at_distance(distance: float) -> tuple[Tensor, Tensor]:
    """One action and an output that far away from it."""
    outputs = torch.zeros(1, 7)
    outputs[0, 0] = distance
    return torch.zeros(1, 7), outputs.requires_grad_()


@pytest.mark.parametrize("distance", [0.0, 0.3, 0.99, 1.01, 1.7])
def test_equation_3_is_the_maximum_of_epsilon_and_the_squared_distance(distance: float) -> None:
    loss = reconstruction_loss(*at_distance(distance), epsilon=1.0)
    assert loss.item() == pytest.approx(max(1.0, distance**2))


def test_equation_3_has_no_gradient_inside_the_epsilon_ball() -> None:
    gradients = []
    for distance in (0.6, 1.4):
        actions, outputs = at_distance(distance)
        reconstruction_loss(actions, outputs, epsilon=1.0).backward()  # type: ignore[no-untyped-call]
        assert outputs.grad is not None
        gradients.append(float(outputs.grad.norm()))
    inside, outside = gradients
    assert inside == 0.0
    assert outside == pytest.approx(2.8)


def test_equation_4_averages_the_negatives_and_leaves_the_positive_out() -> None:
    generator = torch.Generator().manual_seed(0)
    outputs, reranked = torch.randn(2, 3, 4, 7, generator=generator).unbind(0)
    temperature, terms = 0.5, []
    for row in range(3):
        for i in range(4):
            similar = [-float(((outputs[row, i] - reranked[row, j]) ** 2).sum()) for j in range(4)]
            negatives = np.mean([np.exp(similar[j] / temperature) for j in range(4) if j != i])
            terms.append(-np.log(np.exp(similar[i] / temperature) / negatives))
    found = pbarl_printed.preference_loss(outputs, reranked, temperature)
    assert float(found) == pytest.approx(np.mean(terms), rel=1e-5)


def test_the_dynamics_see_the_executed_action_only() -> None:
    states, following = torch.zeros(2, 3), torch.ones(2, 3)
    assert float(pbarl_printed.dynamics_loss(states, following, torch.full((2, 3), 0.5))) == pytest.approx(0.75)


def test_equation_4_is_undefined_for_one_action_and_then_says_nothing() -> None:
    """As printed the mean over n - 1 = 0 negatives is 0/0; the reading here leaves the preference term out."""
    outputs = torch.randn(3, 1, 7, requires_grad=True)
    assert float(pbarl_printed.preference_loss(outputs, outputs, 1.0)) == 0.0


def test_with_one_action_the_encoder_does_not_depend_on_who_it_is_for(problem: FilterProblem) -> None:
    reference = [invented.trajectory(np.random.default_rng(seed)) for seed in range(3)]
    shown = invented.pairs(30, np.random.default_rng(1))
    other = fit(shown, invented.answers_of(shown, -np.eye(len(SIGNALS))[1]), "mlp", 0, mlp=MlpTraining(steps=20))
    somebody_else = replace(problem, reward=other.model)

    def encoders(length: int) -> list[bytes]:
        settings = PrintedConfig(steps=30, batch=8, list_length=length)
        return [fit_printed(each, reference, settings).weights.to_bytes() for each in (problem, somebody_else)]

    alone, listed = encoders(1), encoders(3)
    assert alone[0] == alone[1]
    assert listed[0] != listed[1]


def test_an_empty_list_is_refused() -> None:
    with pytest.raises(ValueError, match="at least n = 1"):
        PrintedConfig(list_length=0)


def test_reranking_puts_the_best_learned_reward_first() -> None:
    states, actions = torch.zeros(1, 4), torch.tensor([[[0.1], [0.9], [0.5]]])
    ordered = pbarl_printed.reranked(states, actions, lambda _, candidates: candidates[..., 0])
    assert ordered.flatten().tolist() == pytest.approx([0.9, 0.5, 0.1])


def test_the_list_is_sampled_from_the_policy_most_probable_first() -> None:
    frozen = FrozenPolicy(POLICY.weights)
    states = torch.from_numpy(invented.observations(200, np.random.default_rng(0)))
    generator = torch.Generator().manual_seed(0)
    actions = pbarl_printed.sample_ranked_list(frozen, states, 10, generator)
    centre, log_std = (each.numpy() for each in frozen(states))
    raw = np.arctanh(np.clip(actions.numpy() / 0.7, -0.9999999, 0.9999999))
    distance = (((raw - np.arctanh(centre / 0.7)[:, None]) / np.exp(log_std)[:, None]) ** 2).sum(-1)
    assert (np.diff(distance, axis=1) >= -1e-2).mean() > 0.99
    assert actions.abs().max() <= 0.7


@pytest.fixture(scope="module")
def problem() -> FilterProblem:
    """Somebody, with a small network as reward model."""
    rng = np.random.default_rng(0)
    shown = invented.pairs(30, rng)
    reward = fit(shown, invented.answers_of(shown, np.eye(len(SIGNALS))[1]), "mlp", 0, mlp=MlpTraining(steps=20))
    return FilterProblem(invented.TASK, POLICY, reward.model, 0)


def test_training_reports_all_four_losses_is_repeatable_and_exports_like_any_filter(problem: FilterProblem) -> None:
    reference = [invented.trajectory(np.random.default_rng(seed)) for seed in range(5)]
    told: list[float] = []
    settings = PrintedConfig(steps=200, batch=16)
    draft = fit_printed(problem, reference, settings, lambda stage, share: told.append(share))
    again = fit_printed(problem, reference, settings)
    assert draft.weights.to_bytes() == again.weights.to_bytes()
    assert told == [0.5, 1.0]
    assert all(name in draft.notes[1] for name in ("rec", "pref", "kl", "dyn"))
    assert draft.weights.gate == 1.0
    seen = invented.observations(5, np.random.default_rng(1))
    actions = build(invented.TASK.modes, POLICY, draft.weights)(
        torch.from_numpy(seen), torch.from_numpy(POLICY.mean(seen))
    )
    assert actions.shape == (5, 7)
    assert float(actions.abs().max()) <= 1.0


def test_a_preference_transformer_ranks_candidates_too() -> None:
    shown = invented.pairs(12, np.random.default_rng(0))
    small = TransformerTraining(steps=5, members=2, hidden=8, heads=2)
    answers = invented.answers_of(shown, np.eye(len(SIGNALS))[1])
    reward = fit(shown, answers, "preference_transformer", 0, transformer=small).model
    reference = [invented.trajectory(np.random.default_rng(seed)) for seed in range(3)]
    draft = fit_printed(FilterProblem(invented.TASK, POLICY, reward, 0), reference, PrintedConfig(steps=20, batch=8))
    assert draft.weights.encoder


def test_a_reward_that_needs_measurements_cannot_rank_untried_actions() -> None:
    structured = FilterProblem(invented.TASK, POLICY, StructuredReward(np.ones((8, len(SIGNALS)))), 0)
    with pytest.raises(TypeError, match="mlp"):
        fit_printed(structured, [invented.trajectory(np.random.default_rng(0))])


@pytest.mark.parametrize("reaches", [True, False])
def test_the_switch_decides_whether_the_dynamics_shape_the_encoder(problem: FilterProblem, reaches: bool) -> None:
    torch.manual_seed(0)
    encoder = PrintedEncoder(torch.from_numpy(POLICY.offset), torch.from_numpy(POLICY.scale))
    dynamics = torch.nn.Linear(7, invented.D)
    states = torch.from_numpy(invented.observations(4, np.random.default_rng(0)))
    config = PrintedConfig(list_length=3, dynamics_to_encoder=reaches)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(4, 3, 7, generator=generator)
    terms = pbarl_printed._losses(
        encoder, dynamics, lambda s, a: a.sum(-1), states, states + 0.1, actions, config, generator
    )
    terms[3].backward()  # type: ignore[no-untyped-call]
    touched = any(each.grad is not None and bool(each.grad.any()) for each in encoder.parameters())
    assert touched is reaches
