"""Every method of the comparison on an invented world in which only the first joint's action is disliked."""

import pickle
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.ml.invented_person import InventedPerson
from worker.compute import learning
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.encoders.fitted_q import ActionValue
from worker.ml.filters.exported.filter_module import load_state
from worker.ml.filters.fitting import response_surface
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.pool import Pool
from worker.ml.methods import prefft, registry
from worker.ml.methods.best_of_n import BestOfN, fit_best_of_n
from worker.ml.methods.latent_people import Latent
from worker.ml.methods.pbrl_hri import FromScratch
from worker.ml.methods.prefft import FineTuning
from worker.ml.methods.prefft_lagrangian import Constraint
from worker.ml.methods.registry import METHODS, MethodConfig, NobodyToAsk, Setting
from worker.ml.methods.steered_rl import Steering
from worker.ml.reinforcement import preference_rl
from worker.ml.reinforcement.guided_reward import sketchy
from worker.ml.reinforcement.refinement import Refinement
from worker.ml.reinforcement.tied_learner import gaussian_divergence
from worker.ml.rewards.reward_models import MlpReward, StructuredReward

POLICY = invented.small_policy()
SPEED, DISTANCE = SIGNALS.index("speed_m_s"), SIGNALS.index("distance_m")
STEPS, LABELS = 15, 18


class World(gymnasium.Env[Any, Any]):
    """Observations are noise that belongs to the scenario; the signal "speed" is the first joint's action."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-2, 2, (invented.D,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (invented.A,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """See gymnasium."""
        super().reset(seed=seed)
        self._seen = invented.observations(STEPS + 1, np.random.default_rng(seed))
        self._step = 0
        return self._seen[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium."""
        self._step += 1
        signals = dict.fromkeys(SIGNALS, 0.0) | {"speed_m_s": float(action[0])}
        return self._seen[self._step], 0.0, False, self._step == STEPS, {"signals": signals}


