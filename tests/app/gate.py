"""A studio with every kind of visitor, every route of it, and the rule that says who is let in where."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta

from fastapi import FastAPI
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from sqlalchemy.orm import Session

from app.db import Base, Database
from app.domain.people import AuditEvent, Experimenter, Role, StudyRole, TokenScope
from app.services.accounts import api_tokens, browser_sessions
from app.services.studies import membership
from app.storage import ArtefactStore
from tests import factories
from tests.conftest import the_routes
from tests.made_once import counts, made_once

API = "/api/v1"
NO_STUDY = "There is no such study"
FORM = {"code": "000000", "response": "left", "client_uuid": "0b7a6a0e-6f7e-4d4e-9d44-5d2f6a2c8d11"}
"""What forms need before they ask who sends them."""
HOUR = timedelta(hours=1)

STRANGER, GUESSED = "stranger", "stranger with a wrong token"
FORGOTTEN = "browser with cookies that are worth nothing"
THIS_PARTICIPANT, OTHER_PARTICIPANT = "participant", "participant of another study"
READER, VIEWER, EDITOR, OWNER = "viewer with a reader's account", "viewer", "editor", "owner"
OTHER_OWNER, ADMIN = "owner of another study", "administrator"
READS, WRITES, VIEWERS = "owner's token to read", "owner's token to write", "viewer's token to write"
ELSEWHERE, OTHERS, ADMINS = "owner's token for another study", "token of an owner of another study", "admin's token"

ACCOUNTS = {READER, VIEWER, EDITOR, OWNER, OTHER_OWNER, ADMIN}
PARTICIPANTS = {THIS_PARTICIPANT, OTHER_PARTICIPANT}
TOKENS = {READS, WRITES, VIEWERS, ELSEWHERE, OTHERS, ADMINS}
EVERYBODY = {STRANGER, GUESSED, FORGOTTEN, *ACCOUNTS, *PARTICIPANTS, *TOKENS}


@dataclass(frozen=True)
class Rule:
    """Who is let in, and with which status the others are refused; who is in neither is asked to log in."""

    let_in: set[str]
    forbidden: frozenset[str] | set[str] = frozenset()
    """403: they may know that there is something."""
    hidden: frozenset[str] | set[str] = frozenset()
    """404, as if there were nothing."""


ANYBODY = Rule(EVERYBODY)
NOBODY = Rule(set())
"""Opened by something that none of these visitors has."""
ACCOUNT = Rule(ACCOUNTS)
EXPERIMENTER = Rule(ACCOUNTS - {READER}, forbidden={READER})
ADMINISTRATOR = Rule({ADMIN}, forbidden=ACCOUNTS - {ADMIN})
LOOKING = Rule({READER, VIEWER, EDITOR, OWNER, ADMIN}, hidden={OTHER_OWNER})
EDITING = Rule({EDITOR, OWNER, ADMIN}, forbidden={READER, VIEWER}, hidden={OTHER_OWNER})
OWNING = Rule({OWNER, ADMIN}, forbidden={READER, VIEWER, EDITOR}, hidden={OTHER_OWNER})
PARTICIPANT = Rule(PARTICIPANTS)
OWN_PAIR = Rule({THIS_PARTICIPANT}, hidden={OTHER_PARTICIPANT})
CLIP = Rule(
    {THIS_PARTICIPANT, READER, VIEWER, EDITOR, OWNER, ADMIN},
    hidden={STRANGER, GUESSED, FORGOTTEN, OTHER_PARTICIPANT, OTHER_OWNER, *TOKENS},
)
OPERATOR = Rule(set(), hidden=EVERYBODY)
"""Without METRICS_TOKEN."""
TOKEN = Rule(TOKENS)
TOKEN_LOOKS = Rule({READS, WRITES, VIEWERS, ADMINS}, hidden={ELSEWHERE, OTHERS})
TOKEN_READS_DATA = Rule({READS, WRITES, ADMINS}, forbidden={VIEWERS}, hidden={ELSEWHERE, OTHERS})
TOKEN_WRITES = Rule({WRITES, ADMINS}, forbidden={READS, VIEWERS}, hidden={ELSEWHERE, OTHERS})

MATRIX: dict[str, Rule] = {
    **dict.fromkeys(("show_login", "log_in", "begin_provider_login", "end_provider_login", "log_out"), ANYBODY),
    **dict.fromkeys(("show_start", "show_health", "show_life", "static", "show_api"), ANYBODY),
    **dict.fromkeys(("show_code", "enter_code"), NOBODY),
    **dict.fromkeys(
        ("show_password", "change_password", "show_own_account", "end_login", "end_other_logins", "show_help"), ACCOUNT
    ),
    **dict.fromkeys(
        ("show_second_factor", "begin_second_factor", "confirm_second_factor", "renew_recovery_codes"), ACCOUNT
    ),
    **dict.fromkeys(("turn_off_second_factor", "show_tokens", "create_token", "revoke_token"), ACCOUNT),
    **dict.fromkeys(("show_studies", "stream_studies", "show_new_study", "show_texts", "show_import"), ACCOUNT),
    **dict.fromkeys(("create_study", "import_study"), EXPERIMENTER),
    **dict.fromkeys(("show_accounts", "add_account", "reset_account", "remove_second_factor"), ADMINISTRATOR),
    **dict.fromkeys(("change_account_role", "disable_account", "enable_account"), ADMINISTRATOR),
    **dict.fromkeys(("show_audit", "download_audit", "download_head", "show_proof", "download_receipt"), ADMINISTRATOR),
    **dict.fromkeys(("show_study", "stream_study", "show_participant", "stream_participant", "operate"), LOOKING),
    **dict.fromkeys(("show_answers", "show_answer", "show_members", "show_settings", "show_lock"), LOOKING),
    **dict.fromkeys(("download_lock", "show_translations", "show_links", "show_sheet", "download_links"), LOOKING),
    **dict.fromkeys(("show_joining", "show_erasing", "show_put_away", "show_unblinding", "show_results"), LOOKING),
    **dict.fromkeys(("show_figure", "show_exports", "show_power"), LOOKING),
    **dict.fromkeys(("download_methods_text", "download_analysis", "download_preregistration"), LOOKING),
    **dict.fromkeys(("exclude_answer", "include_answer", "change_settings", "open_preview", "lock_study"), EDITING),
    **dict.fromkeys(("ask_power",), EDITING),
    **dict.fromkeys(("save_translations", "add_participants", "renew_link", "revoke_link", "renew_links"), EDITING),
    **dict.fromkeys(("open_joining", "close_joining", "erase_participant", "download_bundles"), EDITING),
    **dict.fromkeys(("put_study_away", "take_study_out", "retry_run", "download_bundle", "unblind_study"), EDITING),
    **dict.fromkeys(("start_trial", "finish_trial", "repeat_trial", "download_controller"), EDITING),
    **dict.fromkeys(("show_seal_key", "request_export", "download_export", "download_table"), EDITING),
    **dict.fromkeys(("admit_member", "remove_member", "delete_study"), OWNING),
    "forget_seal_key": ANYBODY,  # leads to show_exports, which asks
    **dict.fromkeys(("show_video", "show_poster"), CLIP),
    "show_metrics": OPERATOR,
    "begin_visit": PARTICIPANT,
    **dict.fromkeys(("join_study", "join_study_now", "open_link"), ANYBODY),  # the address is the key
    **dict.fromkeys(("choose_language", "show_withdrawn"), ANYBODY),
    **dict.fromkeys(("show_consent", "give_consent", "show_consent_copy", "save_consent_copy"), PARTICIPANT),
    **dict.fromkeys(
        ("show_demographics", "save_demographics", "show_questionnaire", "save_questionnaire"), PARTICIPANT
    ),
    **dict.fromkeys(("end_break", "note_event", "show_evaluation", "show_evaluation_done"), PARTICIPANT),
    **dict.fromkeys(("show_finished", "leave_evaluation", "show_debrief", "finish_debrief"), PARTICIPANT),
    **dict.fromkeys(
        ("show_withdraw", "withdraw", "show_next", "show_instructions", "finish_instructions"), PARTICIPANT
    ),
    **dict.fromkeys(("label_query", "undo_label"), OWN_PAIR),
    **dict.fromkeys(("finish_instructions", "show_last_rating", "rate_trial"), PARTICIPANT),
    **dict.fromkeys(("show_head_to_head", "show_last_head_to_head", "answer_head_to_head"), PARTICIPANT),
    **dict.fromkeys(("show_scale", "save_scale", "show_robot_scale", "save_robot_scale"), PARTICIPANT),
    **dict.fromkeys(("show_self_setting", "save_self_setting", "show_hints", "save_hints"), PARTICIPANT),
    "api openapi": ANYBODY,
    **dict.fromkeys(("api show_account", "api list_studies"), TOKEN),
    **dict.fromkeys(("api show_study", "api list_participants", "api list_members", "api list_bundles"), TOKEN_LOOKS),
    **dict.fromkeys(("api show_report", "api show_figure", "api list_tables", "api list_exports"), TOKEN_LOOKS),
    **dict.fromkeys(
        ("api read_table", "api download_table", "api download_bundle", "api download_export"), TOKEN_READS_DATA
    ),
    **dict.fromkeys(
        ("api admit_member", "api remove_member", "api add_participants", "api revoke_link", "api request_export"),
        TOKEN_WRITES,
    ),
}


@dataclass(frozen=True)
class Route:
    """One way to ask for one address."""

    name: str
    method: str
    path: str


def routes(application: FastAPI) -> Iterator[Route]:
    """All there are."""
    for prefix, within in (("", application), ("api", application.state.api)):
        for each in iter_route_contexts(within.routes):
            if each.path == API:
                continue
            name, path = str(getattr(each, "name", "")), (API if prefix else "") + (each.path or "")
            for method in sorted(each.methods or {"GET"}):
                yield Route(f"{prefix} {name}".strip(), method, path + ("/base/tokens.css" if name == "static" else ""))


ROUTES = list(routes(the_routes()))


@dataclass
class Gate:
    """A studio with two studies, and a browser of every kind of visitor."""

    visitors: dict[str, TestClient]
    values: dict[str, str]
    database: Database

    def address(self, route: Route) -> str:
        """Of something that there is."""
        return re.sub(r"{(\w+)(?::\w+)?}", lambda found: self.values.get(found[1], "1"), route.path)

    def ask(self, route: Route, visitor: str) -> Answer:
        address = self.address(route)
        browser = self.visitors[visitor]
        if route.method in ("GET", "HEAD", "DELETE"):
            return browser.request(route.method, address)
        if route.path.startswith(API):
            return browser.request(route.method, address, json={})
        return browser.request(route.method, address, data=FORM)

    def rows(self) -> dict[str, int]:
        """How many there are of each kind; the audit log is left out, which tells of wrong tokens."""
        with self.database.reading() as session:
            counted = counts(session, Base.metadata.sorted_tables)
        return {table.name: count for table, count in counted.items() if table.name != AuditEvent.__tablename__}


@dataclass
class Keys:
    """What makes visitors those who they are, and the words that fill in addresses."""

    cookies: dict[str, dict[str, str]]
    tokens: dict[str, str]
    values: dict[str, str]


def make_gate(
    studio_app: FastAPI, database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]
) -> Gate:
    """Two studies, one account of every kind, and a browser of each visitor that has what makes them one."""
    visitors = {name: new_browser() for name in EVERYBODY}
    with database.writing() as session:
        keys = made_once(_make_keys, session, store)
    for visitor, cookies in keys.cookies.items():
        visitors[visitor].cookies.update(cookies)
    for visitor, token in keys.tokens.items():
        visitors[visitor].headers["authorization"] = f"Bearer {token}"
    studio_app.state.studio.closing.set()  # streams begin, and end at once
    return Gate(visitors, keys.values, database)


def _make_keys(session: Session, store: ArtefactStore) -> Keys:
    cookies = {FORGOTTEN: {"studio_participant": "x" * 43, "studio_experimenter": "x" * 43}}
    tokens = {GUESSED: f"{api_tokens.PREFIX}guessed"}
    here, there = factories.make_study(session, "Here"), factories.make_study(session, "There")
    person, token = factories.make_participant(session, here)
    (query,) = factories.make_queries(session, store, person, 1)
    clip = factories.make_clip(session, store, here)
    stranger_here, _ = factories.make_participant(session, there)
    for visitor, participant in ((THIS_PARTICIPANT, person), (OTHER_PARTICIPANT, stranger_here)):
        cookies[visitor] = {"studio_participant": browser_sessions.open_for_participant(session, participant, HOUR)}
    for visitor, role, study_role in (
        (READER, Role.READER, StudyRole.VIEWER),
        (VIEWER, Role.EXPERIMENTER, StudyRole.VIEWER),
        (EDITOR, Role.EXPERIMENTER, StudyRole.EDITOR),
        (OWNER, Role.EXPERIMENTER, StudyRole.OWNER),
        (OTHER_OWNER, Role.EXPERIMENTER, None),
        (ADMIN, Role.ADMINISTRATOR, None),
    ):
        account = Experimenter(name=visitor, role=role, password_hash="-", must_change_password=False)
        session.add(account)
        session.flush()
        if study_role is not None:
            membership.admit(session, here, visitor, study_role, "the test")
        if visitor in (OWNER, OTHER_OWNER):
            membership.admit(session, there, visitor, StudyRole.OWNER, "the test")
        cookies[visitor] = {"studio_experimenter": browser_sessions.open_for_experimenter(session, account, HOUR)}
        for name, scope, only in TOKENS_OF.get(visitor, ()):
            _, tokens[name] = api_tokens.create(session, account, name, scope=scope, study=there if only else None)
    values = {
        "slug": here.slug,
        "code": person.code,
        "query_id": str(query.id),
        "sha256": clip.video_sha256,
        "token": token,
        "key": "k" * 20,
        "letter": "A",
        "kind": "csv",
        "table": "labels",
        "script": "analysis.py",
        "name": "ratings",
        "account_id": "2000",  # nobody: what is asked here is whether one may ask
    }
    return Keys(cookies, tokens, values)


TOKENS_OF = {
    OWNER: ((READS, TokenScope.READ, False), (WRITES, TokenScope.WRITE, False), (ELSEWHERE, TokenScope.WRITE, True)),
    VIEWER: ((VIEWERS, TokenScope.WRITE, False),),
    OTHER_OWNER: ((OTHERS, TokenScope.WRITE, False),),
    ADMIN: ((ADMINS, TokenScope.WRITE, False),),
}


def outcome(route: Route, answer: Answer) -> str:
    """How a visitor was answered, in the words of the matrix."""
    if MATRIX[route.name] is ANYBODY:
        return "let in" if answer.status_code not in (401, 403) else "refused"
    if answer.status_code == 401 or answer.headers.get("location", "").startswith("/login"):
        return "asked who they are"
    if answer.status_code == 403:
        return "forbidden"
    hides = CLIP, OPERATOR, OWN_PAIR
    if answer.status_code == 404 and (NO_STUDY in answer.text or MATRIX[route.name] in hides):
        return "hidden"
    return "let in"


def refusal(rule: Rule, visitor: str) -> str:
    """How a visitor whom a rule does not let in is to be answered, in the same words."""
    return "forbidden" if visitor in rule.forbidden else "hidden" if visitor in rule.hidden else "asked who they are"
