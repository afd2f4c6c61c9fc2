"""The page of results: honest while there is nothing, by letters while blinded, planned tests marked."""

from collections.abc import Callable
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.models import Report, RunStatus
from app.domain.studies import Study
from app.storage import ArtefactStore
from tests import factories
from tests.finished_study import make_finished_study
from worker import report_work
from worker.analysis.report import make_report

Finished = Callable[..., Study]


@pytest.fixture
def finished(database: Database, store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> Finished:
    """Makes a finished study with the report that the worker would make, without pictures but one."""
    monkeypatch.setattr("worker.analysis.figures.all_figures", lambda _contents: {})

    def make(people: int = 3, *, unblinded: bool = True) -> Study:
        with database.writing() as session:
            study = make_finished_study(session, store, people, labels=4, unblinded=unblinded)
            contents, _ = make_report(report_work.tables_of(session, study))
            run = factories.make_run(session, study, kind="report")
            figures: dict[str, Any] = {"ratings": {"svg": store.put(b"<svg/>"), "png": store.put(b"png")}}
            session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures=figures))
        return study

    return make


def results(browser: TestClient, study: Study) -> str:
    answer = browser.get(f"/studies/{study.slug}/results")
    assert answer.status_code == 200
    return answer.text


def test_without_answers_the_page_says_what_it_waits_for(database: Database, experimenter: TestClient) -> None:
    with database.writing() as session:
        study = factories.make_study(session)
    assert "Nothing to report yet" in results(experimenter, study)


def test_planned_tests_are_marked_and_all_others_are_exploratory(experimenter: TestClient, finished: Finished) -> None:
    text = results(experimenter, finished())
    comparisons, scales, kinds = 3, 2, 4
    assert text.count('tag-planned">planned') == comparisons * scales
    assert text.count(">exploratory<") == comparisons * scales * (kinds - 1)
    assert "never locked, so nothing proves it" in text


def test_tests_that_need_more_people_say_how_many(experimenter: TestClient, finished: Finished) -> None:
    text = results(experimenter, finished(people=3))
    assert "Not computable because 3 people have rated what is compared; 5 are needed." in text
    assert "the paired tests and the mixed model compare each person with themselves" in text


def test_two_people_get_no_paired_tests(experimenter: TestClient, finished: Finished) -> None:
    assert "2 people have rated what is compared; 3 are needed" in results(experimenter, finished(people=2))


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
