"""The page of the audit log: for administrators, by person, act, study and day, page by page; and its files."""

import csv
import io
import re
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app import signing
from app.db import Database, now
from app.domain.people import AuditEvent, Experimenter, Role
from app.services import audit
from app.services.auditing import lookup
from app.services.auditing.lookup import PAGE_SIZE
from app.settings import Settings
from tests import factories

ADDRESSES = ["/audit", "/audit/log.csv", "/audit/log.jsonl", "/audit/head.json", "/audit/proof"]


def rows(page: str) -> list[int]:
    """The numbers of the rows on a page, as shown."""
    return [int(number) for number in re.findall(r'data-label="Row" class="audit-number">(\d+)<', page)]


def link(page: str, rel: str) -> str | None:
    found = re.search(rf'rel="{rel}" href="([^"]+)"', page)
    return found[1].replace("&amp;", "&") if found else None


@pytest.fixture
def long_log(database: Database, experimenter: TestClient) -> TestClient:
    with database.writing() as session:
        study = factories.make_study(session)
        for number in range(170):
            audit.record(
                session, "kim" if number % 2 else "pat", "answers viewed", f"{study.slug}/{number}", study=study
            )
    return experimenter


@pytest.mark.parametrize("address", ADDRESSES)
def test_only_administrators_see_it(experimenter: TestClient, database: Database, address: str) -> None:
    assert experimenter.get(address).status_code == 200
    with database.writing() as session:
        session.scalars(select(Experimenter)).one().role = Role.EXPERIMENTER
    assert experimenter.get(address).status_code == 403


def test_pages_together_are_the_whole_log_once_and_lead_back(long_log: TestClient) -> None:
    long_log.get("/audit")  # from now on looking leaves no further row for an hour
    address, pages = "/audit", []
    while address is not None:
        page = long_log.get(address).text
        pages.append(rows(page))
        last, address = address, link(page, "next")  # type: ignore[assignment]
    seen = [number for page in pages for number in page]
    assert seen == sorted(seen, reverse=True)
    assert seen == list(range(seen[0], 0, -1))
    assert [len(page) for page in pages[:-1]] == [PAGE_SIZE] * 3
    back = link(long_log.get(last).text, "prev")
    assert back is not None
    assert rows(long_log.get(back).text) == pages[-2]


def test_rows_are_found_by_who_what_study_and_day(long_log: TestClient, database: Database) -> None:
    with database.writing() as session:
        for row in session.scalars(select(AuditEvent).where(AuditEvent.id <= 5)):
            row.at = now() - timedelta(days=40)
    by_kim = long_log.get("/audit?actor=kim").text
    assert len(rows(by_kim)) == PAGE_SIZE
    assert 'data-label="Who">pat' not in by_kim
    older = link(by_kim, "next")
    assert older is not None
    assert "actor=kim" in older
    assert len(rows(long_log.get("/audit?action=study+created").text)) == 1
    assert "No row is like this" in long_log.get("/audit?study=no-such-study").text
    assert len(rows(long_log.get("/audit?study=feeding-at-home").text)) == PAGE_SIZE
    until = (now() - timedelta(days=1)).date()
    assert rows(long_log.get(f"/audit?until={until}").text) == [5, 4, 3, 2, 1]
    assert 5 not in rows(long_log.get(f"/audit?since={until}&below=20").text)


def test_files_hold_every_row_and_the_head_is_the_last_one(
    long_log: TestClient, database: Database, settings: Settings
) -> None:
    for kind in ("csv", "jsonl"):
        assert "attachment" in long_log.get(f"/audit/log.{kind}").headers["content-disposition"]
    in_csv = list(csv.DictReader(io.StringIO(long_log.get("/audit/log.csv").text)))
    head = long_log.get("/audit/head.json").json()
    assert signing.signer_of(head) == signing.load(settings).fingerprint
    outcome = lookup.check_lines(long_log.get("/audit/log.jsonl").text.splitlines(), head["hash"])
    assert (outcome.faults, outcome.noted) == ([], audit.Head(head["row"], head["hash"]))
    assert outcome.rows >= len(in_csv) > 170
    assert [int(row["id"]) for row in in_csv] == list(range(1, len(in_csv) + 1))
    assert in_csv[-1]["row_hash"] in long_log.get("/audit/log.jsonl").text
    page = long_log.get("/audit/proof").text
    assert outcome.head.hash in page
    assert signing.load(settings).fingerprint in page
