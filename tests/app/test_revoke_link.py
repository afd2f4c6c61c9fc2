"""Personal links can be switched off at once, and lead to a page that says so, until there is a new one."""

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.studies import Participant
from tests.app.conftest import TakingPart

REVOKE = "/studies/feeding-at-home/participants/P01/link/revoke"


def test_link_and_open_browsers_stop_working_at_once_and_answers_stay(
    taking_part: TakingPart, experimenter: TestClient, new_browser: Callable[[], TestClient]
) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    assert experimenter.post(REVOKE).status_code == 303
    assert taking_part.turn().status_code == 401
    assert taking_part.answer(taking_part.queries[1]).status_code == 401
    assert new_browser().get(f"/p/{taking_part.token}").status_code == 410
    assert len(taking_part.events(taking_part.queries[0])) == 1


@pytest.mark.parametrize(
    ("language", "title"), [("en", "This link has been switched off"), ("de", "Dieser Link wurde abgeschaltet")]
)
def test_the_old_link_shows_a_page_in_the_language_of_the_browser(
    taking_part: TakingPart,
    experimenter: TestClient,
    new_browser: Callable[[], TestClient],
    language: str,
    title: str,
) -> None:
    experimenter.post(REVOKE)
    page = new_browser().get(f"/p/{taking_part.token}", headers={"accept-language": language}).text
    assert f"<h1>{title}</h1>" in page


def test_a_new_link_brings_the_person_back_where_they_were(
    taking_part: TakingPart, experimenter: TestClient, new_browser: Callable[[], TestClient]
) -> None:
    taking_part.turn()
    taking_part.answer(taking_part.queries[0])
    experimenter.post(REVOKE)
    assert "was revoked" in experimenter.get("/studies/feeding-at-home/participants/P01").text
    shown = experimenter.post(REVOKE.removesuffix("/revoke"), follow_redirects=True).text
    token = shown.partition("/p/")[2][:43]
    browser = new_browser()
    assert browser.get(f"/p/{token}").headers["location"] == "/p/next"
    assert browser.get("/p/next").status_code == 200
    assert new_browser().get(f"/p/{taking_part.token}").status_code == 404
    assert "was revoked" not in experimenter.get("/studies/feeding-at-home/participants/P01").text


def test_somebody_who_comes_through_a_panel_is_shut_out_as_well(
    taking_part: TakingPart, experimenter: TestClient, database: Database, client: TestClient
) -> None:
    with database.writing() as session:
        person = session.get_one(Participant, taking_part.participant.id)
        person.panel_id, study = "abc", taking_part.study
        study = session.merge(study)
        study.stored_settings = {**study.stored_settings, "panel_parameter": "ID"}
        study.join_token = "j" * 32
    experimenter.post(REVOKE)
    assert client.post(f"/join/{'j' * 32}?ID=abc").status_code == 410
    assert client.post(f"/join/{'j' * 32}?ID=new").status_code == 303
