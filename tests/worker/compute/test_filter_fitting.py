"""Drafts survive being stored between two stages, and a filter that costs the task says so."""

import numpy as np
import pytest

from worker.compute import filter_fitting
from worker.ml.filters.filter_module import FilterWeights
from worker.ml.filters.filter_problem import FilterDraft, GateTrial


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
    again = filter_fitting.draft_from_bytes(filter_fitting.draft_to_bytes(draft))
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
    warnings = filter_fitting._warnings({"success": {"delta": delta}}, tolerance=0.035)
    assert bool(warnings) == warned
    assert all("Do not run this filter on a person" in warning for warning in warnings)
