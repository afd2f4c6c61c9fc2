"""What the tests of the web half share: a studio in a temporary directory, with and without a real server."""

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import timedelta
from functools import cache
from pathlib import Path
from uuid import uuid4
from zlib import crc32

import pytest
import uvicorn
from anyio.from_thread import BlockingPortal, start_blocking_portal
from argon2 import PasswordHasher
from fastapi import FastAPI
from fastapi.testclient import TestClient
from sqlalchemy import select

import app.domain.clips
import app.domain.evaluation
import app.domain.models
import app.domain.participation
import app.domain.people
import app.domain.preferences
import app.domain.studies  # noqa: F401  (all of them fill Base.metadata)
from app.db import Database
from app.domain.people import Experimenter
from app.main import create_routes, make_studio, serve
from app.services.accounts import accounts, browser_sessions
from app.settings import Settings
from app.storage import ArtefactStore
from app.web.http.connections import KEPT_OPEN_S, Connection
from tests import buckets, databases
from tests.databases import make_tables

databases.share_compiled_statements()
databases.leave_files_to_the_system()
REAL_HASHER = accounts._hasher()


def hash_passwords_quickly() -> None:
    """In this process a password costs no quarter of a second, as it does in programs that tests start."""
    quick = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1)
    patch = pytest.MonkeyPatch()
    patch.setattr(accounts, "_hasher", lambda: quick)
    patch.setattr(accounts, "_HASH_OF_NOTHING", quick.hash(uuid4().hex))


hash_passwords_quickly()


gc.disable()


def pytest_collection_finish() -> None:
    """What was collected stays to the end: looking for garbage in it took a tenth of the suite's time."""
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tell the tests that work on a studio's database, and skip what makes no sense on the one they are given.

    Files with slow tests come first, so that none of them begins when everything else has ended. The others are mixed,
    so that what waits for films in a browser runs beside what computes.
    """
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, crc32(item.nodeid.partition("::")[0].encode())))
    seen = set()
    for item in items:
        name = item.nodeid.partition("[")[0]
        if name not in seen:
            item.add_marker("first_case")
        seen.add(name)
        if "settings" in getattr(item, "fixturenames", ()):
            item.add_marker("database")
        elsewhere = {"sqlite": databases.SERVER, "directory": buckets.BUCKET}
        for name, address in elsewhere.items():
            about = item.get_closest_marker(name)
            if address is not None and about is not None:
                item.add_marker(pytest.mark.skip(reason=about.args[0]))


PASSWORD = "a password of my own"


@pytest.fixture(autouse=databases.SERVER is not None)
def own_database(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """On a PostgreSQL server, a database of its own for each test that writes anything, and programs it starts."""
    if "tmp_path" not in request.fixturenames:
        yield
        return
    with databases.lent(request.getfixturevalue("tmp_path")) as url:
        monkeypatch.setenv("DATABASE_URL", url)
        with databases.all_closed():
            yield


@pytest.fixture(autouse=buckets.BUCKET is not None)
def own_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """On an S3-compatible server, a part of the bucket for each test, and for programs it starts."""
    monkeypatch.setenv("STORAGE_URL", f"{buckets.BUCKET}/{uuid4().hex}")


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Settings of a studio that lives in a temporary directory."""
    return Settings(_env_file=None, data_dir=tmp_path, public_url=None)


@cache
def the_routes() -> FastAPI:
    """Routes and compiled templates of all studios of this process: making them takes longer than most tests."""
    return create_routes(https=False)


@pytest.fixture
def studio_app(settings: Settings) -> FastAPI:
    """The web server, on an empty database of the newest schema."""
    studio = make_studio(settings)
    make_tables(studio.database)
    serve(the_routes(), studio)
    return the_routes()


@pytest.fixture
def database(studio_app: FastAPI) -> Iterator[Database]:
    """The server's database."""
    database: Database = studio_app.state.studio.database
    yield database
    database.dispose()


@pytest.fixture
def store(studio_app: FastAPI) -> ArtefactStore:
    """The server's artefacts."""
    store: ArtefactStore = studio_app.state.studio.store
    return store


@pytest.fixture(scope="session")
def event_loop_thread() -> Iterator[BlockingPortal]:
    """Where requests are answered: one thread for all tests, for each request would start its own otherwise."""
    with start_blocking_portal() as portal:
        yield portal


@pytest.fixture
def new_browser(studio_app: FastAPI, database: Database, event_loop_thread: BlockingPortal) -> Callable[[], TestClient]:
    """Makes browsers without cookies; none follows redirects by itself."""

    def browser() -> TestClient:
        made = TestClient(studio_app, follow_redirects=False)
        made.portal = event_loop_thread
        return made

    return browser


@pytest.fixture
def client(new_browser: Callable[[], TestClient]) -> TestClient:
    """A browser without cookies."""
    return new_browser()


@pytest.fixture(scope="session")
def password_hash() -> str:
    """Of everybody's password."""
    return accounts._hasher().hash(PASSWORD)


@pytest.fixture
def password(database: Database, password_hash: str) -> str:
    """The password of an experimenter who has already chosen it."""
    with database.writing() as session:
        account = Experimenter(
            name=accounts.FIRST_EXPERIMENTER, password_hash=password_hash, must_change_password=False
        )
        session.add(account)
    return PASSWORD


@pytest.fixture
def experimenter_cookie(database: Database, password: str) -> str:
    """The cookie of an experimenter who is logged in."""
    with database.writing() as session:
        account = session.scalars(select(Experimenter)).one()
        return browser_sessions.open_for_experimenter(session, account, timedelta(hours=1))


@pytest.fixture
def experimenter(client: TestClient, experimenter_cookie: str) -> TestClient:
    """A browser whose experimenter is logged in."""
    client.cookies["studio_experimenter"] = experimenter_cookie
    return client


@contextmanager
def serving(application: FastAPI) -> Iterator[str]:
    """Runs a real server on a free port; gives its address. Idle connections stay open as long as in a studio: by
    uvicorn's own 5 s one is closed while a test on a busy machine is just sending."""
    server = uvicorn.Server(
        uvicorn.Config(
            application,
            port=0,
            http=Connection,
            log_level="warning",
            timeout_keep_alive=KEPT_OPEN_S,
            timeout_graceful_shutdown=3,
        )
    )
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        threading.Event().wait(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        application.state.studio.closing.set()
        server.should_exit = True
        thread.join()


@pytest.fixture
def address(studio_app: FastAPI, database: Database) -> Iterator[str]:
    """The address of a real server."""
    with serving(studio_app) as url:
        yield url


Serving = Callable[[FastAPI], AbstractContextManager[str]]
