"""The stages of the studio's filter on an invented world in which speed is the size of the actions."""

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.worker import invented
from worker.compute import learning
from worker.domain.scenarios import GATE, first_of
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Act
from worker.ml.filters.exported.filter_act import act_of
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting import mode_search, pbarl, residual, residual_gate, response_surface
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig, FilterProblem, ReportProgress
from worker.ml.filters.fitting.gate import trial_of, try_on
from worker.ml.filters.fitting.mode_archive import ModeArchive
from worker.ml.filters.fitting.pool import Pool
from worker.ml.filters.fitting.residual import learn_round
from worker.ml.filters.fitting.response_surface import ResponseSurface
from worker.ml.rewards.reward_models import UNDONE, StructuredReward

POLICY = invented.small_policy()
FAMILY = invented.TASK.modes
SPEED = SIGNALS.index("speed_m_s")
STEPS = 15
CONFIG = FilterConfig(
    gate_scenarios=6,
    residual_rounds=1,
    residual_rollouts=6,
    value_steps=150,
    adapter_steps=100,
    mode_attempts=2,
    gates=(0.4,),
)


class World:
    """Observations are noise; an episode fails when it is slower than ``slowest``, and presses with ``force_n``."""

    def __init__(self, slowest: float = -np.inf, force_n: float = 0.0) -> None:
        self.slowest, self.force_n = slowest, force_n
        self.asked: list[int] = []

    def collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        """See filter_problem.Collect."""
        self.asked.append(len(scenarios))
        return [self._episode(learning.noisy(act, noise, seed, scenario), scenario) for scenario in scenarios]

    def _episode(self, act: Act, scenario: int) -> Trajectory:
        rng = np.random.default_rng(scenario)
        seen = invented.observations(STEPS + 1, rng)
        actions = np.clip([act(each) for each in seen[:-1]], -1, 1).astype(np.float32)
        signals = np.zeros((STEPS, len(SIGNALS)), np.float32)
        signals[:, SPEED] = (actions**2).mean(axis=1)
        episode = invented.trajectory(rng, steps=STEPS, scenario=scenario, signals=signals, actions=actions)
        success = bool(signals[:, SPEED].mean() >= self.slowest)
        episode = self.pressed(replace(episode, success=success))
        return replace(episode, observations=seen, reference_actions=POLICY.mean(seen[:-1]))

    def pressed(self, episode: Trajectory) -> Trajectory:
        """The same with this world's force."""
        return replace(episode, contact_force_n=np.full_like(episode.contact_force_n, self.force_n))


def reward(weight: float) -> StructuredReward:
    """Somebody who likes (+) or dislikes (-) speed."""
    weights = np.zeros((8, len(SIGNALS)))
    weights[:, SPEED] = weight
    return StructuredReward(weights)


@pytest.fixture(scope="module")
def reference() -> list[Trajectory]:
    return World().collect(POLICY.mean, first_of(GATE, 6), 0.0, 0)


def no_more() -> list[Trajectory]:
    """Nobody is in doubt."""
    raise AssertionError


@pytest.fixture(scope="module")
def surface() -> ResponseSurface:
    """Fitted to this world: what each mode does to the speed."""
    modes = FAMILY.sample(60, np.random.default_rng(0))
    world, deltas = World(), []
    plain = world.collect(POLICY.mean, [0], 0.0, 0)[0].signals.sum(axis=0)
    for mode in modes:
        act = mode_act(mode)
        deltas.append(world.collect(act, [0], 0.0, 0)[0].signals.sum(axis=0) - plain)
    return response_surface.fit(FAMILY, modes, np.array(deltas), np.ones(60))


def mode_act(mode: np.ndarray) -> Act:
    values = mode.astype(np.float32)

    def act(observation: np.ndarray) -> np.ndarray:
        action: np.ndarray = FAMILY.speed_factor(observation, values) * POLICY.mean(
            FAMILY.perceived(observation, values)
        )
        return action

    return act


def problem(weight: float, reference: list[Trajectory], **config: object) -> FilterProblem:
    """Fit a filter for somebody."""
    settings = replace(CONFIG, **config)  # type: ignore[arg-type]
    return FilterProblem(invented.TASK, POLICY, reward(weight).normalised_over(reference), 0, settings)


