"""The way from the welcome to the end: in order, resumable, and never further than one has come."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.participation import ConsentRecord, FormAnswer, StageRecord
from app.domain.preferences import Purpose, Query
from app.domain.protocol import EvaluationSettings, FormItem, Stage
from app.domain.studies import Participant, Study
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.services.participants import stages
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import agree

DEMOGRAPHICS = (
    FormItem(name="age", kind="number"),
    FormItem(name="hand", kind="choice", question="Which hand do you write with?", choices=("left", "right")),
    FormItem(name="robot_experience", kind="likert"),
)
QUESTIONNAIRE = (FormItem(name="felt_safe", kind="likert"), FormItem(name="comments", kind="text"))


@dataclass
class OnTheWay:
    """Somebody who has just opened the link."""

    browser: TestClient
    participant: Participant
    study: Study
    token: str
    database: Database
    store: ArtefactStore

    def where(self) -> str:
        """The address /p/next leads to; /p/next itself while pairs are compared."""
        return self.browser.get("/p/next").headers.get("location", "/p/next")

    def answer_all(self, purpose: Purpose, count: int) -> None:
        """Every pair of a purpose, as if given on the pages."""
        with self.database.writing() as session:
            person = session.get_one(Participant, self.participant.id)
            for query in factories.make_queries(session, self.store, person, count):
                query.purpose = purpose
                factories.make_label(session, query)

    def rows(self, kind: Any) -> Sequence[Any]:
        """Everything stored of a kind."""
        with self.database.reading() as session:
            return session.scalars(select(kind).order_by(kind.id)).all()


@pytest.fixture
def begin(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> Callable[..., OnTheWay]:
    """Makes a study with these settings and opens its first participant's link."""

    def make(*, ready: bool = False, **settings: Any) -> OnTheWay:
        with database.writing() as session:
            study = factories.make_study(session, **settings)
            participant, token = factories.make_participant(session, study, ready=ready)
        browser = new_browser()
        browser.get(f"/p/{token}")
        return OnTheWay(browser, participant, study, token, database, store)

    return make


@pytest.fixture
def whole_way(begin: Callable[..., OnTheWay]) -> OnTheWay:
    """Every stage but the evaluation, which others bring."""
    return begin(
        demographics=DEMOGRAPHICS, practice_pairs=1, questionnaire=QUESTIONNAIRE, debrief=True, completion_code="C0DE"
    )


def test_the_way_leads_through_every_stage_in_order_to_the_end(whole_way: OnTheWay) -> None:
    way, browser = whole_way, whole_way.browser
    assert way.where() == "/p/consent"
    agree(browser)
    assert way.where() == "/p/demographics"
    browser.post("/p/demographics", data={"age": "28"})
    assert way.where() == "/p/instructions"
    browser.post("/p/instructions")
    assert way.where() == "/p/next"
    way.answer_all(Purpose.PRACTICE, 1)
    assert way.where() == "/p/next"
    way.answer_all(Purpose.PREFERENCE, 10)
    assert way.where() == "/p/questionnaire"
    browser.post("/p/questionnaire", data={"felt_safe": "5"})
    assert way.where() == "/p/debrief"
    browser.post("/p/debrief")
    assert way.where() == "/p/finished"
    assert "C0DE" in browser.get("/p/finished").text
    with way.database.reading() as session:
        assert session.get_one(Participant, way.participant.id).completed_at is not None
        passed = session.scalars(select(StageRecord).order_by(StageRecord.id)).all()
    left_out = (Stage.SELF_SETTING, Stage.EVALUATION)
    assert [record.stage for record in passed] == [stage for stage in Stage if stage not in left_out]
    assert all(record.finished_at is not None for record in passed)


def test_the_papers_protocol_has_every_stage_but_sliders() -> None:
    assert list(stages.stages_of(PAPER_PROTOCOL)) == [stage for stage in Stage if stage is not Stage.SELF_SETTING]


def test_a_plain_study_has_only_what_it_cannot_do_without() -> None:
    assert list(stages.stages_of(StudySettings())) == [Stage.CONSENT, Stage.INSTRUCTIONS, Stage.PAIRS]


@pytest.mark.parametrize(
    "address", ["/p/demographics", "/p/instructions", "/p/questionnaire", "/p/debrief", "/p/finished"]
)
def test_nobody_skips_ahead_by_address(whole_way: OnTheWay, address: str) -> None:
    answer = whole_way.browser.get(address)
    assert (answer.status_code, answer.headers["location"]) == (303, "/p/next")
    if address != "/p/finished":
        assert whole_way.browser.post(address).headers["location"] == "/p/next"
    assert whole_way.where() == "/p/consent"
    assert whole_way.rows(FormAnswer) == []


