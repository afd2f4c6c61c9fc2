"""The participants' pages for eyes, fingers, keyboards and screen readers: enlarging, order of Tab, what is read."""

import re

import pytest
from playwright.sync_api import Page, expect

from app.domain.protocol import PAPER_DEMOGRAPHICS
from app.domain.studies import Participant, Study
from app.services.answers import form_answers
from app.storage import ArtefactStore
from tests import factories
from tests.browser.conftest import Invited, NewPage, overflow, serious_findings, wait_ready

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SMALL = {"width": 320, "height": 568}
ON_ITS_SIDE = {"width": 568, "height": 320}
PHONE = {"has_touch": True, "is_mobile": True}


def width_of(page: Page, side: str) -> float:
    box = page.locator(f"[data-side={side}]").bounding_box()
    assert box is not None
    return box["width"]


@pytest.mark.parametrize("viewport", [SMALL, ON_ITS_SIDE], ids=["upright", "on its side"])
def test_a_tap_enlarges_a_clip_and_another_brings_both_back(
    invited: Invited, new_page: NewPage, viewport: dict[str, int]
) -> None:
    page = new_page(viewport=viewport, **PHONE)
    page.goto(invited.link)
    wait_ready(page, 0)
    before = width_of(page, "left")
    video = page.locator("[data-side=left] video")
    video.tap(position={"x": 20, "y": 20})
    expect(page.locator("[data-enlarged]")).to_be_visible()
    assert width_of(page, "left") > 1.5 * before
    assert overflow(page)[0] <= 0
    video.tap(position={"x": 20, "y": 20})
    expect(page.locator("[data-enlarged]")).to_have_count(0)
    assert width_of(page, "left") == before


def test_both_clips_play_on_together_while_one_is_enlarged_and_are_changed_for_each_other(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page(viewport=SMALL, **PHONE)
    page.goto(invited.link)
    wait_ready(page, 0)
    page.locator("[data-side=left]").get_by_role("button", name="Enlarge this video").tap()
    page.locator("[data-side=left]").get_by_role("button", name="Bottom").tap()
    expect(page.locator("[data-side=right][data-alone]")).to_be_visible()
    expect(page.locator("[data-side=left]")).to_have_attribute("inert", "")
    apart = page.evaluate(
        """async () => {
            const [left, right] = document.querySelectorAll('video');
            const from = right.currentTime;
            while (right.currentTime === from) await new Promise(requestAnimationFrame);
            return Math.abs(left.currentTime - right.currentTime);
        }"""
    )
    assert apart < 0.25
    assert serious_findings(page) == []


def test_escape_brings_both_back_and_keys_answer_while_one_is_enlarged(invited: Invited, new_page: NewPage) -> None:
    page = new_page(viewport=SMALL)
    page.goto(invited.link)
    wait_ready(page, 0)
    enlarge = page.locator("[data-side=right]").get_by_role("button", name="Enlarge this video")
    enlarge.press("Enter")
    expect(enlarge).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("Escape")
    expect(enlarge).to_have_attribute("aria-pressed", "false")
    enlarge.press("Enter")
    page.keyboard.press("ArrowRight")
    expect(page.locator("[data-count]")).to_have_text("1 of 10")
    expect(page.locator("[data-enlarged]")).to_have_count(0)
    wait_ready(page, 1)
    assert invited.responses() == ["right"]


def tab_stops(page: Page) -> list[str]:
    """What Tab reaches from the top of the page on, in its order, by name."""
    named = "(document.activeElement.getAttribute('aria-label') ?? document.activeElement.innerText).trim()"
    stops: list[str] = []
    page.evaluate("document.activeElement.blur()")
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement === document.body"):
            break
        stops.append(re.sub(r"\s+", " ", page.evaluate(named)))
    return stops


def test_the_way_out_is_in_words_and_the_last_that_tab_reaches(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    stops = tab_stops(page)
    assert stops[0] == "Deutsch"
    assert stops.index("← Left") < stops.index("Withdraw from the study") == len(stops) - 1
    expect(page.get_by_role("link", name="Withdraw from the study")).to_be_visible()


@pytest.mark.parametrize("invited", [False], indirect=True)
def test_the_language_is_changed_at_the_top_of_the_page_by_keyboard(invited: Invited, new_page: NewPage) -> None:
    page = new_page(locale="de-DE")
    page.goto(invited.link)
    expect(page.get_by_role("button", name="Ich willige ein")).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_role("button", name="English")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="I agree to take part")).to_be_visible()


