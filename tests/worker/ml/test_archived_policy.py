"""Policies refined beforehand: whose refinement begins as one of them, and when one of them is the filter."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.ml.test_methods import POLICY, REWARD, World, collect
from worker.domain.trajectory import Trajectory
from worker.domain.type_aliases import Act, FloatArray
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting import response_surface
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem
from worker.ml.filters.fitting.gate import signal_changes, trial_of
from worker.ml.policies.gaussian import GaussianPolicy
from worker.ml.reinforcement import refinement
from worker.ml.reinforcement.archived_policy import (
    DRIVEN_IN_MODES,
    NEXT_BEST,
    ArchivedPolicy,
    best_archived,
    choose_archived,
)
from worker.ml.reinforcement.refinement import Beginning, Refinement
from worker.ml.reinforcement.refinement_gate import gate_refined
from worker.ml.rewards.reward_models import StructuredReward

SCENARIOS = range(6)
CHECKED = range(100, 110)
FAR = -0.67
"""mean action of the first joint, which moved(-3.0) is below, in any state"""
NO_MODE = FilterDraft(FilterWeights())
WEAK_MODE = FilterDraft(FilterWeights(mode={"speed_near": -0.3}, gate=0.3))
DISLIKES = FilterProblem(invented.TASK, POLICY, REWARD, 0, FilterConfig(success_tolerance=0.05))
"""somebody who dislikes the first joint's action"""
ONLY_IMITATED = Refinement(
    steps=400, warm_up_steps=400, imitation_steps=1_500, critic_first_updates=10, hidden=64, environments=2
)


def moved(by: float) -> GaussianPolicy:
    """The pre-trained policy with more of the first joint's action."""
    weights = {name: array.copy() for name, array in POLICY.weights.items()}
    weights["bias_2"][0] += by
    return GaussianPolicy(weights)


def archived(policy: GaussianPolicy, *, success: bool = True) -> ArchivedPolicy:
    driven = collect(policy.mean, SCENARIOS, 0.0, 0)
    return ArchivedPolicy(policy, [replace(each, success=success) for each in driven])


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    torch.set_num_threads(1)
    return [replace(each, success=True) for each in collect(POLICY.mean, SCENARIOS, 0.0, 0)]


def failing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    return [replace(each, success=False) for each in collect(act, scenarios, noise, seed)]