def speed_of(draft: FilterDraft) -> float:
    """Mean speed of a finished filter."""
    episodes = World().collect(act_of(FAMILY, POLICY, draft.weights), range(20), 0.0, 0)
    return float(np.mean([each.signals[:, SPEED].mean() for each in episodes]))


@pytest.mark.parametrize(("weight", "direction"), [(-1.0, -1), (1.0, 1)])
def test_the_whole_fit_moves_the_robot_where_the_person_wants_it(
    weight: float, direction: int, reference: list[Trajectory], surface: ResponseSurface
) -> None:
    torch.set_num_threads(1)
    draft = pbarl.fit_studio(problem(weight, reference), surface, Pool(), reference, no_more, World().collect)
    plain = float(np.mean([each.signals[:, SPEED].mean() for each in World().collect(POLICY.mean, range(20), 0.0, 0)]))
    assert direction * (speed_of(draft) - plain) > 0.1 * plain
    assert draft.weights.gate == 1.0
    assert set(draft.seconds) == {"mode", "residual_rollouts", "residual_learning", "gate_residual"}
    assert pickle.loads(pickle.dumps(draft)).weights.mode == draft.weights.mode  # noqa: S301


def _heard(stage: Callable[[ReportProgress], FilterDraft]) -> tuple[FilterDraft, list[float]]:
    """What it made, and the shares that it said were done."""
    shares = list[float]()
    return stage(lambda _, share: shares.append(share)), shares


def test_every_stage_says_how_far_it_is(reference: list[Trajectory], surface: ResponseSurface) -> None:
    torch.set_num_threads(1)
    asked, collect, draft = problem(1.0, reference, residual_rounds=3), World().collect, FilterDraft(FilterWeights())
    stages: tuple[Callable[[ReportProgress], FilterDraft], ...] = (
        lambda say: mode_search.find_mode(asked, surface, Pool(), reference, collect, say),
        lambda say: residual.train_residual(asked, draft, collect, say),
        lambda say: residual_gate.gate_residual(asked, draft, reference, no_more, collect, say),
    )
    for stage in stages:
        draft, shares = _heard(stage)
        assert len(set(shares)) > 1
        assert shares == sorted(shares)
        assert shares[0] == 0.0
        assert shares[-1] < 1.0


