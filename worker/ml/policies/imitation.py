"""Imitating a demonstrator before reinforcement learning begins: its episodes, and a first actor fitted to them."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
import torch.nn.functional as F

from worker.domain.type_aliases import Float32Array
from worker.ml.policies.demonstrations import Demonstrations
from worker.ml.policies.sac import Actor, SacConfig

Demonstrate = Callable[[Float32Array], Float32Array]
"""observation (D,) -> action (A,)"""

NOISES = (0.0, 0.15, 0.3)
"""Episodes are disturbed by so much in turn, so that the learner also sees how errors are put right."""
IMITATION_LEARNING_RATE = 1e-3
IMITATION_BATCH = 256
FIRST_LOG_STD = -1.8


def collect(
    env: gymnasium.Env[Any, Any],
    demonstrate: Demonstrate,
    config: SacConfig,
    rng: np.random.Generator,
    scenarios: range,
) -> Demonstrations:
    """Play ``config.demonstrations`` episodes in random ones of the scenarios."""
    rows, wanted = [], []
    for episode in range(config.demonstrations):
        noise = NOISES[episode % len(NOISES)]
        state, _ = env.reset(seed=int(rng.integers(scenarios.start, scenarios.stop)))
        over = False
        while not over:
            shown = np.clip(demonstrate(state) / config.training_limit, -1.0, 1.0)
            action = np.clip(shown + noise * rng.standard_normal(shown.shape), -1.0, 1.0).astype(np.float32)
            next_state, reward, terminated, truncated, _ = env.step(config.training_limit * action)
            rows.append(np.concatenate([state, action, [float(reward), float(not terminated)], next_state]))
            wanted.append(shown)
            state, over = next_state, terminated or truncated
    return Demonstrations(np.array(rows, np.float32), np.array(wanted, np.float32))


def imitate(
    actor: Actor, demonstrations: Demonstrations, steps: int, early: int, watch: Callable[[Actor], None]
) -> None:
    """Fit the actor's mean to what was wanted, its spread to a usable first value.

    ``watch`` is called once after ``early`` steps.
    """
    optimiser = torch.optim.Adam(actor.parameters(), IMITATION_LEARNING_RATE, fused=True)
    width = len(actor.offset)
    for step in range(steps):
        if step == early:
            watch(actor)
        optimiser.param_groups[0]["lr"] = IMITATION_LEARNING_RATE * (1.0 if step < 0.7 * steps else 0.2)
        rows, wanted = demonstrations.sample(IMITATION_BATCH)
        mean, log_std = actor(rows[:, :width])
        loss = F.mse_loss(mean.tanh(), wanted) + 0.02 * ((log_std - FIRST_LOG_STD) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