def succeeding(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    return [replace(each, success=True) for each in collect(act, scenarios, noise, seed)]


def test_it_begins_as_what_the_person_wants_most_of_what_keeps_the_task(reference: list[Trajectory]) -> None:
    a_little, much, lost, liked = (
        archived(moved(-0.3)),
        archived(moved(-1.0)),
        archived(moved(-2.0), success=False),
        moved(1.0),
    )
    others = [a_little, much, lost, archived(liked)]
    (start, driven), *_ = best_archived(DISLIKES, NO_MODE, others, [], reference, succeeding)
    assert start.weights.refined is much.policy.weights
    assert driven is much.driven
    likes = replace(DISLIKES, reward=StructuredReward(-REWARD.weights))
    assert best_archived(likes, NO_MODE, others, [], reference, succeeding)[0].draft.weights.refined is liked.weights


def explored(each: ArchivedPolicy) -> ArchivedPolicy:
    """With a surface of the modes around it, fitted in other scenarios as it is when an archive is made."""
    family, policy, scenarios = invented.TASK.modes, each.policy, range(200, 260)
    modes, alone = family.sample(len(scenarios), np.random.default_rng(3)), collect(policy.mean, scenarios, 0.0, 0)
    changed = [_in_mode(policy, mode, scenario) for mode, scenario in zip(modes, scenarios, strict=True)]
    around = response_surface.fit(family, modes, signal_changes(alone, changed), np.ones(len(scenarios)))
    return replace(each, around=around)


def _in_mode(policy: GaussianPolicy, mode: FloatArray, scenario: int) -> Trajectory:
    weights = FilterWeights(refined=policy.weights, refined_mode=invented.TASK.modes.named(mode))
    return collect(act_of(invented.TASK.modes, POLICY, weights), [scenario], 0.0, 0)[0]


def test_it_begins_as_an_archived_policy_in_the_mode_that_the_person_wants_it_in(reference: list[Trajectory]) -> None:
    plain = archived(moved(-0.5))
    (start, driven), *_ = best_archived(DISLIKES, NO_MODE, [plain, explored(plain)], [], reference, succeeding)
    assert start.weights.refined is plain.policy.weights
    assert start.weights.refined_mode
    gained, alone = (trial_of(DISLIKES, 1.0, 0.0, reference, some).preference for some in (driven, plain.driven))
    assert gained > 1.2 * alone
    again = succeeding(act_of(invented.TASK.modes, POLICY, start.weights), SCENARIOS, 0.0, 0)
    np.testing.assert_array_equal([each.actions for each in again], [each.actions for each in driven])


def test_what_archived_modes_did_is_known_and_not_driven_again(reference: list[Trajectory]) -> None:
    plain, tried = explored(archived(moved(-0.5))), list[list[float]]()

    def noting(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        found = succeeding(act, scenarios, noise, seed)
        tried.append([float(each.actions[:, 0].mean()) for each in found])
        return found

    (own, driven), *_ = best_archived(DISLIKES, NO_MODE, [plain], [], reference, noting)
    sought = tried.copy()
    known = ArchivedPolicy(plain.policy, driven, mode=own.weights.refined_mode)
    tried.clear()
    (start, _), *_ = best_archived(DISLIKES, NO_MODE, [plain, known], [], reference, noting)
    assert start.weights.refined_mode
    assert len(tried) < len(sought)

    tried.clear()
    best_archived(DISLIKES, NO_MODE, [plain, replace(known, driven=plain.driven)], [], reference, noting)
    assert sought[0] not in tried, "a mode like it has come to nothing"


def test_in_a_mode_that_loses_the_task_an_archived_policy_is_not_begun_as(reference: list[Trajectory]) -> None:
    plain = archived(moved(-0.5))
    (start, driven), *_ = best_archived(DISLIKES, NO_MODE, [explored(plain)], [], reference, failing)
    assert start.weights.refined is plain.policy.weights
    assert not start.weights.refined_mode
    assert driven is plain.driven


def test_whose_best_mode_loses_the_task_begins_in_a_lesser_one_that_keeps_it(reference: list[Trajectory]) -> None:
    plain, tried = explored(archived(moved(-0.5))), list[float]()

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Whoever goes as far as the first loses the task."""
        driven = collect(act, scenarios, noise, seed)
        tried.append(float(np.mean([each.actions[:, 0].mean() for each in driven])))
        return [replace(each, success=tried[-1] > tried[0]) for each in driven]

    (start, driven), *_ = best_archived(DISLIKES, NO_MODE, [plain], [], reference, drive)
    assert start.weights.refined_mode
    assert all(each.success for each in driven)
    alone, gained = (trial_of(DISLIKES, 1.0, 0.0, reference, some).preference for some in (plain.driven, driven))
    assert gained > alone


def test_a_mode_that_loses_anything_is_not_begun_in_however_much_of_it_is_tolerated(
    reference: list[Trajectory],
) -> None:
    plain, tolerant = explored(archived(moved(-0.5))), replace(DISLIKES, config=FilterConfig(success_tolerance=0.3))

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, success=each.scenario > 0) for each in collect(act, scenarios, noise, seed)]

    (start, _), *_ = best_archived(tolerant, NO_MODE, [plain], [], reference, drive)
    assert start.weights.refined is plain.policy.weights
    assert not start.weights.refined_mode


@pytest.mark.parametrize(("lost", "is_taken"), [(1, True), (2, False)])
def test_a_mode_does_not_have_to_win_back_what_its_policy_alone_loses(
    reference: list[Trajectory], lost: int, is_taken: bool
) -> None:
    tolerant = replace(DISLIKES, config=FilterConfig(success_tolerance=0.5))
    plain = explored(archived(moved(-0.5)))
    alone = replace(plain, driven=[replace(each, success=each.scenario >= 1) for each in plain.driven])

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, success=each.scenario >= lost) for each in collect(act, scenarios, noise, seed)]

    (start, _), *_ = best_archived(tolerant, NO_MODE, [alone], [], reference, drive)
    assert bool(start.weights.refined_mode) is is_taken


def test_the_most_promising_is_tried_first_and_no_more_than_somebody_can_wait_for(reference: list[Trajectory]) -> None:
    others, tried = [explored(archived(moved(by))) for by in (-0.4, *[-0.5] * DRIVEN_IN_MODES)], list[float]()

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Whatever is tried keeps the task, and is no better than the frozen policy."""
        driven = collect(act, scenarios, noise, seed)
        tried.append(float(np.mean([each.actions[:, 0].mean() for each in driven])))
        return succeeding(POLICY.mean, scenarios, noise, seed)

    best_archived(DISLIKES, NO_MODE, others, [], reference, drive)
    assert len(tried) == DRIVEN_IN_MODES
    assert tried[0] == min(tried)


def test_modes_that_lose_the_task_in_a_scenario_where_others_have_lost_it_are_driven_no_further(
    reference: list[Trajectory],
) -> None:
    asked, lost = list[list[int]](), SCENARIOS[3]

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        asked.append(list(scenarios))
        return [replace(each, success=each.scenario != lost) for each in collect(act, scenarios, noise, seed)]

    best = best_archived(DISLIKES, NO_MODE, [explored(archived(moved(-0.5)))], [], reference, drive)
    assert not best[0].draft.weights.refined_mode
    assert asked[0] == list(SCENARIOS)
    assert asked[1:]
    assert all(each == [lost] for each in asked[1:])


def test_a_policy_that_loses_the_task_is_not_driven_once_more_where_no_mode_is_better(
    reference: list[Trajectory],
) -> None:
    lost = explored(archived(moved(-0.5), success=False))
    assert lost.around
    flat = replace(lost.around, coefficients=np.zeros_like(lost.around.coefficients))

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        pytest.fail("It was driven again.")

    assert best_archived(DISLIKES, NO_MODE, [replace(lost, around=flat)], [], reference, drive) == []


def test_what_was_learned_from_an_archived_policy_in_a_mode_is_executed_in_none(reference: list[Trajectory]) -> None:
    (start, driven), *_ = best_archived(DISLIKES, NO_MODE, [explored(archived(moved(-0.5)))], [], reference, succeeding)
    begun, *_ = refinement.refine(DISLIKES, start, Beginning(World, [], reference, reference, collect), ONLY_IMITATED)
    assert not begun.weights.refined_mode
    learned = collect(act_of(invented.TASK.modes, POLICY, begun.weights), SCENARIOS, 0.0, 0)
    wanted, came, usual = (np.concatenate([each.actions for each in some]) for some in (driven, learned, reference))
    assert np.abs(came - wanted).mean() < 0.5 * np.abs(usual - wanted).mean()


def test_whose_own_mode_is_better_than_all_of_them_begins_as_that(reference: list[Trajectory]) -> None:
    trial = GateTrial(1.0, 0.0, 99.0, 0.0, 0.0)
    with_mode = FilterDraft(FilterWeights(mode={"speed_near": -0.3}), trials=(trial,))
    assert best_archived(DISLIKES, with_mode, [archived(moved(-1.0))], [], reference, succeeding) == []
    assert best_archived(DISLIKES, NO_MODE, [], [], reference, succeeding) == []
    assert best_archived(DISLIKES, NO_MODE, [archived(moved(1.0))], [], reference, succeeding) == []


@pytest.mark.parametrize("mode", [NO_MODE, WEAK_MODE])
def test_a_refinement_begins_as_the_whole_archived_policy(reference: list[Trajectory], mode: FilterDraft) -> None:
    policy = moved(-1.0)
    (start, _), *_ = best_archived(DISLIKES, mode, [archived(policy)], [], reference, succeeding)
    beginning = Beginning(World, [], reference, reference, collect)
    begun, *_ = refinement.refine(DISLIKES, start, beginning, ONLY_IMITATED)
    seen = invented.observations(300, np.random.default_rng(9))
    imitated = act_of(invented.TASK.modes, POLICY, begun.weights.changed(gate=1.0)).batch(seen)
    assert np.abs(imitated - policy.mean(seen)).mean() < 0.05
    assert np.abs(imitated - POLICY.mean(seen)).mean() > 0.05


@pytest.mark.parametrize(("learned", "is_own"), [(-1.5, True), (-0.5, False)])
def test_the_archived_policy_is_the_filter_where_the_refinement_has_found_none_better(
    reference: list[Trajectory], learned: float, is_own: bool
) -> None:
    best = best_archived(DISLIKES, NO_MODE, [archived(moved(-1.0))], [], reference, succeeding)
    own = replace(NO_MODE, weights=FilterWeights(refined=moved(learned).weights))
    gated = gate_refined(DISLIKES, NO_MODE, best, [own], reference, lambda: reference, succeeding)
    assert gated.weights.refined is (own if is_own else best[0].draft).weights.refined
    assert ("executed in another way" in gated.notes[-1]) != is_own
    assert gated.tested


def test_where_a_refinement_was_given_up_the_archived_policy_is_left(reference: list[Trajectory]) -> None:
    best = best_archived(DISLIKES, NO_MODE, [archived(moved(-1.0))], [], reference, succeeding)
    gated = gate_refined(DISLIKES, NO_MODE, best, [], reference, lambda: reference, succeeding)
    assert gated.weights.refined is best[0].draft.weights.refined
    none = gate_refined(DISLIKES, NO_MODE, [], [], reference, lambda: reference, succeeding)
    assert not none.weights.refined
    assert "given up" in none.notes[-1]


def test_nobody_waits_for_what_the_archived_policy_does_in_scenarios_that_it_was_tried_in(
    reference: list[Trajectory],
) -> None:
    best = best_archived(DISLIKES, NO_MODE, [archived(moved(-1.0))], [], reference, succeeding)
    more, asked = [replace(each, scenario=each.scenario + 100) for each in reference], list[int]()

    def noting(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        asked.extend(scenarios)
        return succeeding(act, scenarios, noise, seed)

    gate_refined(DISLIKES, NO_MODE, best, [], reference, lambda: more, noting)
    assert asked == [each.scenario for each in more]


def residual(gained: float, of_mode: float = 0.1) -> FilterDraft:
    """Mode and residual, which have gained so much in the gate's scenarios and little in others."""
    weights = FilterWeights(mode={"speed_near": -0.3}, encoder={"weight": np.ones(1, np.float32)}, residual_share=1.5)
    shares = [(0.0, of_mode), (1.0, 0.5 * gained), (1.5, gained), (1.5, 0.2 * gained)]
    return FilterDraft(weights, trials=tuple(GateTrial(1.0, share, some, 0.0, 0.0) for share, some in shares))


@pytest.mark.parametrize(("times_as_much", "is_chosen"), [(0.9, True), (1.1, False)])
def test_whoever_gains_more_by_an_archived_policy_than_by_mode_and_residual_gets_it(
    reference: list[Trajectory], times_as_much: float, is_chosen: bool
) -> None:
    policy = archived(moved(-1.0))
    own = residual(times_as_much * trial_of(DISLIKES, 1.0, 0.0, reference, policy.driven).preference)
    more = [replace(each, success=True) for each in collect(POLICY.mean, CHECKED, 0.0, 0)]
    chosen = choose_archived(DISLIKES, own, [policy], [], reference, lambda: more, succeeding)
    assert chosen.trials[: len(own.trials)] == own.trials
    if not is_chosen:
        assert chosen.weights is own.weights
        return
    assert chosen.weights.refined is policy.policy.weights
    assert not chosen.weights.mode
    assert not chosen.weights.encoder
    assert chosen.tested
    assert chosen.trials[-1].refined


@pytest.mark.parametrize(("times_as_much", "is_chosen"), [(0.9, True), (1.1, False)])
def test_an_archived_policy_has_to_beat_the_mode_alone_where_no_residual_is_kept(
    reference: list[Trajectory], times_as_much: float, is_chosen: bool
) -> None:
    policy = archived(moved(-1.0))
    gained = trial_of(DISLIKES, 1.0, 0.0, reference, policy.driven).preference
    own = residual(2.0 * gained, times_as_much * gained)
    own = replace(own, weights=own.weights.changed(residual_share=0.0))
    chosen = choose_archived(DISLIKES, own, [policy], [], reference, lambda: reference, succeeding)
    assert bool(chosen.weights.refined) is is_chosen


def test_whoever_is_left_without_archived_policies_by_the_check_keeps_mode_and_residual(
    reference: list[Trajectory],
) -> None:
    own = residual(0.01)
    more = [replace(each, success=True) for each in collect(POLICY.mean, CHECKED, 0.0, 0)]

    def losing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, success=each.scenario not in CHECKED) for each in succeeding(act, scenarios, noise, seed)]

    kept = choose_archived(DISLIKES, own, [archived(moved(-1.0))], [], reference, lambda: more, losing)
    assert (kept.weights, kept.notes) == (own.weights, own.notes)
    assert choose_archived(DISLIKES, own, [], [], reference, lambda: more, succeeding) is own


def test_what_was_refined_for_the_person_is_not_compared_once_more(reference: list[Trajectory]) -> None:
    own = replace(NO_MODE, weights=FilterWeights(refined=moved(-0.1).weights))
    policies = [archived(moved(-1.0))]
    assert choose_archived(DISLIKES, own, policies, [], reference, lambda: reference, succeeding) is own


def test_an_archived_policy_that_loses_the_task_in_more_scenarios_is_not_the_filter(
    reference: list[Trajectory],
) -> None:
    best = best_archived(DISLIKES, NO_MODE, [archived(moved(-1.0))], [], reference, succeeding)
    more = [replace(each, success=True) for each in collect(POLICY.mean, range(100, 110), 0.0, 0)]

    def failing_there(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, success=each.scenario < 100) for each in succeeding(act, scenarios, noise, seed)]

    gated = gate_refined(DISLIKES, NO_MODE, best, [], reference, lambda: more, failing_there)
    assert gated.weights == NO_MODE.weights


