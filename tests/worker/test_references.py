"""The reference policy's rollouts are there before the first filter of a study needs them."""

from collections.abc import Iterator
from typing import cast

import numpy as np
import pytest

from app.db import Database
from app.domain.choices import Method
from app.domain.study_settings import StudySettings
from app.storage import ArtefactStore
from worker.compute.filter_fitting import Fitting
from worker.compute.pools import Compute
from worker.jobs.learning.filters import filter_config
from worker.jobs.learning.reference_rollouts import make_ready, reference_blocks
from worker.jobs.runtime.context import Workplace

SETTINGS = StudySettings(evaluation_scenarios=10)


@pytest.fixture
def place(database: Database, store: ArtefactStore) -> Iterator[Workplace]:
    compute = Compute(2)
    yield Workplace(database, store, compute)
    compute.close()


def fitting(place: Workplace) -> Fitting:
    return Fitting(
        task="feeding",
        compute=place.compute,
        beat=lambda: None,
        reward=b"",
        seed=7,
        config=filter_config(SETTINGS),
        progress=lambda stage, share: None,
        references=place.references,
    )


def test_they_are_those_a_filter_would_make_for_itself(place: Workplace) -> None:
    evaluation = reference_blocks("feeding", SETTINGS)[-1]
    own = fitting(place).reference(evaluation)
    del place.references["feeding", evaluation]
    make_ready(place.compute, place.references, "feeding", SETTINGS)
    cast("Compute", place.compute).close()  # whatever was missing now could not be made any more
    for scenarios in reference_blocks("feeding", SETTINGS):
        assert [each.scenario for each in fitting(place).reference(scenarios)] == list(scenarios)
    for ahead, mine in zip(fitting(place).reference(evaluation), own, strict=True):
        np.testing.assert_array_equal(ahead.observations, mine.observations)
        np.testing.assert_array_equal(ahead.actions, mine.actions)


def test_what_is_there_is_not_made_again(place: Workplace) -> None:
    for scenarios in reference_blocks("feeding", SETTINGS):
        place.references["feeding", scenarios] = []
    cast("Compute", place.compute).close()
    make_ready(place.compute, place.references, "feeding", SETTINGS)
    assert set(map(len, place.references.values())) == {0}


def test_the_printed_method_which_has_no_gates_needs_the_evaluation_s_only() -> None:
    printed = SETTINGS.model_copy(update={"method": Method.PRINTED})
    assert reference_blocks("feeding", printed) == reference_blocks("feeding", SETTINGS)[1:]
