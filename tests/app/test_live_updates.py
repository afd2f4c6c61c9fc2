"""An open dashboard is told what changed."""

import json
import threading
from collections.abc import Iterator

import httpx2
import pytest
from fastapi import FastAPI
from sqlalchemy import delete

from app.db import Database
from app.domain.people import BrowserSession
from app.domain.studies import Study
from tests import factories
from tests.conftest import serving


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, "Pilot")
        factories.make_participant(session, study)
        return study


@pytest.fixture
def browser(address: str, study: Study, experimenter_cookie: str) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=address, cookies={"studio_experimenter": experimenter_cookie}, timeout=30) as browser:
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


def next_fragment(events: Iterator[tuple[str, str]], name: str) -> str:
    """The HTML of the next part of that name."""
    fragments = (json.loads(data) for event, data in events if event == "fragment")
    return str(next(part["html"] for part in fragments if part["name"] == name))


def test_a_change_arrives_by_itself(browser: httpx2.Client, study: Study, database: Database) -> None:
    with browser.stream("GET", "/studies/pilot/live") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        events = events_of(stream.iter_lines())
        assert "P02" not in next_fragment(events, "participants")
        with database.writing() as session:
            factories.make_participant(session, study)
        assert "P02" in next_fragment(events, "participants")


def test_the_parts_are_those_of_the_page(browser: httpx2.Client) -> None:
    for page in ("/studies", "/studies/pilot", "/studies/pilot/participants/P01"):
        whole = "".join(browser.get(page).text.split())
        with browser.stream("GET", f"{page}/live") as stream:
            events = events_of(stream.iter_lines())
            name, data = next(events)
            part = json.loads(data)
        assert name == "fragment"
        assert f'data-fragment="{part["name"]}">{"".join(part["html"].split())}</div>' in whole


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
            opened.wait(30)
            done.wait(30)

    watchers = [threading.Thread(target=watch) for _ in range(50)]
    for watcher in watchers:
        watcher.start()
    opened.wait(30)
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
        httpx2.Client(base_url=address, cookies=cookies, timeout=30) as browser,
        browser.stream("GET", "/studies/live") as stream,
    ):
        lines = stream.iter_lines()
        next(lines)
        studio_app.state.studio.closing.set()
        assert sum(1 for _ in lines) < 50  # the stream ends by itself
