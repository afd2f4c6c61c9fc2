"""A filter's refinement: what it begins as, where it goes, and that it only stays where it is better."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.ml.test_methods import POLICY, REWARD, STEPS, World, collect
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported.filter_act import FilterAct, act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import Collect, FilterConfig, FilterProblem
from worker.ml.policies import checkpoint
from worker.ml.policies.checkpoint import Checkpoint, Paused, ask_to_pause, begin_again, go_on_from
from worker.ml.reinforcement import refinement, refinement_gate
from worker.ml.reinforcement.guided_reward import guided
from worker.ml.reinforcement.refinement import Beginning, Refinement
from worker.ml.rewards.reward_models import StructuredReward

SEEN = invented.observations(300, np.random.default_rng(9))
SHORT = Refinement(
    steps=400,
    warm_up_steps=120,
    imitation_steps=300,
    critic_first_updates=50,
    critic_again_updates=50,
    hidden=16,
    environments=2,
    largest_loss=1.0,
)
LONGER = replace(SHORT, steps=1_500, critic_first_updates=150, critic_again_updates=150, learning_rate=5e-3)
CHECKED = range(100, 110)
LOST = -0.25
STROKES = SIGNALS.index("strokes")
GATED = FilterWeights(mode={"speed_far": -0.3, "speed_near": -0.3}, gate=0.6)


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    return collect(POLICY.mean, range(6), 0.0, 0)


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def problem(reward: StructuredReward = REWARD) -> FilterProblem:
    """Of somebody who dislikes the first joint's action, by default."""
    return FilterProblem(invented.TASK, POLICY, reward, 0, FilterConfig(success_tolerance=1.0))


def refined(
    draft: FilterDraft,
    reference: list[Trajectory],
    config: Refinement = SHORT,
    checkpoint: Checkpoint | None = None,
    drive: Collect = collect,
) -> tuple[FilterDraft, ...]:
    """After ``config``: the last policy, then the best on the way."""
    return refinement.refine(problem(), draft, Beginning(World, [], reference, reference, drive), config, checkpoint)


def gate_refined(
    problem: FilterProblem, drafts: Sequence[FilterDraft], reference: Sequence[Trajectory], drive: Collect
) -> FilterDraft:
    """Checked in scenarios that the gate does not have, where the frozen policy is as good as in these."""
    driven = collect(POLICY.mean, CHECKED, 0.0, 0)
    checked = [replace(each, success=reference[0].success) for each in driven]
    return refinement_gate.gate_refined(problem, FilterDraft(GATED), [], drafts, reference, lambda: checked, drive)


def weights_of(drafts: Sequence[FilterDraft]) -> list[bytes]:
    """To compare them."""
    return [each.weights.to_bytes() for each in drafts]


def first_joint(weights: FilterWeights) -> float:
    """Mean action of the disliked joint in unseen states."""
    return float(act_of(invented.TASK.modes, POLICY, weights).batch(SEEN)[:, 0].mean())


def test_it_begins_as_the_filter_and_goes_where_the_person_wants_it(reference: list[Trajectory]) -> None:
    draft = FilterDraft(GATED)
    only_imitated = refined(
        draft, reference, replace(SHORT, steps=400, warm_up_steps=400, imitation_steps=1_000, hidden=64)
    )
    began = act_of(invented.TASK.modes, POLICY, GATED).batch(SEEN)
    imitated = act_of(invented.TASK.modes, POLICY, only_imitated[0].weights.changed(gate=1.0)).batch(SEEN)
    assert np.abs(imitated - began).mean() < 0.05
    learned, *_ = refined(draft, reference, LONGER)
    assert first_joint(learned.weights.changed(gate=1.0)) < first_joint(GATED) - 0.1


@pytest.fixture(scope="module")
def learned(reference: list[Trajectory]) -> FilterDraft:
    torch.set_num_threads(1)
    return refined(FilterDraft(GATED), reference, LONGER)[0]


