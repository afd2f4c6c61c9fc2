"""Two clips as one: controls and their keys, what opens the answers, what is noted, practice and breaks."""

import re

import pytest
from playwright.sync_api import Page, expect
from sqlalchemy import select

from app.domain.participation import ParticipantEvent
from app.domain.preferences import Purpose, Query
from tests import factories
from tests.browser.conftest import (
    Invited,
    NewPage,
    hold_clips,
    let_clips_run,
    overflow,
    serious_findings,
    the_only,
    wait_ready,
)
from tests.waiting import until

pytestmark = pytest.mark.browser

LAST_FRAME_S = (factories.FRAMES - 1) / factories.FPS
TIMES = "() => [...document.querySelectorAll('video')].map((video) => video.currentTime)"
RATES = "() => [...document.querySelectorAll('video')].map((video) => video.playbackRate)"
AT_THE_BEGINNING = "() => [...document.querySelectorAll('video')].every((video) => video.currentTime === 0)"
PAUSED = "() => [...document.querySelectorAll('video')].every((video) => video.paused)"
PLAYING = "() => [...document.querySelectorAll('video')].every((video) => !video.paused)"
SEEN_FIRST = pytest.mark.parametrize("invited", [{"answer_after_first_play": True}], indirect=True)


def events(invited: Invited, kind: str) -> list[ParticipantEvent]:
    of_kind = select(ParticipantEvent).where(ParticipantEvent.kind == kind).order_by(ParticipantEvent.id)
    with invited.database.reading() as session:
        return list(session.scalars(of_kind))


def at_rest(page: Page) -> None:
    """Stand still, and until both have arrived there."""
    page.keyboard.press("Space")
    assert until(lambda: page.evaluate(PAUSED))


def scrub(page: Page, permille: int) -> None:
    """As by mouse: the bar does not keep the arrow keys."""
    bar = page.locator("[data-scrub]")
    bar.fill(str(permille))
    bar.blur()


