"""Saying what made the difference: asked where the study wants it, kept with answers for one side, never in the way."""

import csv

import pytest
from fastapi.testclient import TestClient

from app.domain.protocol import Language
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue, qualities
from app.web.texts import quality_words
from app.web.texts.wording import wording_for
from tests.app.conftest import TakingPart
from worker.domain.trajectory import SIGNALS

ASKING = {"asks_what_mattered": True}


@pytest.fixture
def asked(taking_part: TakingPart) -> TakingPart:
    with taking_part.database.writing() as session:
        study = session.get_one(Study, taking_part.study.id)
        study.stored_settings = {**study.stored_settings, **ASKING}
    return taking_part


def mattered(taking_part: TakingPart, response: str, said: str) -> str | None:
    """What is stored of it with an answer to the first pair."""
    taking_part.turn()
    assert taking_part.answer(taking_part.queries[0], response, mattered=said).status_code == 200
    return taking_part.events(taking_part.queries[0])[-1].mattered


@pytest.mark.parametrize(
    ("response", "said", "kept"),
    [("left", "force", "force"), ("right", "speed", "speed"), ("left", "", None), ("equal", "speed", None)],
)
def test_what_mattered_is_kept_with_an_answer_for_one_side(
    asked: TakingPart, response: str, said: str, kept: str | None
) -> None:
    assert mattered(asked, response, said) == kept


def test_where_nobody_asks_nothing_is_kept_and_nothing_is_on_the_page(taking_part: TakingPart) -> None:
    assert "data-quality" not in taking_part.browser.get("/p/next").text
    assert mattered(taking_part, "left", "force") is None


def test_what_cannot_be_said_is_refused_in_words_and_the_pair_stays_open(asked: TakingPart) -> None:
    asked.turn()
    answer = asked.answer(asked.queries[0], "left", mattered="beauty")
    assert (answer.status_code, asked.events(asked.queries[0])) == (422, [])
    assert "reload the page" in answer.json()["detail"]


@pytest.mark.parametrize(("language", "words"), [("en", "How hard it touched"), ("de", "Wie fest er berührt")])
def test_the_page_asks_in_the_language_of_the_page_with_and_without_a_script(
    asked: TakingPart, language: str, words: str
) -> None:
    with asked.database.writing() as session:
        study = session.get_one(Study, asked.study.id)
        study.stored_settings = {**study.stored_settings, "language": language}
    page = asked.browser.get("/p/next").text
    assert page.count(words) == 2
    assert 'data-quality="force"' in page
    assert '<option value="force">' in page


def test_it_is_in_the_export(asked: TakingPart, experimenter: TestClient) -> None:
    mattered(asked, "right", "speed_near")
    table = experimenter.get(f"/studies/{asked.study.slug}/export/labels.csv").text
    assert [row["mattered"] for row in csv.DictReader(table.splitlines())] == ["speed_near"]


@pytest.mark.parametrize("task", catalogue.names())
def test_every_quality_of_a_task_is_about_signals_it_has_and_has_words_in_both_languages(task: str) -> None:
    named = qualities.of_task(task)
    assert {signal for signals in named.values() for signal in signals} <= set(SIGNALS)
    for language in Language:
        words = quality_words.words_of(wording_for(StudySettings(language=language)), task)
        assert [name for name, _ in words] == list(named)
        assert len({word for _, word in words}) == len(named)


def test_nothing_is_spilled_where_nothing_is_carried() -> None:
    assert "spilling" in qualities.of_task("feeding")
    assert "spilling" not in qualities.of_task("scratching")


def test_of_clips_that_were_recorded_elsewhere_nobody_knows_what_can_be_named() -> None:
    assert qualities.of_task("clips_of_somewhere_else") == {}
