"""The promise about harm: what counts, when it is earned, and how often it is made wrongly."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pytest

from tests.worker import invented
from worker.analysis.filters.promise import BATCH, Outcome, Promise, counted, harms, sentence
from worker.compute.harm_tests import STRENGTHS, weakened_until_promised
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft

PROMISE = Promise()
CALM, PRESSED = Outcome(2.0, 0.0, True), Outcome(9.0, 0.0, True)


@pytest.mark.parametrize(
    ("filtered", "harmed"),
    [
        (Outcome(7.0, 0.25, True), ()),
        (Outcome(7.1, 0.0, True), ("force",)),
        (Outcome(2.0, 0.26, True), ("spills",)),
        (Outcome(2.0, 0.0, False), ("failure",)),
        (Outcome(9.0, 1.0, False), ("force", "spills", "failure")),
    ],
)
def test_worse_by_more_than_the_limit_is_harm(filtered: Outcome, harmed: tuple[str, ...]) -> None:
    assert harms(PROMISE, CALM, filtered) == harmed


def test_who_fails_where_the_reference_fails_too_is_not_worse() -> None:
    assert not harms(PROMISE, Outcome(2.0, 0.0, False), Outcome(2.0, 0.0, False))


def test_without_harm_the_number_of_scenarios_is_that_of_the_likelihood_ratio() -> None:
    error = PROMISE.error_of(0, 1)
    enough = math.log(1 / error) / math.log(0.985 / 0.95)
    assert PROMISE.is_earned(math.ceil(enough), 0, error)
    assert not PROMISE.is_earned(math.floor(enough), 0, error)


def test_the_error_is_shared_among_all_strengths_and_all_versions_there_could_ever_be() -> None:
    spent = sum(PROMISE.error_of(attempt, version) for attempt in range(30) for version in range(1, 30_000))
    assert spent == pytest.approx(0.05, rel=1e-3)
    assert spent < 0.05


def test_the_filter_that_is_planned_as_the_last_earns_it_with_the_fewest_scenarios() -> None:
    needed = {version: PROMISE.needed(PROMISE.error_of(0, version)) for version in range(1, 6)}
    assert min(needed, key=needed.__getitem__) == PROMISE.planned == 3


def test_who_harms_two_fifths_as_often_as_promised_is_seldom_weakened() -> None:
    kept = [draft_of((0.02, 0.0, 0.0, 0.0), person, PROMISE.planned).weights.gate for person in range(100)]
    assert kept.count(1.0) >= 75


def draft_of(harm_rates: Sequence[float], seed: int, version: int = 1, promise: Promise = PROMISE) -> FilterDraft:
    """A filter whose strengths truly harm so often, after the tests."""
    rng = np.random.default_rng(seed)
    rate_of = dict(zip(STRENGTHS, harm_rates, strict=True))

    def drive(weights: FilterWeights, scenarios: range) -> list[Outcome]:
        return [PRESSED if harmed else CALM for harmed in rng.random(len(scenarios)) < rate_of[weights.gate]]

    draft = FilterDraft(FilterWeights(mode={"speed_far": 0.5}))
    return weakened_until_promised(
        draft, promise, version, STRENGTHS, range(4_000), drive, lambda some: [CALM] * len(some)
    )


def test_a_filter_that_harms_nobody_stays_as_it_is() -> None:
    kept = draft_of((0.0,) * 4, 0)
    assert kept.weights.gate == 1.0
    (test,) = kept.promise["tests"]
    assert (test["scenarios"], test["harmed"], test["earned"]) == (PROMISE.batches(128), 0, True)


def test_a_filter_that_harms_is_weakened_until_it_does_not() -> None:
    kept = draft_of((0.5, 0.0, 0.0, 0.0), 0)
    assert kept.weights.gate == 0.9
    assert [test["earned"] for test in kept.promise["tests"]] == [False, True]
    assert kept.promise["tests"][0]["scenarios"] == BATCH, "what is lost is not driven any further"


def test_one_that_harms_at_every_strength_becomes_the_reference_policy() -> None:
    kept = draft_of((0.5, 0.4, 0.4, 0.3), 0)
    assert kept.weights == FilterWeights(gate=0.0)
    assert "at no strength" in kept.notes[-1]


def test_at_the_promised_share_it_is_made_wrongly_no_more_often_than_stated() -> None:
    """All strengths and three versions of one person harm just as often as promised at most."""
    people, often = 400, Promise(share=0.3)

    def made_wrongly(person: int) -> bool:
        filters = (draft_of((0.3,) * 4, 10 * person + version, version, often) for version in (1, 2, 3))
        return any(each.weights.gate > 0.0 for each in filters)

    allowed = 0.05 * people
    assert 0 < sum(map(made_wrongly, range(people))) <= allowed + 3 * math.sqrt(allowed * 0.95)


def test_the_sentence_names_promise_confidence_and_scenarios() -> None:
    test = counted(PROMISE, [(CALM, PRESSED)] + [(CALM, CALM)] * 179, 0.6, 0.01)
    said = sentence({**asdict(PROMISE), "tests": [asdict(test)]}, uses_reference=False, task=invented.TASK)
    assert said == (
        "With 95 % confidence, in at most 5 % of scenarios it presses more than 5 N harder on the person, spills more"
        " than 25 % of the portion more, or fails where the reference policy succeeds. It was driven through 180"
        " scenarios that serve nothing else, and 1 of them went so. It was weakened to 60 % for this."
    )


def test_the_reference_policy_says_why_it_is_there() -> None:
    test = counted(PROMISE, [(CALM, PRESSED)] * 30, 1.0, 0.01)
    promise = {**asdict(PROMISE), "tests": [asdict(test)]}
    said = sentence(promise, uses_reference=True, task=invented.TASK)
    assert "the reference policy itself" in said
    assert "30 of 30 at 100 %" in said
