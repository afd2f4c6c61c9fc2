"""Somebody goes the whole way with the keyboard alone, from the open address to the page they came from, or leaves."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, expect
from sqlalchemy import select

from app.db import Database
from app.domain.models import ModelKind
from app.domain.participation import FormAnswer
from app.domain.protocol import PAPER_DEMOGRAPHICS, USUAL_QUESTIONNAIRE, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.participants import recruitment_panel
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import NewPage, overflow, serious_findings, wait_ready

pytestmark = pytest.mark.browser

MOST_TABS = 40
PHONE, LAPTOP = {"width": 390, "height": 844}, {"width": 1366, "height": 768}
DARK = {"color_scheme": "dark", "locale": "de-DE"}
STAYS = """(() => {
    const now = Date.now, ending = () => document.querySelector("[data-return-after-s]");
    let at;
    Date.now = () => (ending() && !window.mayReturn ? (at ??= now()) : now());
})()"""
"""On the last page time stands still until it may go back to the panel, so that no test has to be quicker."""
FOCUSED = "(({ labels, innerText }) => labels?.[0]?.innerText ?? innerText ?? '')(document.activeElement)"
"""What the focused control is called."""


@dataclass
class Open:
    """A study with every stage that can be joined, and who has come."""

    address: str
    study: Study
    database: Database
    store: ArtefactStore

    def person(self) -> Participant:
        with self.database.reading() as session:
            return session.scalars(select(Participant)).one()

    def give_pairs(self) -> None:
        """What the worker does for somebody who has joined."""
        with self.database.writing() as session:
            factories.make_queries(session, self.store, session.scalars(select(Participant)).one(), 12)

    def give_ratings(self) -> None:
        """What the evaluation's own tests go through."""
        with self.database.writing() as session:
            factories.make_rated_trials(session, session.scalars(select(Participant)).one(), 6)

    def give_robot(self) -> None:
        """What the worker has made in the end."""
        with self.database.writing() as session:
            person = session.scalars(select(Participant)).one()
            study = session.get_one(Study, self.study.id)
            model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
            factories.make_film(session, self.store, person, "reference")
            factories.make_film(session, self.store, person, "pbarl", model)


@pytest.fixture
def open_study(database: Database, store: ArtefactStore, address: str) -> Callable[..., Open]:
    """Makes such a study."""

    def make(**settings: Any) -> Open:
        with database.writing() as session:
            study = factories.make_study(
                session,
                demographics=PAPER_DEMOGRAPHICS,
                evaluation=EvaluationSettings(methods=("reference", "pbarl")),
                questionnaire=USUAL_QUESTIONNAIRE,
                debrief=True,
                completion_code="C1X7",
                answer_after_first_play=False,
                **settings,
            )
            token = recruitment_panel.open_joining(session, study, actor="pat")
        return Open(f"{address}/join/{token}", study, database, store)

    return make


def focus(page: Page, name: str) -> None:
    """Tab until the control of this name has the focus."""
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        if name in page.evaluate(FOCUSED):
            return
    raise AssertionError(f"{name} cannot be reached with the keyboard.")


def press(page: Page, name: str) -> None:
    """Reach a control with the keyboard, and press it."""
    focus(page, name)
    page.keyboard.press("Enter")


def pick(page: Page, group: str, point: int) -> None:
    """Choose a point of a scale: the keys go from "no answer", where the focus falls, round to the first."""
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.closest('fieldset')?.querySelector('legend').innerText") == group:
            break
    for _ in range(point):
        page.keyboard.press("ArrowDown")


def at(page: Page, name: str) -> None:
    """Until the page of this name is there; nothing on it may shut anybody out, in either theme or size."""
    expect(page.locator(f"[data-page={name}]")).to_be_visible()
    assert serious_findings(page) == [], name
    for size in (PHONE, LAPTOP):
        page.set_viewport_size(size)  # type: ignore[arg-type]
        assert overflow(page)[0] <= 0, f"{name} scrolls sideways"


