"""The burden of proof: without a sure gain, a filter that costs anything is replaced by the reference policy."""

import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from worker.analysis.filters.proof import case_against
from worker.compute import filter_finishing, learning, simulation
from worker.compute.filter_finishing import Finished
from worker.compute.filter_fitting import FilterFit
from worker.compute.pools import Compute
from worker.domain.trajectory import SIGNALS, Trajectory
from worker.domain.type_aliases import Act
from worker.ml.export import bundle
from worker.ml.export.bundle import Provenance
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft
from worker.ml.filters.fitting.filter_problem import FilterConfig
from worker.ml.rewards.reward_models import StructuredReward


def measured(low: float, high: float, **worse: float) -> dict[str, Any]:
    """An evaluation in which the filter changed nothing but the preference and what is named."""
    success, cost = worse.pop("success", 0.0), worse.pop("C_f", 0.0)
    limits = {"max_force_n": 0.83, "p95_max_force_n": 0.5, "max_speed_m_s": 0.3, "p95_max_speed_m_s": 0.28}
    nothing = {"reference": 0.1, "filter": 0.1, "delta": 0.0, "low": -0.02, "high": 0.02}
    return {
        "preference": {"delta": (low + high) / 2, "low": low, "high": high},
        "success": {"reference": 0.97, "filter": 0.97 + success, "delta": success},
        "safety": {"reference": limits, "filter": {name: limits[name] + worse.get(name, 0.0) for name in limits}},
        "costs": {
            "C_f": {"reference": 0.1, "filter": 0.1 + cost, "delta": cost, "low": cost - 0.02, "high": cost + 0.02},
            **dict.fromkeys(("C_d", "C_v", "C_hf", "C_fd", "C_fdv"), nothing),
        },
    }


def test_an_unsure_gain_with_more_force_is_no_reason_to_change_the_robot() -> None:
    (reason,) = case_against(measured(-0.02, 0.07, max_force_n=0.76))
    assert reason == "the largest force 0.83 -> 1.59 N"


@pytest.mark.parametrize(
    "worse", [{"success": -0.02}, {"p95_max_force_n": 0.3}, {"max_speed_m_s": 0.03}, {"C_f": 0.03}], ids=str
)
def test_without_a_sure_gain_every_kind_of_harm_counts(worse: Mapping[str, float]) -> None:
    assert case_against(measured(-0.1, 0.2, **worse))
    assert not case_against(measured(0.01, 0.2, **worse)), "a sure gain is weighed by the gates, not here"


@pytest.mark.parametrize(
    "worse", [{}, {"success": -0.005}, {"max_force_n": 0.2}, {"max_speed_m_s": 0.01}, {"C_f": 0.01}], ids=str
)
def test_what_costs_nothing_may_stay_although_its_gain_is_not_sure(worse: Mapping[str, float]) -> None:
    assert not case_against(measured(-0.1, 0.2, **worse))


class HereAndNow(FilterFit):
    """Rolls out in this process."""

    def collect(self, act: Act, scenarios: Sequence[int], noise: float, seed: int) -> list[Trajectory]:
        return learning.run_scenarios(self.task, act, scenarios, noise, seed)


def finish(weights: FilterWeights, liked: Mapping[str, float]) -> Finished:
    """What is published of this filter for somebody with these weights of signals, over ten scenarios of Feeding."""
    row = np.zeros((8, len(SIGNALS)))
    for name, weight in liked.items():
        row[:, SIGNALS.index(name)] = weight
    fitting = HereAndNow(
        task="feeding",
        compute=Compute(1),
        beat=lambda: None,
        reward=StructuredReward(row).to_bytes(),
        seed=1,
        config=FilterConfig(evaluation_scenarios=10),
        progress=lambda _stage, _share: None,
        references={},
    )
    provenance = Provenance("demo", "P07", 1, 50, "ab" * 32, 1, "2026-01-02T03:04:05Z", "", "none")
    return filter_finishing.finish(fitting, FilterDraft(weights), provenance, {})


def test_the_published_filter_is_then_the_reference_policy_itself_and_says_so() -> None:
    finished = finish(FilterWeights(mode={"speed_far": 0.8}), {})
    manifest = bundle.verify(finished.bundle)
    assert finished.metrics["uses_reference"]
    assert manifest["uses_reference_policy"]
    assert finished.metrics["rejected"]["mode"] == {"speed_far": 0.8}, "what was tried is kept"
    with zipfile.ZipFile(io.BytesIO(finished.bundle)) as archive:
        card = archive.read("MODEL_CARD.md").decode()
        means, actions = (
            np.load(io.BytesIO(archive.read(f"recorded/{name}.npy"))) for name in ("policy_means", "actions")
        )
    np.testing.assert_array_equal(actions, np.clip(means, -1, 1))
    assert "This is the reference policy" in card
    assert "no sure gain" in card
    assert "speed" in card.partition("a price:")[2]
    assert finished.metrics["evaluation"]["preference"] == {"delta": 0.0, "low": 0.0, "high": 0.0}
    assert json.dumps(finished.metrics)


def test_a_sure_gain_is_published_although_it_is_quicker() -> None:
    finished = finish(FilterWeights(mode={"speed_far": 0.8}), {"distance_m": -1.0})
    assert finished.metrics["evaluation"]["preference"]["low"] > 0
    assert not finished.metrics["uses_reference"]
    assert finished.metrics["mode"] == {"speed_far": 0.8}


def test_the_mode_that_is_told_of_an_archived_policy_is_the_one_it_is_executed_in() -> None:
    policy = next(iter(simulation.archived_policies("feeding").values()))
    in_mode = FilterWeights(refined=policy.weights, refined_mode={"speed_far": 0.3})
    assert finish(in_mode, {"distance_m": -1.0}).metrics["mode"] == {"speed_far": 0.3}
