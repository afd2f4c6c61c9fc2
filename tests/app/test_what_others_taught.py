"""What participants are told of robots that others have taught, and the question which one is theirs."""

from collections.abc import Callable
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from pydantic import ValidationError
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import Rating
from app.domain.participation import FormAnswer
from app.domain.protocol import MADE_FOR_YOU, EvaluationSettings, FormItem, Language
from app.domain.study_settings import StudySettings
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import agree

OTHERS = ("pbarl", "somebody_else", "average")
TOLD = {Language.ENGLISH: "may have learned from other people", Language.GERMAN: "von anderen Menschen gelernt haben"}
STAYS = {Language.ENGLISH: "Nobody new is shown it", Language.GERMAN: "bekommt ihn nicht mehr zu sehen"}


@pytest.mark.parametrize("language", list(Language))
@pytest.mark.parametrize(("methods", "told"), [(OTHERS, True), (("reference", "pbarl"), False)])
def test_consent_and_withdrawal_say_who_is_shown_what_before_it_happens(
    database: Database,
    new_browser: Callable[[], TestClient],
    language: Language,
    methods: tuple[str, ...],
    told: bool,
) -> None:
    with database.writing() as session:
        own = {"consent-body": "Our own words."}
        evaluation = EvaluationSettings(methods=methods)
        study = factories.make_study(session, evaluation=evaluation, language=language, wording=own)
        _, token = factories.make_participant(session, study, ready=False)
    browser = new_browser()
    browser.get(f"/p/{token}")
    consent = browser.get("/p/consent").text
    assert "Our own words." in consent
    assert (TOLD[language] in consent) == told
    agree(browser)
    assert (STAYS[language] in browser.get("/p/withdraw").text) == told


@pytest.mark.parametrize("language", list(Language))
def test_after_the_ratings_people_name_a_letter_that_they_have_met(
    database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient], language: Language
) -> None:
    with database.writing() as session:
        evaluation = EvaluationSettings(methods=OTHERS, trials=1, ask_which_is_theirs=True)
        study = factories.make_study(session, evaluation=evaluation, language=language)
        person, token = factories.make_participant(session, study)
        factories.answer_everything(session, store, study, person)
        factories.make_robots(session, store, study, person)
    browser = new_browser()
    browser.get(f"/p/{token}")
    assert browser.get("/p/questionnaire", follow_redirects=False).status_code == 303, "not before they are rated"
    with database.writing() as session:
        for trial in evaluation_plan.trials_of(session, person.id):
            rating = Rating(trial_id=trial.id, revision=1, satisfaction=4, personalisation=3, client_uuid=str(uuid4()))
            session.add(rating)
    page = browser.get("/p/questionnaire").text
    assert {"en": "was made for you", "de": "wurde für Sie gemacht"}[language] in page
    assert [letter in page for letter in ('value="A"', 'value="C"', 'value="D"')] == [True, True, False]
    browser.post("/p/questionnaire", data={MADE_FOR_YOU: "D"})
    browser.post("/p/questionnaire", data={MADE_FOR_YOU: "B"})
    with database.reading() as session:
        said = session.scalars(select(FormAnswer).where(FormAnswer.item == MADE_FOR_YOU)).all()
    assert [each.value for each in said] == ["B"]


@pytest.mark.parametrize("methods", [("pbarl", "prefft"), ("reference", "average"), ("pbarl", "pbarl_printed")])
def test_it_is_asked_only_where_one_robot_alone_is_theirs(methods: tuple[str, ...]) -> None:
    with pytest.raises(ValidationError, match="only where one was"):
        EvaluationSettings(methods=methods, ask_which_is_theirs=True)


def test_a_study_cannot_ask_it_a_second_time() -> None:
    evaluation = EvaluationSettings(methods=OTHERS, ask_which_is_theirs=True)
    with pytest.raises(ValidationError, match="asked by the evaluation already"):
        StudySettings(evaluation=evaluation, questionnaire=(FormItem(name=MADE_FOR_YOU, kind="text"),))
