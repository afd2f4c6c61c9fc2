"""Ranking actions that were never executed by a learned reward, as the printed method needs it.

A network on (state, action) scores a candidate at a state. The Preference Transformer's reward also depends on the
past: here a candidate takes the place of the action that was executed at that step of a recorded episode, after that
episode's own history. All candidates of a list share the history, so that only the candidates decide the ranking; the
preference weights w_t, which need the whole segment, are left out.

The measured signals of the structured kind exist only after an action was executed: it cannot rank. Where all signals
are predicted it can.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from worker.domain.trajectory import Trajectory
from worker.ml.rewards import preference_transformer
from worker.ml.rewards.predicted_reward import PredictedReward
from worker.ml.rewards.preference_transformer import INPUT_CLIP, PreferenceTransformer
from worker.ml.rewards.reward_models import MlpReward, RewardModel

Ranker = Callable[[Tensor, Tensor], Tensor]
"""states (B, n, D), actions (B, n, 7) -> learned reward (B, n)"""
RankerAt = Callable[[Tensor], Ranker]
"""rows (B,) of the steps of all episodes, one episode after the other -> the ranker for candidates at those steps"""


def can_rank(reward: RewardModel) -> bool:
    """Whether ranker_at() takes this model."""
    return isinstance(reward, (MlpReward, PredictedReward, PreferenceTransformer))


def ranker_at(reward: RewardModel, episodes: Sequence[Trajectory]) -> RankerAt:
    """Mean over members. Raises TypeError for a kind that cannot score actions that were never executed."""
    if isinstance(reward, (MlpReward, PredictedReward)):
        anywhere = mlp_ranker(reward) if isinstance(reward, MlpReward) else predicted_ranker(reward)
        return lambda rows: anywhere
    if isinstance(reward, PreferenceTransformer):
        memory = HistoryMemory(reward, episodes)
        return lambda rows: lambda states, actions: memory.rewards(rows, states, actions).mean(0)
    raise TypeError(
        "The printed method ranks untried actions and needs a reward model of the kind 'predicted', 'mlp' or "
        "'preference_transformer'."
    )


def mlp_ranker(reward: MlpReward) -> Ranker:
    """The learned reward as a torch function, mean over members."""
    layers = [(torch.from_numpy(np.array(matrix)), torch.from_numpy(np.array(bias))) for matrix, bias in reward.layers]
    offset, scale = torch.from_numpy(np.array(reward.offset)), torch.from_numpy(np.array(reward.scale))

    def rank(states: Tensor, actions: Tensor) -> Tensor:
        inputs = torch.cat([states, actions], -1)
        hidden = ((inputs.reshape(1, -1, inputs.shape[-1]) - offset) / scale).clamp(-6.0, 6.0)
        for matrix, bias in layers[:-1]:
            hidden = functional.silu(hidden @ matrix + bias)
        matrix, bias = layers[-1]
        rewards: Tensor = (hidden @ matrix + bias).tanh().mean(0).reshape(inputs.shape[:-1])
        return rewards

    return rank


def predicted_ranker(reward: PredictedReward) -> Ranker:
    """The weighted signals that are foreseen for an action, mean over members."""
    weights = reward.weights.mean(axis=0)

    def rank(states: Tensor, actions: Tensor) -> Tensor:
        foreseen = reward.predictor.predict(states.detach().numpy(), actions.detach().numpy())
        return torch.from_numpy((foreseen @ weights).astype(np.float32))

    return rank


class HistoryMemory:
    """Keys and values of every recorded step: a candidate then costs one token, however long its history is."""

    def __init__(self, reward: PreferenceTransformer, episodes: Sequence[Trajectory]) -> None:
        self._weights, self._heads = reward.torch_weights(), reward.heads
        self._offset, self._scale = (torch.from_numpy(np.array(each)) for each in (reward.offset, reward.scale))
        self._layers = range(preference_transformer.layer_count(self._weights))
        rows = [self._recorded(reward, each) for each in episodes]
        self._past = [
            tuple(torch.cat(parts, 1) for parts in zip(*layer, strict=True)) for layer in zip(*rows, strict=True)
        ]
        """per layer the keys and the values, (E, R, heads, W / heads) each, R steps in all"""
        self._before, self._ago = _histories([len(each) for each in episodes], reward.stride)

    @torch.no_grad()
    def rewards(self, rows: Tensor, states: Tensor, actions: Tensor) -> Tensor:
        """r_t of candidates (B, n, 7) at states (B, n, D) after the histories of the steps in ``rows`` (B,).

        (E, B, n), not normalised.
        """
        inputs = ((torch.cat([states, actions], -1) - self._offset) / self._scale).clamp(-INPUT_CLIP, INPUT_CLIP)
        hidden = preference_transformer.embedded(self._weights, inputs[None])
        before = self._before[rows]
        bias = preference_transformer.attention_bias(self._ago[None, None], self._heads)
        bias = bias.masked_fill(before[:, None, None] < 0, -torch.inf)
        for layer in self._layers:
            query, key, value = preference_transformer.attention_inputs(self._weights, layer, hidden, self._heads)
            past_key, past_value = (each[:, before].transpose(2, 3) for each in self._past[layer])
            scores = torch.cat([query @ past_key.transpose(-1, -2), (query * key).sum(-1, keepdim=True)], -1)
            attention = (scores / query.shape[-1] ** 0.5 + functional.pad(bias, (0, 1))).softmax(-1)
            mixed = attention[..., :-1] @ past_value + attention[..., -1:] * value
            mixed = mixed.transpose(-2, -3).flatten(-2)
            hidden = preference_transformer.after_attention(self._weights, layer, hidden, mixed)
        return preference_transformer.step_rewards(self._weights, preference_transformer.normal(hidden))

    @torch.no_grad()
    def _recorded(self, reward: PreferenceTransformer, episode: Trajectory) -> list[tuple[Tensor, Tensor]]:
        """Per layer the keys and values (E, T, heads, W / heads) of one episode's steps."""
        inputs = reward.inputs(episode.observations[: len(episode)], episode.actions)
        width = self._weights["embed"].shape[-1]
        shape = (reward.size, len(episode), self._heads, width // self._heads)
        past = [(torch.zeros(shape), torch.zeros(shape)) for _ in self._layers]
        for begin in range(min(reward.stride, len(episode))):
            read = preference_transformer.keys_and_values(
                self._weights, inputs[None, begin :: reward.stride], self._heads
            )
            for (keys, values), (key, value) in zip(past, read, strict=True):
                keys[:, begin :: reward.stride] = key[:, 0].transpose(1, 2)
                values[:, begin :: reward.stride] = value[:, 0].transpose(1, 2)
        return past


def _histories(lengths: Sequence[int], stride: int) -> tuple[Tensor, Tensor]:
    """The rows of the tokens before every step, nearest first, (R, H), -1 where there is none; tokens ago, (H,)."""
    longest = (max(lengths) - 1) // stride
    ago = torch.arange(1, longest + 1)
    blocks, first = [], 0
    for length in lengths:
        earlier = torch.arange(length)[:, None] - stride * ago
        blocks.append(torch.where(earlier >= 0, earlier + first, -1))
        first += length
    return torch.cat(blocks), ago
