"""Robots are watched and rated in a real browser, by keyboard alone; operator and participant follow each other."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pytest
from playwright.sync_api import Page, Route, expect
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import HeadToHeadAnswer, Rating, Trial
from app.domain.protocol import EvaluatedMethod, EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import NewPage, hold_clips, let_clips_run, overflow, serious_findings

pytestmark = pytest.mark.browser

PHONE, LAPTOP, TABLET = ({"width": w, "height": h} for w, h in ((390, 844), (1366, 768), (820, 1180)))
TWO = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL)


@dataclass
class Invited:
    """Somebody who has answered every pair."""

    address: str
    token: str
    study: Study
    participant: Participant
    database: Database
    trials: Sequence[Trial]

    @property
    def link(self) -> str:
        """The personal link."""
        return f"{self.address}/p/{self.token}"

    def ratings(self) -> list[tuple[int, int, int]]:
        """Revision and values of everything stored, in its order."""
        with self.database.reading() as session:
            rows = session.scalars(select(Rating).order_by(Rating.id))
            return [(row.revision, row.satisfaction, row.personalisation) for row in rows]

    def head_to_heads(self) -> list[tuple[int, str]]:
        """Revision and response of every answer about two robots, in its order."""
        with self.database.reading() as session:
            rows = session.scalars(select(HeadToHeadAnswer).order_by(HeadToHeadAnswer.id))
            return [(row.revision, row.response) for row in rows]


@pytest.fixture
def invite(database: Database, store: ArtefactStore, address: str) -> Callable[..., Invited]:
    """Makes a study of two robots; ``robots`` says whether they are ready."""

    def make(*, robots: bool = True, watch_first: bool = False, **evaluation: Any) -> Invited:
        with database.writing() as session:
            settings = EvaluationSettings(**{"methods": TWO, "trials": 1, **evaluation})
            study = factories.make_study(session, evaluation=settings, answer_after_first_play=watch_first)
            participant, token = factories.make_participant(session, study)
            factories.answer_everything(session, store, study, participant)
            trials = factories.make_robots(session, store, study, participant) if robots else []
        return Invited(address, token, study, participant, database, trials)

    return make


def test_films_are_rated_by_keyboard_alone_after_they_were_seen(
    invite: Callable[..., Invited], new_page: NewPage
) -> None:
    invited = invite(watch_first=True)
    page = new_page()
    hold_clips(page)
    page.goto(invited.link)
    expect(page.get_by_role("heading", name="Robot A")).to_be_visible()
    expect(page.get_by_text("Watch it once to the end, then rate")).to_be_visible()
    page.keyboard.press("4")
    assert page.locator("input:checked").count() == 0
    let_clips_run(page)
    expect(page.get_by_text("You can rate now")).to_be_visible()
    assert serious_findings(page) == []
    page.keyboard.type("52")
    page.keyboard.press("Backspace")
    page.keyboard.type("3")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Robot B")).to_be_visible()
    let_clips_run(page)
    expect(page.get_by_text("You can rate now")).to_be_visible()
    page.keyboard.type("12")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="All robots are rated")).to_be_visible()
    assert serious_findings(page) == []
    assert invited.ratings() == [(1, 5, 3), (1, 1, 2)]


def test_the_last_rating_is_changed_by_keyboard(invite: Callable[..., Invited], new_page: NewPage) -> None:
    invited = invite()
    page = new_page()
    page.goto(invited.link)
    rate(page, "44")
    expect(page.get_by_role("heading", name="Robot B")).to_be_visible()
    page.get_by_role("link", name="Change my last rating (Robot A)").press("Enter")
    expect(page.get_by_text("You are changing your last rating")).to_be_visible()
    expect(page.get_by_label("4").first).to_be_checked()
    expect(page.get_by_text("Keys: 1 to 5")).to_be_visible()  # said by the script, which listens from then on
    page.keyboard.press("Backspace")
    rate(page, "1")
    expect(page.get_by_role("heading", name="Robot B")).to_be_visible()
    assert invited.ratings() == [(1, 4, 4), (2, 4, 1)]


def test_a_rating_given_while_the_network_is_away_arrives_once_it_is_back(
    invite: Callable[..., Invited], new_page: NewPage
) -> None:
    invited = invite()
    page = new_page()
    page.goto(invited.link)
    away = True

    def answer(route: Route) -> None:
        if away:
            route.abort()
        else:
            route.continue_()

    page.route("**/rating", answer)
    rate(page, "25")
    expect(page.get_by_text("Not saved yet. Trying again")).to_be_visible()
    assert invited.ratings() == []
    away = False
    expect(page.get_by_role("heading", name="Robot B")).to_be_visible()
    assert invited.ratings() == [(1, 2, 5)]


def test_head_to_heads_are_answered_and_changed_by_keyboard_alone(
    invite: Callable[..., Invited], new_page: NewPage
) -> None:
    invited = invite(head_to_heads=2, head_to_head_ties=True, trials=2)
    page = new_page()
    page.goto(invited.link)
    for letter in "AABB":
        expect(page.get_by_role("heading", name=f"Robot {letter}")).to_be_visible()
        rate(page, "34")
    expect(page.locator("[data-count]")).to_have_text("0 of 2")
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    assert serious_findings(page) == []
    page.keyboard.press("ArrowLeft")
    expect(page.locator("[data-count]")).to_have_text("1 of 2")
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    page.keyboard.press("z")
    expect(page.get_by_text("You are changing your last answer, which was: Left.")).to_be_visible()
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    page.keyboard.press("ArrowDown")
    expect(page.locator("[data-count]")).to_have_text("1 of 2")
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("heading", name="All robots are rated")).to_be_visible()
    assert invited.head_to_heads() == [(1, "left"), (2, "equal"), (1, "right")]


@pytest.mark.parametrize("viewport", [PHONE, LAPTOP], ids=["phone", "laptop"])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_the_rating_page_fits_without_scrolling_and_is_accessible(
    invite: Callable[..., Invited], new_page: NewPage, viewport: dict[str, int], theme: str
) -> None:
    page = new_page(viewport=viewport, color_scheme=theme)
    page.goto(invite().link)
    expect(page.get_by_role("heading", name="Robot A")).to_be_visible()
    assert serious_findings(page) == []
    assert max(overflow(page)) <= 0


def test_the_waiting_page_goes_on_by_itself_when_the_robots_are_ready(
    invite: Callable[..., Invited], new_page: NewPage, store: ArtefactStore
) -> None:
    invited = invite(robots=False)
    page = new_page()
    page.goto(invited.link)
    expect(page.get_by_role("heading", name="Your robots are being prepared")).to_be_visible()
    assert serious_findings(page) == []
    with invited.database.writing() as session:
        study = session.get_one(Study, invited.study.id)
        factories.make_robots(session, store, study, session.get_one(Participant, invited.participant.id))
    expect(page.get_by_role("heading", name="Robot A")).to_be_visible()


def test_operator_and_participant_follow_each_other_without_reloading(
    invite: Callable[..., Invited], new_page: NewPage, experimenter_cookie: str
) -> None:
    invited = invite(mode=EvaluationMode.PHYSICAL)
    person, operator = new_page(viewport=PHONE), new_page(viewport=TABLET)
    operator.context.add_cookies(
        [{"name": "studio_experimenter", "value": experimenter_cookie, "url": invited.address}]
    )
    base = f"{invited.address}/studies/{invited.study.slug}"
    operator.goto(f"{base}/participants/{invited.participant.code}/operate")
    person.goto(invited.link)
    expect(person.get_by_role("heading", name="Robot A is next")).to_be_visible()
    assert serious_findings(person) == serious_findings(operator) == []
    operator.get_by_role("button", name="Start").click()
    expect(person.get_by_role("heading", name="Robot A is moving. Please watch.")).to_be_visible()
    expect(operator.get_by_role("button", name="Repeat this trial")).to_be_visible()
    assert serious_findings(person) == serious_findings(operator) == []
    operator.get_by_label("Did something go wrong with the robot?").fill("it dropped the spoon")
    operator.get_by_role("button", name="Repeat this trial").click()
    expect(person.get_by_role("heading", name="Robot A is next")).to_be_visible()
    operator.get_by_role("button", name="Start").click()
    operator.get_by_role("button", name="Done").click()
    expect(person.get_by_text("Please rate what the robot has just done")).to_be_visible()
    assert serious_findings(person) == []
    rate(person, "45")
    expect(person.get_by_role("heading", name="Robot B is next")).to_be_visible()
    expect(operator.get_by_role("heading", name="Robot B")).to_be_visible()
    assert invited.ratings() == [(1, 4, 5)]
    operator.goto(f"{base}/unblind")
    assert serious_findings(operator) == []


def rate(page: Page, digits: str) -> None:
    """Type the digits and save."""
    page.locator("[data-save]:enabled").wait_for()
    page.keyboard.type(digits)
    page.keyboard.press("Enter")
