"""Results, exports and the API's documentation in a browser: for everybody, at every size, from this origin only."""

from typing import Any

import pytest
from playwright.sync_api import Page, expect
from sqlalchemy import select

from app.db import Database
from app.domain.models import Report
from app.domain.people import Experimenter
from app.domain.studies import Study
from app.services.accounts import api_tokens
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import NewPage, overflow, serious_findings
from tests.finished_study import make_finished_study
from worker.analysis.study import figures
from worker.analysis.study.report import make_report
from worker.jobs.publishing import report_files

pytestmark = pytest.mark.browser

SIZES = ((390, 844, "dark"), (1366, 768, "light"))


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    """A finished study without a report."""
    with database.writing() as session:
        return make_finished_study(session, store, people=5, labels=8)


MADE: list[tuple[dict[str, Any], dict[str, dict[str, bytes]]]] = []
"""The report of such a study, which is the same in every test."""


def report(database: Database, store: ArtefactStore, study: Study) -> None:
    with database.writing() as session:
        if not MADE:
            MADE.append(make_report(report_files.tables_of(session, study)))
        (contents, files), *_ = MADE
        stored = {name: {kind: store.put(file) for kind, file in each.items()} for name, each in files.items()}
        run = factories.make_run(session, study, kind="report")
        session.add(Report(study_id=study.id, run_id=run.id, basis="", contents=contents, figures=stored))


@pytest.fixture
def address_of_study(
    database: Database, store: ArtefactStore, address: str, study: Study, monkeypatch: pytest.MonkeyPatch
) -> str:
    """The study with its report; the address of its pages."""
    monkeypatch.setattr(figures, "DPI", 40)
    report(database, store, study)
    return f"{address}/studies/{study.slug}"


def test_the_page_shows_the_first_report_as_soon_as_it_is_there(
    new_page: NewPage,
    address: str,
    study: Study,
    experimenter_cookie: str,
    database: Database,
    store: ArtefactStore,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(figures, "DPI", 40)
    page = new_page()
    page.context.add_cookies([{"name": "studio_experimenter", "value": experimenter_cookie, "url": address}])
    page.goto(f"{address}/studies/{study.slug}/results")
    expect(page.get_by_role("heading", name="The report is being made")).to_be_visible()
    report(database, store, study)
    expect(page.get_by_role("heading", name="Ratings", exact=True)).to_be_visible()


@pytest.mark.parametrize(("width", "height", "theme"), SIZES)
def test_pages_of_results_have_no_serious_findings_and_fit(
    new_page: NewPage,
    address: str,
    address_of_study: str,
    experimenter_cookie: str,
    database: Database,
    width: int,
    height: int,
    theme: str,
) -> None:
    with database.writing() as session:
        api_tokens.create(session, session.scalars(select(Experimenter)).one(), "a notebook")
    page = new_page(viewport={"width": width, "height": height}, color_scheme=theme)
    page.context.add_cookies([{"name": "studio_experimenter", "value": experimenter_cookie, "url": address}])
    elsewhere: list[str] = []
    page.on("request", lambda request: elsewhere.append(request.url) if not request.url.startswith(address) else None)
    for path in (
        f"{address_of_study}/results",
        f"{address_of_study}/export",
        f"{address}/tokens",
        f"{address}/api/docs",
    ):
        page.goto(path)
        assert serious_findings(page) == [], path
        assert overflow(page)[0] <= 0, path
    page.goto(f"{address_of_study}/results")
    assert _broken_pictures(page) == []
    assert elsewhere == []


def _broken_pictures(page: Page) -> list[str]:
    broken: list[str] = page.evaluate(
        "Promise.all([...document.images].map((each) => each.decode().then(() => null, () => each.src)))"
    )
    return [each for each in broken if each]
