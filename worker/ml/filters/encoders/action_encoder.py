"""The personal action encoder: a cVAE that moves an action within the policy's own uncertainty.

PbARL's encoder f(a_bar | s, a) with two changes that made it work (docs/method.md): the decoder outputs a bounded
residual instead of the action itself, so that an untrained encoder is exactly the identity, and distances are measured
in standard deviations of the frozen policy instead of inside a ball of radius 1.
"""

import torch
from torch import Tensor, nn

REACH = 1.5
"""Largest residual, in standard deviations of the frozen policy's action."""
LATENT, HIDDEN = 7, 96
OBSERVATION_CLIP = 6.0
_LOG_VARIANCE_RANGE = (-8.0, 4.0)


class ResidualAdapter(nn.Module):
    """abar = clip(a + REACH * sigma(s) * tanh(decoder(s, z))), z from the encoder of (s, a)."""

    offset: Tensor
    scale: Tensor

    def __init__(self, offset: Tensor, scale: Tensor, action_size: int = 7) -> None:
        """``offset``, ``scale`` (D,): inputs are (s - offset) * scale, as for the policy."""
        super().__init__()
        self.register_buffer("offset", offset.clone())
        self.register_buffer("scale", scale.clone())
        self.encoder = _network(len(offset) + action_size, 2 * LATENT)
        self.decoder = _network(len(offset) + LATENT, action_size)
        for tensor in self.decoder[-1].parameters():
            nn.init.zeros_(tensor)

    def encode(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log variance of q(z | s, a), (B, LATENT) each."""
        mean, log_variance = self.encoder(torch.cat([self._seen(observation), action], -1)).chunk(2, -1)
        return mean, log_variance.clamp(*_LOG_VARIANCE_RANGE)

    def decode(self, observation: Tensor, latent: Tensor, action: Tensor, deviation: Tensor) -> Tensor:
        """The moved action, (B, 7)."""
        direction = self.decoder(torch.cat([self._seen(observation), latent], -1)).tanh()
        moved: Tensor = (action + REACH * deviation * direction).clamp(-1.0, 1.0)
        return moved

    def forward(self, observation: Tensor, action: Tensor, deviation: Tensor) -> Tensor:
        """As deployed: the encoder's mean, decoded. (B, D), (B, 7), (B, 7) -> (B, 7)"""
        return self.decode(observation, self.encode(observation, action)[0], action, deviation)

    def _seen(self, observation: Tensor) -> Tensor:
        return ((observation - self.offset) * self.scale).clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """KL(q(z | s, a) || N(0, I)), averaged over the batch."""
    divergence: Tensor = 0.5 * (mean**2 + log_variance.exp() - 1.0 - log_variance).sum(-1).mean()
    return divergence


def _network(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(inputs, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, outputs)
    )