def test_the_whole_way_with_the_keyboard_alone_and_back_to_the_panel(
    open_study: Callable[..., Open], new_page: NewPage
) -> None:
    study = open_study(return_url="https://panel.example/done?cc={code}&pid={panel_id}")
    page = new_page()
    foreign: list[str] = []
    page.route("https://panel.example/**", lambda route: route.fulfill(body="Thanks", content_type="text/plain"))
    page.add_init_script(STAYS)
    page.on("request", lambda request: foreign.append(request.url))

    page.goto(study.address + "?PROLIFIC_PID=abc")
    at(page, "join")
    press(page, "To the study")
    at(page, "consent")
    press(page, "Save or print a copy")
    at(page, "consent-copy")
    press(page, "Back")
    at(page, "consent")
    press(page, "I agree to take part")
    at(page, "demographics")
    focus(page, "How old are you?")
    page.keyboard.type("twenty")
    press(page, "Save and go on")
    expect(page.get_by_role("alert")).to_contain_text("another look")
    at(page, "demographics")
    expect(page.get_by_label("How old are you?")).to_be_focused()  # where another look is needed
    page.keyboard.press("ControlOrMeta+A")
    page.keyboard.type("28")
    pick(page, "How much experience do you have with robots?", 4)
    press(page, "Save and go on")
    at(page, "instructions")
    study.give_pairs()
    press(page, "Start comparing")
    for number in range(10):
        wait_ready(page, number)
        page.keyboard.press("ArrowLeft")
    expect(page).to_have_url(re.compile("/p/evaluation$"))
    study.give_ratings()
    page.goto(study.address + "?PROLIFIC_PID=abc")
    at(page, "questionnaire")
    pick(page, "I would feel safe with this robot.", 5)
    press(page, "Save and go on")
    at(page, "debrief-making")
    expect(page.get_by_text("still being made")).to_be_visible()
    study.give_robot()
    at(page, "debrief")  # goes on by itself
    expect(page.get_by_role("slider")).to_have_attribute("aria-valuetext", re.compile("^0.[1-9]"))
    page.keyboard.press("Space")
    expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
    page.keyboard.press(",")
    before, after = page.evaluate("[...document.querySelectorAll('video')].map((video) => video.currentTime)")
    assert before == after, "before and after have one clock"
    press(page, "Finish")
    at(page, "finished")
    expect(page.get_by_label("Your completion code")).to_have_value("C1X7")
    press(page, "Copy")
    expect(page.get_by_text("Copied.")).to_be_visible()
    page.evaluate("window.mayReturn = true")
    page.wait_for_url("https://panel.example/done?cc=C1X7&pid=abc")

    assert study.person().completed_at is not None
    own = urlsplit(study.address).netloc
    assert {urlsplit(url).netloc for url in foreign if not url.startswith("blob:")} == {own, "panel.example"}
    with study.database.reading() as session:
        given = {(row.form, row.item): row.value for row in session.scalars(select(FormAnswer))}
    assert given["demographics", "age"] == "28"
    assert given["demographics", "robot_experience"] == "4"
    assert given["questionnaire", "felt_safe"] == "5"
    assert given["questionnaire", "comments"] is None


def test_whoever_wants_to_stay_is_not_taken_away(open_study: Callable[..., Open], new_page: NewPage) -> None:
    study = open_study(return_url="https://panel.example/done")
    page = new_page()
    page.goto(study.address + "?PROLIFIC_PID=abc")
    page.get_by_role("button", name="To the study").click()
    page.wait_for_url("**/p/*")
    study.give_pairs()
    with study.database.writing() as session:
        person = session.scalars(select(Participant)).one()
        factories.finish_everything(session, person, session.get_one(Study, study.study.id))
    page.clock.install()
    page.add_init_script(STAYS)
    page.goto(study.address + "?PROLIFIC_PID=abc")
    expect(page.get_by_text("in a few seconds")).to_be_visible()
    page.get_by_role("button", name="Stay here").click()
    page.evaluate("window.mayReturn = true")
    page.clock.fast_forward(60_000)
    assert page.url.endswith("/p/finished")


def test_in_german_from_the_welcome_to_the_withdrawal(open_study: Callable[..., Open], new_page: NewPage) -> None:
    study = open_study(panel_parameter="")
    page = new_page(**DARK, viewport=PHONE)
    page.goto(study.address)
    press(page, "Zur Studie")  # German from the first page on: so the browser asks for
    at(page, "joined")
    press(page, "Weiter")
    at(page, "consent")
    press(page, "English")
    expect(page.get_by_role("heading", level=1)).to_have_text("Taking part")
    press(page, "Deutsch")
    expect(page.get_by_role("heading", level=1)).to_have_text("Teilnahme")
    expect(page.locator("html")).to_have_attribute("lang", "de")
    at(page, "consent")
    press(page, "Teilnahme widerrufen")
    at(page, "withdraw")
    press(page, "Nein, alles behalten")
    at(page, "consent")
    press(page, "Teilnahme widerrufen")
    at(page, "withdraw")
    press(page, "Alles über mich löschen")
    at(page, "withdrawn")
    expect(page.get_by_role("heading", level=1)).to_have_text("Ihre Daten sind gelöscht")
    page.goto(study.address.rsplit("/join", 1)[0] + "/p/next")
    at(page, "error")
    expect(page.get_by_role("heading", level=1)).to_have_text("Bitte öffnen Sie Ihren Link noch einmal")
    assert study.person().withdrawn_at is not None


def test_an_address_without_the_panels_id_is_explained(open_study: Callable[..., Open], new_page: NewPage) -> None:
    page = new_page()
    page.goto(open_study().address)
    at(page, "panel-id-missing")
