"""Reinforcement learning on a learned reward: what a refinement and the rivals share. The learner is that of sac.

Environments report the measured ``signals`` of every step in their info; their own reward is ignored. An episode is
rewarded when it is over, as a whole, so that the reward model may be one that remembers what came before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml.policies.checkpoint import Checkpoint, Paused
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.policies.sac import Learner, Replay, SacConfig
from worker.ml.rewards.reward_models import RewardModel

Env = gymnasium.Env[Any, Any]
MakeEnv = Callable[[], Env]
EpisodeReward = Callable[[Float32Array, Float32Array, Float32Array], npt.NDArray[np.floating]]
"""signals (T, S), observations (T, D), actions (T, 7) of one whole episode -> rewards (T,)"""
FirstActions = Callable[[Float32Array], Float32Array]
"""observations (N, D) -> actions (N, 7) before the actor takes over"""

TRAINING_SCENARIOS = 1_000_000
"""Episodes are random scenarios below this number; nothing is evaluated there."""
_LONGEST_EPISODE = 1_000


@dataclass(frozen=True)
class PolicyAct:
    """A policy's deterministic action as a rollout's callable."""

    policy: ReferencePolicy

    def __call__(self, observation: Float32Array) -> Float32Array:
        """(D,) -> (7,)"""
        return self.policy.mean(observation)


def learned(reward: RewardModel) -> EpisodeReward:
    """The mean over the members, normalised and clipped."""
    return lambda signals, observations, actions: reward.episode_rewards(signals, observations, actions).mean(axis=0)


@dataclass
class _Episode:
    """What has happened since an environment's last reset."""

    states: list[Float32Array] = field(default_factory=list)
    actions: list[Float32Array] = field(default_factory=list)
    signals: list[list[float]] = field(default_factory=list)


