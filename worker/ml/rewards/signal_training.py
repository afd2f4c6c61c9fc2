"""Trains what foresees the signals of a step (signal_predictor): plain regression on rollouts, no labels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml import dense_network
from worker.ml.rewards.signal_predictor import INPUT_CLIP, SignalPredictor

OUTLIER_SHARE = 0.001
_SMALLEST_INPUT = 1e-3
_SMALLEST_SPREAD = 1e-9


@dataclass(frozen=True)
class PredictorTraining:
    """Mean squared error of standardised signals: what is rare is foreseen as its chance, and sums come out right.

    Signals are cut at the quantile that a thousandth of the steps exceeds: a network learns a single crash by heart and
    then foresees hundreds of newtons in a clip where nothing is touched.
    """

    hidden: int = 128
    steps: int = 6000
    batch: int = 512
    learning_rate: float = 2e-3
    weight_decay: float = 0.1
    last_learning_rate: float = 1e-5


def fit(
    rollouts: Sequence[Trajectory],
    seed: int,
    config: PredictorTraining | None = None,
    progress: Callable[[int], None] = lambda step: None,
) -> SignalPredictor:
    """From every step of these rollouts. The same rollouts and seed give the same predictor."""
    chosen = config or PredictorTraining()
    generator = torch.Generator().manual_seed(seed)
    steps = np.concatenate([np.concatenate([each.observations[:-1], each.actions], axis=-1) for each in rollouts])
    signals = np.concatenate([each.signals for each in rollouts])
    most = np.quantile(signals, 1.0 - OUTLIER_SHARE, axis=0)
    signals = np.minimum(signals, most)
    offset, scale = steps.mean(axis=0), np.maximum(steps.std(axis=0), _SMALLEST_INPUT)
    mean, spread = signals.mean(axis=0, dtype=np.float64), signals.std(axis=0, dtype=np.float64)
    spread = np.where(spread > _SMALLEST_SPREAD, spread, 1.0)  # a column that is always the same
    inputs = torch.from_numpy(np.clip((steps - offset) / scale, -INPUT_CLIP, INPUT_CLIP).astype(np.float32))
    wanted = torch.from_numpy(((signals - mean) / spread).astype(np.float32))
    parameters = _new(inputs.shape[1], chosen.hidden, len(SIGNALS), generator)
    optimiser = torch.optim.AdamW(parameters, chosen.learning_rate, weight_decay=chosen.weight_decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, chosen.steps, chosen.last_learning_rate)
    for step in range(chosen.steps):
        rows = torch.randint(len(inputs), (chosen.batch,), generator=generator)
        loss = functional.mse_loss(_run(parameters, inputs[rows]), wanted[rows])
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]  # torch gives it no types
        optimiser.step()
        schedule.step()
        progress(step + 1)
    layers = dense_network.of_parameters([each.detach().numpy() for each in parameters])
    return SignalPredictor(layers, *(each.astype(np.float32) for each in (offset, scale, mean, spread, most)))


def explained(predictor: SignalPredictor, rollouts: Sequence[Trajectory], steps: int) -> dict[str, dict[str, float]]:
    """Share of each signal's variance that is foreseen: of single steps, and of the sums over the first ``steps``.

    Both up to the predictor's largest value. Signals that never differ in these rollouts are left out.
    """
    measured = [np.minimum(each.signals, predictor.most).astype(np.float64) for each in rollouts]
    foreseen = [predictor.predict(each.observations[:-1], each.actions) for each in rollouts]
    of_steps = _share(np.concatenate(measured), np.concatenate(foreseen))
    of_clips = _share(*(np.array([each[:steps].sum(axis=0) for each in part]) for part in (measured, foreseen)))
    varied = np.concatenate(measured).std(axis=0) > _SMALLEST_SPREAD
    return {
        name: {"step": round(float(step), 3), "clip": round(float(clip), 3)}
        for name, step, clip, there in zip(SIGNALS, of_steps, of_clips, varied, strict=True)
        if there
    }


def _share(measured: FloatArray, foreseen: FloatArray) -> FloatArray:
    variance = np.maximum(measured.var(axis=0), _SMALLEST_SPREAD**2)
    share: FloatArray = 1.0 - ((measured - foreseen) ** 2).mean(axis=0) / variance
    return share


def _new(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> list[nn.Parameter]:
    parameters = []
    for fan_in, fan_out in ((inputs, hidden), (hidden, hidden), (hidden, outputs)):
        matrix = torch.randn(fan_in, fan_out, generator=generator) / fan_in**0.5
        parameters += [nn.Parameter(matrix), nn.Parameter(torch.zeros(1, fan_out))]
    return parameters


def _run(parameters: Sequence[nn.Parameter], inputs: torch.Tensor) -> torch.Tensor:
    """As dense.run()."""
    hidden = inputs
    for matrix, bias in zip(parameters[:-2:2], parameters[1:-2:2], strict=True):
        hidden = functional.silu(hidden @ matrix + bias)
    return hidden @ parameters[-2] + parameters[-1]
