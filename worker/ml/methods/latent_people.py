"""A population latent like VPL's (Poddar et al. 2024, arXiv 2408.10075): who somebody is, as a few numbers z.

An encoder reads a person's answers, in any order, and gives q(z | answers); a decoder gives the reward of somebody with
z. Both are trained on other people's answers by the variational bound. Here the decoder gives the weights of a reward
that is linear in the measured signals, as everybody's is, so that the same filter can be fitted for it: what is tested
is the latent, not the network. Members of the new person's model are samples of q.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import FloatArray
from worker.ml.methods.people import Labels, Person
from worker.ml.rewards.reward_models import NEVER_WANTED, UNDONE, StructuredReward

MEMBERS = 8
_NEVER_WANTED = [SIGNALS.index(name) for name in NEVER_WANTED]


@dataclass(frozen=True)
class Latent:
    """Sizes and training."""

    size: int = 6
    hidden: int = 64
    steps: int = 3_000
    context: int = 100
    """at most so many of a person's answers are read in one step of the training"""
    divergence_weight: float = 0.1
    """beta of the variational bound: the prior must not hide who is unlike the others"""


class Encoder(nn.Module):
    """Answers as differences signed by who won, (P, N, S) -> mean and log deviation of z, (P, Z) each."""

    def __init__(self, signals: int, config: Latent) -> None:
        super().__init__()
        self.each = nn.Sequential(nn.Linear(signals, config.hidden), nn.SiLU(), nn.Linear(config.hidden, config.hidden))
        self.all = nn.Sequential(nn.SiLU(), nn.Linear(config.hidden, 2 * config.size))

    def forward(self, signed: Tensor) -> tuple[Tensor, Tensor]:
        """See the class."""
        mean, log_deviation = self.all(self.each(signed).mean(dim=-2)).chunk(2, -1)
        return mean, log_deviation.clamp(-5.0, 1.0)


class WeightDecoder(nn.Module):
    """z (..., Z) -> weights of the signals in log odds per standard deviation of a pair, (..., S)."""

    def __init__(self, signals: int, config: Latent) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(config.size, config.hidden), nn.SiLU(), nn.Linear(config.hidden, signals))

    def forward(self, z: Tensor) -> Tensor:
        """What nobody wants more of has no positive weight."""
        weights: Tensor = self.body(z)
        costs = torch.zeros(weights.shape[-1], dtype=torch.bool)
        costs[_NEVER_WANTED] = True
        return torch.where(costs, -functional.softplus(-weights), weights)


def model_of(
    person: Person, reference: Sequence[Trajectory], people: int, labels: int, config: Latent, seed: int
) -> StructuredReward:
    """The person's reward model: weights decoded from samples of q(z | their answers)."""
    encoder, decoder = train(
        [_features(each, person.scale.spread) for each in person.others(people, labels)], config, seed
    )
    differences, targets = _features(person.labels, person.scale.spread)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        mean, log_deviation = encoder(_signed(differences, targets)[None])
        half = torch.randn(MEMBERS // 2, config.size, generator=generator) * log_deviation.exp()
        weights = decoder(mean + torch.cat([half, -half])).double().numpy()
    scale = person.scale
    model = StructuredReward(
        weights / scale.spread,
        least_per_step=scale.least_per_step,
        most_per_step=scale.most_per_step,
        undone_column=SIGNALS.index(UNDONE),
    )
    return model.normalised_over(reference)


def train(people: Sequence[tuple[Tensor, Tensor]], config: Latent, seed: int) -> tuple[Encoder, WeightDecoder]:
    """On everybody's differences (N, S) and targets (N,): maximise log p(answers | z) - beta KL(q || N(0, I))."""
    differences, targets = (torch.stack(part) for part in zip(*people, strict=True))
    signed = _signed(differences, targets)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        encoder, decoder = Encoder(signed.shape[-1], config), WeightDecoder(signed.shape[-1], config)
        parameters = [*encoder.parameters(), *decoder.parameters()]
        optimiser = torch.optim.Adam(parameters, 1e-3, weight_decay=1e-5, fused=True)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, 1e-5)
        for _ in range(config.steps):
            seen = torch.randperm(signed.shape[1])[: config.context]
            mean, log_deviation = encoder(signed[:, seen])
            weights = decoder(mean + torch.randn_like(mean) * log_deviation.exp())
            odds = (differences * weights[:, None]).sum(-1)
            surprise = functional.binary_cross_entropy_with_logits(odds, targets, reduction="none").sum(-1)
            divergence = 0.5 * (mean**2 + (2 * log_deviation).exp() - 1 - 2 * log_deviation).sum(-1)
            loss = (surprise + config.divergence_weight * divergence).mean() / signed.shape[1]
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return encoder, decoder


def _features(labels: Labels, spread: FloatArray) -> tuple[Tensor, Tensor]:
    """Standardised differences right minus left (N, S), cut at 5, and targets (N,)."""
    differences = np.clip(labels.pairs.signal_differences() / spread, -5.0, 5.0)
    return torch.from_numpy(differences).float(), torch.from_numpy(labels.targets).float()


def _signed(differences: Tensor, targets: Tensor) -> Tensor:
    """What the winner has more of, half of nothing where both were called equal."""
    return differences * (2.0 * targets - 1.0)[..., None]
