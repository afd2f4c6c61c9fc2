"""Which weight of the calibrated speed cost makes the reference person content with the policy's own speed.

All actions are scaled by one factor (where motion near the target is the service, only those of the approach). The
weight is chosen so that the mean preference return of omega = 1 does not change to first order at factor 1.
"""

import sys

import numpy as np

from worker.compute import simulation
from worker.domain.scenarios import RESIDUAL, first_of
from worker.domain.trajectory import COSTS
from worker.domain.type_aliases import Act
from worker.sim.costs import BASE_WEIGHTS, cost_items
from worker.sim.rollout import rollout
from worker.tasks import registry

FACTORS = (0.8, 0.9, 1.0, 1.1, 1.2)
SCENARIOS = 200


def weigh_speed(task: str, count: int) -> int:
    """Print each item's mean sum per factor, its slope over the logarithm of the factor, and the weight of speed.

    ``count`` scenarios; 200 take about a minute.
    """
    scenarios = first_of(RESIDUAL, count)
    env = simulation.environment(task)
    sums = np.zeros((len(FACTORS), len(COSTS)))
    for row, factor in enumerate(FACTORS):
        successes = 0
        for scenario in scenarios:
            episode = rollout(env, scaled(task, factor), scenario)
            items = cost_items(registry.task(task), episode.costs, episode.signals, "calibrated").sum(0)
            sums[row] += items / len(scenarios)
            successes += episode.success
        printed = "  ".join(f"{name} {value:7.3f}" for name, value in zip(COSTS, sums[row], strict=True))
        sys.stdout.write(f"x{factor:.1f}  success {successes / len(scenarios):.3f}  {printed}\n")
    slopes = np.polyfit(np.log(FACTORS), sums, 1)[0]
    speed = COSTS.index("C_v")
    others = sum(BASE_WEIGHTS[name] * slope for name, slope in zip(COSTS, slopes, strict=True) if name != "C_v")
    distance_only = slopes[COSTS.index("C_d")]
    sys.stdout.write("slopes  " + "  ".join(f"{name} {slope:7.3f}" for name, slope in zip(COSTS, slopes, strict=True)))
    sys.stdout.write(
        f"\nweight  {-others / slopes[speed]:.3f}  ({-distance_only / slopes[speed]:.3f} from distance alone)\n"
    )
    env.close()
    return 0


def scaled(task: str, factor: float) -> Act:
    """The reference policy, faster or slower where its speed is a cost."""
    described = registry.task(task)
    if described.speed_counts_near:
        policy = simulation.reference_policy(task)
        return lambda seen: factor * policy.mean(seen)
    mode = described.modes.vector({"speed_far": float(np.log(factor)), "speed_near": float(np.log(factor))})
    return simulation.act_in_mode(task, np.array(mode))
