"""Before a page's script has begun nothing can be answered; where there are no scripts everything can."""

from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import Rating
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import Invited, NewPage, serious_findings, the_only, wait_ready
from tests.waiting import until

pytestmark = pytest.mark.browser

PHONE = {"width": 320, "height": 568}
TWO = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL)


class Held:
    """A script that does not arrive before it is let go."""

    def __init__(self, page: Page, script: str) -> None:
        self._routes: list[Route] = []
        self._open = False
        page.route(f"**/{script}", self._hold)

    def _hold(self, route: Route) -> None:
        if self._open:
            route.continue_()
        else:
            self._routes.append(route)

    def let_go(self) -> None:
        """Now it arrives."""
        self._open = True
        for route in self._routes:
            route.continue_()


@pytest.fixture
def rating_link(database: Database, store: ArtefactStore, address: str) -> Callable[..., str]:
    """A participant who has two robots to rate on video."""

    def make(**settings: Any) -> str:
        with database.writing() as session:
            evaluation = EvaluationSettings(methods=TWO, trials=1)
            study = factories.make_study(session, evaluation=evaluation, **settings)
            participant, token = factories.make_participant(session, study)
            factories.answer_everything(session, store, study, participant)
            factories.make_robots(session, store, study, participant)
        return f"{address}/p/{token}"

    return make


@pytest.mark.parametrize("invited", [{}, {"practice_pairs": 1}], indirect=True, ids=["pairs", "practice"])
def test_no_pair_can_be_answered_before_the_script_is_there(invited: Invited, new_page: NewPage) -> None:
    page = new_page(viewport=PHONE, has_touch=True)
    held = Held(page, "pair.js")
    page.goto(invited.link, wait_until="commit")
    left = page.locator(".answer-left")
    expect(left).to_be_disabled()
    assert page.locator("video[controls]").count() == 0
    assert until(lambda: page.evaluate("document.readyState != 'loading'"))
    left.scroll_into_view_if_needed()  # waits until the page has its style and nothing moves any more
    left.tap(force=True)
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    assert invited.events() == []
    held.let_go()
    expect(left).to_be_enabled()
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    assert invited.events() == []


def test_the_last_answer_can_be_taken_back_when_the_script_is_there_and_not_before(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    held = Held(page, "pair.js")
    page.reload(wait_until="commit")
    undo = page.get_by_role("button", name="Undo")
    expect(undo).to_be_disabled()
    held.let_go()
    wait_ready(page, 1)
    undo.click()
    wait_ready(page, 0)


def test_no_robot_can_be_rated_before_the_script_is_there(
    rating_link: Callable[..., str], new_page: NewPage, database: Database
) -> None:
    page = new_page()
    held = Held(page, "evaluation.js")
    page.goto(rating_link(), wait_until="commit")
    save = page.get_by_role("button", name="Save and go on")
    expect(save).to_be_disabled()
    expect(page.locator("[data-ratings] input[type=radio]").first).to_be_disabled()
    held.let_go()
    expect(save).to_be_enabled()
    with database.reading() as session:
        assert session.scalars(select(Rating)).all() == []


def test_a_page_whose_script_never_comes_offers_to_load_it_again(invited: Invited, new_page: NewPage) -> None:
    page = new_page(viewport=PHONE)
    page.route("**/outbox.js", lambda route: route.abort())
    page.goto(invited.link)
    again = page.get_by_role("link", name="Load it again")
    expect(again).to_be_visible()
    page.unroute("**/outbox.js")
    again.click()
    wait_ready(page, 0)
    expect(page.locator("[data-late]")).to_have_count(0)


def test_without_scripts_pairs_are_answered_and_taken_back_by_plain_forms(invited: Invited, new_page: NewPage) -> None:
    page = new_page(java_script_enabled=False)
    page.goto(invited.link)
    expect(page.locator("video:visible")).to_have_count(2)
    expect(page.locator("video[controls]:visible")).to_have_count(2)
    the_only(page.get_by_role("button", name="Left")).click()
    expect(page.get_by_text("1 of 10")).to_be_visible()
    the_only(page.get_by_role("button", name="Undo")).click()
    expect(page.get_by_text("0 of 10")).to_be_visible()
    first, undone = invited.events()
    assert (first.response, first.by_script, first.response_time_ms) == ("left", False, None)
    assert undone.response is None


def test_without_scripts_robots_are_rated_by_a_plain_form(
    rating_link: Callable[..., str], new_page: NewPage, database: Database
) -> None:
    page = new_page(java_script_enabled=False)
    page.goto(rating_link())
    expect(page.locator("video[controls]:visible")).to_have_count(1)
    for question in ("How satisfied", "How personalised"):
        the_only(page.get_by_role("group", name=question)).get_by_role("radio", name="4").check(force=True)
    the_only(page.get_by_role("button", name="Save and go on")).click()
    expect(page.get_by_role("heading", name="Robot B")).to_be_visible()
    with database.reading() as session:
        stored = session.scalars(select(Rating)).one()
    assert (stored.satisfaction, stored.personalisation, stored.by_script) == (4, 4, False)


@pytest.mark.long
def test_the_closed_page_is_fit_for_assistive_technology(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    Held(page, "pair.js")
    page.goto(invited.link, wait_until="commit")
    expect(page.locator(".answer-left")).to_be_disabled()
    assert serious_findings(page) == []