def collect(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """See filter_problem.Collect; the same world."""
    return [_episode(learning.noisy(act, noise, seed, scenario), scenario) for scenario in scenarios]


def _episode(act: Act, scenario: int) -> Trajectory:
    rng = np.random.default_rng(scenario)
    seen = invented.observations(STEPS + 1, rng)
    actions = np.clip([act(each) for each in seen[:-1]], -1, 1).astype(np.float32)
    signals = np.zeros((STEPS, len(SIGNALS)), np.float32)
    signals[:, SPEED] = actions[:, 0]
    episode = invented.trajectory(rng, steps=STEPS, scenario=scenario, signals=signals, actions=actions)
    return replace(episode, observations=seen)


REWARD = StructuredReward(-np.tile(np.eye(len(SIGNALS))[SPEED], (8, 1)))
SMALL = MethodConfig(
    printed_steps=20,
    printed_rollouts=4,
    fine_tuning=FineTuning(steps=120, warm_up_steps=60, critic_first_updates=20, cloning_steps=50),
    from_scratch=FromScratch(steps=120, random_steps=60, hidden=16),
    candidates=4,
    value_rollouts=4,
    value_steps=20,
    steering=Steering(steps=120, warm_up_steps=60, critic_first_updates=20, hidden=16, flow_steps=20),
    refinement=Refinement(
        steps=120,
        warm_up_steps=60,
        imitation_steps=20,
        critic_first_updates=20,
        critic_again_updates=20,
        hidden=16,
        environments=2,
    ),
    constraint=Constraint(scenarios=3, every_steps=80),
    others=4,
    others_labels=10,
    latent=Latent(steps=5),
)


@pytest.fixture(scope="module")
def action_reward() -> MlpReward:
    """Minus the first joint's action, as far as a network without hidden layers goes."""
    matrix = np.zeros((1, invented.D + 7, 1), np.float32)
    matrix[0, invented.D] = -0.5
    zeros, ones = np.zeros(invented.D + 7, np.float32), np.ones(invented.D + 7, np.float32)
    return MlpReward(((matrix, np.zeros((1, 1, 1), np.float32)),), zeros, ones)


@pytest.fixture
def setting(action_reward: MlpReward) -> Setting:
    config = FilterConfig(
        gates=(1.0,),
        gate_scenarios=4,
        check_scenarios=6,
        watch_scenarios=4,
        residual_rounds=1,
        residual_rollouts=4,
        value_steps=20,
        adapter_steps=10,
    )
    family = invented.TASK.modes
    modes = family.sample(30, np.random.default_rng(0))
    deltas = np.zeros((30, len(SIGNALS)))
    deltas[:, SPEED] = modes[:, 0]
    return Setting(
        problem=FilterProblem(invented.TASK, POLICY, REWARD, 0, config),
        labels=LABELS,
        pool=Pool(collect(POLICY.mean, range(4), 0.3, 0), [{"temperature": 0.3}] * 4),
        surface=lambda: response_surface.fit(family, modes, deltas, np.ones(30)),
        action_reward=lambda: action_reward,
        reference=lambda scenarios: collect(POLICY.mean, scenarios, 0.0, 0),
        collect=collect,
        make_env=World,
        config=SMALL,
        person=InventedPerson(),
    )


COUNTED = {
    "reference": 0,
    "pbarl_printed": 4 * STEPS,
    "best_of_n": 4 * STEPS,
    "prefft": 120,
    "pbrl_hri": 120 + 4 * STEPS,
    "residual_rl": 120,
    "prefft_lagrangian": 120 + (3 + 3) * STEPS,
}
"""Environment steps that a method asks for."""


@pytest.mark.parametrize("name", METHODS)
def test_every_method_gives_an_act_that_travels_is_the_same_again_and_counts_what_it_asks_for(
    name: str, setting: Setting
) -> None:
    seen = invented.observations(3, np.random.default_rng(0))
    fitted = registry.fit(name, setting)
    actions = np.array([fitted.act(each) for each in seen])
    assert actions.shape == (3, 7)
    assert np.abs(actions).max() <= 1.0
    travelled = pickle.loads(pickle.dumps(fitted.act))  # noqa: S301
    np.testing.assert_array_equal([travelled(each) for each in seen], actions)
    again = registry.fit(name, setting)
    np.testing.assert_array_equal([again.act(each) for each in seen], actions)
    assert fitted.environment_steps == again.environment_steps == COUNTED.get(name, again.environment_steps)
    assert fitted.labels == again.labels == (0 if name in ("reference", "average") else LABELS)


def test_the_trained_policy_begins_as_the_frozen_one_in_the_arms_full_range() -> None:
    torch.manual_seed(0)
    states = invented.observations(600, np.random.default_rng(0))
    actor = prefft.in_full_range(POLICY, torch.from_numpy(states), 600)
    assert POLICY.action_limit < 1.0
    began = actor.policy()
    assert began.action_limit == 1.0
    assert np.abs(began.mean(states) - POLICY.mean(states)).mean() < 0.02
    np.testing.assert_allclose(began.action_std(states).mean(), POLICY.action_std(states).mean(), rtol=0.15)


def test_a_policy_that_already_has_the_full_range_is_taken_over_exactly() -> None:
    policy = type(POLICY)({**POLICY.weights, "action_limit": np.ones(1, np.float32)})
    states = invented.observations(5, np.random.default_rng(0))
    began = prefft.in_full_range(policy, torch.from_numpy(states), 0).policy()
    np.testing.assert_array_equal(began.mean(states), policy.mean(states))


def test_the_divergence_is_that_of_gaussians() -> None:
    generator = torch.Generator().manual_seed(0)
    mean, log_std, other, other_log_std = torch.randn(4, 5, 7, generator=generator).unbind(0)
    expected = torch.distributions.kl_divergence(
        torch.distributions.Normal(mean, log_std.exp()), torch.distributions.Normal(other, other_log_std.exp())
    )
    torch.testing.assert_close(gaussian_divergence(mean, log_std, other, other_log_std), expected.sum(-1))


def fine_tuned(tie_weight: float) -> np.ndarray:
    """Actions in unseen states after some learning."""
    config = FineTuning(steps=1_000, warm_up_steps=120, critic_first_updates=150, cloning_steps=200, learning_rate=5e-3)
    policy = prefft.fine_tune(
        World,
        POLICY,
        preference_rl.learned(REWARD),
        invented.TASK.observation,
        replace(config, tie_weight=tie_weight),
        0,
    )
    actions: np.ndarray = policy.mean(invented.observations(300, np.random.default_rng(9)))
    return actions


def test_fine_tuning_follows_the_learned_reward_and_the_tie_holds_it_back() -> None:
    before = POLICY.mean(invented.observations(300, np.random.default_rng(9)))
    free, tied = fine_tuned(0.0), fine_tuned(prefft.TIED)
    assert free[:, 0].mean() < before[:, 0].mean() - 0.2
    assert tied[:, 0].mean() < before[:, 0].mean()
    assert np.abs(tied - before).mean() < 0.7 * np.abs(free - before).mean()


def test_an_episode_is_rewarded_as_a_whole() -> None:
    asked: list[tuple[int, ...]] = []

    def reward(signals: np.ndarray, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
        asked.append((len(signals), len(observations), len(actions)))
        return np.arange(len(actions), dtype=np.float32)

    config = FineTuning(steps=120, warm_up_steps=60, critic_first_updates=1, cloning_steps=1, environments=2)
    prefft.fine_tune(World, POLICY, reward, invented.TASK.observation, config, 0)
    assert set(asked) == {(STEPS, STEPS, STEPS)}
    assert len(asked) == 120 // STEPS


def test_the_sketchy_reward_is_minus_the_distance_in_the_references_spread_plus_the_learned_one() -> None:
    reference = collect(POLICY.mean, range(3), 0.0, 0)
    for number, each in enumerate(reference):
        each.signals[:, DISTANCE] = number
    both = sketchy(reference, lambda signals, observations, actions: np.full(len(signals), 10.0))
    signals = np.zeros((2, len(SIGNALS)), np.float32)
    signals[:, DISTANCE] = (0.0, 3.0)
    spread = float(np.std([0.0, 1.0, 2.0]))
    rewards = both(signals, signals, signals).tolist()
    assert rewards == pytest.approx([10.0, 10.0 - 3.0 / spread])


@pytest.fixture
def best_of() -> BestOfN:
    rollouts = collect(POLICY.mean, range(20), 0.3, 0)
    return fit_best_of_n(POLICY, REWARD, rollouts, count=8, steps=300, seed=0)


def test_best_of_n_computes_the_value_it_has_learned(best_of: BestOfN) -> None:
    value = ActionValue(torch.zeros(invented.D), torch.ones(invented.D))
    load_state(value, best_of.value)
    seen = invented.observations(1, np.random.default_rng(0))[0]
    candidates = np.random.default_rng(0).uniform(-1, 1, (5, 7)).astype(np.float32)
    expected = value(torch.from_numpy(seen).expand(5, -1), torch.from_numpy(candidates)).detach().numpy()
    np.testing.assert_allclose(best_of.values(seen, candidates), expected, rtol=1e-4, atol=1e-5)


def test_best_of_n_chooses_what_is_liked_among_what_the_policy_would_do(best_of: BestOfN) -> None:
    seen = invented.observations(100, np.random.default_rng(0))
    chosen = np.array([best_of(each) for each in seen])
    assert chosen[:, 0].mean() < POLICY.mean(seen)[:, 0].mean() - 0.02
    assert np.abs(chosen).max() <= POLICY.action_limit + 1e-6


def test_an_unknown_method_is_refused(setting: Setting) -> None:
    with pytest.raises(KeyError):
        registry.fit("magic", setting)


@pytest.mark.parametrize("name", ["sliders", "preferential_bo", "clusters_3", "latent_people"])
def test_who_can_only_give_labels_is_not_served_by_methods_that_ask_for_more(name: str, setting: Setting) -> None:
    with pytest.raises(NobodyToAsk, match="more than labels"):
        registry.fit(name, replace(setting, person=None))
