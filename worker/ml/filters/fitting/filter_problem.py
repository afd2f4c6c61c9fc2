"""What a filter is fitted for: task, policy, reward, and how much is tried.

Rollouts are made by a callable that is passed in, so nothing in here knows the simulation:

    collect(act, scenarios, noise, seed) -> one Trajectory per scenario, in order

with act(observation (D,)) -> action (7,), and ``noise`` the standard deviation of Gaussian noise added to every action
(0 for evaluations; see worker.compute.learning.noisy()). Acts can be pickled, so that collect may spread the scenarios
over processes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from worker.domain.scenarios import GATE, RESIDUAL, first_of
from worker.domain.task import Task
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.fitting.mode_archive import PRESSED
from worker.ml.filters.fitting.response_surface import CAUTION
from worker.ml.policies.reference import ReferencePolicy
from worker.ml.rewards.reward_models import RewardModel

ReportProgress = Callable[[str, float], None]
"""What is being done in human words, and the share of the whole fit that is done."""


class Collect(Protocol):
    """What makes rollouts."""

    def __call__(self, act: Act, scenarios: Sequence[int], noise: float, seed: int, /) -> list[Trajectory]:
        """One trajectory per scenario, in order."""
        ...


CHECK_FROM, WATCH_FROM, HOME_FROM = 10_000, 20_000, 30_000
"""of the gate's scenarios; the ones before are those of a gate, however many that has"""
USUAL_STEPS = 100
"""Control steps of an episode, in which the counts of episodes below are meant."""


@dataclass(frozen=True)
class FilterConfig:
    """Counts and tolerances; the defaults fit two cores and about a minute (docs/results/retraining.md)."""

    mode_attempts: int = 3
    """modes tried on held-out scenarios at full strength, each chosen knowing what came of those before"""
    modes_to_choose_from: int = 2
    """acceptable ones after which no further is tried"""
    mode_attempts_beyond_sums: int = 5
    """modes tried where the reward has further terms, of which less is known beforehand, and all to choose from"""
    success_caution: float = CAUTION
    """standard deviations by which the surface's log odds of success count less while a mode is sought"""
    gates: tuple[float, ...] = (0.6, 0.3)
    """strengths at which the last of them is tried when none at full strength was acceptable"""
    gate_scenarios: int = 80
    """of USUAL_STEPS control steps; see gate_block()"""
    check_scenarios: int = 400
    """of USUAL_STEPS control steps, in which a refined policy is tried once more; see check_block()"""
    watch_scenarios: int = 200
    """of USUAL_STEPS control steps, in which a policy is tried while it is refined; see watch_block()"""
    home_scenarios: int = 320
    """of USUAL_STEPS control steps, of the reference policy alone and of what was doubted; see home_block()"""
    success_tolerance: float = 0.035
    """largest accepted loss of success on the gate's scenarios, as a share of episodes"""
    force_limit_n: float = 10.0
    """largest accepted force on the person: 95 of 100 episodes must stay below it (or below the reference's own)"""
    pressed_n: float = 5.0
    """of growth of an episode's largest force, from which on somebody counts as pressed; as a study's promise has it"""
    pressed_tolerance: float = PRESSED
    """largest accepted share of the gate's episodes in which somebody is pressed"""
    tolerance_in_all: float = 0.02
    """largest accepted loss of success, and share of episodes in which somebody is pressed, of a residual that loses
    anything in the gate's scenarios: in these and those of home_block() together"""
    residual_rounds: int = 3
    """of residual learning; 0 leaves the residual out"""
    residual_rollouts: int = 50
    """of the current filter before each round, of USUAL_STEPS control steps; see residual_block()"""
    residual_noise: float = 0.1
    """standard deviation of what is added to their actions"""
    value_steps: int = 3000
    """of fitted Q evaluation in the first round"""
    adapter_steps: int = 500
    """of the encoder's ascent in the first round"""
    later_share: float = 0.5
    """so much of both in every later round, which goes on from the networks of the one before"""
    batch: int = 96
    preference_weight: float = 0.3
    """lambda: weight of the normalised value against squared distance in policy standard deviations"""
    kl_weight: float = 1e-3
    residual_beyond: tuple[float, ...] = (1.5, 2.0, 3.0, 4.0)
    """tried in this order after the whole, as long as each is better than the last and may keep the task"""
    residual_parts: tuple[float, ...] = (0.5,)
    """tried in this order where nothing from the whole on is better than the mode alone and keeps the task"""
    residual_gentle: float = 2.0
    """more of it is kept only where nobody is touched harder than the reference policy touches anybody there"""
    evaluation_scenarios: int = 100

    def gate_block(self, task: Task) -> range:
        """Scenarios on which a setting is tried before it is accepted."""
        return first_of(GATE, _affordable(self.gate_scenarios, task))

    def check_block(self, task: Task) -> range:
        """Scenarios in which nothing has been tried on the way to what is accepted there."""
        return first_of(GATE, _affordable(self.check_scenarios, task), skip=CHECK_FROM)

    def watch_block(self, task: Task) -> range:
        """Scenarios in which a policy that is being refined is tried, again and again."""
        return first_of(GATE, _affordable(self.watch_scenarios, task), skip=WATCH_FROM)

    def home_block(self, task: Task) -> range:
        """Scenarios that show where the reference policy is at home, and whether what was doubted keeps the task."""
        return first_of(GATE, _affordable(self.home_scenarios, task), skip=HOME_FROM)

    def residual_block(self, task: Task, number: int) -> range:
        """Scenarios in which the filter is rolled out before round ``number`` of residual learning."""
        return first_of(RESIDUAL, _affordable(self.residual_rollouts, task), 1000 * number)

    def learning_steps(self, number: int) -> tuple[int, int]:
        """Gradient steps of the value and of the encoder in round ``number``, from 0 on."""
        share = self.later_share if number else 1.0
        return max(1, round(share * self.value_steps)), max(1, round(share * self.adapter_steps))

    def bolder(self, factor: float) -> "FilterConfig":
        """The same with so many times the weight of the value."""
        return replace(self, preference_weight=factor * self.preference_weight)


@dataclass(frozen=True)
class FilterProblem:
    """What a filter is fitted for."""

    task: Task
    policy: ReferencePolicy
    reward: RewardModel
    seed: int
    config: FilterConfig = FilterConfig()


def _affordable(episodes: int, task: Task) -> int:
    """So many episodes of the usual length, or fewer longer ones: a fit takes about the same time in every task."""
    return max(1, round(episodes * min(1.0, USUAL_STEPS / task.episode_steps)))
