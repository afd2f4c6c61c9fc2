"""Hints such as "slower near me": asked for once where the study wants it, taken back at will, never in the way."""

import csv
import re
from collections.abc import Sequence
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from pydantic import ValidationError
from sqlalchemy import select

from app.domain.choices import RewardKind
from app.domain.hints import HintEvent
from app.domain.protocol import Language
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.installed_tasks import catalogue, hints
from app.installed_tasks.description import InstalledTask
from app.installed_tasks.lab import LabDescription
from app.web.texts import hint_words
from app.web.texts.wording import wording_for
from tests.app.conftest import TakingPart
from worker.domain.trajectory import SIGNALS

INTRODUCED = 3
"""Answers after which hints are asked for."""


@pytest.fixture
def asked(taking_part: TakingPart) -> TakingPart:
    change(taking_part, asks_for_hints=True, introduction_pairs=0, labels_per_participant=10)
    return taking_part


def change(taking_part: TakingPart, **settings: object) -> None:
    with taking_part.database.writing() as session:
        study = session.get_one(Study, taking_part.study.id)
        study.stored_settings = {**study.stored_settings, **settings}


def introduce(taking_part: TakingPart, count: int = INTRODUCED) -> None:
    for query in taking_part.queries[:count]:
        taking_part.turn()
        assert taking_part.answer(query).status_code == 200


def give(taking_part: TakingPart, *names: str, uuid: UUID | None = None) -> Answer:
    form = {"client_uuid": str(uuid or uuid4()), **{f"hint-{name}": "yes" for name in names}}
    return taking_part.browser.post("/p/hints", data=form)


def kept(taking_part: TakingPart) -> Sequence[HintEvent]:
    with taking_part.database.reading() as session:
        return session.scalars(select(HintEvent).order_by(HintEvent.revision)).all()


def ticked(page: str) -> set[str]:
    return set(re.findall(r'name="hint-(\w+)" value="yes" checked', page))


def test_hints_are_asked_for_once_when_the_introduction_was_seen(asked: TakingPart) -> None:
    introduce(asked, INTRODUCED - 1)
    assert asked.turn().json()["state"] == "pair"
    introduce(asked)
    assert asked.turn().json()["state"] == "hints"
    there = asked.browser.get("/p/next").headers["location"]
    page = asked.browser.get(there).text
    assert ('data-page="hints"' in page, ticked(page)) == (True, set())
    assert give(asked).status_code == 303
    assert asked.turn().json()["state"] == "pair"


def test_a_pair_that_waits_behind_the_question_counts_as_shown_later(asked: TakingPart) -> None:
    introduce(asked)
    asked.browser.get("/p/next")
    assert asked.answer(asked.queries[INTRODUCED]).status_code == 409


def test_what_was_given_is_kept_with_when_and_what_was_offered_in_which_order(asked: TakingPart) -> None:
    introduce(asked)
    page = asked.browser.get("/p/hints").text
    give(asked, "gentler", "slower_near")
    [row] = kept(asked)
    assert set(row.hints.split()) == {"gentler", "slower_near"}
    assert row.answered == INTRODUCED
    assert row.offered.split() == re.findall(r'name="hint-(\w+)"', page)
    assert set(row.offered.split()) == set(hints.of_task("feeding"))


def test_hints_can_be_changed_and_taken_back_and_every_set_is_kept(asked: TakingPart) -> None:
    introduce(asked)
    give(asked, "gentler")
    assert ticked(asked.browser.get("/p/hints").text) == {"gentler"}
    give(asked, "quicker")
    give(asked)
    assert [row.hints for row in kept(asked)] == ["gentler", "quicker", ""]
    assert ticked(asked.browser.get("/p/hints").text) == set()


def test_a_retry_is_the_same_set(asked: TakingPart) -> None:
    uuid = uuid4()
    assert [give(asked, "gentler", uuid=uuid).status_code for _ in range(3)] == [303] * 3
    give(asked, "quicker")
    give(asked, "gentler", uuid=uuid)
    assert [row.hints for row in kept(asked)] == ["gentler", "quicker"]


@pytest.mark.parametrize(
    ("names", "says"),
    [(("gentler", "level", "smoother"), "more than 2"), (("slower_near", "quicker_near"), "contradict each other")],
)
def test_too_many_and_contradicting_hints_come_back_ticked_with_what_to_do(
    asked: TakingPart, names: tuple[str, ...], says: str
) -> None:
    answer = give(asked, *names)
    assert (answer.status_code, kept(asked)) == (422, [])
    assert says in answer.text
    assert ticked(answer.text) == set(names)


