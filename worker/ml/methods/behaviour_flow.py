"""A flow fitted to the behaviour pool: the decoder of DSRL whose noise contains the modes, learned instead of designed.

Flow matching (Lipman et al. 2023, arXiv 2210.02747) with straight paths: a network v(s, x, t) is trained towards a - x
at x_t = (1 - t) x + t a with x standard normal, for the actions a of all episodes of the pool in which the task was
done. Some Euler steps from noise w give the action. It needs no mode family, and would serve a foreign policy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import nn

from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Float32Array
from worker.ml import dense_network
from worker.ml.dense_network import Layers
from worker.ml.policies.gaussian import GaussianPolicy

EULER_STEPS = 4
BATCH = 256
_CLIP = 6.0


@dataclass(frozen=True)
class BehaviourFlow:
    """The action that the flow makes of noise ``largest`` times the input."""

    layers: Layers
    offset: Float32Array
    scale: Float32Array
    largest: float

    def __call__(self, observations: Float32Array, inputs: Float32Array) -> Float32Array:
        """See Decoder."""
        seen = np.clip((observations - self.offset) * self.scale, -_CLIP, _CLIP)
        action = np.float32(self.largest) * inputs
        for step in range(EULER_STEPS):
            time = np.full((*action.shape[:-1], 1), step / EULER_STEPS, np.float32)
            known = np.concatenate([seen, action, time], axis=-1)
            action = action + self._velocity(known) / EULER_STEPS
        return np.asarray(np.clip(action, -1.0, 1.0), np.float32)

    def _velocity(self, known: Float32Array) -> Float32Array:
        flat = known.reshape(-1, known.shape[-1])
        return dense_network.run(self.layers, flat).reshape(*known.shape[:-1], -1)


def fit_flow(
    pool: Sequence[Trajectory], like: GaussianPolicy, largest: float, hidden: int, steps: int, seed: int
) -> BehaviourFlow:
    """Flow matching for so many gradient steps. Of ``like`` the standardisation of observations is used."""
    done = [each for each in pool if each.success] or list(pool)
    observations = np.concatenate([each.observations[:-1] for each in done])
    actions = torch.from_numpy(np.concatenate([each.actions for each in done]))
    seen = torch.from_numpy(np.clip((observations - like.offset) * like.scale, -_CLIP, _CLIP))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        sizes = [seen.shape[1] + actions.shape[1] + 1, hidden, hidden, actions.shape[1]]
        linear = [nn.Linear(*size) for size in pairwise(sizes)]
        network = nn.Sequential(linear[0], nn.SiLU(), linear[1], nn.SiLU(), linear[2])
        optimiser = torch.optim.Adam(network.parameters(), 1e-3, fused=True)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), 1e-5)
        for _ in range(steps):
            rows = torch.randint(len(actions), (BATCH,))
            noise, time = torch.randn(BATCH, actions.shape[1]), torch.rand(BATCH, 1)
            there = (1.0 - time) * noise + time * actions[rows]
            velocity = network(torch.cat([seen[rows], there, time], -1))
            loss = nn.functional.mse_loss(velocity, actions[rows] - noise)
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]  # torch's own
            optimiser.step()
            schedule.step()
    layers = tuple((each.weight.detach().numpy().T.copy(), each.bias.detach().numpy()[None].copy()) for each in linear)
    return BehaviourFlow(layers, like.offset, like.scale, largest)
