"""What a study says in its own words: in every language it offers, and what is missing is said to the experimenter."""

import re
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.participation import ConsentRecord, FormAnswer
from app.domain.protocol import FormItem, Language
from app.domain.studies import Deviation, Study
from app.domain.study_settings import StudySettings
from app.services.studies import locking
from app.web.texts.own_texts import missing_facts, missing_translations, own_texts, with_translations
from app.web.texts.wording import Wording, question_of, wording_for
from tests import factories
from tests.app.conftest import agree

HAND = FormItem(name="hand", kind="choice", question="Which hand do you write with?", choices=("left", "right"))
TRUST = FormItem(name="trust", kind="likert", question="I trust it.", low_label="never", high_label="always")
GERMAN = {
    "de:form-hand": "Mit welcher Hand schreiben Sie?",
    "de:form-hand-choice-1": "mit links",
    "de:form-hand-choice-2": "mit rechts",
    "de:form-trust": "Ich vertraue ihm.",
    "de:form-trust-low": "nie",
    "de:form-trust-high": "immer",
    "de:pair-question": "Welcher ist sanfter?",
}
OWN: dict[str, Any] = {"demographics": (HAND, TRUST), "question": "Which one is gentler?"}


@pytest.fixture
def come_in(database: Database, new_browser: Callable[[], TestClient]) -> Callable[..., TestClient]:
    """Makes a study with these settings; gives the browser of a participant who reads German."""

    def make(**settings: Any) -> TestClient:
        with database.writing() as session:
            study = factories.make_study(session, **settings)
            _, token = factories.make_participant(session, study, ready=False)
        browser = new_browser()
        browser.get(f"/p/{token}", headers={"Accept-Language": "de"})
        return browser

    return make


def stored(database: Database, kind: Any) -> Sequence[Any]:
    with database.reading() as session:
        return session.scalars(select(kind).order_by(kind.id)).all()


def test_own_questions_their_choices_and_ends_are_asked_in_the_persons_language(
    come_in: Callable[..., TestClient],
) -> None:
    browser = come_in(**OWN, wording=GERMAN)
    agree(browser)
    page = browser.get("/p/demographics").text
    for said in ("Mit welcher Hand schreiben Sie?", "mit links", "Ich vertraue ihm.", "1: nie", "5: immer"):
        assert said in page
    assert not any(said in page for said in ("Which hand", ">left<", "I trust it.", "always"))


def test_an_answer_is_stored_in_the_studys_words_whatever_language_it_was_given_in(
    come_in: Callable[..., TestClient], database: Database
) -> None:
    browser = come_in(**OWN, wording=GERMAN)
    agree(browser)
    browser.post("/p/demographics", data={"hand": "left", "trust": "5"})
    assert [(each.item, each.value) for each in stored(database, FormAnswer)] == [("hand", "left"), ("trust", "5")]


def test_the_question_above_the_pairs_is_translated_and_else_asked_as_it_is() -> None:
    settings = StudySettings(question="Which one is gentler?")
    assert question_of(wording_for(settings, "de"), settings) == "Which one is gentler?"
    translated = settings.model_copy(update={"wording": GERMAN})
    assert question_of(wording_for(translated, "de"), translated) == "Welcher ist sanfter?"
    assert question_of(wording_for(translated, "en"), translated) == "Which one is gentler?"


def test_whatever_is_said_in_own_words_is_missed_until_it_is_translated() -> None:
    settings = StudySettings(
        demographics=(HAND, TRUST, FormItem(name="age", kind="number")),
        question="Which one is gentler?",
        consent_payment="12 € per hour",
        wording={"consent-body": "Our own text.", "finished-title": "Ta"},
    )
    (missing,) = missing_translations(settings).values()
    assert set(missing) == {key.removeprefix("de:") for key in GERMAN} | {
        "consent-body",
        "finished-title",
        "fact-payment",
    }
    done = with_translations(settings, {f"de:{name}": "etwas" for name in missing})
    assert missing_translations(settings.model_copy(update={"wording": done})) == {}


def test_a_study_without_own_words_and_one_of_a_single_language_miss_nothing() -> None:
    assert own_texts(StudySettings()) == {}
    assert missing_translations(StudySettings(languages=(Language.ENGLISH,), question="Which?")) == {}


FACTS: dict[str, Any] = {
    "consent_duration": "about 45 minutes",
    "consent_payment": "12 € per hour",
    "consent_ethics": "Board 7, 2026-117",
    "consent_contact": "Ada, ada@example.org",
}