def test_the_refined_policy_takes_the_place_of_a_weakened_filter_at_full_strength(
    reference: list[Trajectory], learned: FilterDraft
) -> None:
    weak = replace(learned, trials=(GateTrial(0.6, 0.0, 0.01, 0.0, 0.0),))
    gated = gate_refined(problem(), [weak], reference, collect)
    assert gated.weights.refined
    assert "refined by reinforcement learning" in gated.notes[-1]
    assert gated.weights.gate == 1.0
    assert gated.trials[-1].refined
    assert gated.trials[-1].preference > 0.01
    assert gated.tested
    assert first_joint(gated.weights) < first_joint(GATED)


@pytest.mark.parametrize(("share_of_its_gain", "is_kept"), [(0.85, True), (0.95, False), (99.0, False)])
def test_a_refined_policy_that_is_hardly_better_than_the_mode_leaves_it_to_a_residual(
    reference: list[Trajectory], learned: FilterDraft, share_of_its_gain: float, is_kept: bool
) -> None:
    best = gate_refined(problem(), [learned], reference, collect).trials[0].preference
    mode = GateTrial(0.6, 0.0, share_of_its_gain * best, 0.0, 0.0)
    gated = gate_refined(problem(), [replace(learned, trials=(mode,))], reference, collect)
    assert bool(gated.weights.refined) == is_kept
    assert is_kept or (gated.weights == GATED and "no better" in gated.notes[-1])


@pytest.mark.parametrize(("against", "is_kept"), [(0, True), (2, False)])
def test_a_refined_policy_stays_only_where_the_answers_say_clearly_that_it_is_better(
    reference: list[Trajectory], learned: FilterDraft, against: int, is_kept: bool
) -> None:
    """The reward model's mean always says so; two of its eight members may say the contrary."""
    liked = np.where(np.arange(REWARD.size) < against, -1.0, 1.0)
    doubtful = replace(REWARD, weights=REWARD.weights * liked[:, None])
    gated = gate_refined(problem(doubtful), [learned], reference, collect)
    assert gated.trials[0].preference > 0.0
    assert bool(gated.weights.refined) == is_kept
    assert ("do not say clearly enough" in gated.notes[-1]) != is_kept


def test_a_refined_policy_that_loses_the_task_leaves_the_filter_as_it_was(reference: list[Trajectory]) -> None:
    def failing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, success=False) for each in collect(act, scenarios, noise, seed)]

    strict = replace(problem(), config=FilterConfig(success_tolerance=0.05))
    succeeding = [replace(each, success=True) for each in reference]
    draft = FilterDraft(GATED, trials=(GateTrial(0.6, 0.0, 0.01, 0.0, 0.0),))
    gated = gate_refined(strict, refined(draft, reference), succeeding, failing)
    assert gated.weights == GATED
    assert [trial.gate for trial in gated.trials if trial.refined] == [1.0, 0.8, 0.6] * 2


