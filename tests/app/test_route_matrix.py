"""Every route, read from the router, requested by every kind of visitor: who is let in, and what the others are told.

A route without a row fails. A visitor who is not let in also leaves no row behind. Forms are sent nearly empty, so
whoever is let in is mostly told that something is missing; that is enough to know that they were.
"""

from dataclasses import replace

import pytest
from fastapi import FastAPI
from sqlalchemy import select

from app.domain.people import AuditEvent
from app.main import serve
from app.services.accounts.hourly_counts import HourlyCounts
from tests.app.gate import (
    ADMIN,
    ADMINS,
    CLIP,
    EDITOR,
    ELSEWHERE,
    EVERYBODY,
    MATRIX,
    OPERATOR,
    OTHER_OWNER,
    OTHERS,
    OWN_PAIR,
    OWNER,
    READS,
    ROUTES,
    VIEWER,
    VIEWERS,
    WRITES,
    Gate,
    Route,
    outcome,
    refusal,
)


def test_every_route_has_a_row_and_every_row_a_route() -> None:
    assert {route.name for route in ROUTES} == MATRIX.keys()


@pytest.mark.parametrize("route", ROUTES, ids=lambda route: f"{route.method} {route.name}")
def test_visitors(route: Route, gate: Gate) -> None:
    rule = MATRIX[route.name]
    refused = sorted(EVERYBODY - rule.let_in)
    before = gate.rows()
    found = {visitor: outcome(route, gate.ask(route, visitor)) for visitor in refused}
    assert found == {visitor: refusal(rule, visitor) for visitor in refused}
    assert gate.rows() == before, "whoever is refused changes nothing"
    for visitor in sorted(rule.let_in):
        answer = gate.ask(route, visitor)
        assert outcome(route, answer) == "let in", (visitor, answer.status_code, answer.text[:300])


ACCOUNT_OF = {READS: OWNER, WRITES: OWNER, ELSEWHERE: OWNER, VIEWERS: VIEWER, OTHERS: OTHER_OWNER, ADMINS: ADMIN}


def test_whatever_is_refused_to_somebody_known_is_in_the_audit_log(gate: Gate, studio_app: FastAPI) -> None:
    refused = [
        (route, visitor)
        for route in ROUTES
        for visitor in sorted({*MATRIX[route.name].forbidden, *MATRIX[route.name].hidden})
        if MATRIX[route.name] not in (CLIP, OPERATOR, OWN_PAIR)
    ]
    for route, visitor in refused:
        serve(studio_app, replace(studio_app.state.studio, refusals=HourlyCounts()))  # nothing was refused yet
        gate.ask(route, visitor)
        with gate.database.reading() as session:
            newest = session.scalars(select(AuditEvent).order_by(AuditEvent.id.desc()).limit(1)).one()
        told = newest.actor, newest.action, newest.subject
        what = f"{route.method} {route.path.replace('{slug}', gate.values['slug'])}"
        assert told == (ACCOUNT_OF.get(visitor, visitor), "access refused", what)
        assert (newest.study_id is not None) is ("{slug}" in route.path)


def test_who_is_refused_again_and_again_fills_no_disk(gate: Gate) -> None:
    route = next(each for each in ROUTES if each.name == "delete_study")
    for _ in range(100):
        gate.ask(route, VIEWER)
    gate.ask(route, EDITOR)
    with gate.database.reading() as session:
        rows = session.scalars(select(AuditEvent).where(AuditEvent.action == "access refused")).all()
    assert [(row.actor, (row.subject or "").rpartition(" (")[2]) for row in rows] == [
        (VIEWER, rows[0].subject),
        (VIEWER, "10 times within an hour)"),
        (VIEWER, "100 times within an hour)"),
        (EDITOR, rows[3].subject),
    ]


def test_a_study_that_there_is_not_is_norefusal(gate: Gate) -> None:
    assert gate.visitors[OTHER_OWNER].get("/studies/nothing-of-this-name").status_code == 404
    with gate.database.reading() as session:
        assert "access refused" not in session.scalars(select(AuditEvent.action)).all()
