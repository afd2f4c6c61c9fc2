"""The promise about harm, earned: a filter is driven through scenarios of its own and weakened until it can be made."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from worker.analysis.filters.promise import BATCH, HarmTest, Outcome, Promise, counted
from worker.ml.filters.exported.filter_module import FilterWeights
from worker.ml.filters.fitting.filter_draft import FilterDraft

Drive = Callable[[FilterWeights, range], Sequence[Outcome]]
"""What came of a filter in these scenarios."""
DriveReference = Callable[[range], Sequence[Outcome]]
STRENGTHS = (1.0, 0.9, 0.8, 0.5)
"""of a filter, in the order of the tests; who harms a little too often mostly no longer does at .9 (decision 183)"""


def weakened_until_promised(
    draft: FilterDraft,
    promise: Promise,
    version: int,
    strengths: Sequence[float],
    scenarios: range,
    drive: Drive,
    drive_reference: DriveReference,
) -> FilterDraft:
    """The same filter at the first of these strengths at which the promise can be made of it, else none of it.

    ``version``: of this person's filters, from 1 on; ``scenarios``: used for nothing else, the first ones first.
    """
    tests = list[HarmTest]()
    for attempt, strength in enumerate(strengths):
        weights = draft.weights.changed(gate=draft.weights.gate * strength)
        error = promise.error_of(attempt, version)
        run = partial(drive, weights)
        tests.append(_tested(promise, strength, error, scenarios, run, drive_reference))
        if tests[-1].earned:
            return _with(replace(draft, weights=weights), promise, version, tests)
    note = "The promise about harm could be made at no strength of this filter; the reference policy is used as it is."
    none = replace(draft, weights=FilterWeights(gate=0.0), notes=(*draft.notes, note))
    return _with(none, promise, version, tests)


def untested(draft: FilterDraft, promise: Promise, version: int) -> FilterDraft:
    """A filter that changes nothing keeps every promise."""
    return _with(draft, promise, version, ())


def _with(draft: FilterDraft, promise: Promise, version: int, tests: Sequence[HarmTest]) -> FilterDraft:
    record: Mapping[str, Any] = {**asdict(promise), "version": version, "tests": [asdict(each) for each in tests]}
    return replace(draft, promise=record)


def _tested(
    promise: Promise,
    strength: float,
    error: float,
    scenarios: range,
    drive: DriveReference,
    drive_reference: DriveReference,
) -> HarmTest:
    """Batch by batch, until the promise is earned or lost."""
    pairs, most = list[tuple[Outcome, Outcome]](), min(promise.most(error), len(scenarios))
    while True:
        batch = scenarios[len(pairs) : min(len(pairs) + BATCH, most)]
        pairs += zip(drive_reference(batch), drive(batch), strict=True)
        test = counted(promise, pairs, strength, error)
        if test.earned or len(pairs) >= most or promise.is_lost(len(pairs), test.harmed, error):
            return test
