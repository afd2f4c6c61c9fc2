"""Several web servers on one database lose nothing and double nothing, whichever of them a request reaches."""

import threading
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from uuid import uuid4

import httpx2
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.settings import Settings
from app.storage import ArtefactStore
from tests import factories
from tests.answering import Server
from tests.waiting import PATIENCE_S, free_port, until

SERVERS, PEOPLE, LABELS, JOINING = 2, 6, 12, 20
SCRIPT = {"Accept": "application/json"}


@pytest.fixture
def addresses(settings: Settings, database: Database) -> Iterator[list[str]]:
    """Of servers in processes of their own."""
    servers = [Server(settings.model_copy(update={"port": free_port()})) for _ in range(SERVERS)]
    assert until(lambda: all(map(_is_up, servers)))
    yield [server.address for server in servers]
    for server in servers:
        server.kill()


def _is_up(server: Server) -> bool:
    try:
        return httpx2.get(f"{server.address}/health/live", timeout=PATIENCE_S).is_success
    except httpx2.TransportError:
        return False


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, labels_per_participant=LABELS, pool_scenarios=20)
        study.join_token = "everybody-is-welcome-here"
    return study


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
