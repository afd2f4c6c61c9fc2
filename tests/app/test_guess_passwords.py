"""Guessing passwords and tokens: slow for whoever guesses, harmless for everybody else."""

import asyncio
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from pydantic import ValidationError
from sqlalchemy import select

from app.db import Database
from app.domain.people import BrowserSession, Experimenter
from app.services.accounts import accounts, api_tokens, known_browsers
from app.settings import Settings
from app.web.http.hashing import Hashing
from app.web.http.rate_limit import WINDOW_S, LoginAttempts
from tests import databases
from tests.app.conftest import TakingPart
from tests.waiting import PATIENCE_S, free_port

NAME = accounts.FIRST_EXPERIMENTER


class Clock:
    """A clock that stands still until it is moved."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def attempts(clock: Clock) -> LoginAttempts:
    """Ten per address, thirty per account, sixty in all."""
    return LoginAttempts(10, clock=clock)


def guess(attempts: LoginAttempts, count: int, account: str = NAME) -> list[bool]:
    """Attempts from ever new addresses."""
    return [attempts.allow(f"10.0.{number // 250}.{number % 250}", account) for number in range(count)]


def log_in(browser: TestClient, password: str, **options: str) -> Answer:
    return browser.post("/login", data={"name": NAME, "password": password}, headers=options)


class TestLimits:
    def test_one_address_uses_up_its_own_attempts_and_nobody_elses(self, attempts: LoginAttempts) -> None:
        assert [attempts.allow("10.0.0.1", NAME) for _ in range(12)] == [True] * 10 + [False] * 2
        assert attempts.allow("10.0.0.2", NAME)

    def test_one_account_is_guessed_at_slowly_from_however_many_addresses(self, attempts: LoginAttempts) -> None:
        assert guess(attempts, 40) == [True] * 30 + [False] * 10
        assert attempts.allow("10.9.9.9", "somebody else")

    def test_names_and_addresses_together_have_a_limit(self, attempts: LoginAttempts) -> None:
        allowed = [attempts.allow(f"10.1.{number}.1", f"name {number}") for number in range(100)]
        assert allowed == [True] * 60 + [False] * 40

    def test_a_browser_that_the_account_knows_gets_in_while_others_guess(self, attempts: LoginAttempts) -> None:
        guess(attempts, 1000)
        assert attempts.allow("10.0.0.1", NAME, "known")
        assert [attempts.allow("10.0.0.1", NAME, "known") for _ in range(10)] == [True] * 9 + [False]

    def test_after_a_minute_it_is_over(self, attempts: LoginAttempts, clock: Clock) -> None:
        guess(attempts, 1000)
        assert not attempts.allow("10.9.9.9", NAME)
        clock.now_s += WINDOW_S
        assert attempts.allow("10.9.9.9", NAME)

    def test_whoever_has_one_ipv6_address_has_no_more_attempts_than_others(self, attempts: LoginAttempts) -> None:
        neighbours = [f"2001:db8:0:1::{number:x}" for number in range(1, 13)]
        assert [attempts.allow(each, NAME) for each in neighbours] == [True] * 10 + [False] * 2
        assert attempts.allow("2001:db8:0:2::1", NAME)

    def test_what_is_remembered_is_bounded_by_the_limits(self, attempts: LoginAttempts) -> None:
        for number in range(5000):
            attempts.allow(f"10.{number % 200}.{number % 250}.7", f"name {number}")
        assert len(attempts) == 60


class TestKnownBrowsers:
    def test_a_login_makes_the_browser_known_and_it_gets_in_past_a_guesser(
        self, client: TestClient, password: str, studio_app: FastAPI, new_browser: Callable[[], TestClient]
    ) -> None:
        assert log_in(client, password).status_code == 303
        guess(studio_app.state.studio.login_attempts, 1000)
        assert log_in(new_browser(), password).status_code == 429
        assert log_in(client, password).status_code == 303

    def test_a_mark_opens_nothing_by_itself(self, client: TestClient, password: str) -> None:
        log_in(client, password)
        client.cookies.delete("studio_experimenter")
        assert client.get("/studies").status_code == 303
        assert log_in(client, "wrong").status_code == 401

    def test_a_known_browser_does_not_queue_behind_those_who_guess(
        self, client: TestClient, password: str, studio_app: FastAPI
    ) -> None:
        log_in(client, password)
        go_on = threading.Event()
        studio_app.state.studio.hashing._executor.submit(go_on.wait)
        assert log_in(client, password).status_code == 303
        go_on.set()

    def test_marks_are_good_for_one_account_and_one_password(self) -> None:
        pat, kim = Experimenter(id=1, password_hash="one"), Experimenter(id=2, password_hash="one")
        mark = known_browsers.new_mark(pat)
        assert known_browsers.name_in(mark, pat)
        assert known_browsers.name_in(mark, kim) is None
        assert known_browsers.name_in(mark, None) is None
        pat.password_hash = "another"
        assert known_browsers.name_in(mark, pat) is None

    @pytest.mark.parametrize("mark", ["", ".", "a.b", "ä.ö", "x" * 4000, "\udcff.\x00"])
    def test_a_forged_mark_is_a_strangers(self, mark: str) -> None:
        assert known_browsers.name_in(mark, Experimenter(id=1, password_hash="one")) is None


def test_wrong_tokens_do_not_lock_the_people_of_that_address_out(client: TestClient, password: str) -> None:
    for _ in range(30):
        client.get("/api/v1/me", headers={"Authorization": "Bearer pbarl_wrong"})
    assert log_in(client, password).status_code == 303


def test_wrong_passwords_do_not_lock_a_program_out(client: TestClient, password: str, database: Database) -> None:
    with database.writing() as session:
        token = api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")[1]
    for _ in range(11):
        log_in(client, "wrong")
    for wrong in range(12):
        client.get("/api/v1/me", headers={"Authorization": f"Bearer pbarl_{wrong}"})
    assert client.get("/api/v1/me", headers={"Authorization": f"Bearer {token}"}).status_code == 200


class TestHashing:
    @pytest.fixture
    def stuck(self, studio_app: FastAPI) -> Iterator[threading.Event]:
        """Somebody's password is being hashed, and takes forever."""
        begun, go_on = threading.Event(), threading.Event()

        def hash_for_long() -> None:
            begun.set()
            go_on.wait()

        hashing: Hashing = studio_app.state.studio.hashing
        hashing._executor.submit(hash_for_long)
        begun.wait()
        yield go_on
        go_on.set()

    def test_while_passwords_are_hashed_everybody_else_is_served(
        self, studio_app: FastAPI, taking_part: TakingPart, password: str, stuck: threading.Event
    ) -> None:
        application = studio_app
        application.state.studio.login_attempts._per_address = 1000
        codes: list[int] = []
        browsers = [TestClient(application, follow_redirects=False) for _ in range(24)]
        waiting = [
            threading.Thread(target=lambda browser=browser: codes.append(log_in(browser, "wrong").status_code))
            for browser in browsers
        ]
        for thread in waiting:
            thread.start()
        while application.state.studio.hashing._executor._work_queue.qsize() < 24:
            threading.Event().wait(0.01)
        taking_part.turn()
        assert taking_part.answer(taking_part.queries[0]).status_code == 200
        sha256 = taking_part.turn().json()["pair"]["left"]["video"]
        assert taking_part.browser.get(sha256).status_code == 200
        assert codes == []
        stuck.set()
        for thread in waiting:
            thread.join()
        assert set(codes) == {401}

    def test_passwords_are_hashed_one_at_a_time(self) -> None:
        hashing, at_once, most = Hashing(), 0, 0

        def work() -> None:
            nonlocal at_once, most
            at_once += 1
            most = max(most, at_once)
            threading.Event().wait(0.01)
            at_once -= 1

        async def several() -> None:
            await asyncio.gather(*(hashing.run(work) for _ in range(10)))

        asyncio.run(several())
        hashing.close()
        assert most == 1


