"""The form of a study promises that participants do not see its name; and it is in none of their pages."""

from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.protocol import PAPER_DEMOGRAPHICS, USUAL_QUESTIONNAIRE, EvaluationSettings
from app.domain.studies import Participant
from app.services.participants import recruitment_panel
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import agree

NAME = "Zzyzx doubts"


@pytest.fixture
def pages(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> list[str]:
    """Every page of the way of one participant, as text, with its headers."""
    with database.writing() as session:
        study = factories.make_study(
            session,
            NAME,
            demographics=PAPER_DEMOGRAPHICS,
            questionnaire=USUAL_QUESTIONNAIRE,
            debrief=True,
            completion_code="DONE",
            return_url="https://panel.example/?code={code}",
            evaluation=EvaluationSettings(trials=1),
        )
        token = recruitment_panel.open_joining(session, study, "someone")
    browser = new_browser()
    seen: list[str] = []

    def see(address: str) -> None:
        answer = browser.get(address, headers={"Accept": "text/html"}, follow_redirects=True)
        assert answer.status_code < 500
        seen.extend([answer.text, str(answer.url), str(answer.headers)])

    for address in (f"/join/{token}", f"/join/{token}?PROLIFIC_PID=abc"):
        see(address)
    browser.post(f"/join/{token}?PROLIFIC_PID=abc")
    for address in ("/p/consent", "/p/consent/copy"):
        see(address)
    agree(browser)
    for address in ("/p/consent/copy", "/p/consent/copy.txt", "/p/demographics"):
        see(address)
    browser.post("/p/demographics", data={"age": "old"})
    browser.post("/p/demographics", data={})
    see("/p/instructions")
    browser.post("/p/instructions")
    see("/p/next")  # waiting
    with database.writing() as session:
        person = session.get_one(Participant, 1)
        queries = factories.make_queries(session, store, person, 10)
    see("/p/next")  # a pair
    seen.append(browser.get("/p/next", headers={"Accept": "application/json"}).text)
    with database.writing() as session:
        for query in queries:
            factories.make_label(session, query)
    see("/p/evaluation")
    for address in ("/p/questionnaire", "/p/debrief", "/p/finished", "/p/nowhere", "/p/withdraw"):
        see(address)
    browser.post("/p/withdraw")
    see("/p/withdrawn")
    return seen


def test_no_page_of_a_participant_tells_the_name_of_the_study(pages: list[str]) -> None:
    assert len(pages) > 40
    assert [page for page in pages if NAME.split()[0].lower() in page.lower()] == []
