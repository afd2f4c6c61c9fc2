"""Reports are made when something is newer, not too often, and know letters only until somebody unblinds."""

import io
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pandas as pd
import pytest
from scipy import stats
from sqlalchemy import select

from app.db import Database, now
from app.domain.evaluation import Assignment
from app.domain.models import Report, Run, RunKind, RunStatus
from app.domain.preferences import Exclusion, LabelEvent, Query
from app.domain.protocol import MADE_FOR_YOU, Stage
from app.domain.studies import Participant, Study
from app.services.exports import export_formats, export_tables
from app.services.participants import forms, withdrawal
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study
from tests.worker.at_hand import AtHand
from worker.analysis.study import figures
from worker.jobs import reconcile
from worker.jobs.publishing import report_files
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "DPI", 30)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drawing them takes longest, and most tests look at numbers or at when a report is due."""
    monkeypatch.setattr(figures, "all_figures", lambda _contents: {})


@pytest.fixture
def finished(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        return make_finished_study(session, store, people=5, labels=6)


def due(context: WorkerContext, study: Study) -> list[Job]:
    with context.database.reading() as session:
        return report_files.due(session, session.get_one(Study, study.id))


def make_report(context: WorkerContext, study: Study) -> Report:
    """Make the report that is due, as the worker would."""
    (job,) = due(context, study)
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    report_files.make(context, job, run_id, lambda _name, function, *arguments: function(*arguments))
    with context.database.writing() as session:
        records.finish_run(session, run_id)
        return session.scalars(select(Report)).one()


def age(context: WorkerContext, by: timedelta, took: timedelta = timedelta(0)) -> None:
    with context.database.writing() as session:
        moment = now()
        for report in session.scalars(select(Report)):
            report.created_at = moment - by
            run = session.get_one(Run, report.run_id)
            run.started_at, run.finished_at = moment - took, moment


@pytest.mark.usefixtures("no_pictures")
def test_who_named_their_own_robot_is_counted_after_unblinding(context: WorkerContext, finished: Study) -> None:
    with context.database.writing() as session:
        study = session.get_one(Study, finished.id)
        study.unblinded_at = None
        methods = ("reference", "pbarl", "somebody_else")
        evaluation = {"methods": methods, "ask_which_is_theirs": True}
        study.stored_settings = {**study.stored_settings, "evaluation": evaluation}
        people = session.scalars(select(Participant).where(Participant.study_id == study.id)).all()
        own = select(Assignment).where(Assignment.method == "pbarl")
        letters = {each.participant_id: each.letter for each in session.scalars(own)}
        for person, is_right in zip(people, (True, True, True, False), strict=False):  # the fifth leaves it out
            letter = next(each for each in "ABC" if (each == letters[person.id]) == is_right)
            forms.record(session, person, Stage.QUESTIONNAIRE, study.settings.closing_form, {MADE_FOR_YOU: letter})
    blinded = make_report(context, finished).contents["guesses"]
    assert (blinded["people"], blinded["right"], blinded["p"]) == (4, None, None)
    with context.database.writing() as session:
        session.get_one(Study, finished.id).unblinded_at = now()
    found = make_report(context, finished).contents["guesses"]
    assert (found["people"], found["right"], found["robots"]) == (4, 3, 3)
    assert found["p"] == pytest.approx(stats.binomtest(3, 4, 1 / 3).pvalue)


def test_an_empty_study_has_no_report(context: WorkerContext) -> None:
    with context.database.writing() as session:
        study = factories.make_study(session)
    assert due(context, study) == []


@pytest.mark.usefixtures("no_pictures")
def test_reports_are_found_by_the_reconciler_and_only_while_something_is_newer(
    context: WorkerContext, finished: Study
) -> None:
    with context.database.reading() as session:
        assert RunKind.REPORT in {job.kind for job, _ in reconcile.due(session)}
    make_report(context, finished)
    age(context, timedelta(hours=1))
    assert due(context, finished) == []


@pytest.mark.usefixtures("no_pictures")
def test_a_new_rating_makes_a_new_report_but_not_at_once(context: WorkerContext, finished: Study) -> None:
    first = make_report(context, finished)
    with context.database.writing() as session:
        factories.make_rated_trials(session, session.scalars(select(Participant)).first(), 1)  # type: ignore[arg-type]
    assert due(context, finished) == []
    age(context, report_files.AT_MOST_EVERY)
    second = make_report(context, finished)
    assert (second.id, second.basis) != (first.id, first.basis)
    with context.database.reading() as session:
        runs = session.scalars(select(Run).where(Run.kind == RunKind.REPORT)).all()
        assert [run.id for run in runs] == [second.run_id], "older reports go with their runs"


@pytest.mark.usefixtures("no_pictures")
def test_an_excluded_answer_makes_a_new_report_without_it(context: WorkerContext, finished: Study) -> None:
    before = make_report(context, finished).contents["answers"]["participants"][0]
    age(context, timedelta(hours=1))
    with context.database.writing() as session:
        first = session.scalars(select(LabelEvent).join(Query).where(Query.ordinal == 2)).first()
        assert first is not None
        session.add(Exclusion(label_event_id=first.id, excluded=True, reason="phone", actor="x"))
    after = make_report(context, finished).contents["answers"]["participants"][0]
    assert (before["labels"], after["labels"]) == (6, 5)


@pytest.mark.usefixtures("no_pictures")
def test_on_a_busy_machine_reports_do_not_keep_people_s_models_waiting(context: WorkerContext, finished: Study) -> None:
    make_report(context, finished)
    with context.database.writing() as session:
        session.get_one(Study, finished.id).unblinded_at = now() - timedelta(days=1)
        factories.make_rated_trials(session, session.scalars(select(Participant)).first(), 1)  # type: ignore[arg-type]
    slow, very_slow = timedelta(seconds=9), timedelta(minutes=9)
    age(context, report_files.AT_MOST_EVERY, slow)
    assert due(context, finished) == []
    age(context, report_files.REST * slow, slow)
    assert len(due(context, finished)) == 1
    age(context, report_files.LONGEST_REST, very_slow)
    assert len(due(context, finished)) == 1, "somebody wants to see the end of it"


@pytest.mark.usefixtures("no_pictures")
def test_whoever_unblinds_a_study_does_not_wait_for_the_next_round(context: WorkerContext) -> None:
    with context.database.writing() as session:
        study = make_finished_study(session, context.store, people=3, labels=6, unblinded=False)
    make_report(context, study)
    assert due(context, study) == []
    with context.database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = now()
    assert len(due(context, study)) == 1


def test_one_report_is_made_at_a_time(context: WorkerContext, finished: Study) -> None:
    with context.database.writing() as session:
        factories.make_run(session, finished, kind=RunKind.REPORT, status=RunStatus.RUNNING)
    assert due(context, finished) == []


def test_pictures_of_an_older_report_go_with_it(context: WorkerContext, finished: Study) -> None:
    old = {each["svg"] for each in make_report(context, finished).figures.values()}
    with context.database.writing() as session:
        session.get_one(Study, finished.id).unblinded_at = None
    age(context, timedelta(minutes=1))
    new = {each["svg"] for each in make_report(context, finished).figures.values()}
    assert [sha256 for sha256 in old - new if context.store.has(sha256)] == []
    assert all(context.store.has(sha256) for sha256 in new)


def test_a_blinded_report_has_letters_and_no_tests(context: WorkerContext) -> None:
    with context.database.writing() as session:
        study = make_finished_study(session, context.store, people=4, unblinded=False)
    report = make_report(context, study)
    assert report.contents["ratings"]["groups"] == ["A", "B", "C"]
    assert report.contents["ratings"]["scales"]["satisfaction"]["comparisons"] == []
    text = repr(report.contents) + "".join(
        context.store.read(each["svg"]).decode() for name, each in report.figures.items() if name.startswith("ratings")
    )
    assert not any(name in text for name in ("pbarl", "prefft", "PbARL", "PrefFT", "Pre-trained"))


def test_somebody_who_withdraws_while_a_report_is_made_is_in_no_report(context: WorkerContext, finished: Study) -> None:
    (job,) = due(context, finished)
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)

    class Meanwhile(AtHand):
        def run(self, lane: Any, beat: Any, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            with context.database.writing() as session:
                person = session.scalars(select(Participant)).first()
                assert person is not None
                withdrawal.withdraw(session, context.store, person, "the person")
            return function(*args, **kwargs)

    other = WorkerContext(context.database, context.store, Meanwhile())
    stored = report_files._make(other, finished.id, run_id)
    with context.database.reading() as session:
        assert session.scalars(select(Report)).all() == []
    assert not any(context.store.has(sha256) for sha256 in stored)


@pytest.mark.usefixtures("no_pictures")
def test_numbers_of_the_report_are_those_of_the_exported_csv(context: WorkerContext, finished: Study) -> None:
    report = make_report(context, finished)
    with context.database.reading() as session:
        study = session.get_one(Study, finished.id)
        provenance = export_formats.provenance_of(session, study)
        lines = export_formats.csv_lines(export_tables.BY_NAME["ratings"], session, study, provenance)
        table = pd.read_csv(io.StringIO("".join(lines)))
    table = table[table.counts]
    assert len(table) == 5 * 9
    for scale in ("satisfaction", "personalisation"):
        means = table.groupby(["participant", "method"])[scale].mean().unstack()
        for comparison in report.contents["ratings"]["scales"][scale]["comparisons"]:
            first, second = comparison["first"], comparison["second"]
            paper = stats.ttest_ind(table[table.method == second][scale], table[table.method == first][scale])
            paired = stats.ttest_rel(means[second], means[first])
            assert comparison["two_sample_t"]["p"] == pytest.approx(paper.pvalue)
            assert comparison["paired_t"]["p"] == pytest.approx(paired.pvalue)
