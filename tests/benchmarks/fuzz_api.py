"""Sends generated requests to the API, as its OpenAPI document describes them, and generated nonsense to every form.

    python -m tests.benchmarks.fuzz_api --requests 10000

Nothing may be answered with a failure of ours, nor by the API with a status, content type or body that its document
does not name. Every address is tried on a studio of its own, so that a study deleted by chance hides nothing.
"""

import argparse
import random
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any
from urllib.parse import quote

import hypothesis
import hypothesis.configuration
import schemathesis
from argon2 import PasswordHasher
from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase
from schemathesis.checks import not_a_server_error
from schemathesis.core.failures import FailureGroup
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from tqdm import tqdm

from app.domain.clips import Clip
from app.domain.models import ModelKind
from app.domain.people import Experimenter, Role, StudyRole, TokenScope
from app.domain.study_settings import StudySettings
from app.main import create_routes, make_studio, serve
from app.services.accounts import api_tokens, browser_sessions
from app.services.studies import membership
from app.settings import Settings
from app.storage import ArtefactStore
from app.web.api.callers import PREFIX
from tests import factories
from tests.databases import make_tables

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]
WRITING, READING, ELSEWHERE, NOBODY, GUESSED = "token", "token to read", "token elsewhere", "no token", "wrong token"
PARTICIPANT, OWNER, ADMINISTRATOR, STRANGER = "participant", "owner", "administrator", "stranger"
CALLERS, VISITORS = (WRITING, READING, ELSEWHERE, NOBODY, GUESSED), (PARTICIPANT, OWNER, ADMINISTRATOR, STRANGER)
PASSWORD_HASH = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash("a password of nobody")
HOUR = timedelta(hours=1)
STATUSES = {200, 201, 204, 206, 302, 303, 304, 307, 400, 401, 403, 404, 405, 409, 410, 413, 415, 416, 422, 429}
"""What a page may answer a form with. 503 would be a database that is away, and 500 our fault."""
TYPES = ("text/", "application/json", "application/problem+json", "application/zip", "video/mp4", "image/")
PARAMETER = re.compile(r"{(\w+)(?::\w+)?}")
PIECES = ["", "0", "1", "-1", "1e999", "NaN", "9" * 40, "true", "on", "left", "equal", "en", "de", "\0", "\ud83d\ude00"]
PIECES += [
    "' OR 1=1 --",
    "<script>",
    "../../etc/passwd",
    "%s%n",
    "{{7*7}}",
    "2026-13-45",
    "null",
    "[]",
    "\u202e",
    " \t\r\n",
]
PIECES += ["x" * 5000, "0b7a6a0e-6f7e-4d4e-9d44-5d2f6a2c8d11", "P01", "here", "viewer", "owner", "ß" * 300]


@dataclass
class Found:
    """How many requests were sent, how they were answered, and what must not be."""

    requests: Counter[str] = field(default_factory=Counter)
    statuses: Counter[int] = field(default_factory=Counter)
    findings: dict[str, str] = field(default_factory=dict)
    """one example of each kind"""


@dataclass
class Fuzzed:
    """A studio with a study in the middle of everything, and a browser or program of every kind."""

    browsers: Mapping[str, TestClient]
    values: Mapping[str, str]
    """what addresses are made of"""


def main() -> int:
    """Send so many, print what came of them; 1 when anything was found."""
    options = _options()
    found = fuzz(options.requests, options.seed, quiet=False)
    for what, count in found.requests.items():
        _say(f"{what}: {count} requests")
    _say("answers: " + ", ".join(f"{count} x {status}" for status, count in sorted(found.statuses.items())))
    _say(f"findings: {len(found.findings)}")
    for kind, example in found.findings.items():
        _say(f"* {kind}\n    {example}")
    return 1 if found.findings else 0


