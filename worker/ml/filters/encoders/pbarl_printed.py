"""PbARL as printed in the paper, in one file: the cVAE encoder, Eqs. (3) to (7), and its training.

It is kept faithful on purpose, including what does not work well (docs/method.md has the measurements); the studio's
default filter is pbarl. What the paper leaves open is a field of PrintedConfig whose comment says so.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from worker.ml.filters.encoders.action_encoder import kl_divergence
from worker.ml.filters.encoders.fitted_q import Transitions
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.policies.torch_module import FrozenPolicy
from worker.ml.rewards.action_ranking import Ranker, RankerAt

ReportShare = Callable[[float], None]


@dataclass(frozen=True)
class PrintedConfig:
    """The paper's settings where it gives them; a comment where it does not."""

    list_length: int = 10
    """n. For the paper's n = 1 Eq. (4) is 0/0, and a list of one cannot be re-ranked. The reading that can be run: one
    sample of the policy, without a preference term, since one action says nothing about what is preferred to what"""
    epsilon: float = 1.0
    temperature: float = 1.0  # tau: not given
    betas: tuple[float, float, float, float] = (1.0, 1.5, 0.1, 1.0)  # a task has its own, see Task.printed_betas
    learning_rate: float = 1e-4
    steps: int = 3000
    """the paper trains 1.5e7 steps (days on this machine); for the web this is enough to see what the objective does"""
    batch: int = 64  # not given
    dynamics_to_encoder: bool = True
    """whether L_dyn also shapes the encoder: the paper writes L_dyn with subscript varsigma only, yet says it does"""
    dynamics_scale: float = 1.0
    """the states of L_dyn are multiplied by this; 1 is the literal reading, raw SI units"""
    stop_gradient: bool = False
    """whether the re-ranked list is a constant in Eq. (4): not said; the literal reading differentiates both lists"""

    def __post_init__(self) -> None:
        if self.list_length < 1:
            raise ValueError("A list needs at least n = 1 action.")