@pytest.mark.parametrize(
    "invited", [{"demographics": PAPER_DEMOGRAPHICS}], indirect=True, ids=["questions about the person"]
)
def test_a_form_leads_to_the_answer_that_needs_another_look(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    age = page.get_by_label("How old are you?")
    age.fill("young")
    page.get_by_role("button", name="Save and go on").click()
    expect(age).to_be_focused()
    expect(age).to_have_accessible_description("Please enter a number, or leave this empty.")
    age.evaluate("field => field.blur()")
    page.get_by_role("alert").get_by_role("link", name="How old are you?").click()
    page.keyboard.press("Tab")
    expect(page.get_by_label("What is your gender?")).to_be_focused()
    radios = page.get_by_role("group", name="How much experience").get_by_role("radio")
    assert [radio.evaluate("each => each.getAttribute('aria-label')") for radio in radios.all()][:5] == [
        "1: none",
        None,
        None,
        None,
        "5: a lot",
    ]
    assert serious_findings(page) == []


@pytest.mark.parametrize("invited", [{"labels_per_participant": 10, "instruments": ("tia",)}], indirect=True)
def test_a_standard_questionnaire_is_filled_in_with_the_keyboard_and_fits_a_phone(
    invited: Invited, new_page: NewPage, store: ArtefactStore
) -> None:
    answer_all(invited, store)
    page = new_page(viewport=SMALL)
    page.goto(invited.link)
    expect(page.get_by_role("group", name="I trust the system.")).to_be_visible()
    assert overflow(page)[0] <= 0
    assert serious_findings(page) == []
    trust = page.get_by_role("group", name="I trust the system.")
    trust.get_by_role("radio", name="No answer").focus()
    page.keyboard.press("ArrowUp")
    expect(trust.get_by_role("radio", name="Strongly agree")).to_be_checked()
    page.get_by_role("button", name="Save and go on").press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("18 answers are missing")
    page.get_by_role("button", name="Save and go on").press("Enter")
    expect(page).to_have_url(re.compile("/p/finished$"))
    with invited.database.reading() as session:
        given = form_answers.newest(session, session.get_one(Participant, invited.participant.id), "tia")
    assert (given["item_09"], given["item_14"]) == ("5", None)


@pytest.mark.parametrize(
    "invited",
    [{"labels_per_participant": 10, "instruments": ("nasa_tlx", "rosas"), "languages": ("en",)}],
    indirect=True,
)
@pytest.mark.parametrize("viewport", [SMALL, {"width": 1366, "height": 768}], ids=["phone", "laptop"])
def test_scales_of_many_points_fit_every_screen_and_say_what_their_ends_mean(
    invited: Invited, new_page: NewPage, store: ArtefactStore, viewport: dict[str, int]
) -> None:
    answer_all(invited, store)
    page = new_page(viewport=viewport)
    page.goto(invited.link)
    effort = page.get_by_role("group", name=re.compile("^Effort"))
    expect(effort.get_by_role("radio")).to_have_count(21 + 1)
    expect(effort.get_by_role("radio", name="100: very high")).to_be_visible()
    sizes = page.locator(".points .option").evaluate_all("all => all.map(each => each.getBoundingClientRect().width)")
    assert min(sizes) >= 24, "WCAG 2.5.8"
    assert overflow(page)[0] <= 0
    assert serious_findings(page) == []
    page.get_by_role("button", name="Save and go on").click()
    expect(page.get_by_role("alert")).to_be_visible()
    page.get_by_role("button", name="Save and go on").click()
    expect(page.get_by_role("group", name="Happy")).to_be_visible()
    assert overflow(page)[0] <= 0
    assert serious_findings(page) == []


def answer_all(invited: Invited, store: ArtefactStore) -> None:
    with invited.database.writing() as session:
        person = session.get_one(Participant, invited.participant.id)
        factories.answer_everything(session, store, session.get_one(Study, invited.study.id), person)
