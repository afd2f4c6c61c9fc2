"""How much of a residual the gate keeps: better than the mode, the task kept, and nobody pressed much harder."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.worker.ml.test_pbarl import FAMILY, POLICY, SPEED, World, no_more, problem
from worker.domain.scenarios import GATE, first_of
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import FilterProblem
from worker.ml.filters.fitting.gate import keeps_task_in_all
from worker.ml.filters.fitting.residual import learn_round
from worker.ml.filters.fitting.residual_gate import gate_residual


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    return World().collect(POLICY.mean, first_of(GATE, 6), 0.0, 0)


@pytest.fixture(scope="module")
def of_somebody_slow(reference: list[Trajectory]) -> FilterDraft:
    """What was learned for somebody who dislikes speed."""
    return learn_round(
        problem(-1.0, reference), FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)]
    )


def test_a_residual_that_does_not_help_is_left_out_and_said_so(reference: list[Trajectory]) -> None:
    """An adapter trained for somebody who wants the opposite."""
    wrong = learn_round(
        problem(1.0, reference), FilterDraft(FilterWeights()), [World().collect(POLICY.mean, range(6), 0.3, 0)]
    )
    gated = gate_residual(problem(-1.0, reference), wrong, reference, no_more, World().collect)
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
    gated = gate_residual(problem(-1.0, reference), draft, reference, no_more, World().collect)
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
    slowest: float,
    force_n: float,
    tried: list[float],
    kept: float,
    reference: list[Trajectory],
    of_somebody_slow: FilterDraft,
) -> None:
    """For somebody who dislikes speed, where whatever is slower than ``slowest`` fails, and whatever acts presses."""
    asked = problem(-1.0, reference, residual_gentle=1.5)
    gated = gate_residual(asked, of_somebody_slow, reference, lambda: reference, World(slowest, force_n).collect)
    assert [each.residual_share for each in gated.trials] == tried
    assert gated.weights.residual_share == kept


class Timed(World):
    """In these scenarios whoever is slower than this share of the frozen policy's speed fails."""

    def __init__(self, scenarios: Collection[int], slowest_share: float = 0.8) -> None:
        super().__init__()
        self.scenarios, self.slowest_share = scenarios, slowest_share

    def _episode(self, act: Act, scenario: int) -> Trajectory:
        episode = super()._episode(act, scenario)
        in_time = _speed_share(episode) >= self.slowest_share
        return replace(episode, success=in_time or scenario not in self.scenarios)


def _speed_share(episode: Trajectory) -> float:
    return float(episode.signals[:, SPEED].mean() / (POLICY.mean(episode.observations[:-1]) ** 2).mean())


def others_of(scenarios: Sequence[int]) -> list[Trajectory]:
    """The reference policy's rollouts behind those of the gate."""
    return World().collect(POLICY.mean, scenarios[6:], 0.0, 0)


def kept_and_looks(
    asked: FilterProblem, draft: FilterDraft, reference: list[Trajectory], fails_in: Sequence[int], others: int
) -> tuple[float, int]:
    """What is kept if it fails in these of six scenarios and so many others, and how often 40 of them are driven."""
    scenarios = first_of(GATE, 6 + others)
    world = Timed([scenarios[place] for place in fails_in])
    gated = gate_residual(asked, draft, reference, lambda: others_of(scenarios), world.collect)
    return gated.weights.residual_share, world.asked.count(40)


@pytest.mark.parametrize(
    ("fails_in", "kept", "tried_in_others"),
    [
        ([0], 2.0, 1),
        ([0, 6, 7, 8], 2.0, 1),
        ([0, 6, 7, 8, 9], 0.5, 2),
        ([0, 1], 0.5, 0),
        ([6, 7, 8, 9, 10], 2.0, 0),
    ],
)
def test_what_loses_anything_is_tried_in_other_scenarios_and_may_lose_little_in_all_of_them(
    fails_in: list[int], kept: float, tried_in_others: int, reference: list[Trajectory], of_somebody_slow: FilterDraft
) -> None:
    """From its whole on a residual fails in some of six scenarios and of forty others; a tenth of all are accepted."""
    asked = problem(-1.0, reference, success_tolerance=0.1, tolerance_in_all=0.1)
    assert kept_and_looks(asked, of_somebody_slow, reference, fails_in, others=40) == (kept, tried_in_others)


