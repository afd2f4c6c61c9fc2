"""The Preference Transformer (Kim et al. 2023): a reward that may depend on everything that has happened so far.

A causal transformer reads the (state, action) tokens of a segment; its output at step t is the non-Markovian reward
r_t. A preference-attention layer over those outputs, which is not causal, says how much each step counts: with queries
q, keys k and N tokens,

    w_t = sum_i softmax_t(<q_i, k_t> / sqrt(width))   (they sum to N),      P[right > left] = sigmoid(sum w r - sum w r)

Small enough for one processor: every ``stride``-th control step is a token. A segment is therefore read ``stride``
times, each time beginning one step later, so that every step gets its reward from its own past at the same spacing.
Position enters only as a distance (attention falls off linearly with it, per head; Press et al. 2022): episodes may be
longer than the clips that were labelled.

As a reward of one step, for values and returns, r_t is used without w_t, which needs the whole segment (as the authors
do). A candidate action at a state takes the place of the last action of the history that really led to that state.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.rewards.reward_models import RewardModel
from worker.ml.rewards.segments import LEFT, RIGHT, Mask, SegmentPairs

Weights = Mapping[str, Tensor]
"""By name, each (E, in, out), or (E, 1, out) for a bias; layers are numbered."""

INPUT_CLIP = 6.0
_UNATTENDED = -1e9
"""Score of a token that was not shown; finite, since a row of nothing but infinities has no softmax."""
_CHUNK = 256
"""Segments read at a time: bounds the memory."""


@dataclass(frozen=True)
class PreferenceTransformer(RewardModel):
    """E members, each a transformer; see the module. Inputs are standardised with ``offset`` and ``scale`` (D + 7,)."""

    kind: ClassVar[str] = "preference_transformer"
    weights: Mapping[str, Float32Array]
    offset: Float32Array
    scale: Float32Array
    heads: int
    stride: int

    def raw_rewards(self, signals: Float32Array, observations: Float32Array, actions: Float32Array) -> FloatArray:
        """See RewardModel; the signals are not used. The axis before the last is time, from an episode's start."""
        return self._read(observations, actions)[0]

    def logits(self, pairs: SegmentPairs) -> FloatArray:
        """See RewardModel: here the steps are weighed by preference attention."""
        rewards, weights = self._read(pairs.observations, pairs.actions, pairs.mask)
        returns = (rewards * weights).sum(axis=-1)  # steps that were not shown weigh nothing
        difference: FloatArray = returns[..., RIGHT] - returns[..., LEFT]
        return difference

    def step_weights(self, pairs: SegmentPairs) -> FloatArray:
        """How much every step counts in its segment; the mean over shown steps is 1. (E, N, 2, T)"""
        return self._read(pairs.observations, pairs.actions, pairs.mask)[1]

    def inputs(self, observations: npt.ArrayLike, actions: npt.ArrayLike) -> Tensor:
        """(..., D), (..., 7) -> (..., D + 7) standardised."""
        joined = np.concatenate([observations, actions], axis=-1)
        seen = np.clip((joined - self.offset) / self.scale, -INPUT_CLIP, INPUT_CLIP)
        return torch.from_numpy(np.ascontiguousarray(seen, np.float32))

    def torch_weights(self) -> Weights:
        """The weights as tensors that share their memory."""
        return {name: torch.from_numpy(np.array(array)) for name, array in self.weights.items()}

    @torch.no_grad()
    def _read(
        self, observations: Float32Array, actions: Float32Array, mask: Mask | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Rewards and preference weights, (E, ..., T) each; ``mask`` (..., T): the steps that were shown."""
        leading = np.shape(actions)[:-1]
        shown = None if mask is None else torch.from_numpy(np.array(mask)).reshape(-1, leading[-1])
        inputs = self.inputs(observations, actions).reshape(-1, leading[-1], len(self.offset))
        weights = self.torch_weights()
        rewards, importance = np.zeros((2, self.size, *inputs.shape[:2]))
        for first in range(0, len(inputs), _CHUNK):
            part = slice(first, first + _CHUNK)
            for begin in range(min(self.stride, leading[-1])):
                tokens = hidden_states(weights, inputs[part, begin :: self.stride], self.heads)
                rewards[:, part, begin :: self.stride] = step_rewards(weights, tokens).numpy()
                seen = None if shown is None else shown[part, begin :: self.stride]
                importance[:, part, begin :: self.stride] = preference_attention(weights, tokens, seen).numpy()
        return rewards.reshape(self.size, *leading), importance.reshape(self.size, *leading)

    def tensors(self) -> dict[str, Float32Array]:
        """See RewardModel."""
        named = {"offset": self.offset, "scale": self.scale, **self.weights}
        return {name: np.ascontiguousarray(array, np.float32) for name, array in named.items()}

    def config(self) -> dict[str, Any]:
        """See RewardModel."""
        return {**super().config(), "heads": self.heads, "stride": self.stride}

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, Float32Array], config: Mapping[str, Any]) -> Self:
        """See RewardModel."""
        weights = {name: array for name, array in tensors.items() if name not in {"offset", "scale"}}
        return cls(weights, tensors["offset"], tensors["scale"], int(config["heads"]), int(config["stride"]))

    @property
    def size(self) -> int:
        """See RewardModel."""
        return len(self.weights["embed"])


def new_weights(inputs: int, members: int, width: int, layers: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Random weights; the reward head starts small, so that a segment's return starts undecided."""
    sizes = {"embed": (inputs, width), "query_key": (width, 2 * width), "reward": (width, 1)}
    for layer in range(layers):
        sizes[f"attention_{layer}"] = (width, 3 * width)
        sizes[f"mixed_{layer}"] = (width, width)
        sizes[f"up_{layer}"] = (width, 2 * width)
        sizes[f"down_{layer}"] = (2 * width, width)
    weights = {name: torch.randn(members, *size, generator=generator) / size[0] ** 0.5 for name, size in sizes.items()}
    weights["reward"] *= 0.03
    for name in ("embed", *(f"up_{layer}" for layer in range(layers))):
        weights[f"{name}_bias"] = torch.zeros(members, 1, sizes[name][1])
    return weights


def hidden_states(weights: Weights, inputs: Tensor, heads: int) -> Tensor:
    """The causal transformer. (B, T, F) -> (E, B, T, W)"""
    return _transformed(weights, inputs, heads)[0]


def keys_and_values(weights: Weights, inputs: Tensor, heads: int) -> list[tuple[Tensor, Tensor]]:
    """What later tokens attend to, per layer. (B, T, F) -> (E, B, heads, T, W / heads) twice"""
    return _transformed(weights, inputs, heads)[1]


def _transformed(weights: Weights, inputs: Tensor, heads: int) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    hidden, past = embedded(weights, inputs[None]), []
    steps = torch.arange(inputs.shape[1])
    bias = attention_bias(steps[:, None] - steps, heads)
    for layer in range(layer_count(weights)):
        query, key, value = attention_inputs(weights, layer, hidden, heads)
        past.append((key, value))
        hidden = after_attention(weights, layer, hidden, attended(query, key, value, bias))
    return normal(hidden), past


def step_rewards(weights: Weights, tokens: Tensor) -> Tensor:
    """r_t of every token. (E, B, T, W) -> (E, B, T)"""
    return _linear(tokens, weights["reward"])[..., 0]


def preference_attention(weights: Weights, tokens: Tensor, shown: Tensor | None = None) -> Tensor:
    """w_t of every token: how much all tokens attend to it; the mean over time is 1. (E, B, T, W) -> (E, B, T)

    ``shown`` (B, T): tokens outside it neither attend nor are attended to; the mean over the others is 1.
    """
    query, key = _linear(tokens, weights["query_key"]).chunk(2, -1)
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
    if shown is None:
        importance: Tensor = scores.softmax(-1).sum(-2)
        return importance
    scores = scores.masked_fill(~shown[:, None, :], _UNATTENDED)
    importance = (scores.softmax(-1) * shown[:, :, None]).sum(-2) * shown
    return importance


def layer_count(weights: Weights) -> int:
    """How many transformer layers these weights make."""
    return sum(name.startswith("attention_") for name in weights)


def embedded(weights: Weights, inputs: Tensor) -> Tensor:
    """(E or 1, B, T, F) -> (E, B, T, W)"""
    hidden: Tensor = functional.silu(_linear(inputs, weights["embed"], weights["embed_bias"]))
    return hidden


def attention_inputs(weights: Weights, layer: int, hidden: Tensor, heads: int) -> list[Tensor]:
    """Query, key and value of every token, (E, B, T, W) -> (E, B, heads, T, W / heads) each."""
    mixed = _linear(normal(hidden), weights[f"attention_{layer}"])
    return [part.reshape(*part.shape[:-1], heads, -1).transpose(-2, -3) for part in mixed.chunk(3, -1)]


def attended(query: Tensor, key: Tensor, value: Tensor, bias: Tensor) -> Tensor:
    """Attention with a bias (..., heads, Q, K) on its scores. (E, B, heads, Q, d) -> (E, B, Q, W)"""
    scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5 + bias
    mixed: Tensor = (scores.softmax(-1) @ value).transpose(-2, -3).flatten(-2)
    return mixed


def after_attention(weights: Weights, layer: int, hidden: Tensor, attention: Tensor) -> Tensor:
    """The rest of a layer: both residual branches. (E, B, T, W) twice -> (E, B, T, W)"""
    hidden = hidden + _linear(attention, weights[f"mixed_{layer}"])
    raised = functional.silu(_linear(normal(hidden), weights[f"up_{layer}"], weights[f"up_{layer}_bias"]))
    return hidden + _linear(raised, weights[f"down_{layer}"])


def attention_bias(distance: Tensor, heads: int) -> Tensor:
    """Less attention to what is longer ago, none to the future. Tokens ago (..., Q, K) -> (..., heads, Q, K)"""
    slopes = torch.tensor([0.5 ** (1 + 2 * head) for head in range(heads)])[:, None, None]
    ago = distance.unsqueeze(-3)
    return (-slopes * ago).masked_fill(ago < 0, -torch.inf)


def _linear(inputs: Tensor, matrix: Tensor, bias: Tensor | None = None) -> Tensor:
    """(E or 1, B, T, in), (E, in, out) -> (E, B, T, out)"""
    out = inputs.flatten(1, 2) @ matrix
    shifted: Tensor = out if bias is None else out + bias
    return shifted.reshape(len(shifted), *inputs.shape[1:3], -1)


def normal(hidden: Tensor) -> Tensor:
    """Every token with mean 0 and deviation 1 over its width."""
    return functional.layer_norm(hidden, hidden.shape[-1:])