def test_what_loses_the_task_in_more_scenarios_than_a_few_is_not_shipped(
    reference: list[Trajectory], learned: FilterDraft
) -> None:
    succeeding = [replace(each, success=True) for each in reference]
    drives = list[FilterAct]()

    def once(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Lost in one of those of the check, but when the filter is checked for the third time."""
        assert isinstance(act, FilterAct)
        drives.append(act)
        driven = collect(act, scenarios, noise, seed)
        return [replace(each, success=each.scenario != CHECKED[0] or len(drives) > 5) for each in driven]

    within = replace(problem(), config=FilterConfig(success_tolerance=0.2))
    gated = gate_refined(within, [learned], succeeding, once)
    assert [(trial.gate, trial.success_change) for trial in gated.trials] == [
        (1.0, 0.0), (1.0, -0.1), (0.8, 0.0), (0.6, 0.0), (0.8, -0.1), (0.6, 0.0),
    ]  # fmt: skip
    assert gated.weights.gate == 0.6
    assert gated.weights.refined


def test_a_training_that_paused_goes_on_from_its_checkpoint_with_the_same_result(
    reference: list[Trajectory], tmp_path: Path
) -> None:
    draft = FilterDraft(GATED)
    ask_to_pause(tmp_path)
    with pytest.raises(Paused):
        refined(draft, reference, checkpoint=Checkpoint(tmp_path))
    begin_again(tmp_path)
    kept = Checkpoint(tmp_path).read()
    assert kept is not None
    assert kept[1]["steps"] >= SHORT.warm_up_steps
    went_on = refined(draft, reference, checkpoint=Checkpoint(tmp_path))
    assert weights_of(went_on) == weights_of(refined(draft, reference))


def test_what_was_begun_on_half_the_answers_goes_where_all_of_them_say(
    reference: list[Trajectory], tmp_path: Path
) -> None:
    likes = problem(StructuredReward(-REWARD.weights))
    draft, beginning = FilterDraft(GATED), Beginning(World, [], reference, reference, collect)
    config = replace(LONGER, steps=900, share_ahead=0.5)
    refinement.refine_ahead(likes, draft, beginning, config, Checkpoint(tmp_path))
    ahead = Checkpoint(tmp_path).read_counts()
    assert ahead is not None
    assert config.ahead_steps <= ahead["steps"] < config.steps
    on_the_way, *_ = refinement.refine(likes, draft, beginning, config, Checkpoint(_copy(tmp_path, "liked")))
    changed, *_ = refinement.refine(problem(), draft, beginning, config, Checkpoint(_copy(tmp_path, "disliked")))
    assert first_joint(changed.weights) < first_joint(on_the_way.weights) - 0.1


def test_a_tie_to_what_it_was_lately_lets_it_go_further_than_one_to_the_imitation(reference: list[Trajectory]) -> None:
    tied = replace(LONGER, steps=3_000, first_tie=1.0, last_tie=1.0)
    stays, goes = (
        first_joint(refined(FilterDraft(GATED), reference, replace(tied, hold_every_steps=every))[0].weights)
        for every in (1_000_000, 500)
    )
    assert goes < stays - 0.03


def test_it_is_tried_in_scenarios_of_its_own_on_the_way(reference: list[Trajectory]) -> None:
    tried = set[int]()

    def noting(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        tried.update(scenarios)
        return collect(act, scenarios, noise, seed)

    beginning = Beginning(World, [], reference, collect(POLICY.mean, CHECKED, 0.0, 0), noting)
    refinement.refine(problem(), FilterDraft(GATED), beginning, replace(SHORT, hold_every_steps=100))
    assert tried == set(CHECKED)


class Narrow(World):
    """The same world, where the task stays undone while the first joint's action is below LOST."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium."""
        observation, reward, terminated, truncated, info = super().step(action)
        info["signals"]["undelivered"] = float(action[0] < LOST)
        return observation, reward, terminated, truncated, info


def narrowly(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """Rollouts in that world."""
    driven = collect(act, scenarios, noise, seed)
    return [replace(each, success=bool(each.actions[:, 0].mean() > LOST)) for each in driven]


def wide(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """Rollouts that see nothing of it."""
    return [replace(each, success=True) for each in collect(act, scenarios, noise, seed)]


def in_narrow(
    drive: Collect, reference: list[Trajectory], checkpoint: Checkpoint | None = None
) -> tuple[FilterDraft, ...]:
    """What a refinement comes to there that is tried by ``drive`` on the way."""
    succeeding = [replace(each, success=True) for each in reference]
    beginning = Beginning(Narrow, [], succeeding, succeeding, drive)
    looking = replace(LONGER, first_tie=0.1, last_tie=0.1, hold_every_steps=250, largest_loss=0.05, price=1.0)
    return refinement.refine(problem(), FilterDraft(GATED), beginning, looking, checkpoint)


@pytest.fixture(scope="module")
def blind(reference: list[Trajectory]) -> FilterDraft:
    torch.set_num_threads(1)
    return in_narrow(wide, reference)[0]


@pytest.fixture(scope="module")
def watched(reference: list[Trajectory]) -> tuple[FilterDraft, ...]:
    torch.set_num_threads(1)
    return in_narrow(narrowly, reference)


def test_where_the_task_gets_lost_it_goes_back_and_the_task_gets_a_price(
    blind: FilterDraft, watched: tuple[FilterDraft, ...]
) -> None:
    last, best = watched
    assert first_joint(blind.weights) < LOST - 0.03
    assert first_joint(last.weights) > LOST + 0.03
    assert LOST < first_joint(best.weights) < first_joint(GATED) - 0.05


def test_where_it_gets_no_better_it_goes_back(reference: list[Trajectory]) -> None:
    """Where it is tried, the signals say the contrary of what they said while it learned."""

    def contrary(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return [replace(each, signals=-each.signals) for each in collect(act, scenarios, noise, seed)]

    looking = replace(LONGER, first_tie=0.1, last_tie=0.1, hold_every_steps=250, share_ahead=1.0)
    free = refined(FilterDraft(GATED), reference, looking)
    held = refined(FilterDraft(GATED), reference, looking, drive=contrary)
    went, best, stayed, began = (first_joint(each.weights) for each in (*free, *held))
    assert went < best < began - 0.15
    assert stayed > (went + began) / 2


@pytest.mark.parametrize("lost", range(6))
def test_where_the_whole_last_policy_loses_the_task_whatever_gains_most_is_next(
    reference: list[Trajectory], watched: tuple[FilterDraft, ...], lost: int
) -> None:
    drives = list[FilterAct]()

    def later(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """Lost where the first ``lost`` filters are tried."""
        assert isinstance(act, FilterAct)
        drives.append(act)
        return [replace(each, success=len(drives) > lost) for each in collect(act, scenarios, noise, seed)]

    strict = replace(problem(), config=FilterConfig(success_tolerance=0.05))
    succeeding = [replace(each, success=True) for each in reference]
    gated = refinement_gate.gate_refined(strict, FilterDraft(GATED), [], watched, succeeding, lambda: succeeding, later)
    *tried, checked = gated.trials
    assert [trial.success_change < -0.5 for trial in tried] == [True] * lost + [False] * (6 - lost if lost else 1)
    chances = [each.weights.changed(gate=gate) for each in watched for gate in refinement_gate.STRENGTHS]
    gained = {place: trial.preference for place, trial in enumerate(tried) if place >= lost}
    assert gated.weights == chances[max(gained, key=lambda place: gained[place])]
    assert checked.preference == max(gained.values())


def test_a_training_that_went_back_and_paused_ends_with_the_same_policies(
    reference: list[Trajectory], watched: tuple[FilterDraft, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a step with the task undone costs is in its checkpoint, and where it is held."""
    monkeypatch.setattr(checkpoint, "NOTE_EVERY_S", 0.0)  # looking once a second, it may be done before it looks again

    def then_pausing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        driven = narrowly(act, scenarios, noise, seed)
        if not all(each.success for each in driven):
            ask_to_pause(tmp_path)
        return driven

    with pytest.raises(Paused):
        in_narrow(then_pausing, reference, Checkpoint(tmp_path))
    begin_again(tmp_path)
    assert weights_of(in_narrow(narrowly, reference, Checkpoint(tmp_path))) == weights_of(watched)


def test_what_was_begun_before_there_were_prices_is_gone_on_with(reference: list[Trajectory], tmp_path: Path) -> None:
    draft, checkpoint = FilterDraft(GATED), Checkpoint(tmp_path)
    beginning = Beginning(World, [], reference, reference, collect)
    refinement.refine_ahead(problem(), draft, beginning, SHORT, checkpoint)
    kept = checkpoint.read()
    assert kept is not None
    checkpoint.write({name: each for name, each in kept[0].items() if name not in {"price", "best_gain"}}, kept[1])
    last, *_ = weights_of(refined(draft, reference, checkpoint=checkpoint))
    assert last == weights_of(refined(draft, reference))[0]


def test_what_was_made_ahead_is_promising_only_to_whoever_likes_it(reference: list[Trajectory], tmp_path: Path) -> None:
    likes = problem(StructuredReward(-REWARD.weights))
    draft, beginning = FilterDraft(GATED), Beginning(World, [], reference, reference, collect)
    config, checkpoint = replace(LONGER, share_ahead=0.9, hold_every_steps=300), Checkpoint(tmp_path)
    assert refinement.is_promising(problem(), draft, reference, config, checkpoint, collect), "nothing was made ahead"
    refinement.refine_ahead(problem(), draft, beginning, config, checkpoint)
    assert refinement.is_promising(problem(), draft, reference, config, checkpoint, collect)
    assert not refinement.is_promising(likes, draft, reference, config, checkpoint, collect)
    ambitious = replace(draft, trials=(GateTrial(0.6, 0.0, 99.0, 0.0, 0.0),))
    assert not refinement.is_promising(problem(), ambitious, reference, config, checkpoint, collect)
    assert "given up" in gate_refined(problem(), [], reference, collect).notes[-1]


def test_a_training_that_changed_its_mind_and_paused_ends_with_the_same_policy(
    reference: list[Trajectory], tmp_path: Path
) -> None:
    likes = problem(StructuredReward(-REWARD.weights))
    draft, beginning = FilterDraft(GATED), Beginning(World, [], reference, reference, collect)
    refinement.refine_ahead(likes, draft, beginning, SHORT, Checkpoint(tmp_path))
    whole, paused = _copy(tmp_path, "whole"), _copy(tmp_path, "paused")
    went_through = refined(draft, reference, checkpoint=Checkpoint(whole))
    ask_to_pause(paused)
    with pytest.raises(Paused):
        refined(draft, reference, checkpoint=Checkpoint(paused, every_s=0.0))
    begin_again(paused)
    went_on = refined(draft, reference, checkpoint=Checkpoint(paused))
    assert weights_of(went_on) == weights_of(went_through)


def test_strokes_count_where_the_task_is_done_by_strokes(reference: list[Trajectory]) -> None:
    stroking = [replace(each, signals=each.signals.copy()) for each in reference]
    for each in stroking:
        each.signals[:, STROKES] = np.arange(len(each)) % 2
    signals = np.zeros((2, len(SIGNALS)), np.float32)
    signals[1, STROKES] = 1.0
    without, counted = (
        guided(some, nothing_learned, 0.3, 1.0)(signals, signals, signals) for some in (reference, stroking)
    )
    spread = float(np.concatenate([each.signals[:, STROKES] for each in stroking]).std())
    assert np.ptp(without) == 0.0
    assert counted[1] - counted[0] == pytest.approx(0.3 / spread)


def test_force_costs_something_beyond_what_the_reference_policy_presses_with(reference: list[Trajectory]) -> None:
    pressing = [replace(each, contact_force_n=np.full(STEPS, 3.0, np.float32)) for each in reference]
    signals = np.zeros((5, len(SIGNALS)), np.float32)
    signals[:, SIGNALS.index("force_at_target_n")] = (0.0, 3.0, 3.0, 3.0, 3.0)
    signals[:, SIGNALS.index("force_away_n")] = (0.0, 0.0, 1.0, 2.0, 40.0)
    rewards = guided(pressing, nothing_learned, 0.0, 0.5)(signals, signals, signals)
    np.testing.assert_allclose(rewards - rewards[0], [0.0, 0.0, -0.25, -0.5, -1.5], atol=1e-6)


class Hitting(World):
    """The same world, where the person is hit while the first joint's action is below LOST."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """See gymnasium."""
        observation, reward, terminated, truncated, info = super().step(action)
        info["signals"]["force_away_n"] = 20.0 * (action[0] < LOST)
        return observation, reward, terminated, truncated, info


def test_a_refinement_keeps_away_from_where_people_would_be_hit(reference: list[Trajectory]) -> None:
    hasty = replace(LONGER, first_tie=0.1, last_tie=0.1)
    hits, misses = (
        first_joint(
            refinement.refine(
                problem(),
                FilterDraft(GATED),
                Beginning(Hitting, [], reference, reference, collect),
                replace(hasty, force_price=price),
            )[0].weights
        )
        for price in (0.0, 1.0)
    )
    assert hits < LOST
    assert misses > LOST


def nothing_learned(signals: np.ndarray, observations: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """An R-hat that has no wishes."""
    return np.zeros(len(signals))


def _copy(folder: Path, name: str) -> Path:
    copied = folder.with_name(f"{folder.name}-{name}")
    copied.mkdir()
    go_on_from(folder, copied)
    return copied


def test_the_same_seed_gives_the_same_policy_and_it_survives_being_stored(reference: list[Trajectory]) -> None:
    first, again = (refined(FilterDraft(GATED), reference)[0].weights for _ in range(2))
    assert first.to_bytes() == again.to_bytes()
    read = FilterWeights.from_bytes(first.to_bytes())
    assert first_joint(read) == first_joint(first)
    assert len(reference[0]) == STEPS
