"""Several web servers on one database lose nothing and double nothing, whichever of them a request reaches."""

import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta, tzinfo
from itertools import chain
from uuid import uuid4

import httpx2
import pytest
from sqlalchemy import select

from app import db
from app.db import Database, now
from app.domain.people import Experimenter, NewLinks
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.settings import Settings
from app.storage import ArtefactStore
from app.web.http import new_links
from app.web.http.new_links import NewLink
from app.web.http.rate_limit import SharedAttempts
from tests import databases, factories
from tests.answering import Server
from tests.waiting import PATIENCE_S, free_port

SERVERS, PEOPLE, LABELS, JOINING = 2, 6, 12, 20
SCRIPT = {"Accept": "application/json"}
SEVERAL = pytest.mark.skipif(databases.SERVER is None, reason="with SQLite there is one web server")


@pytest.fixture
def addresses(settings: Settings, database: Database) -> Iterator[list[str]]:
    """Of servers in processes of their own."""
    servers = [Server(settings.model_copy(update={"port": free_port()})) for _ in range(SERVERS)]
    yield [server.address for server in servers]
    for server in servers:
        server.kill()


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=LABELS, pool_scenarios=20)
        study.join_token = "everybody-is-welcome-here"
    return study


@SEVERAL
def test_attempts_to_log_in_are_limited_for_all_of_them_together(database: Database) -> None:
    servers = [SharedAttempts(database, "password", 3) for _ in range(3)]
    assert [server.allow("192.0.2.1", "ana") for server in servers * 2] == [True] * 3 + [False] * 3
    assert servers[0].allow("192.0.2.2", "ana"), "from elsewhere"
    assert SharedAttempts(database, "token", 3).allow("192.0.2.1"), "of another kind"


def test_new_links_are_shown_by_another_server_and_the_database_alone_knows_none(
    database: Database, password: str
) -> None:
    left = NewLink("the-first-participant", "https://studio/p/secret")  # nothing that a cipher spells by chance
    with database.writing() as session:
        owner = session.scalars(select(Experimenter)).one()
        key = new_links.leave(session, owner.id, [left])
    with database.reading() as session:
        assert new_links.pick_up(session, owner.id, key) == [left]
        assert list(new_links.pick_up(session, owner.id + 1, key)) == []
        assert list(new_links.pick_up(session, owner.id, key + "x")) == []
        row = session.scalars(select(NewLinks)).one()
        assert not any(word in f"{row.sealed} {row.key_sha256}" for word in (left.code, "secret", key))
    with database.writing() as session:
        session.scalars(select(NewLinks)).one().expires_at = now() - timedelta(seconds=1)
    with database.reading() as session:
        assert list(new_links.pick_up(session, owner.id, key)) == []


@pytest.mark.skipif(databases.SERVER is None, reason="SQLite has no clock of its own")
def test_all_machines_go_by_the_clock_of_the_database(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    class Wrong(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> "Wrong":
            return super().now(tz) - timedelta(minutes=7)

    monkeypatch.setattr("app.db.datetime", Wrong)
    monkeypatch.setattr("app.db._clock", type(db._clock)())
    assert abs(now() - datetime.now(UTC)) > timedelta(minutes=6)
    with database.writing():
        pass
    assert abs(now() - datetime.now(UTC)) < timedelta(seconds=30)


@SEVERAL
def test_an_answer_sent_to_all_of_them_at_once_is_kept_once(
    addresses: list[str], database: Database, store: ArtefactStore, study: Study
) -> None:
    tokens = []
    with database.writing() as session:
        for _ in range(PEOPLE):
            person, token = factories.make_participant(session, study)
            factories.make_queries(session, store, person, LABELS)
            tokens.append(token)
    with ThreadPoolExecutor(PEOPLE) as pool:
        said = list(chain(*pool.map(lambda token: _label_everywhere(addresses, token), tokens)))
    with database.reading() as session:
        events = session.scalars(select(LabelEvent)).all()
    assert Counter(event.query_id for event in events).most_common(1)[0][1] == 1
    assert len(events) == PEOPLE * LABELS
    assert {event.client_uuid for event in events} <= {uuid for uuids in said for uuid in uuids}
    assert all(sum(event.client_uuid in uuids for event in events) == 1 for uuids in said)


def _label_everywhere(addresses: list[str], token: str) -> list[set[str]]:
    """Every answer goes to every server at once, twice: under one name, as when it is sent again, and another one's.

    Returns the names under which each answer was sent.
    """
    said = []
    with ThreadPoolExecutor(2 * len(addresses)) as pool:
        browsers = [httpx2.Client(base_url=each, headers=SCRIPT, timeout=PATIENCE_S) for each in addresses]
        browsers[0].get(f"/p/{token}")
        for browser in browsers[1:]:
            browser.cookies = browsers[0].cookies
        pair = browsers[0].get("/p/next").raise_for_status().json()["pair"]
        while pair:
            uuids = [str(uuid4()), str(uuid4())]
            together = threading.Barrier(2 * len(browsers))

            def send(browser: httpx2.Client, uuid: str, path: str = pair["label_path"]) -> None:
                together.wait()  # noqa: B023  (all are waited for before the next one is made)
                browser.post(path, data={"response": "left", "client_uuid": uuid}).raise_for_status()

            sent = [pool.submit(send, browser, uuid) for browser in browsers for uuid in uuids]
            for each in sent:
                each.result()
            said.append(set(uuids))
            turn = browsers[0].get("/p/next").raise_for_status().json()
            pair = turn["pair"] if turn["state"] == "pair" else None
        for browser in browsers:
            browser.close()
    return said


@SEVERAL
def test_people_who_join_at_once_get_numbers_of_their_own(
    addresses: list[str], database: Database, study: Study
) -> None:
    together = threading.Barrier(JOINING)

    def join(number: int) -> None:
        with httpx2.Client(base_url=addresses[number % SERVERS], timeout=PATIENCE_S) as browser:
            together.wait()
            browser.post(f"/join/{study.join_token}?PROLIFIC_PID={number}", follow_redirects=True).raise_for_status()

    with ThreadPoolExecutor(JOINING) as pool:
        list(pool.map(join, range(JOINING)))
    with database.reading() as session:
        numbers = sorted(session.scalars(select(Participant.number)))
    assert numbers == list(range(1, JOINING + 1))
