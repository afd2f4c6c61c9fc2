"""Log lines as JSON: each names the request or the job it is about, and no line has a personal link."""

import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app import logs
from app.__main__ import main, migrate
from app.settings import Settings
from tests import databases
from tests.app.conftest import TakingPart
from tests.waiting import PATIENCE_S, free_port, until


@pytest.fixture
def lines() -> Iterator[list[dict[str, object]]]:
    """What is logged, as JSON and read again."""
    written: list[dict[str, object]] = []

    class Kept(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.name != "httpx2":  # the tests' own browser
                written.append(json.loads(self.format(record)))

    handler, root = Kept(), logging.getLogger()
    handler.setFormatter(logs.JsonLines())
    level = root.level
    root.addHandler(handler)
    root.setLevel(logging.INFO)
    yield written
    root.removeHandler(handler)
    root.setLevel(level)


def test_a_line_says_what_it_is_about_and_keeps_its_traceback(lines: list[dict[str, object]]) -> None:
    log = logging.getLogger("somewhere")
    with logs.about(job="filter/participant-1"):
        with logs.about(step="save"):
            log.warning("a line\nof two, with \N{SNOWMAN}")
        try:
            raise ValueError("broken")
        except ValueError:
            log.exception("it failed")
    log.info("after it")
    first, second, third = lines
    assert (first["job"], first["step"], first["level"]) == ("filter/participant-1", "save", "warning")
    assert first["message"] == "a line\nof two, with \N{SNOWMAN}"
    assert "ValueError: broken" in str(second["traceback"])
    assert "step" not in second
    assert "job" not in third


def test_every_request_has_an_id_that_is_told_and_logged(client: TestClient, lines: list[dict[str, object]]) -> None:
    ids = [client.get("/login").headers["x-request-id"] for _ in range(2)]
    assert len(set(ids)) == 2
    logged = [line for line in lines if line["logger"] == "app.requests"]
    assert [(line["request"], line["route"], line["status"]) for line in logged] == [
        (each, "/login", 200) for each in ids
    ]


@pytest.mark.parametrize(
    ("given", "is_taken"),
    [("a-proxy-s-own-id", True), ("short", False), ("x" * 65, False), ('ab"c{}defgh', False), ("", False)],
)
def test_an_id_that_a_proxy_has_given_is_kept_if_it_is_one(client: TestClient, given: str, is_taken: bool) -> None:
    answer = client.get("/login", headers={"X-Request-ID": given})
    assert (answer.headers["x-request-id"] == given) is is_taken


def test_a_failure_of_ours_is_told_with_the_id_its_line_has(
    studio_app: FastAPI, taking_part: TakingPart, lines: list[dict[str, object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.web.http.deps.browser_sessions.participant_of", lambda *_: 1 / 0)
    browser = TestClient(studio_app, raise_server_exceptions=False, cookies=taking_part.browser.cookies)
    answer = browser.get("/p/next")
    assert answer.status_code == 500
    (line,) = [each for each in lines if each.get("status") == 500]
    assert line["request"] == answer.headers["x-request-id"]


def test_no_line_has_a_personal_link(taking_part: TakingPart, lines: list[dict[str, object]]) -> None:
    taking_part.browser.get(f"/p/{taking_part.token}")
    taking_part.browser.get(f"/p/{taking_part.token}?x={taking_part.token}")
    assert any(line.get("route") == "/p/{token}" for line in lines)
    assert taking_part.token not in json.dumps(lines)


def test_the_web_server_alone_writes_nothing_but_json(tmp_path: Path) -> None:
    settings = Settings(_env_file=None, data_dir=tmp_path, port=free_port())
    migrate(settings)
    environment = databases.environment(tmp_path, PORT=str(settings.port), LOG_FORMAT="json")
    server = subprocess.Popen(
        [sys.executable, "-m", "app", "web"],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )

    def answers() -> bool:
        try:
            return httpx2.get(f"{settings.base_url}/health", timeout=PATIENCE_S).status_code == 200
        except httpx2.TransportError:
            return False

    assert until(answers)
    server.terminate()
    said, _ = server.communicate(timeout=PATIENCE_S)
    written = [json.loads(line) for line in said.splitlines()]
    assert "/health" in [line.get("route") for line in written]


def test_the_web_server_alone_says_that_its_port_is_in_use(
    tmp_path: Path, address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PORT", address.rpartition(":")[2])
    monkeypatch.setenv("DATA_DIR", str(tmp_path))
    assert main(["web"]) == 1
    assert "Stop the program that uses it" in capsys.readouterr().out
