"""Joining by the open address of a study, and going back to where one came from."""

import html
import re
import threading
from collections.abc import Callable

import httpx2
import pytest
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from sqlalchemy import select

from app.db import Database
from app.domain.studies import Participant, Study
from app.services.participants import completion, recruitment_panel
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import agree
from tests.waiting import PATIENCE_S


@pytest.fixture
def open_study(database: Database) -> Callable[..., str]:
    """Makes a study with these settings that can be joined; gives its address."""

    def make(**settings: str) -> str:
        with database.writing() as session:
            study = factories.make_study(session, **settings)
            return f"/join/{recruitment_panel.open_joining(session, study, actor='pat')}"

    return make


def everybody(database: Database) -> list[Participant]:
    with database.reading() as session:
        return list(session.scalars(select(Participant).order_by(Participant.id)))


def press(browser: TestClient, address: str) -> Answer:
    """Open the address and press the button on its page."""
    action = re.search(r'<form class="onward"[^>]+action="([^"]+)"', browser.get(address).text)
    assert action is not None
    return browser.post(html.unescape(action[1]))


class TestThroughAPanel:
    def test_looking_at_the_address_makes_nobody_and_leaves_no_cookie(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        """Mail and chat programs open every link they see."""
        answer = client.get(open_study() + "?PROLIFIC_PID=abc")
        assert answer.status_code == 200
        assert "set-cookie" not in answer.headers
        assert everybody(database) == []

    def test_parameters_with_any_characters_survive_the_button(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        press(client, open_study() + "?PROLIFIC_PID=a%26b%22%3E%3Cb%3E&x=%C3%A4+%2B&y=%0D%0AX:1")
        (person,) = everybody(database)
        assert person.panel_id == 'a&b"><b>'
        assert person.panel_parameters == {"PROLIFIC_PID": 'a&b"><b>', "x": "ä +", "y": "\r\nX:1"}

    def test_another_person_at_the_same_browser_is_not_taken_for_the_first(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        address = open_study()
        press(client, address + "?PROLIFIC_PID=abc")
        assert client.get(address + "?PROLIFIC_PID=abc").headers["location"] == "/p/next"
        press(client, address + "?PROLIFIC_PID=def")
        assert [person.panel_id for person in everybody(database)] == ["abc", "def"]

    def test_an_id_of_the_panel_comes_in_and_all_parameters_are_kept(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        answer = press(client, open_study() + "?PROLIFIC_PID=abc&STUDY_ID=s1&SESSION_ID=x")
        assert (answer.status_code, answer.headers["location"]) == (303, "/p/next")
        assert client.get("/p/next").headers["location"] == "/p/consent"
        (person,) = everybody(database)
        assert person.panel_id == "abc"
        assert person.panel_parameters == {"PROLIFIC_PID": "abc", "STUDY_ID": "s1", "SESSION_ID": "x"}

    def test_the_same_id_resumes_on_any_device_instead_of_duplicating(
        self,
        open_study: Callable[..., str],
        client: TestClient,
        database: Database,
        new_browser: Callable[[], TestClient],
    ) -> None:
        address = open_study() + "?PROLIFIC_PID=abc"
        press(client, address)
        agree(client)
        other = new_browser()
        press(other, address)
        assert other.get("/p/next").headers["location"] == "/p/instructions"
        assert len(everybody(database)) == 1

    def test_of_ten_at_once_with_one_id_one_participant_is_made(
        self, open_study: Callable[..., str], database: Database, address: str
    ) -> None:
        join = address + open_study() + "?PROLIFIC_PID=abc"
        codes: list[int] = []
        threads = [
            threading.Thread(target=lambda: codes.append(httpx2.post(join, timeout=PATIENCE_S).status_code))
            for _ in range(10)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert codes == [303] * 10
        assert len(everybody(database)) == 1

    def test_the_constraint_is_the_last_judge_when_two_look_at_once(
        self, open_study: Callable[..., str], database: Database, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        open_study()
        with database.writing() as session:
            study = session.scalars(select(Study)).one()
            first = recruitment_panel.join(session, study, {"PROLIFIC_PID": "abc"}).participant
            looks = iter([None, first])
            monkeypatch.setattr(recruitment_panel, "_known", lambda *_: next(looks))
            assert recruitment_panel.join(session, study, {"PROLIFIC_PID": "abc"}).participant is first
        assert len(everybody(database)) == 1

    @pytest.mark.parametrize("query", ["", "?PROLIFIC_PID=", "?PROLIFIC_PID=%20", "?prolific_pid=abc"])
    def test_without_an_id_there_is_a_page_that_says_what_is_missing(
        self, open_study: Callable[..., str], client: TestClient, database: Database, query: str
    ) -> None:
        address = open_study() + query
        for answer in (client.get(address), client.post(address)):
            assert answer.status_code == 400
            assert "PROLIFIC_PID" in answer.text
            assert "set-cookie" not in answer.headers
        assert everybody(database) == []

    def test_two_studies_may_have_the_same_person(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        press(client, open_study() + "?PROLIFIC_PID=abc")
        press(client, open_study() + "?PROLIFIC_PID=abc")
        assert [person.panel_id for person in everybody(database)] == ["abc", "abc"]


class TestWithoutAPanel:
    def test_anybody_comes_in_and_is_given_the_personal_link_to_keep(
        self, open_study: Callable[..., str], client: TestClient, new_browser: Callable[[], TestClient]
    ) -> None:
        page = press(client, open_study(panel_parameter="")).text
        link = re.search(r'value="http://[^/]+(/p/[\w-]+)"', page)
        assert link is not None
        agree(client)
        other = new_browser()
        other.get(link[1])
        assert other.get("/p/next").headers["location"] == "/p/instructions"

    def test_the_same_browser_goes_on_instead_of_joining_again(
        self, open_study: Callable[..., str], client: TestClient, database: Database
    ) -> None:
        address = open_study(panel_parameter="")
        press(client, address)
        assert client.post(address).headers["location"] == "/p/next"
        assert client.get(address).headers["location"] == "/p/next"
        assert len(everybody(database)) == 1


def test_an_address_that_was_closed_lets_nobody_in(
    open_study: Callable[..., str], client: TestClient, database: Database
) -> None:
    address = open_study()
    with database.writing() as session:
        recruitment_panel.close_joining(session, session.scalars(select(Study)).one(), actor="pat")
    for answer in (client.get(address + "?PROLIFIC_PID=abc"), client.post(address + "?PROLIFIC_PID=abc")):
        assert answer.status_code == 404
        assert "does not lead to a study that can be joined" in answer.text


@pytest.mark.parametrize(
    ("url", "filled"),
    [
        ("https://panel.example/done?cc=ABC", "https://panel.example/done?cc=ABC"),
        ("https://panel.example/done?cc={code}&id={panel_id}", "https://panel.example/done?cc=C%26D&id=a%2Fb%20c"),
        ("https://panel.example/{STUDY_ID}?x={unknown}", "https://panel.example/s%3F1?x="),
        ("", None),
    ],
)
def test_the_way_back_is_filled_in_and_nothing_can_break_out_of_it(
    database: Database, url: str, filled: str | None
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, return_url=url, completion_code="C&D")
        person, _ = factories.make_participant(session, study)
        person.panel_id, person.panel_parameters = "a/b c", {"STUDY_ID": "s?1"}
        person.study = study
        assert completion.return_address(person) == filled


def test_the_way_back_is_taken_by_itself_only_the_first_time_and_only_at_the_end(
    database: Database, store: ArtefactStore, client: TestClient
) -> None:
    with database.writing() as session:
        study = factories.make_study(session, return_url="https://panel.example/?cc={code}", completion_code="OK-1")
        person, token = factories.make_participant(session, study)
    client.get(f"/p/{token}")
    assert client.get("/p/finished").headers["location"] == "/p/next"
    with database.writing() as session:
        for query in factories.make_queries(session, store, session.get_one(Participant, person.id), 10):
            factories.make_label(session, query)
    pages = [client.get("/p/finished").text for _ in range(2)]
    assert all('href="https://panel.example/?cc=OK-1"' in page for page in pages)
    assert ["data-return-after-s" in page for page in pages] == [True, False]
    with database.reading() as session:
        assert session.get_one(Participant, person.id).completed_at is not None
