"""Puts the web server together: settings, database, guard, routes, error pages."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from http import HTTPStatus

from fastapi import FastAPI
from fastapi.responses import PlainTextResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry

from app import data_directory
from app.db import Database
from app.paths import STATIC
from app.services.accounts.openid import Provider
from app.services.alerting import alerts
from app.settings import Settings
from app.storage import ArtefactStore
from app.web import media, metrics
from app.web.api import pages
from app.web.api.application import create_api
from app.web.api.callers import PREFIX
from app.web.error_pages import add_error_pages, error_page
from app.web.experimenter import audit, help_page, results
from app.web.experimenter.accounts import account, accounts, login, provider_login, second_factor
from app.web.experimenter.dashboard import answers, live, studies
from app.web.experimenter.study import (
    imports,
    invitations,
    members,
    operator,
    planning,
    power,
    retirement,
    selection,
    translations,
)
from app.web.http.addresses import QuickAddresses
from app.web.http.asides import count_ahead, keep_log_short
from app.web.http.deps import Studio, StudioDep
from app.web.http.rate_limit import SharedAttempts
from app.web.http.readiness import Readiness
from app.web.http.request_log import RequestLog
from app.web.http.security import Guard
from app.web.http.session_queue import SessionQueue
from app.web.http.shared_pages import SharedPages
from app.web.participant import (
    consent,
    entry,
    evaluation,
    finish,
    forms,
    head_to_heads,
    hints,
    joining,
    pairs,
    scales,
    self_setting,
    withdrawal,
)
from app.web.texts import languages
from app.web.texts.templating import make_environment

MAX_BODY_BYTES = 256 * 1024
WRONG_TOKENS = 600
"""A minute, from everywhere together; right ones always pass."""
PARTICIPANT_PARTS = (
    pairs,
    scales,
    media,
    joining,
    languages,
    consent,
    forms,
    evaluation,
    head_to_heads,
    self_setting,
    hints,
    finish,
    withdrawal,
    entry,
)
"""What is asked for most comes first: routes are tried one by one.

The last one comes last: it takes whatever address below /p/ is left for a personal link.
"""
EXPERIMENTER_PARTS = (
    login,
    provider_login,
    second_factor,
    account,
    accounts,
    answers,
    audit,
    members,
    planning,
    power,
    translations,
    invitations,
    selection,
    retirement,
    help_page,
    studies,
    operator,
    results,
    imports,
    pages,
    metrics,
)


def create_app(settings: Settings | None = None) -> FastAPI:
    """The web server for these settings, by default those of the environment. Migrates nothing."""
    settings = settings or Settings()
    app = create_routes(https=settings.secure_cookies)
    serve(app, make_studio(settings))
    return app


def make_studio(settings: Settings) -> Studio:
    """What every request shares."""
    database = Database(settings.sqlalchemy_url, keeps_log_short=True)
    return Studio(
        settings=settings,
        database=database,
        store=ArtefactStore.of(settings),
        readiness=Readiness(database, settings.data_dir),
        session_queue=SessionQueue(database),
        login_attempts=SharedAttempts(database, "password", settings.login_attempts_per_minute),
        token_attempts=SharedAttempts(
            database, "token", settings.login_attempts_per_minute, WRONG_TOKENS, WRONG_TOKENS
        ),
        provider=Provider(settings) if settings.oidc_issuer else None,
        shared_pages=SharedPages(database),
    )


def serve(app: FastAPI, studio: Studio) -> None:
    """From now on, requests are about this studio."""
    app.state.studio = app.state.api.state.studio = studio


def create_routes(https: bool) -> FastAPI:
    """Every page, and what guards them."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        studio: Studio = app.state.studio
        with (
            data_directory.shared(studio.settings.data_dir),
            live.closing_on_signals(studio.closing),
            alerts.watching(studio.settings, studio.database, studio.store),
        ):
            aside = asyncio.gather(count_ahead(studio), keep_log_short(studio))
            yield
        await aside
        studio.hashing.close()
        studio.hashing_for_known.close()
        studio.database.dispose()

    app = QuickAddresses(
        title="PbARL Studio", openapi_url=None, lifespan=lifespan, max_body_size=MAX_BODY_BYTES, redirect_slashes=False
    )
    app.state.templates = make_environment(app.url_path_for)
    app.state.metrics = CollectorRegistry()
    app.add_middleware(Guard, https=https, refuse=error_page)
    app.add_middleware(RequestLog, registry=app.state.metrics)
    add_error_pages(app)
    for part in (*PARTICIPANT_PARTS, *EXPERIMENTER_PARTS):
        app.include_router(part.router)
    app.state.api = create_api(app.url_path_for, MAX_BODY_BYTES)
    app.mount(PREFIX, app.state.api)
    app.mount("/static", StaticFiles(directory=STATIC), name="static")

    @app.get("/", name="show_start")
    def show_start() -> RedirectResponse:
        """Participants come by their links; whoever comes here is an experimenter."""
        return RedirectResponse(app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)

    @app.get("/health", name="show_health")
    async def show_health(studio: StudioDep) -> PlainTextResponse:
        """Whether answers can be kept: 200, or 503 with the reason. For load balancers and whoever watches."""
        complaint = await studio.readiness.complaint()
        status = HTTPStatus.OK if complaint is None else HTTPStatus.SERVICE_UNAVAILABLE
        return PlainTextResponse(complaint or "ok", status)

    @app.get("/health/live", name="show_life")
    async def show_life() -> PlainTextResponse:
        """Whether the server answers at all. For whatever restarts it: that mends no full disk."""
        return PlainTextResponse("ok")

    return app