class PrintedEncoder(nn.Module):
    """A 3-layer cVAE: q(z | s, a) and abar = tanh(decoder(s, z)). Latent size and width are not given in the paper."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, action_size: int = 7, latent: int = 7, hidden: int = 128) -> None:
        super().__init__()
        self.register_buffer("offset", offset.clone())
        self.register_buffer("scale", scale.clone())
        self.encoder = _three_layers(len(offset) + action_size, hidden, 2 * latent)
        self.decoder = _three_layers(len(offset) + latent, hidden, action_size)

    def encode(self, states: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of z, (..., latent) each."""
        mean, log_variance = self.encoder(torch.cat([self._seen(states), actions], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-8.0, 4.0)

    def decode(self, states: Tensor, latents: Tensor) -> Tensor:
        """(..., 7) in (-1, 1)"""
        action: Tensor = self.decoder(torch.cat([self._seen(states), latents], -1)).tanh()
        return action

    def forward(self, states: Tensor, actions: Tensor) -> Tensor:
        """As deployed. Whether the paper decodes the mean of z or a sample is not said; the mean is deterministic."""
        return self.decode(states, self.encode(states, actions)[0])

    def _seen(self, states: Tensor) -> Tensor:
        return ((states - self.offset) * self.scale).clamp(-6.0, 6.0)


def reconstruction_loss(actions: Tensor, outputs: Tensor, epsilon: float) -> Tensor:
    """Eq. (3): mean of d^2 + max(0, eps - d^2), which is max(eps, d^2): no gradient while d^2 < eps. (..., 7) -> ()"""
    squared = ((actions - outputs) ** 2).sum(-1)
    return (squared + (epsilon - squared).clamp_min(0.0)).mean()


def preference_loss(outputs: Tensor, reranked: Tensor, temperature: float) -> Tensor:
    """Eq. (4) with sim = -d^2 (Eq. 5): positives at equal positions, negatives averaged over j != i. (B, n, 7) -> ()

    Without averaging in the exponent it would be plain InfoNCE; the mean over the n - 1 negatives only adds log(n - 1).
    0 for n = 1, see PrintedConfig.list_length.
    """
    count = outputs.shape[-2]
    if count == 1:
        return torch.zeros(())
    similarity = -((outputs[:, :, None] - reranked[:, None]) ** 2).sum(-1) / temperature
    positive = similarity.diagonal(dim1=1, dim2=2)
    others = similarity.masked_fill(torch.eye(count, dtype=torch.bool), -torch.inf)
    negative = others.logsumexp(-1) - float(np.log(count - 1))
    return -(positive - negative).mean()


def dynamics_loss(states: Tensor, next_states: Tensor, predicted_change: Tensor) -> Tensor:
    """Eqs. (6), (7): |s' - (s + f(abar_1))|^2; f sees the first action of the list and not the state. (B, D) -> ()"""
    return ((next_states - (states + predicted_change)) ** 2).sum(-1).mean()


def reranked(states: Tensor, outputs: Tensor, ranker: Ranker) -> Tensor:
    """The same actions, best learned reward first. (B, D), (B, n, 7) -> (B, n, 7)"""
    repeated = states[:, None].expand(-1, outputs.shape[1], -1)
    with torch.no_grad():
        order = ranker(repeated, outputs).argsort(dim=1, descending=True)
    return outputs.gather(1, order[..., None].expand_as(outputs))


def train(
    policy: GaussianPolicy,
    ranker_at: RankerAt,
    data: Transitions,
    config: PrintedConfig,
    seed: int,
    progress: ReportShare = lambda share: None,
) -> tuple[PrintedEncoder, dict[str, float]]:
    """Minimise Eq. (8), the weighted sum of the four losses, on transitions of the frozen policy.

    ``ranker_at`` ranks actions that were never executed (see action_ranking); its rows are those of ``data``.
    Returns the encoder and the last values of the losses.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        frozen = FrozenPolicy(policy.weights)
        encoder = PrintedEncoder(torch.from_numpy(policy.offset), torch.from_numpy(policy.scale))
        dynamics = _three_layers(policy.action_size, 128, len(policy.offset))
    optimiser = torch.optim.Adam([*encoder.parameters(), *dynamics.parameters()], config.learning_rate)
    losses: dict[str, float] = {}
    started = time.perf_counter()
    for step in range(config.steps):
        rows = torch.randint(len(data), (config.batch,), generator=generator)
        states, next_states = data.observations[rows], data.next_observations[rows]
        actions = sample_ranked_list(frozen, states, config.list_length, generator)
        terms = _losses(encoder, dynamics, ranker_at(rows), states, next_states, actions, config, generator)
        total = sum((beta * term for beta, term in zip(config.betas, terms, strict=True)), torch.zeros(()))
        optimiser.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        if step % 100 == 99 or step == config.steps - 1:
            losses = dict(zip(("rec", "pref", "kl", "dyn"), (float(term.detach()) for term in terms), strict=True))
            progress((step + 1) / config.steps)
    return encoder, {**losses, "seconds": time.perf_counter() - started}


def sample_ranked_list(frozen: FrozenPolicy, states: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """n actions of pi(a | s), the most probable first, (B, n, 7).

    Ranked by the density of the Gaussian before the tanh; whether the paper ranks by the density before or after
    the tanh is not said.
    """
    action, log_std = frozen(states)
    centre = (action / frozen.action_limit).clamp(-0.99999, 0.99999).atanh()
    noise = torch.randn(len(states), count, centre.shape[-1], generator=generator)
    order = (noise**2).sum(-1).argsort(dim=1)
    noise = noise.gather(1, order[..., None].expand_as(noise))
    actions: Tensor = frozen.action_limit * (centre[:, None] + log_std.exp()[:, None] * noise).tanh()
    return actions


def _losses(
    encoder: PrintedEncoder,
    dynamics: nn.Module,
    ranker: Ranker,
    states: Tensor,
    next_states: Tensor,
    actions: Tensor,
    config: PrintedConfig,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """L_rec, L_pref, L_KL, L_dyn."""
    repeated = states[:, None].expand(-1, config.list_length, -1)
    mean, log_variance = encoder.encode(repeated, actions)
    latents = mean + (0.5 * log_variance).exp() * torch.randn(mean.shape, generator=generator)
    outputs = encoder.decode(repeated, latents)
    better = reranked(states, outputs, ranker)
    executed = outputs[:, 0] if config.dynamics_to_encoder else outputs[:, 0].detach()
    factor = config.dynamics_scale
    return (
        reconstruction_loss(actions, outputs, config.epsilon),
        preference_loss(outputs, better.detach() if config.stop_gradient else better, config.temperature),
        kl_divergence(mean, log_variance),
        dynamics_loss(factor * states, factor * next_states, dynamics(executed)),
    )


def _three_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs)
    )
