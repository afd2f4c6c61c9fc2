"""Modes of archived policies: in which scenarios they are driven first, and when they are driven no further."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.ml.test_methods import POLICY, REWARD, collect
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.fitting.filter_problem import Collect, FilterConfig, FilterProblem
from worker.ml.reinforcement.archived_in_modes import DRIVEN_FIRST, DoubtedFirst, Lost

SCENARIOS = range(40, 52)
PROBLEM = FilterProblem(invented.TASK, POLICY, REWARD, 0, FilterConfig())
NOTHING = Lost(0, 0)
ACT = POLICY.mean


@pytest.fixture(scope="module")
def rollouts() -> dict[int, Trajectory]:
    """In which everything succeeds and nobody is touched, by scenario."""
    torch.set_num_threads(1)
    driven = collect(ACT, SCENARIOS, 0.0, 0)
    return {
        each.scenario: replace(each, success=True, contact_force_n=np.zeros_like(each.contact_force_n))
        for each in driven
    }


@pytest.fixture
def asked() -> list[list[int]]:
    return []


@pytest.fixture
def driving(rollouts: dict[int, Trajectory], asked: list[list[int]]) -> Callable[..., Collect]:
    """What drives so that some scenarios are failed and in some somebody is pressed."""

    def losing(failed: Sequence[int] = (), pressed: Sequence[int] = ()) -> Collect:
        def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int, /) -> list[Trajectory]:
            asked.append(list(scenarios))
            return [_so(rollouts[each], each in failed, each in pressed) for each in scenarios]

        return drive

    return losing


def _so(rollout: Trajectory, is_failed: bool, is_pressed: bool) -> Trajectory:
    force_n = np.full_like(rollout.contact_force_n, 2 * PROBLEM.config.pressed_n if is_pressed else 0.0)
    return replace(rollout, success=not is_failed, contact_force_n=force_n)


@pytest.mark.parametrize("how", ["failed", "pressed"])
def test_a_mode_that_loses_where_one_has_lost_before_is_driven_nowhere_else(
    rollouts: dict[int, Trajectory], driving: Callable[..., Collect], asked: list[list[int]], how: str
) -> None:
    drives = DoubtedFirst(PROBLEM, list(rollouts.values()), driving(**{how: [47]}))
    first = drives.drive(ACT, NOTHING)
    assert first is not None
    assert [each.scenario for each in first] == list(SCENARIOS)
    assert drives.drive(ACT, NOTHING) is None
    assert asked == [list(SCENARIOS), [47]]


def test_a_mode_that_loses_elsewhere_is_driven_to_the_end_and_both_are_doubted_then(
    rollouts: dict[int, Trajectory], driving: Callable[..., Collect], asked: list[list[int]]
) -> None:
    drives = DoubtedFirst(PROBLEM, list(rollouts.values()), driving([47]))
    drives.drive(ACT, NOTHING)
    drives.collect = driving([45])
    second = drives.drive(ACT, NOTHING)
    assert second is not None
    assert [each.scenario for each in second if not each.success] == [45]
    assert [each.scenario for each in second] == list(SCENARIOS)
    drives.drive(ACT, NOTHING)
    assert asked[-1] == [45, 47]


def test_what_may_still_be_won_elsewhere_is_waited_for(
    rollouts: dict[int, Trajectory], driving: Callable[..., Collect], asked: list[list[int]]
) -> None:
    """Where the reference policy fails, a mode may make good for what it loses: nothing is refused before that."""
    reference = [replace(each, success=each.scenario != 50) for each in rollouts.values()]
    drives = DoubtedFirst(PROBLEM, reference, driving([47, 50]))
    drives.drive(ACT, NOTHING)
    drives.collect = driving([47])
    kept = drives.drive(ACT, NOTHING)
    assert kept is not None
    assert asked[-2] == [47, 50]
    assert not Lost.of(PROBLEM, reference, kept).exceeds(NOTHING)


def test_what_the_policy_alone_loses_may_be_lost(
    rollouts: dict[int, Trajectory], driving: Callable[..., Collect]
) -> None:
    drives = DoubtedFirst(PROBLEM, list(rollouts.values()), driving([47], [43]))
    assert drives.drive(ACT, NOTHING) is not None
    assert drives.drive(ACT, Lost(1, 0)) is None
    assert drives.drive(ACT, Lost(0, 1)) is None
    assert drives.drive(ACT, Lost(1, 1)) is not None


def test_however_much_was_lost_a_few_scenarios_are_driven_first(
    rollouts: dict[int, Trajectory], driving: Callable[..., Collect], asked: list[list[int]]
) -> None:
    drives = DoubtedFirst(PROBLEM, list(rollouts.values()), driving(SCENARIOS))
    drives.drive(ACT, NOTHING)
    drives.drive(ACT, NOTHING)
    assert len(asked[-1]) == DRIVEN_FIRST


@pytest.mark.parametrize(("failed", "alone", "exceeds"), [(1, 0, True), (1, 1, False), (0, -2, False), (-1, 0, False)])
def test_no_mode_has_to_win_what_its_policy_alone_wins(failed: int, alone: int, exceeds: bool) -> None:
    assert Lost(failed, 0).exceeds(Lost(alone, 0)) is exceeds
