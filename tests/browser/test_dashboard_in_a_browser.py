"""The experimenter's pages in a real browser: they update themselves, and everybody can use them."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Dialog, Page, expect
from sqlalchemy import delete

from app.db import Database
from app.domain.models import ModelKind, RunStatus
from app.domain.people import BrowserSession
from app.domain.preferences import Response
from app.domain.studies import Study
from app.services.participants import enrolment
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import PATIENCE_MS, findings, overflow
from tests.conftest import PASSWORD
from tests.waiting import until

pytestmark = pytest.mark.browser

TIMES = "() => [...document.querySelectorAll('video')].map((video) => video.currentTime)"


@pytest.fixture
def study(database: Database, store: ArtefactStore, password: str) -> Study:
    """A study with something of everything."""
    with database.writing() as session:
        study = factories.make_study(session, "Pilot", evaluation={"mode": "physical"})
        participant, _ = factories.make_participant(session, study)
        left, right = (factories.make_clip(session, store, study) for _ in range(2))
        for number in range(8):
            query = factories.make_query(session, participant, left, right, 0.2 + 0.1 * number)
            factories.make_label(session, query, Response.RIGHT, response_time_ms=3000)
        factories.make_model(session, study, participant, ModelKind.REWARD, factories.reward_metrics())
        model = factories.make_model(session, study, participant, ModelKind.FILTER, factories.filter_metrics())
        factories.make_bundle(session, store, model)
        factories.make_run(session, study, participant, status=RunStatus.FAILED, error="It ran out of memory.")
        return study


@pytest.fixture
def page(chromium: Browser, address: str, study: Study) -> Iterator[Page]:
    """Logged in, by typing."""
    errors: list[str] = []
    context = chromium.new_context(base_url=address, viewport={"width": 1366, "height": 768})
    context.set_default_timeout(PATIENCE_MS)
    page = context.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto("/studies")
    page.get_by_label("Name").fill("experimenter")
    page.get_by_label("Password").fill(PASSWORD)
    page.get_by_role("button", name="Log in").click()
    expect(page.get_by_role("heading", name="Studies")).to_be_visible()
    yield page
    context.close()
    assert errors == []


def test_what_was_typed_is_kept_when_the_login_has_ended(page: Page, study: Study, database: Database) -> None:
    page.goto(f"/studies/{study.slug}/members")
    page.get_by_label("Name of the account").fill("somebody with a long name")
    with database.writing() as session:
        session.execute(delete(BrowserSession))
    page.get_by_role("button", name="Make a member").click()
    expect(page.get_by_role("alert")).to_contain_text("What you typed is still here")
    with page.context.expect_page() as opened:
        page.get_by_role("link", name="Log in in another tab").click()
    other = opened.value
    other.get_by_label("Name").fill("experimenter")
    other.get_by_label("Password").fill(PASSWORD)
    other.get_by_role("button", name="Log in").click()
    expect(other.get_by_role("heading", name="Studies")).to_be_visible()
    other.close()
    page.get_by_role("button", name="Make a member").click()
    expect(page.get_by_role("alert")).to_contain_text("There is no account of this name")
    expect(page.get_by_label("Name of the account")).to_have_value("somebody with a long name")


def test_an_open_page_updates_itself_and_keeps_what_the_person_does(
    page: Page, study: Study, database: Database
) -> None:
    page.goto("/studies/pilot")
    expect(page.locator("[data-live-state]")).to_have_text("live")
    page.get_by_label("How many participants to add").fill("7")
    link = page.get_by_role("rowheader").get_by_role("link", name="P01")
    link.focus()
    with database.writing() as session:
        factories.make_participant(session, study)
    expect(page.get_by_role("link", name="P02")).to_be_visible()
    expect(link).to_be_focused()
    expect(page.get_by_label("How many participants to add")).to_have_value("7")


def test_what_was_folded_stays_folded_when_the_page_updates(page: Page, study: Study, database: Database) -> None:
    page.goto("/studies/pilot/participants/P01")
    expect(page.locator("[data-live-state]")).to_have_text("live")
    expect(page.get_by_text("Speed of the spoon")).to_be_visible()
    page.locator("details.version > summary").click()
    expect(page.get_by_text("Speed of the spoon")).to_be_hidden()
    with database.writing() as session:
        participant = enrolment.find_by_code(session, study, "P01")
        metrics = factories.filter_metrics(scenarios=77)
        factories.make_model(session, study, participant, ModelKind.FILTER, metrics, labels=5)
    older = page.locator("details.version").nth(1)
    older.locator("summary").click()
    expect(older.get_by_text("77 scenarios")).to_be_visible()
    expect(page.locator("details.version").first.get_by_text("Speed of the spoon")).to_be_hidden()


def test_links_can_be_made_and_copied(page: Page) -> None:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.goto("/studies/pilot")
    page.get_by_label("How many participants to add").fill("2")
    page.get_by_role("button", name="Add participants").click()
    page.get_by_role("button", name="Copy the link of P02").click()
    expect(page.get_by_text("Copied.")).to_be_visible()
    assert page.evaluate("navigator.clipboard.readText()") == page.get_by_label("P02", exact=True).input_value()
    page.get_by_role("button", name="Copy all").click()
    expect(page.get_by_text("All links copied.")).to_be_visible()
    assert len(page.evaluate("navigator.clipboard.readText()").splitlines()) == 2


def test_new_links_and_their_sheet_shut_nobody_out(page: Page) -> None:
    page.goto("/studies/pilot")
    page.get_by_label("How many participants to add").fill("3")
    page.get_by_role("button", name="Add participants").click()
    expect(page.get_by_role("heading", name="Personal links")).to_be_visible()
    for scheme in ("light", "dark"):
        page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
        for size in ((1366, 768), (390, 844)):
            page.set_viewport_size({"width": size[0], "height": size[1]})
            assert findings(page) == []
            assert overflow(page)[0] <= 0
        page.get_by_role("link", name="Sheet with QR codes").click()
        expect(page.get_by_role("link", name="Back to the links")).to_be_visible()
        page.wait_for_load_state()
        assert findings(page) == []
        page.get_by_role("link", name="Back to the links").click()
        expect(page.get_by_role("heading", name="Personal links")).to_be_visible()
        page.wait_for_load_state()


@pytest.mark.parametrize("scheme", [pytest.param("light", marks=pytest.mark.long), "dark"])
def test_no_page_shuts_anybody_out(page: Page, scheme: str) -> None:
    page.emulate_media(color_scheme="dark" if scheme == "dark" else "light")
    for path in (
        "/studies",
        "/studies/new",
        "/studies/new?preset=paper",
        "/studies/texts",
        "/studies/pilot",
        "/studies/pilot/settings",
        "/studies/pilot/lock",
        "/studies/pilot/joining",
        "/studies/pilot/unblind",
        "/studies/pilot/answers",
        "/studies/pilot/answers/1",
        "/studies/pilot/results",
        "/studies/pilot/away",
        "/help",
        "/studies/pilot/participants/P01",
        "/studies/pilot/participants/P01/erase",
        "/studies/pilot/participants/P01/operate",
        "/import",
        "/accounts",
        "/password",
        "/nowhere",
    ):
        page.goto(path)
        page.evaluate("document.querySelectorAll('details').forEach((each) => (each.open = true))")
        for size in ((1366, 768), (390, 844)):
            page.set_viewport_size({"width": size[0], "height": size[1]})
            assert findings(page) == [], path
            assert overflow(page)[0] <= 0, path


def test_a_task_is_chosen_with_the_keyboard_alone(page: Page) -> None:
    page.goto("/studies/new")
    page.get_by_role("radio", name="Feeding").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("radio", name="Itch scratching")).to_be_checked()
    page.get_by_label("Name of the study").fill("Itches")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Itches")).to_be_visible()
    expect(page.locator(".page-sub")).to_contain_text("Itch scratching")


def test_ticks_survive_an_update_and_new_links_ask_first(page: Page, study: Study, database: Database) -> None:
    page.goto("/studies/pilot")
    expect(page.locator("[data-live-state]")).to_have_text("live")
    page.get_by_label("Tick P01").check()
    with database.writing() as session:
        factories.make_participant(session, study)
    expect(page.get_by_role("link", name="P02")).to_be_visible()
    expect(page.get_by_label("Tick P01")).to_be_checked()
    asked: list[str] = []

    def refuse(dialog: Dialog) -> None:
        asked.append(dialog.message)
        dialog.dismiss()

    page.once("dialog", refuse)
    page.get_by_role("button", name="New links and sheet").click()
    assert "stop working at once" in asked[0]
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="New links and sheet").click()
    expect(page.get_by_role("heading", name="Personal links")).to_be_visible()


def moved_alike(one: float, other: float) -> bool:
    return one == other > 0


def test_an_answer_is_played_on_one_clock_and_excluded(page: Page) -> None:
    page.goto("/studies/pilot/answers")
    page.get_by_role("link", name="P01, pair 3").click()
    player = page.get_by_role("button", name="Pause")
    expect(player).to_be_visible()
    player.click()
    page.get_by_label("Position").focus()
    page.keyboard.press("Home")
    page.get_by_role("button", name="One frame forward").click()
    assert until(lambda: moved_alike(*page.evaluate(TIMES)))
    page.get_by_label("Reason").fill("Was on the phone.")
    page.get_by_role("button", name="Exclude").click()
    expect(page.get_by_role("heading", name="Excluded")).to_be_visible()
    page.get_by_role("button", name="Take this answer in again").click()
    expect(page.get_by_role("heading", name="Exclude this answer")).to_be_visible()


def test_without_script_answers_are_excluded_and_words_explained(page: Page, chromium: Browser) -> None:
    context = chromium.new_context(storage_state=page.context.storage_state(), java_script_enabled=False)
    plain = context.new_page()
    plain.goto(page.url + "/pilot/answers?participant=P01")
    meaning = plain.get_by_text("before they answered")
    expect(meaning).to_be_hidden()
    plain.get_by_role("button", name=re.compile("prediction. means")).click()
    expect(meaning).to_be_visible()
    plain.keyboard.press("Escape")
    plain.get_by_role("link", name="P01, pair 3").click()
    plain.get_by_label("Reason").fill("Was on the phone.")
    plain.get_by_role("button", name="Exclude").click()
    expect(plain.get_by_role("heading", name="Excluded")).to_be_visible()
    context.close()


def test_a_preset_is_chosen_by_its_button_only_and_keeps_what_was_typed(page: Page) -> None:
    page.goto("/studies/new")
    page.get_by_label("Name of the study").fill("Mine")
    page.get_by_role("button", name="Paper protocol").click()
    expect(page.get_by_role("button", name="Paper protocol")).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_label("Name of the study")).to_have_value("Mine")
    page.get_by_label("Name of the study").press("Enter")
    expect(page.get_by_role("heading", name="Mine")).to_be_visible()
    expect(page.get_by_text("3 methods, 3 trials each")).to_be_visible()
