"""The reference policy's rollouts are there before the first filter of a study needs them."""

from collections.abc import Iterator
from typing import cast

import numpy as np
import pytest

from app.db import Database
from app.domain.choices import Method
from app.domain.study_settings import StudySettings
from app.storage import ArtefactStore
from tests.worker import invented
from worker.analysis.filters.promise import Outcome
from worker.compute import simulation
from worker.compute.archived import everything_archived
from worker.compute.filter_fitting import FilterFit, driven_as
from worker.compute.pools import Compute
from worker.domain.scenarios import of_promise
from worker.jobs.learning.fits import filter_config
from worker.jobs.learning.reference_rollouts import make_ready, promise_block, reference_blocks
from worker.jobs.runtime.context import WorkerContext

SETTINGS = StudySettings(evaluation_scenarios=10)


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> Iterator[WorkerContext]:
    compute = Compute(2)
    yield WorkerContext(database, store, compute)
    compute.close()


def fitting(context: WorkerContext) -> FilterFit:
    return FilterFit(
        task="feeding",
        compute=context.compute,
        beat=lambda: None,
        reward=b"",
        seed=7,
        config=filter_config(SETTINGS),
        progress=lambda stage, share: None,
        references=context.references,
        study_seed=5,
        outcomes=context.outcomes,
    )


@pytest.mark.long
def test_they_are_those_a_filter_would_make_for_itself(context: WorkerContext) -> None:
    evaluation = reference_blocks("feeding", SETTINGS)[-1]
    own = fitting(context).reference(evaluation)
    del context.references["feeding", evaluation]
    make_ready(context.compute, context.references, context.outcomes, "feeding", SETTINGS, 5)
    cast("Compute", context.compute).close()  # whatever was missing now could not be made any more
    for scenarios in reference_blocks("feeding", SETTINGS):
        assert [each.scenario for each in fitting(context).reference(scenarios)] == list(scenarios)
    gate, *_ = reference_blocks("feeding", SETTINGS)
    for archived in fitting(context)._archived(lambda stage, share: None):
        assert [each.scenario for each in archived.driven] == list(gate)
    drawn = promise_block(SETTINGS, 5)
    assert fitting(context)._reference_outcomes(drawn) == context.outcomes["feeding", drawn.start]
    for ahead, mine in zip(fitting(context).reference(evaluation), own, strict=True):
        np.testing.assert_array_equal(ahead.observations, mine.observations)
        np.testing.assert_array_equal(ahead.actions, mine.actions)


def test_what_is_there_is_not_made_again(context: WorkerContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulation, "reference_policy", lambda _: invented.small_policy())  # others trace its filters
    for scenarios in reference_blocks("feeding", SETTINGS):
        context.references["feeding", scenarios] = []
    gate, *_ = reference_blocks("feeding", SETTINGS)
    for each in everything_archived("feeding"):
        context.references[driven_as("feeding", each.name), gate] = []
    met = [Outcome(0.0, 0.0, True)] * len(promise_block(SETTINGS, 5))
    context.outcomes["feeding", of_promise(5).start] = met
    cast("Compute", context.compute).close()
    make_ready(context.compute, context.references, context.outcomes, "feeding", SETTINGS, 5)
    assert set(map(len, context.references.values())) == {0}
    assert list(context.outcomes.values()) == [met]


def test_a_gate_refuses_what_could_not_be_promised_in_this_study() -> None:
    strict = filter_config(StudySettings(harm_force_n=2, harm_share=0.02))
    assert (strict.pressed_n, strict.pressed_tolerance) == (2, 0.014)


def test_the_printed_method_which_has_no_gates_needs_the_evaluation_s_only() -> None:
    printed = SETTINGS.model_copy(update={"method": Method.PRINTED})
    assert reference_blocks("feeding", printed) == reference_blocks("feeding", SETTINGS)[-1:]