def test_a_password_that_was_replaced_while_it_was_checked_opens_nothing(
    client: TestClient, password: str, database: Database, studio_app: FastAPI, monkeypatch: pytest.MonkeyPatch
) -> None:
    verify = accounts.verify

    def verify_slowly(experimenter: Experimenter | None, typed: str) -> Experimenter:
        found = verify(experimenter, typed)
        with database.writing() as session:
            accounts.reset_password(session, NAME)
        return found

    monkeypatch.setattr("app.services.accounts.accounts.verify", verify_slowly)
    assert log_in(client, password).status_code == 401
    with database.reading() as session:
        assert session.scalars(select(BrowserSession)).all() == []


class TestProxies:
    @pytest.mark.parametrize("text", ["*", "0.0.0.0/0", "::/0", "proxy.example", "127.0.0.1, nonsense"])
    def test_only_addresses_can_be_trusted(self, text: str) -> None:
        with pytest.raises(ValidationError, match=r"neither an address|everybody"):
            Settings(_env_file=None, trusted_proxies=text)

    def test_several_can_be_named(self) -> None:
        assert Settings(_env_file=None, trusted_proxies=" 127.0.0.1 , 10.0.0.0/8").trusted_proxies == (
            "127.0.0.1,10.0.0.0/8"
        )

    @pytest.mark.parametrize(("trusted", "last"), [("", 429), pytest.param("127.0.0.1", 401, marks=pytest.mark.long)])
    def test_where_a_request_comes_from_is_believed_only_from_a_trusted_proxy(
        self, settings: Settings, password: str, trusted: str, last: int
    ) -> None:
        """On the real server: a guesser who names another address every time is one address all the same."""
        with _server(settings.data_dir, trusted) as address:
            codes = [
                httpx2.post(
                    f"{address}/login",
                    data={"name": NAME, "password": "wrong"},
                    headers={"X-Forwarded-For": f"203.0.113.{number}"},
                    timeout=PATIENCE_S,
                ).status_code
                for number in range(4)
            ]
        assert codes == [401, 401, 401, last]


@contextmanager
def _server(directory: Path, trusted_proxies: str) -> Iterator[str]:
    """The web server as ``python -m app up`` starts it, three attempts per minute; gives its address."""
    settings = Settings(_env_file=None, port=free_port())
    environment = databases.environment(directory, LOGIN_ATTEMPTS_PER_MINUTE="3", FORWARDED_ALLOW_IPS="127.0.0.1")
    environment |= {"PORT": str(settings.port), "TRUSTED_PROXIES": trusted_proxies}
    server = subprocess.Popen([sys.executable, "-m", "app", "web"], env=environment)
    try:
        while True:
            try:
                httpx2.get(f"{settings.base_url}/login", timeout=PATIENCE_S)
                break
            except httpx2.ConnectError:
                assert server.poll() is None
                threading.Event().wait(0.1)
        yield settings.base_url
    finally:
        server.terminate()
        server.wait()