def test_an_archived_policy_that_loses_the_task_in_its_mode_is_the_filter_in_none(reference: list[Trajectory]) -> None:
    plain = explored(archived(moved(-0.5)))
    best = best_archived(DISLIKES, NO_MODE, [plain], [], reference, succeeding)
    assert best[0].draft.weights.refined_mode
    more = [replace(each, success=True) for each in collect(POLICY.mean, CHECKED, 0.0, 0)]
    far = 0.002 - np.mean([each.actions[:, 0].mean() for each in collect(plain.policy.mean, CHECKED, 0.0, 0)])

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Whoever goes a little further than the policy alone loses the task in more scenarios."""
        driven = collect(act, scenarios, noise, seed)
        is_kept = scenarios[0] not in CHECKED or np.mean([each.actions[:, 0].mean() for each in driven]) >= -far
        return [replace(each, success=bool(is_kept)) for each in driven]

    gated = gate_refined(DISLIKES, NO_MODE, best, [], reference, lambda: more, drive)
    assert gated.weights.refined is plain.policy.weights
    assert not gated.weights.refined_mode
    assert gated.weights.gate == 1.0
    assert "refined beforehand" in gated.notes[-1]


@pytest.mark.parametrize(("second", "is_second"), [(-1.3, True), (-0.7, False)])
def test_where_the_best_archived_policy_loses_the_task_what_gains_most_of_the_next_best_and_less_of_it_is_the_filter(
    reference: list[Trajectory], second: float, is_second: bool
) -> None:
    """80 % of a move by 2 gains more than a move by .7 and less than one by 1.3."""
    others = [archived(moved(by)) for by in (-0.2, second, -2.0)]
    best = best_archived(DISLIKES, NO_MODE, others, [], reference, succeeding)
    more = [replace(each, success=True) for each in collect(POLICY.mean, CHECKED, 0.0, 0)]
    furthest = np.mean([each.actions[:, 0].mean() for each in collect(others[2].policy.mean, CHECKED, 0.0, 0)])

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Whoever goes as far as the best loses the task in more scenarios."""
        driven = collect(act, scenarios, noise, seed)
        is_kept = scenarios[0] not in CHECKED or np.mean([each.actions[:, 0].mean() for each in driven]) > furthest
        return [replace(each, success=bool(is_kept)) for each in driven]

    gated = gate_refined(DISLIKES, NO_MODE, best, [], reference, lambda: more, drive)
    assert gated.weights.refined is others[1 if is_second else 2].policy.weights
    assert gated.weights.gate == (1.0 if is_second else 0.8)
    assert "refined beforehand" in gated.notes[-1]