def test_who_cannot_wait_gets_the_first_mode_that_will_do(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    asked, world = problem(-1.0, reference), World()
    found = mode_search.find_mode_quickly(asked, surface, Pool(), reference, world.collect, 0.0)
    assert len(world.asked) == 1, "what is foreseen is so"
    assert found.trials[-1].preference > 0.0
    assert found.weights.gate == 1.0
    assert mode_search.find_mode_quickly(asked, surface, Pool(), reference, world.collect, 1e6).weights.moves_nothing
    assert len(world.asked) == 1, "no mode is driven of which no more is foreseen than there is"


def test_who_cannot_wait_gets_less_of_a_mode_that_presses(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    found = mode_search.find_mode_quickly(
        problem(-1.0, reference, gates=(0.4, 0.1)), surface, Pool(), reference, pressing, 0.0
    )
    assert found.weights.gate < 1.0
    assert found.trials[-1].pressed == 0.0


def test_a_mode_that_fails_the_task_is_turned_off(reference: list[Trajectory], surface: ResponseSurface) -> None:
    plain = min(each.signals[:, SPEED].mean() for each in reference)
    world = World(slowest=0.99 * plain)
    found = mode_search.find_mode(problem(-1.0, reference, mode_attempts=1), surface, Pool(), reference, world.collect)
    assert found.weights.moves_nothing
    assert [trial.gate for trial in found.trials] == [1.0, 0.4]
    assert "off" in found.notes[0]


def test_a_mode_that_fails_teaches_the_search_to_find_one_that_does_not(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    """The world forbids more than the surface knows: whoever is much slower than the reference fails."""
    plain = min(each.signals[:, SPEED].mean() for each in reference)
    world = World(slowest=0.55 * plain)
    found = mode_search.find_mode(problem(-1.0, reference, mode_attempts=4), surface, Pool(), reference, world.collect)
    assert found.trials[0].success_change < -0.9, "the first attempt must fail for the second to learn"
    assert found.trials[-1].success_change == 0.0
    assert found.trials[-1].preference > 0.0
    assert (found.weights.gate, found.notes) == (1.0, ())


def test_a_mode_that_was_tried_for_everybody_is_tried_too_and_taken_if_it_is_better(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    """The surface was fitted to the opposite, so that what it would seek is worse than nothing."""
    slowest = np.array([axis.low if axis.name.startswith("speed") else 0.0 for axis in FAMILY.axes])
    signals = np.zeros((1, len(SIGNALS)))
    signals[:, SPEED] = -1.0
    archive = ModeArchive(slowest[None], signals, np.zeros(1), np.zeros(1))
    wrong = replace(surface, coefficients=-surface.coefficients)
    asked = problem(-1.0, reference)
    without = mode_search.find_mode(asked, wrong, Pool(), reference, World().collect)
    found = mode_search.find_mode(asked, replace(wrong, archive=archive), Pool(), reference, World().collect)
    assert found.weights.mode == FAMILY.named(slowest)
    assert found.trials[-1].preference > max(0.0, *(each.preference for each in without.trials))
    assert found.trials[: CONFIG.mode_attempts] == without.trials[: CONFIG.mode_attempts]
    off = replace(asked, config=replace(asked.config, mode_attempts=0))
    assert not mode_search.find_mode(
        off, replace(wrong, archive=archive), Pool(), reference, World().collect
    ).weights.mode


def test_what_an_archive_says_of_modes_like_its_own_finds_one_that_is_better_than_all_of_them(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    """Nobody of the archive wants it as slow as this person; the surface knows hardly anything, and that is wrong."""
    slowest = np.array([axis.low if axis.name == "speed_far" else 0.0 for axis in FAMILY.axes])
    modes = np.outer([0.3, 0.6], slowest)
    archive = ModeArchive(modes, surface.predict(modes)[0], np.zeros(2), np.zeros(2))
    wrong = replace(surface, coefficients=-0.1 * surface.coefficients)
    found = mode_search.find_mode(
        problem(-1.0, reference), replace(wrong, archive=archive), Pool(), reference, World().collect
    )
    archived = found.trials[CONFIG.mode_attempts]
    assert found.weights.mode["speed_far"] < 0.75 * slowest.min()
    assert found.trials[-1].preference > 1.2 * archived.preference > 0.0


def pressing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
    """What World.collect() drives, where whoever is slower than 0.017 presses."""
    episodes = World().collect(act, scenarios, noise, seed)
    slow = [each.signals[:, SPEED].mean() < 0.017 for each in episodes]
    return [World(force_n=9.0 * presses).pressed(each) for presses, each in zip(slow, episodes, strict=True)]


def test_whoever_wants_what_presses_gets_the_best_of_what_an_archive_says_does_not(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    """Of three modes the two slower ones are known to press."""
    slowest = np.array([axis.low if axis.name.startswith("speed") else 0.0 for axis in FAMILY.axes])
    modes = np.outer([0.3, 0.7, 1.0], slowest)
    archive = ModeArchive(modes, surface.predict(modes)[0], np.zeros(3), np.array([0.0, 9.0, 9.0]))
    unaware, aware = (
        mode_search.find_mode(problem(-1.0, reference), each, Pool(), reference, pressing)
        for each in (surface, replace(surface, archive=archive))
    )
    assert unaware.weights.gate < 1.0, "all that is tried must press for an archive to be needed"
    assert aware.weights.gate == 1.0
    assert aware.trials[-1].pressed == 0.0
    assert aware.trials[-1].preference > 0.0


def test_what_an_archive_says_presses_is_never_tried(reference: list[Trajectory], surface: ResponseSurface) -> None:
    """Nothing presses in this world, so that only the archive can have kept the search from what is wanted most."""
    asked = problem(-1.0, reference, mode_attempts=1)
    unaware = mode_search.find_mode(asked, surface, Pool(), reference, World().collect)
    wanted = np.array([[unaware.weights.mode[name] for name in FAMILY.names]])
    archive = ModeArchive(wanted, surface.predict(wanted)[0], np.zeros(1), np.array([9.0]))
    aware = mode_search.find_mode(asked, replace(surface, archive=archive), Pool(), reference, World().collect)
    assert aware.trials[-1].preference > 0.0
    assert unaware.trials[0].preference not in [each.preference for each in aware.trials]


def test_trials_that_press_teach_what_does_not(reference: list[Trajectory], surface: ResponseSurface) -> None:
    found = mode_search.find_mode(problem(-1.0, reference, mode_attempts=5), surface, Pool(), reference, pressing)
    assert found.trials[0].pressed == 1.0
    assert found.weights.gate == 1.0
    assert found.trials[-1].pressed == 0.0


def test_a_filter_that_presses_too_hard_is_turned_off(reference: list[Trajectory], surface: ResponseSurface) -> None:
    def pressing(act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        episodes = World().collect(act, scenarios, noise, seed)
        return [replace(each, contact_force_n=np.full(STEPS, 30.0, np.float32)) for each in episodes]

    found = mode_search.find_mode(problem(-1.0, reference), surface, Pool(), reference, pressing)
    assert found.weights.moves_nothing


def test_somebody_who_has_said_nothing_yet_costs_no_rollouts(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    world = World()
    found = mode_search.find_mode(problem(0.0, reference), surface, Pool(), reference, world.collect)
    assert found.weights.moves_nothing
    assert "do not yet say" in found.notes[0]
    assert world.asked == []


def test_of_the_modes_that_keep_the_task_the_best_is_taken(
    reference: list[Trajectory], surface: ResponseSurface
) -> None:
    plain = min(each.signals[:, SPEED].mean() for each in reference)
    world = World(slowest=0.55 * plain)
    found = mode_search.find_mode(problem(-1.0, reference, mode_attempts=6), surface, Pool(), reference, world.collect)
    kept = [trial.preference for trial in found.trials if trial.success_change == 0.0]
    assert len(kept) > 1, "several attempts must succeed for one to be better"
    assert found.trials[-1].preference == max(kept) > 0.0


def test_the_gate_sees_that_more_of_what_is_liked_is_better_though_no_clip_has_shown_so_much(
    reference: list[Trajectory],
) -> None:
    asked = problem(1.0, reference)
    assert isinstance(asked.reward, StructuredReward)
    most = np.max([each.signals.mean(axis=0) for each in reference], axis=0)
    shown = replace(asked, reward=replace(asked.reward, most_per_step=most))
    quick, quicker = (
        try_on(
            shown, act_of(FAMILY, POLICY, FilterWeights(mode={"speed_far": fast})), 1.0, 0.0, reference, World().collect
        )[0].preference
        for fast in (0.25, 0.45)
    )
    assert quicker > 1.3 * quick > 0.0


def test_a_residual_is_learned_for_more_of_what_is_liked_though_no_clip_has_shown_so_much(
    reference: list[Trajectory],
) -> None:
    torch.set_num_threads(1)
    asked = problem(1.0, reference)
    assert isinstance(asked.reward, StructuredReward)
    slowest = 0.05 * np.min([each.signals.mean(axis=0) for each in reference], axis=0)
    shown = replace(asked, reward=replace(asked.reward, most_per_step=slowest))
    quick = FilterDraft(FilterWeights(mode={"speed_far": 0.3}))
    learned, limited = (residual.train_residual(each, quick, World().collect) for each in (asked, shown))
    assert speed_of(learned) > 1.1 * speed_of(quick)
    assert limited.weights.to_bytes() == learned.weights.to_bytes(), "by weights, whatever clips have shown"


def _failed(driven: Trajectory) -> Trajectory:
    """The same with the task undone, so that it earns nothing."""
    signals = driven.signals.copy()
    signals[-1, SIGNALS.index(UNDONE)] = 1.0
    return replace(driven, signals=signals, success=False)


def test_two_failures_in_eighty_scenarios_do_not_hide_what_is_better_in_all_others_but_many_do() -> None:
    """Of the mode and a little more of it, for somebody who likes speed."""
    scenarios = first_of(GATE, 80)
    reference = World().collect(POLICY.mean, scenarios, 0.0, 0)
    asked = problem(1.0, reference)
    asked = replace(asked, reward=replace(asked.reward, undone_column=SIGNALS.index(UNDONE)))
    acts = [act_of(FAMILY, POLICY, FilterWeights(mode={"speed_far": fast})) for fast in (0.3, 0.305)]
    quick, quicker = (World().collect(act, scenarios, 0.0, 0) for act in acts)

    def preference(driven: Sequence[Trajectory], failures: Sequence[int] = ()) -> float:
        seen = [_failed(each) if place in failures else each for place, each in enumerate(driven)]
        return trial_of(asked, 1.0, 0.0, reference, seen).preference

    assert preference(quicker) > preference(quick)
    assert preference(quicker, (5, 60)) > preference(quick)
    assert preference(quicker, range(0, 80, 4)) < preference(quick)
    assert preference(quick, (5, 60)) < preference(quick)


def test_what_was_refined_is_driven_no_further(reference: list[Trajectory], surface: ResponseSurface) -> None:
    def refined(draft: FilterDraft) -> FilterDraft:
        return replace(draft, weights=draft.weights.changed(refined=POLICY.weights))

    world, searching = World(), World()
    draft = pbarl.fit_studio(
        problem(-1.0, reference), surface, Pool(), reference, no_more, world.collect, refined=refined
    )
    mode_search.find_mode(problem(-1.0, reference), surface, Pool(), reference, searching.collect)
    assert draft.weights.refined
    assert not draft.weights.encoder
    assert world.asked == searching.asked


def test_learning_is_repeatable_and_later_rounds_go_on_from_earlier_ones(reference: list[Trajectory]) -> None:
    rollouts = World().collect(POLICY.mean, range(6), 0.3, 0)
    start = FilterDraft(FilterWeights(mode={"speed_far": -0.2}, gate=0.7))
    first, again = (learn_round(problem(-1.0, reference), start, [rollouts]) for _ in range(2))
    assert first.weights.to_bytes() == again.weights.to_bytes()
    assert first.weights.gate == 0.7
    second = learn_round(problem(-1.0, reference), first, [rollouts, rollouts])
    assert second.weights.to_bytes() != first.weights.to_bytes()
    assert set(second.value) == set(first.value) != set()


def test_noise_belongs_to_the_scenario_and_not_to_the_order() -> None:
    together = World().collect(POLICY.mean, [1, 2], 0.2, 5)
    alone = World().collect(POLICY.mean, [2], 0.2, 5)
    np.testing.assert_array_equal(together[1].actions, alone[0].actions)
    assert (together[0].actions != World().collect(POLICY.mean, [1], 0.2, 6)[0].actions).any()


def test_a_round_that_made_it_worse_is_taken_back_and_the_next_step_is_half_as_bold(
    reference: list[Trajectory],
) -> None:
    """Somebody dislikes speed; the first step of a careless learner makes the robot as fast as it can be."""
    slow, fast = FilterWeights(mode={"speed_far": -0.5}), FilterWeights(mode={"speed_far": 0.5})
    boldness, came_from = [], []

    def careless(asked: FilterProblem, draft: FilterDraft, rounds: Sequence[Sequence[Trajectory]]) -> FilterDraft:
        boldness.append(asked.config.preference_weight)
        came_from.append(draft.weights)
        return replace(draft, weights=fast if len(rounds) == 1 else draft.weights)

    dislikes_speed = problem(-1.0, reference, residual_rounds=3, preference_weight=1.0)
    found = residual.train_residual(
        dislikes_speed, FilterDraft(slow), World().collect, lambda stage, share: None, careless
    )
    assert came_from == [slow, slow, slow]
    assert boldness == [1.0, 0.5, 0.5]
    assert found.weights == slow


def test_a_task_of_longer_episodes_gets_fewer_of_them_and_no_more_time() -> None:
    config = FilterConfig(gate_scenarios=80, residual_rollouts=50)
    usual, long = replace(invented.TASK, episode_steps=100), replace(invented.TASK, episode_steps=130)
    assert [len(config.gate_block(task)) * task.episode_steps for task in (usual, long)] == [8000, 62 * 130]
    assert [len(config.residual_block(task, 0)) * task.episode_steps for task in (usual, long)] == [5000, 38 * 130]
    assert len(config.gate_block(replace(invented.TASK, episode_steps=50))) == 80


def test_only_the_first_round_learns_from_nothing_and_takes_all_steps() -> None:
    config = FilterConfig(value_steps=100, adapter_steps=20, later_share=0.5)
    assert [config.learning_steps(number) for number in range(3)] == [(100, 20), (50, 10), (50, 10)]