class TestTheConsentText:
    def test_it_says_what_the_study_says_and_is_kept_word_for_word_as_it_was_shown(
        self, come_in: Callable[..., TestClient], database: Database
    ) -> None:
        browser = come_in(**FACTS)
        page = browser.get("/p/consent").text
        agree(browser)
        (record,) = stored(database, ConsentRecord)
        shown = " ".join(re.sub(r"<[^>]+>", " ", page.split("<h1>")[1].split("<form")[0]).split())
        kept = " ".join(line.removeprefix("- ") for line in record.text.splitlines() if line)
        assert " ".join(kept.split()) == shown
        assert all(fact in record.text for fact in FACTS.values())

    def test_it_reads_well_when_only_some_is_known(self, come_in: Callable[..., TestClient]) -> None:
        page = come_in(consent_payment="12 € pro Stunde").get("/p/consent").text
        assert "Vergütung: 12 € pro Stunde" in page
        assert "Wenden Sie sich bitte an die Personen" in page
        assert not any(word in page for word in ("Dauer:", "Ethikvotum", "{", "None"))

    def test_own_text_says_it_where_it_wants_and_the_rest_follows(self, come_in: Callable[..., TestClient]) -> None:
        body = "It takes { $duration }.\n\n- One thing."
        page = come_in(**FACTS, wording={"consent-body": body}).get("/p/consent").text
        assert "It takes about 45 minutes." in page
        assert page.count("about 45 minutes") == 1
        assert "<li>One thing.</li><li>Vergütung: 12 € per hour</li>" in re.sub(r">\s+<", "><", page)

    def test_what_it_says_is_translated_too(self, come_in: Callable[..., TestClient]) -> None:
        page = come_in(**FACTS, wording={"de:fact-duration": "etwa 45 Minuten"}).get("/p/consent").text
        assert "Dauer: etwa 45 Minuten" in page
        assert "about 45" not in page

    def test_what_is_missing_is_known(self) -> None:
        assert missing_facts(StudySettings()) == ["duration", "payment", "ethics", "contact"]
        assert missing_facts(StudySettings(**FACTS)) == []
        own = StudySettings(wording={"consent-body": "Ask { $contact }. It takes an hour."})
        assert missing_facts(own) == ["contact"]

    def test_nobody_can_write_markup_or_another_text_into_it(self) -> None:
        settings = StudySettings(consent_contact="<b>{ $code }</b>")
        said = Wording(Language.ENGLISH)("consent-contact", contact=settings.consent_contact)
        assert said.endswith("<b>{ $code }</b>")


class TestTranslating:
    @pytest.fixture
    def study(self, database: Database) -> Study:
        with database.writing() as session:
            return factories.make_study(session, **OWN)

    def test_the_study_says_what_is_missing_and_where_to_write_it(self, experimenter: TestClient, study: Study) -> None:
        page = experimenter.get(f"/studies/{study.slug}").text
        assert "7 of your own texts have no German translation" in page
        assert "how long it takes, what people are given, who approved it, whom to ask" in page
        assert f'href="/studies/{study.slug}/translations"' in page

    def test_what_is_typed_is_kept_and_then_nothing_is_missing(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        answer = experimenter.post(f"/studies/{study.slug}/translations", data=GERMAN)
        assert answer.status_code == 303
        with database.reading() as session:
            assert session.get_one(Study, study.id).settings.wording == GERMAN
        assert "translation" not in experimenter.get(f"/studies/{study.slug}").text
        assert "Ich vertraue ihm." in experimenter.get(f"/studies/{study.slug}/translations").text

    def test_a_text_that_cannot_be_shown_is_refused_and_nothing_typed_is_lost(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        typed = {**GERMAN, "de:form-hand": "Eine { offene Klammer"}
        answer = experimenter.post(f"/studies/{study.slug}/translations", data=typed)
        assert answer.status_code == 422
        assert 'href="#de:form-hand"' in answer.text
        assert "Eine { offene Klammer" in answer.text
        assert "mit rechts" in answer.text
        with database.reading() as session:
            assert session.get_one(Study, study.id).settings.wording == {}

    def test_other_names_are_not_written(self, experimenter: TestClient, study: Study, database: Database) -> None:
        experimenter.post(f"/studies/{study.slug}/translations", data={"de:consent-title": "x", "en:pair-left": "y"})
        with database.reading() as session:
            assert session.get_one(Study, study.id).settings.wording == {}

    def test_a_locked_study_asks_why_and_notes_the_change_of_the_texts_alone(
        self, experimenter: TestClient, study: Study, database: Database
    ) -> None:
        with database.writing() as session:
            mine = session.get_one(Study, study.id)
            mine.stored_settings = {  # as a version stored them that knew fewer settings
                name: value
                for name, value in mine.stored_settings.items()
                if not name.startswith(("consent_d", "languages"))
            }
            locking.lock(session, mine, mine.slug, "someone")
        path = f"/studies/{study.slug}/translations"
        assert experimenter.post(path, data=GERMAN).status_code == 422
        assert experimenter.post(path, data={**GERMAN, "reason": "Asked for in German."}).status_code == 303
        (deviation,) = stored(database, Deviation)
        assert set(deviation.after) == {"wording"}