class PreferenceRl:
    """Several environments, the replay, and a learner once there is one. Draws torch's global random numbers."""

    def __init__(
        self,
        make_env: MakeEnv,
        reward: EpisodeReward,
        config: SacConfig,
        known: Sequence[Trajectory] = (),
        reward_mark: str = "",
    ) -> None:
        """``known``: rollouts that the replay begins with; they count as no steps. ``reward_mark``: differs where the
        reward does, for checkpoints.
        """
        self.config, self.reward, self.reward_mark = config, reward, reward_mark
        self.rng = np.random.default_rng([config.seed, 6])
        self.envs = [make_env() for _ in range(config.environments)]
        self.actions = int(np.prod(self.envs[0].action_space.shape or ()))
        capacity = max(config.total_steps + config.environments, _LONGEST_EPISODE * config.environments)
        capacity += sum(len(each) for each in known)
        self.replay = Replay(capacity, config.observation.size, self.actions)
        self.signals = np.zeros((capacity, len(SIGNALS)), np.float32)
        self.ends: list[int] = []
        """of the episodes in the replay"""
        for each in known:
            self._remember(each.signals, each.observations, each.actions, terminated=False)
        self.steps = 0
        self._goes_on = False
        self._begin()

    def warm_up(self, first: FirstActions) -> Float32Array:
        """Make ``random_steps`` steps, or at least one episode, without learning; returns all states seen, (N, D)."""
        before = self.replay.count
        while self.steps < self.config.random_steps or self.replay.count == before:
            self._step(first(self.states))
        return self.seen

    def learn(
        self,
        learner: Learner,
        checkpoint: Checkpoint | None = None,
        watch: "Watch | None" = None,
        until: int | None = None,
    ) -> None:
        """The rest of the steps: first the critics alone, on the warm-up's episodes, then everything.

        ``watch`` is called before every step of the environments. ``until``: stop after so many steps, with all that
        restore() needs in the checkpoint.
        """
        config = self.config
        for _ in range(0 if self._goes_on else config.critic_first_updates):
            learner.update(self.replay, actor=False)
        owed = 0.0
        while self.steps < config.total_steps:
            if checkpoint:
                ends_here = until is not None and self.steps >= until
                self._keep_state(learner, checkpoint, ends_here)
                if ends_here and not self._is_in_midst:
                    return
            if watch:
                watch(self, learner)
            with torch.no_grad():
                actions: Float32Array = learner.actor.sample(torch.from_numpy(self.states))[0].numpy()
            self._step(self.explored(actions))
            learner.set_learning_rate(self.steps / config.total_steps)
            owed += config.updates_per_step * len(self.envs)
            while owed >= 1:
                learner.update(self.replay)
                owed -= 1

    def explored(self, actions: Float32Array) -> Float32Array:
        """What is tried of what the actor says, (N, A) -> (N, A), for subclasses that explore in their own way."""
        return actions

    def restore(self, learner: Learner, tensors: dict[str, Tensor], counts: dict[str, Any]) -> None:
        """Go on from a checkpoint of learn(), as if nothing had happened where episodes are equally long.

        If the reward is another one by now, all episodes are rewarded anew, and learn() begins with the critics again.
        """
        self.replay.count, self.steps, self.ends = len(tensors["replay"]), counts["steps"], counts["ends"]
        self.replay.rows[: self.replay.count] = tensors["replay"]
        self.signals[: self.replay.count] = tensors["signals"].numpy()
        if is_new := counts["reward"] != self.reward_mark:
            self.reward_anew(self.reward)
        learner.load_state(tensors, counts["updates"])
        torch.set_rng_state(tensors["torch_rng"])
        self.rng.bit_generator.state = counts["rng"]
        self._goes_on = not is_new
        self._begin()

    def reward_anew(self, reward: EpisodeReward) -> None:
        """From here on this is what episodes are rewarded by, those in the replay included."""
        self.reward = reward
        for start, end in pairwise([0, *self.ends]):
            states, actions, rewards, *_ = self.replay.split(self.replay.rows[start:end])
            anew = self.reward(self.signals[start:end], states.numpy(), actions.numpy())
            rewards[:, 0] = torch.from_numpy(np.asarray(anew, np.float32))

    def _keep_state(self, learner: Learner, checkpoint: Checkpoint, at_once: bool) -> None:
        checkpoint.note(self.steps / self.config.total_steps)
        if self._is_in_midst:
            return
        if at_once or checkpoint.is_due or checkpoint.pause_is_asked:
            rows, signals = self.replay.rows[: self.replay.count], torch.from_numpy(self.signals[: self.replay.count])
            tensors = {**learner.state(), "replay": rows, "signals": signals, "torch_rng": torch.get_rng_state()}
            counts = {"steps": self.steps, "updates": learner.updates, "rng": self._rng_at_beginning, "ends": self.ends}
            kept = {"reward": self.reward_mark, "target_entropy": learner.config.target_entropy}
            checkpoint.write(tensors, {**counts, **kept})
        if checkpoint.pause_is_asked:
            raise Paused(Paused.__doc__)

    @property
    def _is_in_midst(self) -> bool:
        """Whether all episodes will soon be over at once; what went on from here would begin them anew."""
        lengths = {len(each.states) for each in self.episodes}
        return len(lengths) == 1 and lengths != {1}

    def _begin(self) -> None:
        """New episodes everywhere."""
        self._rng_at_beginning = self.rng.bit_generator.state
        self.states = np.stack([self._reset(env) for env in self.envs])
        self.episodes = [_Episode([state.copy()]) for state in self.states]

    def close(self) -> None:
        """Free the environments."""
        for env in self.envs:
            env.close()

    def _step(self, actions: Float32Array) -> None:
        """One step in every environment."""
        rng = self.rng.bit_generator.state
        for index, (env, action) in enumerate(zip(self.envs, actions, strict=True)):
            state, _, terminated, truncated, info = env.step(action)
            episode = self.episodes[index]
            episode.states.append(state)
            episode.actions.append(action)
            episode.signals.append([info["signals"][name] for name in SIGNALS])
            if terminated or truncated:
                self._keep(episode, terminated)
                self._rng_at_beginning = rng
                state = self._reset(env)
                self.episodes[index] = _Episode([state])
            self.states[index] = state
        self.steps += len(self.envs)

    def _keep(self, episode: _Episode, terminated: bool) -> None:
        states, actions = np.array(episode.states, np.float32), np.array(episode.actions, np.float32)
        self._remember(np.array(episode.signals, np.float32), states, actions, terminated)

    def _remember(self, signals: Float32Array, states: Float32Array, actions: Float32Array, terminated: bool) -> None:
        """Reward a finished episode and put it into the replay: (T, S), (T + 1, D), (T, A)."""
        rewards = self.reward(signals, states[:-1], actions)
        goes_on = np.ones(len(actions), np.float32)
        goes_on[-1] = not terminated  # a time limit is not an end: what would have followed still counts
        self.signals[self.replay.count : self.replay.count + len(actions)] = signals
        self.replay.add(states[:-1], actions, np.asarray(rewards, np.float32), goes_on, states[1:])
        self.ends.append(self.replay.count)

    @property
    def seen(self) -> Float32Array:
        """The states in the replay, (N, D)."""
        states: Float32Array = self.replay.rows[: self.replay.count, : self.config.observation.size].numpy()
        return states

    def _reset(self, env: Env) -> Float32Array:
        state: Float32Array = env.reset(seed=int(self.rng.integers(TRAINING_SCENARIOS)))[0]
        return state


Watch = Callable[[PreferenceRl, Learner], None]
