"""An open dashboard is told what changed."""

import json
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import timedelta
from typing import Any

import httpx2
import pytest
from fastapi import FastAPI
from sqlalchemy import delete, select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.people import BrowserSession, Experimenter, Role, StudyRole
from app.domain.studies import Participant, Study
from app.services.accounts import browser_sessions
from app.services.monitoring import dashboard
from app.services.monitoring.tallies import Tallies
from app.services.studies import membership
from app.storage import ArtefactStore
from tests import factories
from tests.conftest import serving
from tests.waiting import PATIENCE_S


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        factories.make_participant(session, study)
        return study


@pytest.fixture
def browser(address: str, study: Study, experimenter_cookie: str) -> Iterator[httpx2.Client]:
    with httpx2.Client(
        base_url=address, cookies={"studio_experimenter": experimenter_cookie}, timeout=PATIENCE_S
    ) as browser:
        yield browser


def events_of(lines: Iterator[str]) -> Iterator[tuple[str, str]]:
    """Event names and data as they arrive."""
    name = ""
    for line in lines:
        if line.startswith("event: "):
            name = line.removeprefix("event: ")
        elif line.startswith("data: "):
            yield name, line.removeprefix("data: ")
        elif line == "data:":
            yield name, ""


def sent_of(events: Iterator[tuple[str, str]], name: str) -> Iterator[dict[str, Any]]:
    """What is sent about a part of the page."""
    return (part for event, data in events if event == "fragment" if (part := json.loads(data))["name"] == name)


def test_a_change_arrives_by_itself(browser: httpx2.Client, study: Study, database: Database) -> None:
    with browser.stream("GET", "/studies/pilot/live") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        sent = sent_of(events_of(stream.iter_lines()), "participants")
        assert "P02" not in "".join(next(sent)["pieces"])
        with database.writing() as session:
            factories.make_participant(session, study)
        assert "P02" in "".join(next(sent)["pieces"])


def test_of_a_change_only_the_rows_are_sent_that_it_is_in(
    browser: httpx2.Client, study: Study, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        first = session.scalars(select(Participant)).one()
        (query,) = factories.make_queries(session, store, first, 1)
        for _ in range(3):
            factories.make_participant(session, study)
    with browser.stream("GET", "/studies/pilot/live") as stream:
        sent = sent_of(events_of(stream.iter_lines()), "participants")
        pieces = next(sent)["pieces"]
        with database.writing() as session:
            factories.make_label(session, query)
        changed = next(sent)["changed"]
        pieces = [changed.get(str(place), piece) for place, piece in enumerate(pieces)]
        others = [
            code for code in ("P02", "P03", "P04") if any(f'data-row="{code}"' in row for row in changed.values())
        ]
        assert others == []
        page = browser.get("/studies/pilot").text
    assert "".join("".join(pieces).split()) in "".join(page.split())


def test_however_many_look_a_page_is_drawn_once(
    browser: httpx2.Client, study: Study, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawings: list[str] = []
    overview = dashboard.study_overview

    def counted(session: Session, study: Study, tallies: Tallies) -> dashboard.StudyOverview:
        drawings.append(study.slug)
        return overview(session, study, tallies)

    monkeypatch.setattr(dashboard, "study_overview", counted)
    with ExitStack() as stack:
        streams = [stack.enter_context(browser.stream("GET", "/studies/pilot/live")) for _ in range(8)]
        parts = [sent_of(events_of(stream.iter_lines()), "participants") for stream in streams]
        for each in parts:
            next(each)
        before = len(drawings)
        with database.writing() as session:
            factories.make_participant(session, study)
        for each in parts:
            assert "P02" in "".join(next(each)["pieces"])
    assert len(drawings) - before < len(streams)


def test_all_who_look_are_sent_the_same_whatever_their_role(
    browser: httpx2.Client, database: Database, address: str
) -> None:
    with database.writing() as session:
        reader = Experimenter(name="reader", password_hash="-", must_change_password=False, role=Role.READER)
        session.add(reader)
        session.flush()
        for study in session.scalars(select(Study)):
            membership.admit(session, study, "reader", StudyRole.VIEWER, "the test")
        cookie = browser_sessions.open_for_experimenter(session, reader, timedelta(hours=1))
    with httpx2.Client(base_url=address, cookies={"studio_experimenter": cookie}, timeout=PATIENCE_S) as other:
        for page in ("/studies", "/studies/pilot", "/studies/pilot/participants/P01"):
            pages = [fragments_of(each.get(page).text) for each in (browser, other)]
            assert pages[0] == pages[1] != []


def fragments_of(page: str) -> list[str]:
    """The names and the beginnings of the parts that a page has."""
    return [part.split("<h2")[0] for part in page.split("data-fragment=")[1:]]


def test_the_parts_are_those_of_the_page(browser: httpx2.Client) -> None:
    for page in ("/studies", "/studies/pilot", "/studies/pilot/participants/P01"):
        whole = "".join(browser.get(page).text.split())
        with browser.stream("GET", f"{page}/live") as stream:
            events = events_of(stream.iter_lines())
            name, data = next(events)
            part = json.loads(data)
        assert name == "fragment"
        html = "".join("".join(part["pieces"]).split())
        assert f'data-fragment="{part["name"]}">{html}</div>' in whole


def test_a_stream_ends_with_the_login(browser: httpx2.Client, database: Database) -> None:
    with browser.stream("GET", "/studies/live") as stream:
        events = events_of(stream.iter_lines())
        next(events)
        with database.writing() as session:
            session.execute(delete(BrowserSession))
        assert [name for name, _ in events][-1] == "gone"


def test_without_login_there_is_no_stream(browser: httpx2.Client) -> None:
    browser.cookies.clear()
    answer = browser.get("/studies/live", headers={"Accept": "text/event-stream"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/login?next=/studies/live")


def test_fifty_open_dashboards_leave_room_for_everybody_else(browser: httpx2.Client) -> None:
    opened = threading.Barrier(51)
    done = threading.Event()

    def watch() -> None:
        with browser.stream("GET", "/studies/live") as stream:
            next(stream.iter_lines())
            opened.wait(PATIENCE_S)
            done.wait(PATIENCE_S)

    watchers = [threading.Thread(target=watch) for _ in range(50)]
    for watcher in watchers:
        watcher.start()
    opened.wait(PATIENCE_S)
    assert browser.get("/studies").status_code == 200
    done.set()
    for watcher in watchers:
        watcher.join()


def test_the_server_stops_at_once_although_dashboards_are_open(
    studio_app: FastAPI, database: Database, experimenter_cookie: str
) -> None:
    cookies = {"studio_experimenter": experimenter_cookie}
    with (
        serving(studio_app) as address,
        httpx2.Client(base_url=address, cookies=cookies, timeout=PATIENCE_S) as browser,
        browser.stream("GET", "/studies/live") as stream,
    ):
        lines = stream.iter_lines()
        next(lines)
        studio_app.state.studio.closing.set()
        assert sum(1 for _ in lines) < 50  # the stream ends by itself
