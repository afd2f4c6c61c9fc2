"""Inviting: links as a file and as a sheet, the open address, and erasing somebody who asks for it."""

import csv
import io
import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from tests import factories


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, "Pilot", panel_parameter="PID")


def test_the_file_of_links_has_a_working_link_for_everybody(
    experimenter: TestClient, study: Study, new_browser: Callable[[], TestClient]
) -> None:
    location = experimenter.post("/studies/pilot/participants", data={"count": "3"}).headers["location"]
    rows = list(csv.DictReader(io.StringIO(experimenter.get(f"{location}/links.csv").text)))
    assert [row["participant"] for row in rows] == ["P01", "P02", "P03"]
    assert [new_browser().get(row["link"]).status_code for row in rows] == [303] * 3


def test_the_sheet_has_a_card_with_code_link_and_qr_code_for_everybody(experimenter: TestClient, study: Study) -> None:
    location = experimenter.post("/studies/pilot/participants", data={"count": "2"}).headers["location"]
    page = experimenter.get(f"{location}/sheet").text
    assert page.count("<svg") == 2
    assert len(set(re.findall(r"http://testserver/p/[\w-]+", page))) == 2
    assert "P02" in page


def test_links_are_for_nobody_but_who_made_them(
    experimenter: TestClient, study: Study, new_browser: Callable[[], TestClient]
) -> None:
    location = experimenter.post("/studies/pilot/participants", data={"count": "1"}).headers["location"]
    for path in ("sheet", "links.csv"):
        assert new_browser().get(f"{location}/{path}").headers["location"].startswith("/login")


def test_the_open_address_lets_people_in_until_it_is_closed(
    experimenter: TestClient, study: Study, new_browser: Callable[[], TestClient]
) -> None:
    assert "Joining is closed" in experimenter.get("/studies/pilot/joining").text
    experimenter.post("/studies/pilot/joining/open")
    page = experimenter.get("/studies/pilot/joining").text
    (address,) = re.findall(r'value="(http://testserver/join/[\w-]+)\?PID=', page)
    assert new_browser().post(f"{address}?PID=abc").headers["location"] == "/p/next"
    experimenter.post("/studies/pilot/joining/close")
    assert new_browser().post(f"{address}?PID=def").status_code == 404


class TestErasingOnRequest:
    """The same as withdrawing, done by an experimenter."""

    @pytest.fixture
    def participant(self, study: Study, database: Database, store: ArtefactStore) -> Participant:
        with database.writing() as session:
            participant, _ = factories.make_participant(session, study)
            (query,) = factories.make_queries(session, store, participant, 1)
            factories.make_label(session, query)
        return participant

    def test_everything_goes_when_the_code_is_typed(
        self, experimenter: TestClient, participant: Participant, database: Database
    ) -> None:
        answer = experimenter.post("/studies/pilot/participants/P01/erase", data={"typed": " p01"})
        assert answer.headers["location"] == "/studies/pilot"
        with database.reading() as session:
            assert session.scalars(select(LabelEvent)).all() == []
            assert session.scalars(select(Participant)).one().withdrawn_at is not None
        assert experimenter.get("/studies/pilot/participants/P01").status_code == 200

    def test_nothing_goes_without_the_code(
        self, experimenter: TestClient, participant: Participant, database: Database
    ) -> None:
        answer = experimenter.post("/studies/pilot/participants/P01/erase", data={"typed": "P02"})
        assert answer.status_code == 422
        with database.reading() as session:
            assert len(session.scalars(select(LabelEvent)).all()) == 1