def test_the_evaluation_is_over_when_every_trial_is_rated(begin: Callable[..., OnTheWay]) -> None:
    way = begin(ready=True, evaluation=EvaluationSettings(trials=1))
    way.answer_all(Purpose.PREFERENCE, 10)
    with way.database.writing() as session:
        factories.make_rated_trials(session, way.participant, 2)
    assert current(way) is Stage.EVALUATION
    with way.database.writing() as session:
        factories.make_rated_trials(session, way.participant, 1)
    assert current(way) is None


def current(way: OnTheWay) -> Stage | None:
    with way.database.writing() as session:
        person = session.get_one(Participant, way.participant.id)
        person.study = session.get_one(Study, way.study.id)
        return stages.current_stage(session, person)


def test_repeats_and_catch_pairs_are_part_of_the_pairs_and_practice_is_not(begin: Callable[..., OnTheWay]) -> None:
    way = begin(ready=True, repeated_pairs=1, catch_pairs=1)
    way.answer_all(Purpose.PREFERENCE, 10)
    way.answer_all(Purpose.PRACTICE, 2)
    assert current(way) is Stage.PAIRS
    way.answer_all(Purpose.REPEAT, 1)
    way.answer_all(Purpose.CATCH, 1)
    assert current(way) is None


class TestConsent:
    def test_what_was_agreed_to_is_stored_word_for_word_in_its_language_with_version_and_time(
        self, begin: Callable[..., OnTheWay]
    ) -> None:
        way = begin(consent_version="7b", wording={"consent-body": "You agree to & sign <this>."})
        way.browser.post("/p/language", data={"language": "de"})
        agree(way.browser)
        (record,) = way.rows(ConsentRecord)
        assert (record.version, record.language) == ("7b", "de")
        assert "You agree to & sign <this>." in record.text
        assert "Herzlich willkommen" in record.text
        assert record.agreed_at is not None

    def test_a_double_click_agrees_once(self, begin: Callable[..., OnTheWay]) -> None:
        way = begin()
        page = way.browser.get("/p/consent").text
        shown = page.split('name="shown" value="')[1].split('"')[0]
        for _ in range(2):
            way.browser.post("/p/consent", data={"shown": shown})
        assert len(way.rows(ConsentRecord)) == 1

    def test_a_text_that_changed_while_it_was_read_is_shown_again(self, begin: Callable[..., OnTheWay]) -> None:
        way = begin()
        page = way.browser.get("/p/consent").text
        shown = page.split('name="shown" value="')[1].split('"')[0]
        with way.database.writing() as session:
            study = session.get_one(Study, way.study.id)
            study.stored_settings = {**study.stored_settings, "wording": {"consent-body": "Something else."}}
        answer = way.browser.post("/p/consent", data={"shown": shown})
        assert "Something else." in answer.text
        assert way.rows(ConsentRecord) == []

    def test_a_new_version_is_asked_for_again_and_both_are_kept(self, begin: Callable[..., OnTheWay]) -> None:
        way = begin()
        agree(way.browser)
        with way.database.writing() as session:
            study = session.get_one(Study, way.study.id)
            study.stored_settings = {**study.stored_settings, "consent_version": "2"}
        assert way.where() == "/p/consent"
        assert "has changed" in way.browser.get("/p/consent").text
        agree(way.browser)
        assert way.where() == "/p/instructions"
        assert [record.version for record in way.rows(ConsentRecord)] == ["1", "2"]

    def test_the_copy_is_the_text_that_was_agreed_to_even_when_it_has_changed_since(
        self, begin: Callable[..., OnTheWay]
    ) -> None:
        way = begin(wording={"consent-body": "The old text."})
        assert "What you will be asked to agree to" in way.browser.get("/p/consent/copy").text
        agree(way.browser)
        with way.database.writing() as session:
            study = session.get_one(Study, way.study.id)
            study.stored_settings = {**study.stored_settings, "wording": {"consent-body": "The new text."}}
        for address in ("/p/consent/copy", "/p/consent/copy.txt"):
            copy = way.browser.get(address).text
            assert "The old text." in copy
            assert "You agreed to this text on" in copy
        assert "attachment" in way.browser.get("/p/consent/copy.txt").headers["content-disposition"]