def fuzz(count: int, seed: int, *, quiet: bool = True) -> Found:
    """So many requests, half of them to the API, spread evenly over its operations and over all forms and pages.

    Of fewer requests than there are addresses each goes to another one.
    Ctrl-C ends it early.
    """
    hypothesis.configuration.set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")
    found, application = Found(), create_routes(https=False)
    with tqdm(total=count, disable=quiet, mininterval=10) as bar, suppress(KeyboardInterrupt):
        operations = list(_operations(application))
        for number, (method, path) in enumerate(operations):
            share = _share(count // 2, number, len(operations))
            if share:
                with _studio(application) as studio:
                    _fuzz_operation(application, studio, method, path, share, seed, found)
            bar.update(share)
        addresses = list(_addresses(application))
        for number, (method, path, fields) in enumerate(addresses):
            share = _share(count - count // 2, number, len(addresses))
            rng = random.Random(f"{seed} {method} {path}")  # noqa: S311  (no secret)
            if share:
                with _studio(application) as studio:
                    for _ in range(share):
                        _fuzz_page(studio, method, path, fields, rng, found)
            bar.update(share)
    return found


def _share(count: int, number: int, of: int) -> int:
    return count * (number + 1) // of - count * number // of


def _operations(application: FastAPI) -> Iterator[tuple[str, str]]:
    for path, methods in application.state.api.openapi()["paths"].items():
        for method in methods:
            yield method, path


def _fuzz_operation(
    application: FastAPI, studio: Fuzzed, method: str, path: str, count: int, seed: int, found: Found
) -> None:
    schema = schemathesis.openapi.from_dict(application.state.api.openapi())
    operation = schema[path][method]
    rng = random.Random(f"{seed} {method} {path}")  # noqa: S311  (no secret)
    modes = [GenerationMode.POSITIVE, GenerationMode.NEGATIVE]
    strategy = hypothesis.strategies.one_of(*(operation.as_strategy(generation_mode=mode) for mode in modes))

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=[Phase.generate],
    )
    @hypothesis.given(strategy)
    def ask(case: Any) -> None:
        (caller,) = rng.choices(CALLERS, weights=(8, 3, 2, 1, 1))
        if rng.random() < 0.7:  # else nearly everything is about studies that do not exist
            case.path_parameters.update(
                {name: studio.values.get(name, value) for name, value in case.path_parameters.items()}
            )
        sent = case.as_transport_kwargs(base_url=PREFIX)
        names = {"json": "json", "data": "content" if isinstance(sent.get("data"), bytes) else "data"}
        body = {names[name]: sent[name] for name in names if sent.get(name) is not None}
        headers = {name: str(value) for name, value in (sent.get("headers") or {}).items()}
        headers.pop("Authorization", None)
        answer = studio.browsers[caller].request(
            sent["method"], sent["url"], params=sent.get("params"), headers=headers, **body
        )
        found.requests["the API"] += 1
        found.statuses[answer.status_code] += 1
        try:
            case.validate_response(answer, checks=CHECKS)
        except FailureGroup as group:
            for failure in group.exceptions:
                kind = f"{method.upper()} {path}: {failure.title}, {answer.status_code}"
                found.findings.setdefault(kind, f"{caller}: {sent['url']} {body}: {answer.text[:200]!r}")

    # what cannot be generated (an address without parameters cannot be wrong) is not asked
    with suppress(hypothesis.errors.Unsatisfiable):
        ask()


def _addresses(application: FastAPI) -> Iterator[tuple[str, str, list[str]]]:
    """Method, path and names of fields of every page and form."""
    for route in iter_route_contexts(application.routes):
        dependant = getattr(route.original_route, "dependant", None)
        if dependant is None or not route.path or route.path == "/health":
            continue  # which says 503 of tables that no migration has made
        fields = sorted(_fields(dependant)) or sorted(StudySettings.model_fields)
        for method in sorted(route.methods or ()):
            yield method, route.path, fields


def _fields(dependant: Any) -> set[str]:
    return {each.alias for each in dependant.body_params}.union(*(_fields(each) for each in dependant.dependencies))


def _fuzz_page(studio: Fuzzed, method: str, path: str, fields: list[str], rng: random.Random, found: Found) -> None:
    (visitor,) = rng.choices(VISITORS, weights=(4, 4, 4, 1))

    def part(name: str) -> str:
        known = studio.values.get(name, "1")
        return known if rng.random() < 0.8 else quote(rng.choice(PIECES).encode("utf-8", "replace"), safe="")

    address = PARAMETER.sub(lambda match: part(match[1]), path)
    chosen = [name for name in fields if rng.random() < 0.8] + ["nonsense"]
    form = [(name, _piece(rng)) for name in chosen for _ in range(1 + (rng.random() < 0.1))]
    encoded = "&".join(f"{quote(name)}={quote(value.encode('utf-8', 'replace'))}" for name, value in form)
    headers = {"accept": rng.choice(["text/html", "application/json"])}
    browser = studio.browsers[visitor]
    if method == "POST":
        headers["content-type"] = "application/x-www-form-urlencoded"
        answer = browser.request(method, address, content=encoded, headers=headers)
    else:
        answer = browser.request(method, f"{address}?{encoded[:2000]}", headers=headers)
    found.requests["pages and forms"] += 1
    found.statuses[answer.status_code] += 1
    known_type = answer.headers.get("content-type", "").startswith(TYPES) or not answer.content
    silent = answer.status_code >= 400 and method != "HEAD" and not answer.text
    if answer.status_code not in STATUSES or not known_type or silent:
        kind = f"{method} {path}: {answer.status_code} {answer.headers.get('content-type')}"
        found.findings.setdefault(kind, f"{visitor}: {address[:100]} {encoded[:300]}")


def _piece(rng: random.Random) -> str:
    """A value of a field: nonsense that is known to hurt, or characters at random."""
    if rng.random() < 0.7:
        return rng.choice(PIECES)
    return "".join(chr(rng.choice((rng.randrange(128), rng.randrange(0xD800)))) for _ in range(rng.randrange(40)))


@contextmanager
def _studio(application: FastAPI) -> Iterator[Fuzzed]:
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        settings = Settings(_env_file=None, data_dir=Path(folder), database_url=None, storage_url=None, public_url=None)
        studio = make_studio(settings)
        make_tables(studio.database)
        serve(application, studio)
        studio.closing.set()  # streams begin, and end at once
        try:
            yield _filled(application, ArtefactStore.of(settings))
        finally:
            studio.database.dispose()


def _filled(application: FastAPI, store: ArtefactStore) -> Fuzzed:
    browsers = {
        name: TestClient(application, raise_server_exceptions=False, follow_redirects=False)
        for name in (*CALLERS, *VISITORS)
    }
    browsers[GUESSED].headers["authorization"] = f"Bearer {api_tokens.PREFIX}guessed"
    with application.state.studio.database.writing() as session:
        here, there = factories.make_study(session, "Here"), factories.make_study(session, "There")
        person, token = factories.make_participant(session, here)
        query, other = factories.make_queries(session, store, person, 2)
        factories.make_label(session, other)
        model = factories.make_model(session, here, person, ModelKind.FILTER, factories.filter_metrics())
        bundle = factories.make_bundle(session, store, model)
        browsers[PARTICIPANT].cookies["studio_participant"] = browser_sessions.open_for_participant(
            session, person, HOUR
        )
        for name, role in ((OWNER, Role.EXPERIMENTER), (ADMINISTRATOR, Role.ADMINISTRATOR)):
            account = Experimenter(name=name, role=role, password_hash=PASSWORD_HASH, must_change_password=False)
            session.add(account)
            session.flush()
            browsers[name].cookies["studio_experimenter"] = browser_sessions.open_for_experimenter(
                session, account, HOUR
            )
            if name == OWNER:
                for study in (here, there):
                    membership.admit(session, study, name, StudyRole.OWNER, "the fuzzer")
                for caller, scope, only in (
                    (WRITING, TokenScope.WRITE, None),
                    (READING, TokenScope.READ, None),
                    (ELSEWHERE, TokenScope.WRITE, there),
                ):
                    _, text = api_tokens.create(session, account, caller, scope=scope, study=only)
                    browsers[caller].headers["authorization"] = f"Bearer {text}"
        values = {
            "slug": here.slug,
            "code": person.code,
            "query_id": str(query.id),
            "sha256": session.get_one(Clip, query.left_clip_id).video_sha256,
            "token": token,
            "version": str(bundle.version),
            "table": "labels",
            "kind": "csv",
            "name": "ratings",
            "letter": "A",
        }
    return Fuzzed(browsers, values)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
