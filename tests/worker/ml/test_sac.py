"""Soft actor-critic: it learns a problem with a known answer, and a killed training resumes."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from worker.domain.spaces import Field, Space
from worker.ml.policies import pretraining, sac
from worker.ml.policies.gaussian import GaussianPolicy


class Reach(gymnasium.Env[Any, Any]):
    """A point on a plane is to be moved to a random goal within ten steps."""

    def __init__(self) -> None:
        self.observation_space = gymnasium.spaces.Box(-2, 2, (4,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.goal = self.np_random.uniform(-1, 1, 2)
        self.place = np.zeros(2)
        self.steps = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place = self.place + 0.3 * np.clip(action, -1, 1)
        self.steps += 1
        distance = float(np.linalg.norm(self.goal - self.place))
        return self._observe(), -distance, False, self.steps == 10, {"success": distance < 0.15}

    def _observe(self) -> np.ndarray:
        return np.concatenate([self.place, self.goal - self.place]).astype(np.float32)


CONFIG = sac.SacConfig(
    total_steps=3000,
    random_steps=200,
    environments=2,
    hidden=32,
    batch=64,
    learning_rate=2e-3,
    target_entropy=-2.0,
    average_rate=0.02,
    evaluate_every_steps=1000,
    evaluation_episodes=20,
    test_episodes=50,
    observation=Space((Field("place", 2, "1", -2, 2, ""), Field("to_goal", 2, "1", -2, 2, ""))),
)


def test_it_learns_to_reach_and_writes_policy_and_record(tmp_path: Path) -> None:
    record = pretraining.pretrain(Reach, CONFIG, tmp_path, command="test")
    policy = GaussianPolicy.load(tmp_path / "policy.safetensors")
    untrained = pretraining.evaluate(Reach(), lambda _: np.zeros(2, np.float32), 0, 50)
    assert untrained["success"] < 0.2
    assert pretraining.evaluate(Reach(), policy.mean, 0, 50)["success"] > 0.9
    assert record["test_mean_action"]["success"] > 0.9
    assert json.loads((tmp_path / "training.json").read_text())["steps"] == 3000


class Killed(Exception):
    """Stands for kill -9 in the middle of a training."""


def test_a_killed_training_resumes_where_it_last_saved(tmp_path: Path) -> None:
    config = replace(CONFIG, total_steps=600, save_every_s=0.0, evaluate_every_steps=200, test_episodes=5)

    def kill_at_500(steps: int, figures: dict[str, float]) -> None:
        if steps >= 500:
            raise Killed

    with pytest.raises(Killed):
        pretraining.pretrain(Reach, config, tmp_path, kill_at_500)
    seen: list[int] = []
    record = pretraining.pretrain(Reach, config, tmp_path, lambda steps, figures: seen.append(steps))
    assert seen[0] > 400
    assert record["steps"] == 600
    assert [point["steps"] for point in record["curve"]][-2:] == [400, 600]


def test_saved_state_holds_every_number_of_the_learner() -> None:
    torch.manual_seed(0)
    replay = sac.Replay(300, 4, 2)
    rng = np.random.default_rng(0)
    replay.add(*(rng.random(shape).astype(np.float32) for shape in ((300, 4), (300, 2), (300,), (300,), (300, 4))))

    def learner() -> sac.Learner:
        return sac.Learner(CONFIG, torch.zeros(4), torch.ones(4), 2)

    original = learner()
    for _ in range(4):
        original.update(replay)
    copy = learner()
    copy.load_state({name: tensor.clone() for name, tensor in original.state().items()}, original.updates)
    for one in (original, copy):
        torch.manual_seed(1)
        for _ in range(4):
            one.update(replay)
    for name, tensor in original.state().items():
        assert torch.equal(tensor, copy.state()[name]), name


def test_log_probabilities_are_those_of_a_squashed_gaussian() -> None:
    torch.manual_seed(0)
    actor = sac.Actor(torch.zeros(4), torch.ones(4), 2, 16)
    states = torch.randn(6, 4)
    mean, log_std = actor(states)
    actions, log_probability = actor.sample(states)
    gaussian = torch.distributions.Normal(mean, log_std.exp())
    squashed = torch.distributions.TransformedDistribution(gaussian, torch.distributions.TanhTransform(cache_size=0))
    expected = squashed.log_prob(actions.clamp(-1 + 1e-6, 1 - 1e-6)).sum(-1)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(log_probability, expected, rtol=1e-3, atol=1e-3)


def test_the_exported_policy_acts_like_the_actor() -> None:
    torch.manual_seed(0)
    actor = sac.Actor(torch.randn(4), torch.rand(4) + 0.5, 2, 16)
    states = torch.randn(6, 4)
    np.testing.assert_allclose(actor.policy().mean(states.numpy()), actor(states)[0].tanh().detach().numpy(), atol=2e-6)


def test_target_critics_follow_slowly() -> None:
    slow, fast = torch.nn.Linear(3, 1), torch.nn.Linear(3, 1)
    before = slow.weight.detach().clone()
    sac._move_towards(slow, fast, 0.01)
    torch.testing.assert_close(slow.weight, before + 0.01 * (fast.weight - before))


def test_the_learning_rate_fades_only_in_the_second_half() -> None:
    learner = sac.Learner(CONFIG, torch.zeros(4), torch.ones(4), 2)

    def rate_at(share: float) -> float:
        learner.set_learning_rate(share)
        return float(learner.optimisers["actor"].param_groups[0]["lr"])

    assert rate_at(0.4) == CONFIG.learning_rate
    assert math.isclose(rate_at(1.0), CONFIG.final_learning_rate)
