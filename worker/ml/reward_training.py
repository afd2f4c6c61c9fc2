"""Fitting a reward model to labelled pairs. Deterministic: the same pairs, targets and seed give the same model."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional

from worker.ml.bradley_terry import preference_loss, probability_right
from worker.ml.reward_models import MlpReward, Normalisation, RewardModel, StructuredReward
from worker.ml.segments import LEFT, RIGHT, SegmentPairs
from worker.trajectory import SIGNALS, Trajectory

Floats = npt.NDArray[np.float64]
Layers = list[tuple[Tensor, Tensor]]
Kind = Literal["structured", "mlp"]

MEMBERS = 8
NEWTON_STEPS = 15
LONGEST_NEWTON_STEP = 3.0
_SMALLEST_SPREAD = 1e-6


@dataclass(frozen=True)
class FitResult:
    """A reward model and what is worth knowing about it, as plain values for a JSON column."""

    model: RewardModel
    metrics: dict[str, Any]


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


def fit(
    pairs: SegmentPairs,
    targets: npt.ArrayLike,
    kind: Kind,
    seed: int,
    *,
    spread: Floats | None = None,
    reference: Sequence[Trajectory] = (),
    mlp: MlpTraining | None = None,
) -> FitResult:
    """Fit an ensemble to N pairs and their targets P(right preferred) in {0, 1/2, 1}.

    ``spread`` (S,): standard deviation of summed signal differences over the pool the pairs come from (see
    ``signal_spread``); from the labelled pairs themselves when missing, which is shaky below about 30 labels.
    ``reference``: rollouts of the reference policy to normalise over; the labelled segments when missing.
    Raises ValueError for targets outside {0, 1/2, 1} or a count that differs from the pairs'.
    """
    started = time.perf_counter()
    answers = _checked(pairs, targets)
    metrics: dict[str, Any] = {"kind": kind, "trained_on": len(pairs), "seed": seed}
    if kind == "structured":
        model, found = _fit_structured(pairs, answers, seed, spread)
    else:
        model, found = _fit_mlp(pairs, answers, seed, mlp or MlpTraining())
    model = model.normalised_over(reference) if reference else _normalised_over_segments(model, pairs)
    metrics.update(found)
    metrics["training_accuracy"] = _accuracy(model, pairs, answers)
    metrics["fit_seconds"] = round(time.perf_counter() - started, 4)
    return FitResult(model, metrics)


def signal_spread(pairs: SegmentPairs) -> Floats:
    """(S,) standard deviation of the summed signal differences; a column that never differs gets 1."""
    return _spread_of(pairs.signal_differences())


def _spread_of(differences: Floats) -> Floats:
    spread = np.sqrt((differences**2).mean(axis=0))
    return np.where(spread > _SMALLEST_SPREAD, spread, 1.0)


def _checked(pairs: SegmentPairs, targets: npt.ArrayLike) -> Floats:
    answers = np.asarray(targets, np.float64)
    if answers.shape != (len(pairs),):
        raise ValueError(f"{len(pairs)} pairs need as many targets, got shape {answers.shape}.")
    if not np.isin(answers, (0.0, 0.5, 1.0)).all():
        raise ValueError("Targets must be 0, 1/2 or 1; leave out answers of the kind 'can't tell'.")
    return answers


def _accuracy(model: RewardModel, pairs: SegmentPairs, answers: Floats) -> float | None:
    decided = answers != 0.5
    if not decided.any():
        return None
    return float(((model.probability_right(pairs) > 0.5) == (answers > 0.5))[decided].mean())


def _normalised_over_segments(model: RewardModel, pairs: SegmentPairs) -> RewardModel:
    raw = model.raw_rewards(pairs.signals, pairs.observations, pairs.actions)
    return model.with_normalisation(Normalisation.over(raw))


# -- structured: Bayesian logistic regression --------------------------------------------------------------------------


def _fit_structured(
    pairs: SegmentPairs, answers: Floats, seed: int, spread: Floats | None
) -> tuple[RewardModel, dict[str, Any]]:
    scale = signal_spread(pairs) if spread is None else np.where(spread > _SMALLEST_SPREAD, spread, 1.0)
    mean, covariance = posterior(pairs.signal_differences() / scale, answers)
    members = _antithetic(mean, covariance, np.random.default_rng(seed)) / scale
    deviation = 1.96 * np.sqrt(np.diag(covariance))
    weights = {
        name: {"mean": float(value), "low": float(value - margin), "high": float(value + margin)}
        for name, value, margin in zip(SIGNALS, mean, deviation, strict=True)
    }
    return StructuredReward(members), {"weights": weights, "weights_unit": "log odds per standard deviation of a pair"}


def posterior(features: Floats, answers: Floats) -> tuple[Floats, Floats]:
    """Laplace approximation of p(w | labels) with the prior N(0, I): its mean (S,) and covariance (S, S).

    features (N, S) standardised differences right minus left; answers (N,) in {0, 1/2, 1}. Newton's method with steps
    of bounded length: separable data then move towards the prior's shoulder instead of overflowing.
    """
    weights: Floats = np.zeros(features.shape[1])
    for _ in range(NEWTON_STEPS):
        gradient, hessian = _gradient_and_hessian(features, answers, weights)
        step = np.asarray(np.linalg.solve(hessian, gradient), np.float64)
        length = max(float(np.linalg.norm(step)), 1e-12)
        weights = weights - min(1.0, LONGEST_NEWTON_STEP / length) * step
    hessian = _gradient_and_hessian(features, answers, weights)[1]
    return weights, np.asarray(np.linalg.inv(hessian), np.float64)


def _gradient_and_hessian(features: Floats, answers: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Of the summed right form of Eq. (2) plus |w|^2 / 2."""
    probability = probability_right(features @ weights)
    gradient: Floats = features.T @ (probability - answers) + weights
    hessian: Floats = features.T @ (features * (probability * (1 - probability))[:, None]) + np.eye(len(weights))
    return gradient, hessian