def test_space_pauses_and_plays_both(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    at_rest(page)
    expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
    left, right = page.evaluate(TIMES)
    assert abs(left - right) <= 1 / factories.FPS
    page.keyboard.press("Space")
    assert until(lambda: page.evaluate(PLAYING))
    expect(page.get_by_role("button", name="Pause")).to_be_visible()


def test_comma_and_full_stop_go_one_frame_in_both(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    at_rest(page)
    scrub(page, 500)
    before = page.evaluate(TIMES)
    page.keyboard.press(".")
    page.keyboard.press(".")
    page.keyboard.press(",")
    after = page.evaluate(TIMES)
    assert [round(now - then, 2) for now, then in zip(after, before, strict=True)] == [1 / factories.FPS] * 2
    assert page.evaluate(PAUSED)


def test_number_keys_set_the_speed_of_both_which_stays_for_the_next_pair_and_is_stored(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("1")
    assert page.evaluate(RATES) == [pytest.approx(0.25, rel=0.35)] * 2
    page.keyboard.press("4")
    expect(page.get_by_role("button", name="2 times normal speed")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert page.evaluate(RATES) == [pytest.approx(2.0, rel=0.35)] * 2
    assert invited.events()[0].playback_rate == 2.0


def test_one_bar_scrubs_both_and_the_arrows_answer_again_afterwards(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    bar = page.get_by_role("slider", name="Position in both videos")
    box = bar.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 20, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] / 2, steps=4)
    page.mouse.up()
    left, right = page.evaluate(TIMES)
    assert left == right
    assert left == pytest.approx(0.75 * factories.FRAMES / factories.FPS, abs=0.1)
    assert page.evaluate(PAUSED)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert invited.responses() == ["left"]
    assert invited.events()[0].scrub_count == 1


def test_whoever_came_to_the_bar_by_keyboard_moves_it_by_keyboard(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.get_by_role("slider", name="Position in both videos").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowLeft")
    assert invited.responses() == []


@SEEN_FIRST
def test_answers_open_when_both_clips_have_been_seen_once(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    hold_clips(page)
    page.goto(invited.link)
    expect(page.locator("[data-phase=watching]")).to_be_visible()
    expect(page.get_by_role("status")).to_have_text("Watch both once, then answer")
    assert serious_findings(page) == []
    page.keyboard.press("ArrowLeft")
    scrub(page, 990)  # the end alone is not the whole
    page.keyboard.press("Space")
    assert until(lambda: page.evaluate(AT_THE_BEGINNING)), "of the next round"
    page.keyboard.press("ArrowLeft")
    assert invited.responses() == []
    let_clips_run(page)
    wait_ready(page, 0)
    expect(page.get_by_role("status")).to_have_text("You can answer now")
    page.keyboard.press("ArrowLeft")
    expect(page.locator("[data-count]")).to_have_text("1 of 10")
    (event,) = invited.events()
    assert event.watched_whole is True


@SEEN_FIRST
def test_what_was_played_of_each_clip_is_noted_whatever_the_speed_at_the_end(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page()
    page.goto(invited.link)
    page.keyboard.press("4")
    wait_ready(page, 0)  # both have been played once, at double speed
    page.keyboard.press("1")
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    (event,) = invited.events()
    assert event.playback_rate == 0.25
    whole_ms = 1000 * factories.FRAMES / factories.FPS
    for watched_ms in (event.left_watched_ms, event.right_watched_ms):
        assert watched_ms == pytest.approx(whole_ms, abs=2 * 1000 / factories.FPS), "once, however often it was played"


@SEEN_FIRST
def test_clips_that_break_off_do_not_lock_the_answers(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    hold_clips(page)
    page.goto(invited.link)
    expect(page.locator("[data-phase=watching]")).to_be_visible()
    page.evaluate("document.querySelector('video').dispatchEvent(new Event('error'))")
    expect(page.get_by_text("These videos stopped playing.")).to_be_visible()
    page.keyboard.press("ArrowRight")
    expect(page.locator("[data-count]")).to_have_text("1 of 10")
    (event,) = invited.events()
    assert (event.response, event.play_error_count, event.watched_whole) == ("right", 1, False)
    assert len(events(invited, "play_error")) == 1
    assert len(events(invited, "answers_opened")) == 1


def test_cant_tell_asks_why_with_one_more_key_and_takes_no_for_an_answer(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("s")
    expect(page.get_by_role("dialog", name="Why can\u2019t you tell?")).to_be_visible()
    assert serious_findings(page) == []
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_be_hidden()
    assert invited.responses() == []
    page.keyboard.press("s")
    page.keyboard.press("2")
    wait_ready(page, 1)
    page.keyboard.press("s")
    page.keyboard.press("s")
    wait_ready(page, 2)
    assert [(event.response, event.reason) for event in invited.events()] == [("skip", "both_bad"), ("skip", None)]


def test_how_the_clips_were_watched_is_resent_after_the_network_was_away(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("2")
    scrub(page, 300)
    page.context.set_offline(True)
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("status")).to_contain_text("Not saved yet")
    page.context.set_offline(False)
    wait_ready(page, 1)
    (event,) = invited.events()
    assert (event.response, event.playback_rate, event.scrub_count) == ("right", 0.5, 1)
    assert (event.stall_count, event.stalled_ms, event.watched_whole) == (0, 0, False)
    assert event.largest_drift_ms is not None


def test_the_next_two_pairs_are_loaded_ahead(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url) if request.url.endswith(".mp4") else None)
    page.goto(invited.link)
    wait_ready(page, 0)
    page.wait_for_load_state("networkidle")
    assert len(set(asked)) == 4  # of three pairs: neighbours share a clip here


@pytest.mark.parametrize("invited", [{"practice_pairs": 1}], indirect=True)
def test_practice_notices_which_keys_were_used_and_counts_for_nothing(invited: Invited, new_page: NewPage) -> None:
    with invited.database.writing() as session:
        session.scalars(select(Query).order_by(Query.ordinal)).first().purpose = Purpose.PRACTICE  # type: ignore[union-attr]
    page = new_page()
    page.goto(invited.link)
    expect(page.locator("[data-count]")).to_have_text("Practice 0 of 1")
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    assert serious_findings(page) == []
    for number, key in enumerate(["Space", ".", "3", "r"], start=1):
        page.keyboard.press(key)
        expect(page.locator("[data-practice-key][data-used]")).to_have_count(number)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 0)
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    assert [event.detail for event in events(invited, "keys_used")] == [{"count": 5}]


@pytest.mark.parametrize("invited", [{"break_every": 2}], indirect=True)
def test_after_some_answers_a_break_is_offered_once_and_enter_goes_on(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    for number in range(2):
        wait_ready(page, number)
        page.keyboard.press("ArrowLeft")
    expect(page.get_by_role("heading", name="2 answers done")).to_be_visible()
    assert serious_findings(page) == []
    page.goto(invited.link)  # on another day
    expect(page.get_by_role("heading", name="2 answers done")).to_be_visible()
    page.keyboard.press("Enter")
    wait_ready(page, 2)
    page.keyboard.press("z")
    wait_ready(page, 1)
    page.keyboard.press("ArrowRight")
    wait_ready(page, 2)
    for kind in ("break_begun", "break_over"):
        assert [event.detail for event in events(invited, kind)] == [{"answered": 2}]


@pytest.mark.parametrize(("width", "height"), [(1366, 768), (390, 844)])
@pytest.mark.parametrize("invited", [{"practice_pairs": 1, "language": "de"}], indirect=True)
def test_practice_fits_the_screen_in_the_longer_language_too(
    invited: Invited, new_page: NewPage, width: int, height: int
) -> None:
    with invited.database.writing() as session:
        session.scalars(select(Query).order_by(Query.ordinal)).first().purpose = Purpose.PRACTICE  # type: ignore[union-attr]
    page = new_page(viewport={"width": width, "height": height}, has_touch=width < 900, is_mobile=width < 900)
    page.goto(invited.link)
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    expect(page.locator("[data-scrub]")).to_have_attribute("aria-valuetext", re.compile(r"^\d,\d von \d,\d Sekunden$"))
    assert overflow(page) == [0, 0]
    for box in [each.bounding_box() for each in page.locator("video, button:visible, input:visible").all()]:
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height


def test_without_script_the_clips_have_the_browser_s_controls_and_the_rest_stays_away(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page(java_script_enabled=False)
    page.goto(invited.link)
    expect(page.locator("video[controls]")).to_have_count(2)
    expect(page.locator("[data-player]")).to_be_hidden()
    expect(page.get_by_role("dialog")).to_be_hidden()
    the_only(page.get_by_role("button", name="Equal")).click()
    expect(page.locator("[data-count]")).to_have_text("1 of 10")
    assert invited.responses() == ["equal"]
