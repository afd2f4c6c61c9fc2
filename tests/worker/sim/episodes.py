"""Episodes that depend on nothing but their scenario; little more than this is imported to replay one."""

import numpy as np

from worker.ml.policies.gaussian import GaussianPolicy
from worker.sim.assistive import AssistiveEnv
from worker.tasks.registry import checkpoint


def policy_for(kind: type[AssistiveEnv]) -> GaussianPolicy:
    return GaussianPolicy.load(checkpoint(kind.task.name) / "policy.safetensors")


def episode(env: AssistiveEnv, scenario: int, noise: float = 0.3, steps: int = 100) -> np.ndarray:
    """Observations and rewards of an episode with a policy disturbed in a way that depends on the scenario only."""
    rng, policy = np.random.default_rng(scenario), policy_for(type(env))
    observation, _ = env.reset(seed=scenario)
    seen = [np.append(observation, 0.0)]
    for _ in range(steps):
        action = policy.mean(observation) + noise * rng.standard_normal(7)
        observation, reward, *_ = env.step(action.astype(np.float32))
        seen.append(np.append(observation, reward))
    return np.array(seen)