@pytest.mark.parametrize(
    ("fails_in", "kept", "looks"),
    [
        ([0], 2.0, 2),
        ([0, 6, 7, 50, 51], 2.0, 3),
        ([0, 6, 7, 50, 51, 90, 91], 0.5, 2 * 3),
        ([0, 6, 7, 8, 9], 0.5, 2 * 1),
    ],
)
def test_no_more_other_scenarios_are_driven_than_make_it_clear_whether_a_residual_keeps_the_task(
    fails_in: list[int], kept: float, looks: int, reference: list[Trajectory], of_somebody_slow: FilterDraft
) -> None:
    """A twentieth of all may be lost: 2.3, 4.3 and 6.3 after each look. What is refused is tried at twice and whole."""
    asked = problem(-1.0, reference, success_tolerance=0.1, tolerance_in_all=0.05)
    assert kept_and_looks(asked, of_somebody_slow, reference, fails_in, others=120) == (kept, looks)


@pytest.mark.parametrize(
    ("failed", "pressing", "clear", "in_the_end"),
    [(0, 0, True, True), (0, 3, None, False), (4, 0, None, True), (5, 0, None, False), (7, 3, False, False)],
)
def test_forces_alone_refuse_a_residual_only_when_all_others_are_driven(
    failed: int, pressing: int, clear: bool | None, in_the_end: bool, reference: list[Trajectory]
) -> None:
    """A tenth of forty scenarios may be lost, and 3 of 40 with 12 N are more than one in twenty above 10 N."""
    asked = problem(-1.0, reference, pressed_n=20.0, tolerance_in_all=0.1)
    before = World().collect(POLICY.mean, first_of(GATE, 40), 0.0, 0)
    after = [
        replace(
            each,
            success=place >= failed,
            contact_force_n=np.full_like(each.contact_force_n, 12.0 if place < pressing else 0.0),
        )
        for place, each in enumerate(before)
    ]
    assert keeps_task_in_all(asked, before, after, within=2.0) is clear
    assert keeps_task_in_all(asked, before, after) is in_the_end


def test_of_what_loses_too_much_in_other_scenarios_two_thirds_or_less_are_next(
    reference: list[Trajectory], of_somebody_slow: FilterDraft
) -> None:
    """Twice a residual fails too often, and one and a half times is not asked for."""
    draft, scenarios = of_somebody_slow, first_of(GATE, 46)

    def speed_share(share: float) -> float:
        act = act_of(FAMILY, POLICY, draft.weights.changed(residual_share=share))
        return float(np.mean([_speed_share(each) for each in World().collect(act, scenarios, 0.0, 0)]))

    world = Timed([scenarios[place] for place in (0, 6, 7, 8, 9)], (speed_share(1.0) + 2 * speed_share(1.5)) / 3)
    asked = problem(-1.0, reference, success_tolerance=0.1, tolerance_in_all=0.1)
    gated = gate_residual(asked, draft, reference, lambda: others_of(scenarios), world.collect)
    assert [each.residual_share for each in gated.trials] == [1.0, 1.5, 2.0, 3.0, 2.0]
    assert gated.weights.residual_share == 1.0


class Pressing(Timed):
    """In these scenarios whoever takes much longer than the frozen policy succeeds, and presses with 6 N."""

    def _episode(self, act: Act, scenario: int) -> Trajectory:
        episode = super()._episode(act, scenario)
        forces = np.full_like(episode.contact_force_n, 0.0 if episode.success else 6.0)
        return replace(episode, contact_force_n=forces, success=True)


@pytest.mark.parametrize(
    ("pressed_in", "pressed_n", "kept"),
    [([0], 5.0, 2.0), ([0, 6, 7, 8, 9], 5.0, 0.5), ([0, 1, 2], 5.0, 0.5), ([0, 1, 2], 7.0, 2.0)],
)
def test_what_presses_much_harder_in_more_than_a_few_scenarios_is_not_kept(
    pressed_in: list[int], pressed_n: float, kept: float, reference: list[Trajectory], of_somebody_slow: FilterDraft
) -> None:
    asked = problem(-1.0, reference, pressed_n=pressed_n, pressed_tolerance=0.2, tolerance_in_all=0.1)
    scenarios = first_of(GATE, 46)
    world = Pressing([scenarios[place] for place in pressed_in])
    gated = gate_residual(asked, of_somebody_slow, reference, lambda: others_of(scenarios), world.collect)
    assert gated.weights.residual_share == kept
    in_gate = sum(place < 6 for place in pressed_in)
    assert gated.trials[0].pressed == pytest.approx(in_gate / 6 if pressed_n < 6.0 else 0.0)