def test_what_nobody_offered_is_refused_in_words(asked: TakingPart) -> None:
    answer = give(asked, "beautiful")
    assert (answer.status_code, kept(asked)) == (422, [])
    assert "choose again" in answer.text


def test_when_all_pairs_are_compared_hints_change_nothing_any_more(asked: TakingPart) -> None:
    give(asked, "gentler")
    introduce(asked, 10)
    answer = give(asked, "quicker")
    assert (answer.status_code, [row.hints for row in kept(asked)]) == (409, ["gentler"])
    assert "compared all pairs" in answer.text


def test_where_nobody_asks_there_is_no_question_no_link_and_nothing_kept(taking_part: TakingPart) -> None:
    introduce(taking_part)
    assert taking_part.turn().json()["state"] == "pair"
    assert "/p/hints" not in taking_part.browser.get("/p/next").text
    assert taking_part.browser.get("/p/hints").headers["location"].endswith("/p/next")
    assert (give(taking_part, "gentler").status_code, kept(taking_part)) == (422, [])


def test_pairs_and_breaks_lead_to_the_hints(asked: TakingPart) -> None:
    assert 'href="/p/hints"' in asked.browser.get("/p/next").text
    give(asked)
    change(asked, break_every=2)
    introduce(asked, 2)
    page = asked.browser.get("/p/next").text
    assert 'data-page="break"' in page
    assert 'href="/p/hints"' in page


@pytest.mark.parametrize(("language", "words"), [("en", "slower near me"), ("de", "langsamer in meiner Nähe")])
def test_the_page_is_in_the_language_of_the_study(asked: TakingPart, language: str, words: str) -> None:
    change(asked, language=language)
    assert words in asked.browser.get("/p/hints").text


def test_they_are_in_the_export(asked: TakingPart, experimenter: TestClient) -> None:
    give(asked, "gentler")
    give(asked, "slower_near", "smoother")
    table = experimenter.get(f"/studies/{asked.study.slug}/export/hints.csv").text
    rows = list(csv.DictReader(table.splitlines()))
    assert [set(row["hints"].split()) for row in rows] == [{"gentler"}, {"slower_near", "smoother"}]
    assert [(row["participant"], row["revision"], row["superseded"]) for row in rows] == [
        ("P01", "1", "true"),
        ("P01", "2", "false"),
    ]


@pytest.mark.parametrize("task", catalogue.names())
def test_every_hint_of_a_task_is_about_signals_that_vary_in_it_and_has_words_in_both_languages(task: str) -> None:
    known, installed = hints.of_task(task), catalogue.find(task)
    assert known
    assert installed
    meant = {signal for each in known.values() for signal in (*each.less, *each.more)}
    assert meant <= set(SIGNALS) - installed.description.words.silent_signals
    for language in Language:
        words = hint_words.words_of(wording_for(StudySettings(language=language)), task, known)
        assert len({word for _, word in words}) == len(known)
        assert all(language in each.words for each in known.values())


def test_a_laboratory_without_hints_of_its_own_has_less_and_more_of_its_signals_but_no_more_of_a_cost(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    lab = LabDescription.model_validate(
        {
            "name": "stacking",
            "title": "Stacking",
            "summary": "",
            "episode_steps": 50,
            "usual_clip_steps": 50,
            "environment": {"id": "a:B-v0", "rate_hz": 10, "actions": "delta"},
            "policy": {"file": "policy.onnx"},
            "success": {"info": "done"},
            "signals": {
                "noise_db": {"info": "noise", "unit": "dB", "words": {"en": "noise", "de": "Lärm"}, "cost": True},
                "lift_m": {"info": "lift", "unit": "m", "words": {"en": "lifting"}},
            },
        }
    )
    folder = tmp_path_factory.getbasetemp()
    monkeypatch.setattr(catalogue, "find", lambda name: InstalledTask(name, "", folder, lab, ""))
    wording = wording_for(StudySettings(language=Language.GERMAN))
    assert [words for _, words in hint_words.words_of(wording, "stacking", hints.of_task("stacking"))] == [
        "weniger: Lärm",
        "weniger: lifting",
        "mehr: lifting",
    ]


def test_of_clips_that_were_recorded_elsewhere_nothing_can_be_hinted_at() -> None:
    assert hints.of_task("clips_of_somewhere_else") == {}


def test_models_that_weigh_no_signals_are_refused_the_setting() -> None:
    with pytest.raises(ValidationError, match="structured reward models only"):
        StudySettings(asks_for_hints=True, reward_kind=RewardKind.MLP)
