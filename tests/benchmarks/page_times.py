"""Prints how long every page, table and export of a large study takes to its first byte, the slowest first.

    python -m tests.benchmarks.page_times --people 100 --labels 200

Which there are is read from the routes. Of tables over the API: the first, middle and last page. "Processor" is the web
server's own time for the whole answer, which does not depend on who else computes.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from datetime import timedelta
from pathlib import Path
from statistics import median
from typing import NamedTuple

import httpx2
from fastapi.routing import iter_route_contexts
from sqlalchemy import select

from app.__main__ import migrate
from app.db import Database
from app.domain.models import Export
from app.domain.people import Experimenter
from app.domain.preferences import Query
from app.main import create_routes
from app.programs import end_with_parent
from app.services.accounts import api_tokens, browser_sessions
from app.services.exports import export_tables
from app.settings import Settings
from app.storage import ArtefactStore
from tests.benchmarks import large_study
from tests.benchmarks.save_latency import _await_health, _processor_s, _rss_mb, _say
from tests.waiting import free_port

API = "/api/v1"
PROMISED_MS = 300
NOT_ASKED = re.compile(
    r"^/(p|join|media|static|language)/|/links/|/live$|/controllers/|/figures/|/metrics|receipts|/operate|/report$"
)
"""Of participants; of one's own files; streams; and what such a study has none of."""


class Measured(NamedTuple):
    """One address, asked several times."""

    first_byte_ms: float
    slowest_ms: float
    processor_ms: float
    size_kb: float
    path: str


def main() -> None:
    """Fill a studio, ask for everything, and print the times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=100)
    parser.add_argument("--labels", type=int, default=200, help="of each")
    parser.add_argument("--times", type=int, default=4, help="that each address is asked for; the first is told apart")
    parser.add_argument("--directory", type=Path, help="keeps the studio there, or takes the one that is there")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        directory = options.directory or Path(temporary)
        directory.mkdir(parents=True, exist_ok=True)
        settings = Settings(_env_file=None, data_dir=directory, database_url=None, port=free_port())
        migrate(settings)
        cookie, token, query_id = _studio(settings, options.people, options.labels)
        server = subprocess.Popen(
            [
                *(sys.executable, "-m", "uvicorn", "app.main:create_app", "--factory", "--no-access-log"),
                *("--log-level", "warning", "--port", str(settings.port)),
            ],
            env={**os.environ, "DATA_DIR": str(directory), "DATABASE_URL": settings.sqlalchemy_url},
            preexec_fn=end_with_parent,
        )
        try:
            _await_health(settings.base_url)
            headers = {"Authorization": f"Bearer {token}"}
            with httpx2.Client(
                base_url=settings.base_url, cookies={"studio_experimenter": cookie}, headers=headers, timeout=120
            ) as browser:
                paths = [*_pages(query_id), *_api(browser)]
                measured = [_measure(browser, path, server.pid, options.times) for path in paths]
            _print(measured)
            _say(f"memory of the web server {_rss_mb(server.pid):.0f} MB")
        finally:
            server.terminate()
            server.wait()


def _studio(settings: Settings, people: int, labels: int) -> tuple[str, str, int]:
    """A cookie and a token of an experimenter, and the id of a pair in the middle."""
    database, store = Database(settings.sqlalchemy_url), ArtefactStore(settings.data_dir / "artefacts")
    with database.writing() as session:
        if session.scalar(select(Query.id).limit(1)) is None:
            study = large_study.make_study(session, labels)
            large_study.fill(session, store, study, large_study.make_clips(session, store, study), people, labels)
            session.add(Export(study_id=study.id, kind="data", requested_by="ada"))
            session.add(Experimenter(name="ada", password_hash="-", must_change_password=False))
            session.flush()
        account = session.scalars(select(Experimenter).where(Experimenter.name == "ada")).one()
        cookie = browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))
        _, token = api_tokens.create(session, account, "benchmark")
        ids = session.scalars(select(Query.id).order_by(Query.id)).all()
    database.dispose()
    return cookie, token, ids[len(ids) // 2]


def _pages(query_id: int) -> Iterator[str]:
    """Every page of experimenters, and every table as a file."""
    values = {"slug": "feeding-at-home", "code": "P01", "query_id": str(query_id), "kind": "jsonl", "version": "1"}
    yield from _filled(_addresses(""), values)
    study = f"/studies/{values['slug']}"
    yield from (f"{study}/export/{table.name}.{kind}" for table in export_tables.TABLES for kind in ("csv", "jsonl"))
    yield from (f"{study}?{view}" for view in ("page=0", "sort=seen"))
    yield from (f"{study}/answers?page={page}" for page in (100, 400, 800))
    yield from (
        f"{study}/answers?{narrowed}" for narrowed in ("mark=mispredicted", "mark=contradicts", "participant=P01")
    )


def _api(browser: httpx2.Client) -> Iterator[str]:
    """Every address of the API, and of each table the first, middle and last page."""
    values = {"slug": "feeding-at-home", "code": "P01", "version": "1"}
    yield from (f"{API}{path}" for path in _filled(_addresses("api"), values))
    for table in export_tables.TABLES:
        pages, page = [], f"{API}/studies/{values['slug']}/tables/{table.name}"
        while page:
            pages.append(page)
            page = browser.get(page).raise_for_status().json()["next"]
        yield from dict.fromkeys((pages[0], pages[len(pages) // 2], pages[-1]))


def _addresses(of: str) -> Iterator[str]:
    application = create_routes(https=False)
    for each in iter_route_contexts((application.state.api if of == "api" else application).routes):
        if "GET" in (getattr(each, "methods", None) or ()) and each.path:
            yield each.path


def _filled(addresses: Iterator[str], values: Mapping[str, str]) -> Iterator[str]:
    for address in dict.fromkeys(addresses):
        if not NOT_ASKED.search(address) and set(re.findall(r"{(\w+)}", address)) <= set(values):
            yield address.format(**values)


def _measure(browser: httpx2.Client, path: str, pid: int, times: int) -> Measured:
    first_byte_ms, size, before_s = list[float](), 0, 0.0
    for number in range(times):
        if number == 1:
            before_s = _processor_s(pid)
        started = time.perf_counter()
        with browser.stream("GET", path) as answer:
            pieces = answer.iter_raw()
            size = len(next(pieces, b""))
            first_byte_ms.append(1000 * (time.perf_counter() - started))
            size += sum(map(len, pieces))
            if answer.status_code >= 400:
                _say(f"{answer.status_code}: {path}")
    used_ms = 1000 * (_processor_s(pid) - before_s) / max(1, times - 1)
    return Measured(median(first_byte_ms[1:]), max(first_byte_ms), used_ms, size / 1000, path)


def _print(measured: list[Measured]) -> None:
    _say("first byte, median | slowest | processor, whole answer | size | address")
    for each in sorted(measured, reverse=True):
        times = f"{each.first_byte_ms:6.0f} ms {each.slowest_ms:6.0f} ms {each.processor_ms:6.0f} ms"
        _say(f"{times} {each.size_kb:7.0f} kB  {re.sub('cursor=.*', 'cursor=...', each.path)}")
    late = sum(each.slowest_ms > PROMISED_MS for each in measured)
    _say(f"{len(measured)} addresses; first byte after more than {PROMISED_MS} ms at least once: {late}")


if __name__ == "__main__":
    main()