class TestForms:
    @pytest.fixture
    def way(self, whole_way: OnTheWay) -> OnTheWay:
        agree(whole_way.browser)
        return whole_way

    def answers(self, way: OnTheWay) -> list[tuple[str, str | None]]:
        return [(row.item, row.value) for row in way.rows(FormAnswer)]

    def test_nothing_is_required(self, way: OnTheWay) -> None:
        assert way.browser.post("/p/demographics", data={}).headers["location"] == "/p/next"
        assert self.answers(way) == [("age", None), ("hand", None), ("robot_experience", None)]
        assert way.where() == "/p/instructions"

    def test_a_correction_is_appended_and_only_what_was_corrected(self, way: OnTheWay) -> None:
        way.browser.post("/p/demographics", data={"age": "28", "hand": "left"})
        way.browser.post("/p/demographics", data={"age": "29,5", "hand": "left"})
        assert self.answers(way) == [("age", "28"), ("hand", "left"), ("robot_experience", None), ("age", "29.5")]
        assert 'value="29.5"' in way.browser.get("/p/demographics").text

    @pytest.mark.parametrize(
        ("typed", "kept"),
        [("12345.678", "12345.678"), ("0.10", "0.10"), ("007", "007"), ("28,50", "28.50"), (" -3 ", "-3")],
    )
    def test_a_number_is_kept_as_it_was_typed(self, way: OnTheWay, typed: str, kept: str) -> None:
        way.browser.post("/p/demographics", data={"age": typed})
        assert self.answers(way)[0] == ("age", kept)

    def test_an_answer_can_be_taken_away_again(self, way: OnTheWay) -> None:
        way.browser.post("/p/demographics", data={"robot_experience": "4"})
        way.browser.post("/p/demographics", data={"robot_experience": ""})
        assert self.answers(way)[-1] == ("robot_experience", None)

    @pytest.mark.parametrize(
        ("item", "typed", "said"),
        [
            ("age", "old", "Please enter a number"),
            ("age", "nan", "Please enter a number"),
            ("age", "1_000", "Please enter a number"),
            ("age", "1e3", "Please enter a number"),
            ("hand", "foot", "Please choose one"),
            ("robot_experience", "6", "Please choose one"),
        ],
    )
    def test_what_cannot_be_kept_is_said_and_nothing_typed_is_lost(
        self, way: OnTheWay, item: str, typed: str, said: str
    ) -> None:
        answer = way.browser.post("/p/demographics", data={"age": "41", item: typed})
        assert answer.status_code == 422
        assert said in answer.text
        if item == "age":
            assert f'value="{typed}"' in answer.text
        else:
            assert 'value="41"' in answer.text
        assert self.answers(way) == []
        assert way.where() == "/p/demographics"

    def test_the_page_before_can_be_gone_back_to(self, way: OnTheWay) -> None:
        assert 'href="/p/consent/copy"' in way.browser.get("/p/demographics").text
        way.browser.post("/p/demographics", data={"age": "28"})
        assert 'href="/p/demographics"' in way.browser.get("/p/instructions").text

    def test_a_studys_own_question_is_asked_as_it_is_and_ours_in_the_persons_language(self, way: OnTheWay) -> None:
        way.browser.post("/p/language", data={"language": "de"})
        page = way.browser.get("/p/demographics").text
        assert "Which hand do you write with?" in page
        assert "Wie alt sind Sie?" in page
        assert '<html lang="de">' in page


def test_whatever_language_a_page_has_no_other_is_left_on_it(whole_way: OnTheWay) -> None:
    whole_way.browser.post("/p/language", data={"language": "de"})
    page = whole_way.browser.get("/p/consent").text
    assert "Ich willige ein" in page
    assert not any(word in page for word in ("agree", "Welcome", "Withdraw", "print a copy"))


def test_a_chosen_language_is_remembered_on_every_device(
    whole_way: OnTheWay, new_browser: Callable[[], TestClient]
) -> None:
    whole_way.browser.post("/p/language", data={"language": "de"})
    other = new_browser()
    other.get(f"/p/{whole_way.token}")
    assert '<html lang="de">' in other.get("/p/consent").text
    assert other.post("/p/language", data={"language": "xx"}).status_code == 422


def test_the_evaluated_pairs_do_not_come_before_their_time_to_a_script(whole_way: OnTheWay) -> None:
    answer = whole_way.browser.get("/p/next", headers={"Accept": "application/json"})
    assert answer.status_code == 303
    with whole_way.database.reading() as session:
        assert session.scalars(select(Query)).all() == []


def test_who_goes_astray_is_led_back_and_a_stranger_is_not(whole_way: OnTheWay, client: TestClient) -> None:
    assert 'href="/p/next"' in whole_way.browser.get("/p/no-such-page", headers={"accept": "text/html"}).text
    assert 'href="/p/next"' not in client.get("/p/no-such-page", headers={"accept": "text/html"}).text
