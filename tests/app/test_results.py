"""The page of results: honest while there is nothing, by letters while blinded, planned tests marked."""

import re
from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pandas as pd
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.evaluation import DonorDraw
from app.domain.models import Report, RunStatus
from app.domain.preferences import Query, Response
from app.domain.protocol import EvaluatedMethod, PlannedTest
from app.domain.studies import Participant, Study
from app.services.answers import exclusions
from app.services.evaluation import donors
from app.services.monitoring import dashboard
from app.services.studies import locking
from app.storage import ArtefactStore
from app.web.texts.templating import signed_points
from tests import factories
from tests.finished_study import make_finished_study
from tests.made_once import made_once
from worker.analysis.study.report import make_report
from worker.analysis.study.statistics import MEASURED_ERROR_PERCENT, rating_report
from worker.jobs.publishing import report_files

Finished = Callable[..., Study]


@pytest.fixture
def finished(database: Database, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> Finished:
    """Makes a finished study with the report that the worker would make, without pictures but one."""
    monkeypatch.setattr("worker.analysis.study.figures.all_figures", lambda _contents: {})

    def make(people: int = 3, *, unblinded: bool = True, locked: bool = False) -> Study:
        with database.writing() as session:
            return session.get_one(Study, made_once(_with_report, session, store, people, unblinded, locked))

    return make


def _with_report(session: Session, store: ArtefactStore, people: int, unblinded: bool, locked: bool) -> int:
    study = make_finished_study(session, store, people, labels=4, unblinded=unblinded)
    if locked:
        locking.lock(session, study, study.slug, "Ada")
        study.locked_at = now() - timedelta(days=1)
    contents, _ = make_report(report_files.tables_of(session, study))
    run = factories.make_run(session, study, kind="report")
    figures: dict[str, Any] = {"ratings": {"svg": store.put(b"<svg/>"), "png": store.put(b"png")}}
    session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures=figures))
    return study.id


def results(browser: TestClient, study: Study) -> str:
    answer = browser.get(f"/studies/{study.slug}/results")
    assert answer.status_code == 200
    return answer.text


def test_whose_filters_were_shown_is_counted_once_the_study_is_unblinded(
    experimenter: TestClient, finished: Finished, database: Database
) -> None:
    study = finished(unblinded=False)
    with database.writing() as session:
        for person in session.scalars(select(Participant)):
            donors.draw(session, study, person, EvaluatedMethod.SOMEBODY_ELSE, ("neutral",))
    assert "by whose it was" not in results(experimenter, study)
    with database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = now()
    with database.reading() as session:
        rules = Counter(session.scalars(select(DonorDraw.rule)))
    assert f"another participant\N{RIGHT SINGLE QUOTATION MARK}s: {rules['by_lot']}" in results(experimenter, study)


def test_without_answers_the_page_says_what_it_waits_for(database: Database, experimenter: TestClient) -> None:
    with database.writing() as session:
        study = factories.make_study(session)
    assert "Nothing to report yet" in results(experimenter, study)


def test_planned_tests_are_marked_and_all_others_are_exploratory(experimenter: TestClient, finished: Finished) -> None:
    text = results(experimenter, finished(locked=True))
    comparisons, scales, kinds = 3, 2, 6
    questionnaire = comparisons * 6 * 2
    """Six scores of the standard questionnaire, two tests: never planned, for plans are about ratings."""
    assert text.count('tag-planned">planned') == comparisons * scales
    assert text.count(">exploratory<") == comparisons * scales * (kinds - 1) + questionnaire
    assert "Planned tests were locked before the first answer." in text


@pytest.mark.parametrize("evaluated", [True, False])
def test_answers_excluded_after_locking_stand_beside_the_plan_with_their_reasons(
    experimenter: TestClient, finished: Finished, database: Database, evaluated: bool
) -> None:
    study = finished(locked=True)
    with database.writing() as session:
        there = session.get_one(Study, study.id)
        if not evaluated:
            there.stored_settings = there.stored_settings | {"evaluation": None}
        for query_id in session.scalars(select(Query.id).order_by(Query.id).limit(2)):
            exclusions.exclude(session, there, query_id, "The <phone> rang.", "Ada")
    text = " ".join(results(experimenter, study).split())
    side = " after unblinding" if evaluated else ""
    assert f"2 answers of P01 excluded{side}: The &lt;phone&gt; rang." in text
    assert ("First rating" in text) is evaluated


def test_no_test_of_a_study_that_was_never_locked_is_called_planned(
    experimenter: TestClient, finished: Finished
) -> None:
    text = results(experimenter, finished())
    assert "tag-planned" not in text
    assert "The study was never locked" in text


def test_a_test_named_under_the_lock_is_exploratory_and_the_change_is_listed(
    database: Database, store: ArtefactStore, experimenter: TestClient, finished: Finished
) -> None:
    study = finished(locked=True)
    with database.writing() as session:
        locked = session.get_one(Study, study.id)
        settings = locked.settings.model_copy(update={"planned_tests": (PlannedTest.WILCOXON,)})
        name, task = locked.name, locked.task
        locking.change(
            session, store, locked, name=name, task=task, seed=None, settings=settings, actor="Ada", reason="Nicer."
        )
    text = results(experimenter, study)
    assert re.search(r"Paired t<span class=\"tag tag-planned\">planned", text)
    assert re.search(r"Wilcoxon signed-rank<span class=\"tag \">exploratory", text)
    assert "Nicer." in text
    assert "after the first rating" in text


