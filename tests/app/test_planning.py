"""What was planned, as the locked document and the times of the data tell it; and what pages say of it."""

from collections.abc import Callable
from datetime import datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, update

from app.db import Database, now
from app.domain.evaluation import Rating
from app.domain.preferences import Exclusion, LabelEvent, Query
from app.domain.protocol import PlannedTest
from app.domain.studies import Deviation, Study
from app.services.answers import exclusions
from app.services.exports import export_formats
from app.services.studies import locking, preregistration
from app.services.studies.preregistration import Plan, PlanStanding
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study

START = datetime.fromisoformat("2026-03-01T09:00:00+00:00")
ANSWERED, RATED, UNBLINDED = (START + timedelta(days=days) for days in (10, 20, 30))

Planned = Callable[..., Study]


@pytest.fixture
def planned(database: Database, store: ArtefactStore) -> Planned:
    """A study answered, rated and unblinded ten days after each other, and locked so many days after its start."""

    def make(locked_on_day: int | None) -> Study:
        with database.writing() as session:
            study = make_finished_study(session, store, 3, labels=4)
            session.execute(update(LabelEvent).values(created_at=ANSWERED))
            session.execute(update(Rating).values(created_at=RATED))
            study.unblinded_at = UNBLINDED
            if locked_on_day is not None:
                locking.lock(session, study, study.slug, "Ada")
                study.locked_at = START + timedelta(days=locked_on_day)
        return study

    return make


def plan_of(database: Database, study: Study) -> Plan:
    with database.reading() as session:
        return preregistration.plan_of(session, session.get_one(Study, study.id))


@pytest.mark.parametrize(
    ("locked_on_day", "standing", "may_be_called_planned"),
    [
        (None, PlanStanding.NOT_LOCKED, False),
        (5, PlanStanding.BEFORE_DATA, True),
        (10, PlanStanding.BEFORE_RATINGS, True),
        (15, PlanStanding.BEFORE_RATINGS, True),
        (20, PlanStanding.AFTER_RATINGS, False),
        (25, PlanStanding.AFTER_RATINGS, False),
        (30, PlanStanding.AFTER_UNBLINDING, False),
        (35, PlanStanding.AFTER_UNBLINDING, False),
    ],
)
def test_only_what_was_locked_before_the_first_rating_is_called_planned(
    database: Database,
    planned: Planned,
    locked_on_day: int | None,
    standing: PlanStanding,
    may_be_called_planned: bool,
) -> None:
    study = planned(locked_on_day)
    plan = plan_of(database, study)
    assert plan.standing is standing
    assert list(plan.planned) == (["paired_t"] if may_be_called_planned else [])
    assert ("every test is exploratory" in plan.in_words) is not may_be_called_planned


def test_answers_to_practice_and_of_previews_are_no_data(database: Database, store: ArtefactStore) -> None:
    with database.writing() as session:
        study = factories.make_study(session, evaluation={})
        person, _ = factories.make_participant(session, study)
        (query,) = factories.make_queries(session, store, person, 1)
        query.purpose = "practice"
        factories.make_label(session, query)
        guest, _ = factories.make_participant(session, study)
        guest.is_preview = True
        (query,) = factories.make_queries(session, store, guest, 1)
        factories.make_label(session, query)
        locking.lock(session, study, study.slug, "Ada")
    assert plan_of(database, study).standing is PlanStanding.BEFORE_DATA


def test_a_test_that_was_named_under_the_lock_is_not_planned(
    database: Database, store: ArtefactStore, planned: Planned
) -> None:
    study = planned(5)
    with database.writing() as session:
        locked = session.get_one(Study, study.id)
        settings = locked.settings.model_copy(update={"planned_tests": (PlannedTest.WILCOXON,)})
        locking.change(
            session,
            store,
            locked,
            name=locked.name,
            task=locked.task,
            seed=None,
            settings=settings,
            actor="Ada",
            reason="It looks better.",
        )
    plan = plan_of(database, study)
    assert (list(plan.planned), list(plan.added)) == (["paired_t"], ["wilcoxon"])
    assert "Named only after locking, and so not planned: Wilcoxon" in plan.in_words
    assert "Changes after locking: 1, of which 1 when there were ratings already." in plan.in_words


def test_a_change_before_anything_was_rated_is_told_apart(database: Database, planned: Planned) -> None:
    study = planned(5)
    with database.writing() as session:
        for at in (START + timedelta(days=6), now()):
            session.add(Deviation(study_id=study.id, at=at, actor="Ada", reason="So.", before={}, after={}))
    plan = plan_of(database, study)
    assert [plan.seen_before(each) for each in plan.deviations] == [False, True]


def exclude(database: Database, study: Study, place: int, day: int, reason: str) -> None:
    """Leave one of the answers out on that day; without a reason it is taken in again."""
    with database.writing() as session:
        here = session.get_one(Study, study.id)
        query_id = session.scalars(select(Query.id).order_by(Query.id)).all()[place]
        if reason:
            exclusions.exclude(session, here, query_id, reason, "Ada")
        else:
            exclusions.include(session, here, query_id, "Ada")
        session.flush()
        session.scalars(select(Exclusion).order_by(Exclusion.id)).all()[-1].at = START + timedelta(days=day)


def test_answers_excluded_after_locking_are_told_with_their_reasons_and_their_side_of_unblinding(
    experimenter: TestClient, database: Database, planned: Planned
) -> None:
    study = planned(5)
    exclude(database, study, 0, 4, "Was excluded before the lock.")
    exclude(database, study, 1, 4, "Was in again at the end.")
    exclude(database, study, 1, 6, "")
    exclude(database, study, 2, 12, "The phone rang.")
    exclude(database, study, 3, 13, "The phone rang.")
    exclude(database, study, 4, 31, "The phone rang.")
    exclude(database, study, 5, 14, "In and out again, as it was locked.")
    exclude(database, study, 5, 15, "")
    plan = plan_of(database, study)
    assert [(each.excluded, each.reason, each.after_unblinding, len(each.whose)) for each in plan.left_out] == [
        (False, "", False, 1),
        (True, "The phone rang.", False, 2),
        (True, "The phone rang.", True, 1),
    ]
    assert "Answers excluded or taken in again after locking: 4, of which 1 after unblinding." in plan.in_words
    assert "the page of results will tell" in experimenter.get(f"/studies/{study.slug}/answers/7").text
    assert "after locking: 4, of which 1 after unblinding" in experimenter.get(f"/studies/{study.slug}/lock").text


def test_in_a_study_that_is_not_locked_an_exclusion_is_no_deviation(database: Database, planned: Planned) -> None:
    study = planned(None)
    exclude(database, study, 0, 12, "The phone rang.")
    assert plan_of(database, study).left_out == []


def test_provenance_of_an_export_lists_the_changes(database: Database, planned: Planned) -> None:
    study = planned(5)
    with database.writing() as session:
        session.add(Deviation(study_id=study.id, actor="Ada", reason="Fewer people came.", before={}, after={}))
        assert (
            "Fewer people came." in export_formats.provenance_of(session, session.get_one(Study, study.id)).deviations
        )


def test_whoever_locks_after_the_first_rating_is_told_what_that_is_worth(
    experimenter: TestClient, planned: Planned
) -> None:
    study = planned(None)
    assert "A study that is locked now has no planned tests" in experimenter.get(f"/studies/{study.slug}/lock").text
