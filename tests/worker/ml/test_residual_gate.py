"""How much of a residual the gate keeps: better than the mode, the task kept, and nobody pressed much harder."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest

from tests.worker.ml.test_pbarl import POLICY, SPEED, World, no_more, problem
from worker.domain.scenarios import GATE, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting import residual
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.gate import keeps_task_after_all
from worker.ml.filters.fitting.residual import learn_round


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    return World().collect(POLICY.mean, first_of(GATE, 6), 0.0, 0)


def test_a_residual_that_does_not_help_is_left_out_and_said_so(reference: list[Trajectory]) -> None:
    """An adapter trained for somebody who wants the opposite."""
    wrong = learn_round(
        problem(1.0, reference), FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)]
    )
    gated = residual.gate_residual(problem(-1.0, reference), wrong, reference, no_more, World().collect)
    assert gated.weights.residual_share == 0.0
    assert "residual" in gated.notes[0]


def test_a_residual_has_to_be_better_than_the_mode_though_a_refinement_was_refused_since(
    reference: list[Trajectory],
) -> None:
    speed = {"speed_far": -0.2}
    learned = learn_round(
        problem(-1.0, reference),
        FilterDraft(FilterWeights(mode=speed)),
        [World().collect(POLICY.mean, range(6), 0.3, 0)],
    )
    trials = (GateTrial(1.0, 0.0, 99.0, 0.0, 0.0), GateTrial(1.0, 0.0, -1.0, 0.0, 0.0, refined=True))
    draft = replace(learned, trials=trials)
    gated = residual.gate_residual(problem(-1.0, reference), draft, reference, no_more, World().collect)
    assert gated.weights.residual_share == 0.0


@pytest.mark.parametrize(
    ("slowest", "force_n", "tried", "kept"),
    [
        (0.0, 0.0, [1.0, 1.5, 2.0, 3.0], 2.0),
        (0.0, 0.1, [1.0, 1.5, 2.0], 1.5),
        (0.019, 0.0, [1.0, 1.5], 1.0),
        (0.021, 0.0, [1.0, 0.5], 0.5),
    ],
)
def test_more_of_a_residual_than_was_learned_is_kept_while_it_is_better_keeps_the_task_and_is_gentle(
    slowest: float, force_n: float, tried: list[float], kept: float, reference: list[Trajectory]
) -> None:
    """For somebody who dislikes speed, where whatever is slower than ``slowest`` fails, and whatever acts presses."""
    asked = problem(-1.0, reference, residual_gentle=1.5)
    learned = learn_round(asked, FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)])
    gated = residual.gate_residual(asked, learned, reference, lambda: reference, World(slowest, force_n).collect)
    assert [each.residual_share for each in gated.trials] == tried
    assert gated.weights.residual_share == kept


class Timed(World):
    """In these scenarios whoever takes much longer than the frozen policy fails."""

    def __init__(self, scenarios: Collection[int]) -> None:
        super().__init__()
        self.scenarios = scenarios

    def _episode(self, act: Act, scenario: int) -> Trajectory:
        episode = super()._episode(act, scenario)
        usual = (POLICY.mean(episode.observations[:-1]) ** 2).mean()
        in_time = bool(episode.signals[:, SPEED].mean() >= 0.8 * usual)
        return replace(episode, success=in_time or scenario not in self.scenarios)


@pytest.mark.parametrize(
    ("fails_in", "others", "kept"),
    [([0], 40, 2.0), ([0, 6], 40, 2.0), ([0, 6, 7, 8, 9], 40, 0.5), ([0, 1], 40, 0.5)],
)
def test_what_fails_a_little_too_often_is_tried_in_other_scenarios_and_has_to_do_better_there(
    fails_in: list[int], others: int, kept: float, reference: list[Trajectory]
) -> None:
    """The whole of a residual fails in some of six scenarios and of forty others; a tenth are accepted."""
    asked = problem(-1.0, reference, success_tolerance=0.1)
    scenarios = first_of(GATE, 6 + others)
    learned = learn_round(asked, FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)])
    world = Timed([scenarios[place] for place in fails_in])
    more = World().collect(POLICY.mean, scenarios[6:], 0.0, 0)
    gated = residual.gate_residual(asked, learned, reference, lambda: more, world.collect)
    assert gated.weights.residual_share == kept
    assert (others in world.asked) == (1 not in fails_in)


class Pressing(Timed):
    """In these scenarios whoever takes much longer than the frozen policy succeeds, and presses with 6 N."""

    def _episode(self, act: Act, scenario: int) -> Trajectory:
        episode = super()._episode(act, scenario)
        forces = np.full_like(episode.contact_force_n, 0.0 if episode.success else 6.0)
        return replace(episode, contact_force_n=forces, success=True)


@pytest.mark.parametrize(
    ("pressed_in", "pressed_n", "kept"), [([0], 5.0, 2.0), ([0, 1, 2], 5.0, 0.5), ([0, 1, 2], 7.0, 2.0)]
)
def test_what_presses_much_harder_in_more_than_a_few_scenarios_is_not_kept(
    pressed_in: list[int], pressed_n: float, kept: float, reference: list[Trajectory]
) -> None:
    asked = problem(-1.0, reference, pressed_n=pressed_n, pressed_tolerance=0.2)
    scenarios = first_of(GATE, 6)
    learned = learn_round(asked, FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)])
    world = Pressing([scenarios[place] for place in pressed_in])
    gated = residual.gate_residual(asked, learned, reference, no_more, world.collect)
    assert gated.weights.residual_share == kept
    assert gated.trials[0].pressed == pytest.approx(len(pressed_in) / 6 if pressed_n < 6.0 else 0.0)


@pytest.mark.parametrize(
    ("doubted", "more_often", "again"), [(False, False, False), (False, True, True), (True, False, True)]
)
def test_what_follows_what_was_doubted_or_fails_more_often_is_tried_in_other_scenarios(
    doubted: bool, more_often: bool, again: bool, reference: list[Trajectory]
) -> None:
    asked = problem(-1.0, reference)
    earlier = GateTrial(1.0, 1.0, 1.0, -0.05 if doubted else -0.01, 0.0)
    trial = replace(earlier, residual_share=1.5, success_change=-0.02 if more_often else -0.01)
    asked_for = list[GateTrial]()

    def fails() -> GateTrial:
        asked_for.append(trial)
        return replace(trial, success_change=-0.03)

    assert keeps_task_after_all(asked, trial, reference, fails, earlier) == (not again)
    assert bool(asked_for) == again