def test_the_page_says_which_test_to_rely_on_and_how_often_the_papers_errs(
    experimenter: TestClient, finished: Finished
) -> None:
    text = " ".join(results(experimenter, finished()).split())
    assert "Rely on the paired t test" in text
    for row in MEASURED_ERROR_PERCENT:
        assert f'<th scope="row">{row["people"]}</th><td data-label="Paired t">' in text
        assert f"{row['two_sample_t']['percent']:.1f} %" in text


def test_a_report_of_an_earlier_version_is_not_shown_but_made_again(
    database: Database, experimenter: TestClient, finished: Finished
) -> None:
    study = finished()
    with database.writing() as session:
        report = session.scalars(select(Report)).one()
        report.contents = {**report.contents, "version": 1}
    assert "The report is being made again" in results(experimenter, study)


def test_dashboard_and_results_have_the_same_figures_of_a_person(
    database: Database, experimenter: TestClient, finished: Finished
) -> None:
    study = finished(people=1)
    with database.reading() as session:
        (row,) = dashboard.study_overview(session, session.get_one(Study, study.id)).rows
        (person,) = session.scalars(select(Report)).one().contents["answers"]["participants"]
    judged, curve = row.watched.consistency, row.curve
    assert person["median_response_ms"] == judged.median_response_ms
    assert {each.value: person[each.value] for each in Response} == row.counts
    assert curve.overall is not None
    assert (person["accuracy"]["correct"], person["accuracy"]["low"]) == (curve.overall.correct, curve.overall.low)
    assert person["curve"] == [[point.scored, point.recent.value] for point in curve.points]
    assert person["foresight"] == curve.foresight
    assert judged.repeats.agreement is not None
    assert (person["test_retest"]["same"], person["test_retest"]["asked"]) == (
        judged.repeats.agreement.correct,
        judged.repeats.agreement.scored,
    )


@pytest.mark.parametrize(("change", "shown"), [(-0.0004, "+0.0"), (-0.0006, "\N{MINUS SIGN}0.1"), (0.05, "+5.0")])
def test_what_is_rounded_to_nothing_has_no_minus(change: float, shown: str) -> None:
    assert signed_points(change) == shown


def test_tests_that_need_more_people_say_how_many(experimenter: TestClient, finished: Finished) -> None:
    text = results(experimenter, finished(people=2))
    assert "Not computable because 2 people have rated both; 3 are needed." in text
    assert "paired tests and the mixed models compare each person with themselves" in text


def test_a_blinded_study_shows_letters_and_no_tests(experimenter: TestClient, finished: Finished) -> None:
    text = results(experimenter, finished(unblinded=False))
    assert "Robot A" in text
    assert "This study is blinded" in text
    assert not any(name in text for name in ("PrefFT", "Pre-trained", "Holm"))


def test_a_report_that_failed_can_be_asked_for_again(
    database: Database, experimenter: TestClient, finished: Finished
) -> None:
    study = finished()
    with database.writing() as session:
        factories.make_run(session, study, kind="report", status=RunStatus.FAILED, error="It broke.")
    text = results(experimenter, study)
    assert "It broke." in text
    assert "Try again" in text


def test_figures_are_shown_and_cannot_run_anything(experimenter: TestClient, finished: Finished) -> None:
    study = finished()
    assert f"/studies/{study.slug}/results/figures/ratings.svg" in results(experimenter, study)
    answer = experimenter.get(f"/studies/{study.slug}/results/figures/ratings.svg")
    assert (answer.content, answer.headers["content-type"]) == (b"<svg/>", "image/svg+xml")
    assert "sandbox" in answer.headers["content-security-policy"]
    assert experimenter.get(f"/studies/{study.slug}/results/figures/secrets.svg").status_code == 404


def test_between_arms_order_and_equivalence_are_on_the_page_and_in_the_text(
    experimenter: TestClient, finished: Finished, database: Database
) -> None:
    study = finished()
    said = {"reference": (2, 3, 3, 2, 4), "prefft": (3, 2, 3, 2, 4), "pbarl": (5, 4, 5, 4, 4)}
    people = [
        (f"{method}{number}", method, value) for method, all_of in said.items() for number, value in enumerate(all_of)
    ]
    rows = pd.DataFrame(people, columns=["participant", "method", "satisfaction"])
    with database.writing() as session:
        report = session.scalars(select(Report)).one()
        ratings = rating_report(rows.assign(personalisation=rows["satisfaction"]), list(said), between=True, bound=1.0)
        report.contents = {**report.contents, "ratings": ratings}
        here = session.get_one(Study, study.id)
        arms = [{"name": f"arm{place}", "methods": [method]} for place, method in enumerate(said)]
        here.stored_settings = {**here.stored_settings, "arms": arms}
    text = " ".join(results(experimenter, study).split())
    equal, order = (
        ratings["scales"]["satisfaction"]["comparisons"][0][f"{name}_between"]
        for name in ("equivalence", "cumulative_link")
    )
    assert f"t({round(equal['degrees_of_freedom'])}) =" in text
    assert "shown to be less than 1 points apart, 5 and 5 people" in text
    assert "5 and 5 people, 10 ratings" in text
    paper = experimenter.get(f"/studies/{study.slug}/results/methods_and_results.md").text
    assert f"odds ratio of a higher rating {order['odds_ratio']:.2f}" in paper
    assert re.search(
        r"\| Equivalence, two one-sided Welch t, between people \| exploratory \| difference 0\.00, 90 %", paper
    )
    assert "n = 5 and 5 people, 10 ratings" in paper