def test_each_policy_is_offered_once_in_its_best_mode_and_no_more_than_can_be_tried(
    reference: list[Trajectory],
) -> None:
    plain = explored(archived(moved(-0.5)))
    weak = [archived(moved(by)) for by in (-0.1, -0.3, -0.2, -0.4, -0.15)]
    best = best_archived(DISLIKES, NO_MODE, [*weak, plain], [], reference, succeeding)
    assert len(best) == 1 + NEXT_BEST
    assert best[0].draft.weights.refined_mode
    refined = [each.draft.weights.refined for each in best]
    wanted = [plain, weak[3], weak[1], weak[2]]
    assert all(found is each.policy.weights for found, each in zip(refined, wanted, strict=True))


@pytest.mark.parametrize(("best_on_the_way", "is_own"), [(-1.4, True), (-0.8, False)])
@pytest.mark.parametrize("lost_where", [SCENARIOS, CHECKED])
def test_where_the_last_policy_loses_the_task_what_gains_most_of_all_others_is_the_filter(
    reference: list[Trajectory], lost_where: range, best_on_the_way: float, is_own: bool
) -> None:
    """Wherever that shows: in the gate's scenarios or in those of the check."""
    best = best_archived(DISLIKES, NO_MODE, [archived(moved(-1.2))], [], reference, succeeding)
    last, learned = (
        replace(NO_MODE, weights=FilterWeights(refined=moved(by).weights)) for by in (-3.0, best_on_the_way)
    )
    more = [replace(each, success=True) for each in collect(POLICY.mean, CHECKED, 0.0, 0)]

    def drive(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Whoever goes far loses the task."""
        driven = collect(act, scenarios, noise, seed)
        far = [each.actions[:, 0].mean() < FAR and each.scenario in lost_where for each in driven]
        return [replace(each, success=not is_far) for each, is_far in zip(driven, far, strict=True)]

    gated = gate_refined(DISLIKES, NO_MODE, best, [last, learned], reference, lambda: more, drive)
    assert gated.weights.gate == 1.0
    assert gated.weights.refined is (learned if is_own else best[0].draft).weights.refined
