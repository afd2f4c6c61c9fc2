"""Drafts survive being stored between two stages, and a filter that costs the task says so."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.worker import invented
from tests.worker.at_hand import AtHand
from worker.analysis.filters.promise import Outcome
from worker.compute import filter_finishing, filter_fitting, learning, simulation, stages
from worker.compute.filter_fitting import FilterFit
from worker.compute.pools import Lane
from worker.compute.refining import Training
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.exported.shield import limits_of
from worker.ml.filters.fitting.filter_draft import FilterDraft, GateTrial
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.filters.fitting.pool import Pool
from worker.ml.policies.checkpoint import Checkpoint
from worker.ml.reinforcement.refinement import Refinement
from worker.ml.reinforcement.refinement_gate import ArchivedDraft
from worker.ml.rewards.reward_models import StructuredReward
from worker.tasks import registry


def test_a_draft_comes_back_as_it_was_stored() -> None:
    weights = FilterWeights(
        mode={"speed_far": 0.1, "press": -0.2},
        gate=0.7,
        encoder={"layer": np.arange(6, dtype=np.float32).reshape(2, 3)},
    )
    trial = GateTrial(gate=0.7, residual_share=0.0, preference=0.4, success_change=-0.01, p95_force_n=2.0)
    tested, promised = {"change_low": np.zeros(7, np.float32)}, {"share": 0.05, "tests": []}
    draft = FilterDraft(
        weights, {"value": np.ones(3, np.float32)}, (trial,), ("a note",), {"mode": 1.5}, tested, promised
    )
    again = FilterDraft.from_bytes(draft.to_bytes())
    assert again.weights.mode == draft.weights.mode
    assert (again.weights.gate, again.trials, again.notes, again.seconds, again.promise) == (
        draft.weights.gate,
        draft.trials,
        draft.notes,
        draft.seconds,
        draft.promise,
    )
    np.testing.assert_array_equal(again.tested["change_low"], tested["change_low"])
    np.testing.assert_array_equal(again.weights.encoder["layer"], weights.encoder["layer"])
    np.testing.assert_array_equal(again.value["value"], draft.value["value"])


@pytest.mark.parametrize(("delta", "warned"), [(-0.10, True), (-0.035, False), (0.01, False)])
def test_a_filter_that_costs_more_success_than_allowed_warns_against_its_use(delta: float, warned: bool) -> None:
    warnings = filter_finishing._warnings({"success": {"delta": delta}}, tolerance=0.035)
    assert bool(warnings) == warned
    assert all("Do not run this filter on a person" in warning for warning in warnings)


@pytest.mark.parametrize("episodes", [40, 120, 500])
def test_a_usual_episode_rarely_counts_as_unusual(episodes: int) -> None:
    rng = np.random.default_rng(episodes)
    shares = rng.beta(0.2, 2.0, (4000, episodes + 1))
    false_alarms = [share > filter_finishing.usually_at_most(tested) for share, *tested in shares]
    assert 0.005 < np.mean(false_alarms) < 0.035


class Drives(AtHand):
    """Drives nothing, and knows where it should have."""

    def __init__(self) -> None:
        super().__init__()
        self.scenarios = set[int]()

    def run_all(self, lane: Lane, beat: Callable[[], None], function: Any, arguments: list[tuple[Any, ...]]) -> Any:
        """See Compute."""
        assert function is learning.run_scenarios
        self.scenarios.update(*(scenarios for _, _, scenarios, *_ in arguments))
        return [[] for _ in arguments]


class AtHome(AtHand):
    """Episodes of noise, of the reference policy in the scenarios of its home; nobody is ever harmed."""

    HOME = FilterConfig().home_block(invented.TASK)

    def run_all(self, lane: Lane, beat: Callable[[], None], function: Any, arguments: list[tuple[Any, ...]]) -> Any:
        """See Compute."""
        if function is learning.outcomes:
            return [[Outcome(0.0, 0.0, True)] * len(scenarios) for _, _, scenarios in arguments]
        assert {scenario for _, _, scenarios, *_ in arguments for scenario in scenarios} == set(self.HOME)
        return [[self.episode(scenario) for scenario in scenarios] for _, _, scenarios, *_ in arguments]

    @staticmethod
    def episode(scenario: int) -> Trajectory:
        """The same again in the same scenario."""
        return invented.trajectory(np.random.default_rng(scenario), scenario=scenario)


def test_a_shield_reaches_as_far_as_the_reference_policy_has_been_in_scenarios_that_no_filter_is_tried_in() -> None:
    few = [AtHome.episode(scenario) for scenario in FilterConfig().gate_block(invented.TASK)[:2]]
    tested = limits_of(invented.TASK.observation, invented.TASK.action, few, few)
    reward = StructuredReward(np.ones((1, len(SIGNALS)))).to_bytes()
    said = list[str]()
    fit = FilterFit(
        "feeding", AtHome(), lambda: None, reward, 0, FilterConfig(), lambda stage, _: said.append(stage), {}
    )
    kept = fit.keep_promise(FilterDraft(FilterWeights(mode={"press": 0.5}), tested=tested))
    assert kept.promise["tests"][-1]["earned"]
    seen = np.concatenate([AtHome.episode(scenario).observations for scenario in AtHome.HOME])
    assert (seen >= kept.weights.shield["observation_low"]).all()
    assert (seen <= kept.weights.shield["observation_high"]).all()
    assert (seen > tested["observation_high"]).any()
    assert "reach" in said[0]
    said.clear()
    fit.keep_promise(FilterDraft(FilterWeights(mode={"press": 0.5}), tested=tested))
    assert not any("reach" in each for each in said), "what is known is not driven again"


@pytest.mark.parametrize(("ahead", "tried"), [(True, False), (False, True)])
def test_who_waits_for_the_rest_does_not_wait_for_scenarios_of_looks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ahead: bool, tried: bool
) -> None:
    steps, compute, config = 1_000, Drives(), FilterConfig()
    monkeypatch.setattr(filter_fitting, "is_promising", lambda *_: True)
    monkeypatch.setattr(simulation, "archived_policies", lambda task: {})
    made = Refinement(steps).ahead_steps - (0 if ahead else 1)
    Checkpoint(tmp_path).write({"a": torch.zeros(1)}, {"steps": made})
    task = registry.task("feeding")
    reward = StructuredReward(np.ones((1, len(SIGNALS)))).to_bytes()
    fit = FilterFit(
        "feeding", compute, lambda: None, reward, 0, config, lambda stage, share: None, {}, stages=stages.REFINED
    )

    def nobody_needs_it(part: Callable[[Path], Sequence[FilterDraft]]) -> None: ...

    known: list[Trajectory] = []
    assert fit.refine(FilterDraft(FilterWeights()), known, steps, tmp_path, nobody_needs_it) is None
    assert bool(compute.scenarios & set(config.watch_block(task))) == tried


@pytest.mark.parametrize("is_ahead", [True, False])
def test_what_an_archived_policy_does_counts_until_its_refinement_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_ahead: bool
) -> None:
    steps, trained = 1_000, list[Training]()
    Checkpoint(tmp_path).write({"a": torch.zeros(1)}, {"steps": Refinement(steps).ahead_steps if is_ahead else 0})
    draft = FilterDraft(FilterWeights(refined=invented.small_policy(1).weights))
    best = [ArchivedDraft(draft, [AtHome.episode(7)])]
    monkeypatch.setattr(filter_fitting, "is_promising", lambda *_: True)
    monkeypatch.setattr(filter_fitting, "everything_archived", lambda task: [])
    monkeypatch.setattr(filter_fitting, "best_archived", lambda *_: best)
    reward = StructuredReward(np.ones((1, len(SIGNALS)))).to_bytes()
    fit = FilterFit(
        "feeding",
        Drives(),
        lambda: None,
        reward,
        0,
        FilterConfig(),
        lambda stage, share: None,
        {},
        stages=stages.REFINED,
    )

    def noted(part: Callable[[Path], Sequence[FilterDraft]]) -> None:
        assert isinstance(part, partial)
        trained.append(part.args[0])

    fit.refine(FilterDraft(FilterWeights()), list[Trajectory](), steps, tmp_path, noted)
    assert [each.start for each in trained] == best


class Episodes(AtHand):
    """Episodes of noise, and how many were driven by which policy or filter."""

    def __init__(self) -> None:
        super().__init__()
        self.driven = Counter[object]()

    def run_all(self, lane: Lane, beat: Callable[[], None], function: Any, arguments: list[tuple[Any, ...]]) -> Any:
        """See Compute."""
        for _, act, scenarios, *_ in arguments:
            self.driven[getattr(act, "__self__", act)] += len(scenarios)
        return [[AtHome.episode(scenario) for scenario in scenarios] for _, _, scenarios, *_ in arguments]


def test_what_archived_policies_do_is_driven_once_for_everybody(monkeypatch: pytest.MonkeyPatch) -> None:
    policies, scenarios = {"level": invented.small_policy(1), "soon": invented.small_policy(2)}, FilterConfig()
    monkeypatch.setattr(simulation, "archived_policies", lambda task: policies)
    compute, references = Episodes(), dict[tuple[str, range], list[Trajectory]]()
    count = len(scenarios.gate_block(invented.TASK))
    for wish in (1.0, -1.0):
        reward = StructuredReward(np.full((1, len(SIGNALS)), wish)).to_bytes()
        fit = FilterFit(
            "feeding",
            compute,
            lambda: None,
            reward,
            0,
            scenarios,
            lambda stage, share: None,
            references,
        )
        fit.choose_archived(FilterDraft(FilterWeights()), Pool([], []))
        assert [compute.driven[each] for each in policies.values()] == [count, count]
