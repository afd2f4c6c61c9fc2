"""Training ensembles of networks on labelled pairs: the MLP of B-Pref and the Preference Transformer.

All members are trained at once as one batch of tensors. Each sees its own bootstrap sample of the labels, so that they
disagree where the labels leave room. A share of the labels is seen by none: it says when to stop, and how sure to be.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml.rewards import preference_transformer
from worker.ml.rewards.calibration import HeldOut
from worker.ml.rewards.preference_loss import preference_loss
from worker.ml.rewards.preference_transformer import PreferenceTransformer
from worker.ml.rewards.reward_models import MlpReward, RewardModel
from worker.ml.rewards.segments import LEFT, RIGHT, SegmentPairs

Logits = Callable[[Tensor, Tensor, int], Tensor]
"""Inputs (B, 2, T, F), which steps were shown (B, 2, T), and the first step to look at -> every member's log odds that
right is preferred, (E, B)."""

FEWEST_TO_STOP = 20
"""With fewer labels none is held out: every one is needed for learning."""


@dataclass(frozen=True)
class MlpTraining:
    """How the network ensemble is trained. More steps overfit at 200 labels (measured: docs/method.md)."""

    members: int = 4
    hidden: int = 64
    learning_rate: float = 1e-3
    weight_decay: float = 1e-4
    steps: int = 240
    batch_pairs: int = 32
    every_nth_step: int = 2
    """Neighbouring control steps are nearly the same; using every second one halves the cost."""
    held_out: float = 0.15
    check_every: int = 20
    patience: int = 4


@dataclass(frozen=True)
class TransformerTraining(MlpTraining):
    """How the Preference Transformer is trained; ``hidden`` is the width of its tokens."""

    members: int = 3
    learning_rate: float = 5e-4
    weight_decay: float = 1.0
    every_nth_step: int = 5
    """one token per so many control steps: six as good as three at half the price"""
    check_every: int = 10
    patience: int = 8
    layers: int = 1
    heads: int = 4


def fit_mlp(
    pairs: SegmentPairs, answers: FloatArray, seed: int, config: MlpTraining
) -> tuple[RewardModel, dict[str, Any]]:
    """The model in raw units, and what is worth knowing about its training."""
    generator = torch.Generator().manual_seed(seed)
    inputs, shown, offset, scale = _standardised(pairs)
    sizes = [inputs.shape[-1], config.hidden, config.hidden, 1]
    layers = []
    for fan_in, fan_out in pairwise(sizes):
        matrix = torch.randn(config.members, fan_in, fan_out, generator=generator) / fan_in**0.5
        if fan_out == 1:
            matrix *= 0.1  # returns of a hundred steps: start undecided
        layers += [matrix, torch.zeros(config.members, 1, fan_out)]

    def logits(segments: Tensor, seen: Tensor, first: int) -> Tensor:
        steps = slice(first, None, config.every_nth_step)
        return _mlp_logits(layers, segments[:, :, steps], seen[:, :, steps]) * config.every_nth_step

    trained = _train(layers, logits, inputs, shown, answers, config, generator)
    arrays = [tensor.numpy() for tensor in trained.best]
    model = MlpReward(tuple(zip(arrays[::2], arrays[1::2], strict=True)), offset, scale)
    return model, trained.metrics(model, pairs, answers)


def fit_transformer(
    pairs: SegmentPairs, answers: FloatArray, seed: int, config: TransformerTraining
) -> tuple[RewardModel, dict[str, Any]]:
    """The model in raw units, and what is worth knowing about its training."""
    generator = torch.Generator().manual_seed(seed)
    inputs, shown, offset, scale = _standardised(pairs)
    weights = preference_transformer.new_weights(
        inputs.shape[-1], config.members, config.hidden, config.layers, generator
    )

    def logits(segments: Tensor, seen: Tensor, first: int) -> Tensor:
        tokens = segments[:, :, first :: config.every_nth_step].flatten(0, 1)
        counting = seen[:, :, first :: config.every_nth_step].flatten(0, 1)
        hidden = preference_transformer.hidden_states(weights, tokens, config.heads)
        rewards = preference_transformer.step_rewards(weights, hidden)
        importance = preference_transformer.preference_attention(weights, hidden, counting)
        returns = (rewards * importance).sum(-1).reshape(config.members, -1, 2) * config.every_nth_step
        difference: Tensor = returns[..., RIGHT] - returns[..., LEFT]
        return difference

    trained = _train(list(weights.values()), logits, inputs, shown, answers, config, generator)
    arrays = {name: tensor.numpy() for name, tensor in zip(weights, trained.best, strict=True)}
    model = PreferenceTransformer(arrays, offset, scale, config.heads, config.every_nth_step)
    return model, trained.metrics(model, pairs, answers)


@dataclass(frozen=True)
class _Trained:
    best: list[Tensor]
    unseen: npt.NDArray[np.bool_]
    """(N,)"""
    steps: int
    validation_loss: float | None

    def metrics(self, model: RewardModel, pairs: SegmentPairs, answers: FloatArray) -> dict[str, Any]:
        return {
            "steps": self.steps,
            "validation_loss": self.validation_loss,
            "held_out": HeldOut(model.logits(pairs)[:, self.unseen], answers[self.unseen]),
        }


def _train(
    parameters: list[Tensor],
    logits: Logits,
    inputs: Tensor,
    shown: Tensor,
    answers: FloatArray,
    config: MlpTraining,
    generator: torch.Generator,
) -> _Trained:
    """Minimise the right form of Eq. (2) over bootstrap samples, and keep what did best on the held-out labels."""
    targets = torch.as_tensor(answers, dtype=torch.float32)
    order = torch.randperm(len(targets), generator=generator)
    held_out = max(1, round(config.held_out * len(order))) if len(order) >= FEWEST_TO_STOP else 0
    validation, training = order[:held_out], order[held_out:]
    draws = training[torch.randint(len(training), (config.members, len(training)), generator=generator)]
    unseen = np.isin(np.arange(len(targets)), validation.numpy())
    counts = torch.stack([torch.bincount(draw, minlength=len(targets)) for draw in draws]).float()

    for tensor in parameters:
        tensor.requires_grad_()
    optimiser = torch.optim.AdamW(parameters, config.learning_rate, weight_decay=config.weight_decay)
    best, best_loss, waited, steps = _copied(parameters), float("inf"), 0, 0
    for step in range(1, config.steps + 1):
        steps = step
        rows = training[torch.randint(len(training), (config.batch_pairs,), generator=generator)]
        first = int(torch.randint(min(config.every_nth_step, inputs.shape[2]), (), generator=generator))
        loss = preference_loss(logits(inputs[rows], shown[rows], first), targets[rows], counts[:, rows])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if held_out and step % config.check_every == 0:
            with torch.no_grad():
                current = float(preference_loss(logits(inputs[validation], shown[validation], 0), targets[validation]))
            if current < best_loss:
                best, best_loss, waited = _copied(parameters), current, 0
            else:
                waited += 1
            if waited >= config.patience:
                break
    if not held_out:
        best = _copied(parameters)
    return _Trained(best, unseen, steps, best_loss if held_out else None)


def _standardised(pairs: SegmentPairs) -> tuple[Tensor, Tensor, Float32Array, Float32Array]:
    """Inputs (N, 2, T, D + 7) with mean 0 and deviation 1 over the steps shown, which those are (N, 2, T), and the
    offset and scale used."""
    steps = np.concatenate([pairs.observations, pairs.actions], axis=-1)
    flat = steps[pairs.shown]
    offset = flat.mean(axis=0)
    scale = np.maximum(flat.std(axis=0), 1e-3)
    standardised = np.clip((steps - offset) / scale, -6.0, 6.0)
    inputs = torch.from_numpy(standardised.astype(np.float32))
    return inputs, torch.from_numpy(pairs.shown.copy()), offset.astype(np.float32), scale.astype(np.float32)


def _mlp_logits(layers: list[Tensor], inputs: Tensor, shown: Tensor) -> Tensor:
    """(B, 2, T, F), (B, 2, T) -> (E, B)"""
    hidden = inputs.reshape(1, -1, inputs.shape[-1])
    for matrix, bias in zip(layers[:-2:2], layers[1:-2:2], strict=True):
        hidden = functional.silu(hidden @ matrix + bias)
    matrix, bias = layers[-2:]
    rewards = (hidden @ matrix + bias).tanh().reshape(len(matrix), *inputs.shape[:3])
    returns = (rewards * shown).sum(dim=-1)
    return returns[..., RIGHT] - returns[..., LEFT]


def _copied(parameters: list[Tensor]) -> list[Tensor]:
    return [tensor.detach().clone() for tensor in parameters]