def _antithetic(mean: Floats, covariance: Floats, rng: np.random.Generator) -> Floats:
    """(E, S) posterior samples in mirrored pairs: their mean is the posterior's mean exactly."""
    half = rng.standard_normal((MEMBERS // 2, len(mean))) @ np.linalg.cholesky(covariance).T
    samples: Floats = mean + np.concatenate([half, -half])
    return samples


# -- mlp: an ensemble of networks on (observation, action) -------------------------------------------------------------


def _fit_mlp(
    pairs: SegmentPairs, answers: Floats, seed: int, config: MlpTraining
) -> tuple[RewardModel, dict[str, Any]]:
    generator = torch.Generator().manual_seed(seed)
    inputs, offset, scale = _standardised_inputs(pairs, config.every_nth_step)
    targets = torch.as_tensor(answers, dtype=torch.float32)
    order = torch.randperm(len(targets), generator=generator)
    held_out = max(1, round(config.held_out * len(order))) if len(order) >= 20 else 0
    validation, training = order[:held_out], order[held_out:]
    draws = torch.randint(len(training), (config.members, len(training)), generator=generator)
    counts = torch.stack([torch.bincount(draw, minlength=len(training)) for draw in draws]).float()

    layers = _new_layers(inputs.shape[-1], config, generator)
    optimiser = torch.optim.AdamW(
        [tensor for layer in layers for tensor in layer], config.learning_rate, weight_decay=config.weight_decay
    )
    best, best_loss, waited, steps = _copied(layers), float("inf"), 0, 0
    for step in range(1, config.steps + 1):
        steps = step
        rows = torch.randint(len(training), (config.batch_pairs,), generator=generator)
        logits = _ensemble_logits(layers, inputs[training[rows]], config.every_nth_step)
        loss = preference_loss(logits, targets[training[rows]], counts[:, rows])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if held_out and step % config.check_every == 0:
            current = _validation_loss(layers, inputs[validation], targets[validation], config.every_nth_step)
            if current < best_loss:
                best, best_loss, waited = _copied(layers), current, 0
            else:
                waited += 1
            if waited >= config.patience:
                break
    if not held_out:
        best = _copied(layers)
    arrays = tuple((matrix.numpy(), bias.numpy()) for matrix, bias in best)
    found = {"steps": steps, "validation_loss": best_loss if held_out else None}
    return MlpReward(arrays, offset, scale), found


def _standardised_inputs(
    pairs: SegmentPairs, every_nth_step: int
) -> tuple[Tensor, npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    steps = np.concatenate([pairs.observations, pairs.actions], axis=-1)[:, :, ::every_nth_step]
    flat = steps.reshape(-1, steps.shape[-1])
    offset = flat.mean(axis=0)
    scale = np.maximum(flat.std(axis=0), 1e-3)
    standardised = np.clip((steps - offset) / scale, -6.0, 6.0)
    return torch.as_tensor(standardised, dtype=torch.float32), offset.astype(np.float32), scale.astype(np.float32)


def _new_layers(inputs: int, config: MlpTraining, generator: torch.Generator) -> Layers:
    sizes = [inputs, config.hidden, config.hidden, 1]
    layers = []
    for fan_in, fan_out in pairwise(sizes):
        matrix = torch.randn(config.members, fan_in, fan_out, generator=generator) / fan_in**0.5
        if fan_out == 1:
            matrix *= 0.1  # returns of a hundred steps: start undecided
        layers.append((matrix.requires_grad_(), torch.zeros(config.members, 1, fan_out, requires_grad=True)))
    return layers


def _ensemble_logits(layers: Layers, inputs: Tensor, every_nth_step: int) -> Tensor:
    """(B, 2, T, D + 7) -> (E, B), every member's log odds that right is preferred."""
    hidden = inputs.reshape(1, -1, inputs.shape[-1])
    for matrix, bias in layers[:-1]:
        hidden = functional.silu(hidden @ matrix + bias)
    matrix, bias = layers[-1]
    rewards = (hidden @ matrix + bias).tanh().reshape(len(matrix), *inputs.shape[:3])
    returns = rewards.sum(dim=-1) * every_nth_step
    return returns[..., RIGHT] - returns[..., LEFT]


@torch.no_grad()
def _validation_loss(layers: Layers, inputs: Tensor, targets: Tensor, every_nth_step: int) -> float:
    return float(preference_loss(_ensemble_logits(layers, inputs, every_nth_step), targets))


def _copied(layers: Layers) -> Layers:
    return [(matrix.detach().clone(), bias.detach().clone()) for matrix, bias in layers]
