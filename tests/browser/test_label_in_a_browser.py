"""A participant labels in a real browser, from the personal link to the thanks; the experimenter looks on."""

import pytest
from playwright.sync_api import Route, expect
from sqlalchemy import select

from app.domain.clips import Clip
from app.domain.preferences import Query
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.browser.conftest import Invited, NewPage, overflow, serious_findings, the_only, wait_ready

pytestmark = [pytest.mark.browser, pytest.mark.slow]

KEYS = {"left": "ArrowLeft", "right": "ArrowRight", "equal": "ArrowDown", "skip": "s"}


@pytest.mark.parametrize("invited", [False], indirect=True)
def test_from_the_link_to_the_tenth_answer_and_on_the_dashboard(
    invited: Invited, new_page: NewPage, experimenter_cookie: str
) -> None:
    page = new_page()
    page.goto(invited.link)
    assert invited.token not in page.url
    assert serious_findings(page) == []
    page.get_by_role("button", name="I agree to take part").click()
    expect(page.get_by_role("button", name="Start comparing")).to_be_visible()
    assert serious_findings(page) == []
    page.get_by_role("button", name="Start comparing").click()
    given = ["left", "right", "equal", "skip", "left", "right", "left", "equal", "left", "right"]
    for number, response in enumerate(given):
        wait_ready(page, number)
        if number == 0:
            assert serious_findings(page) == []
        page.keyboard.press(KEYS[response])
        if response == "skip":
            page.keyboard.press("1")  # the reason
    expect(page.get_by_role("heading", name="Thank you")).to_be_visible()
    assert serious_findings(page) == []
    assert invited.responses() == given
    first = invited.events()[0]
    assert first.response_time_ms is not None
    assert first.response_time_ms > 100
    assert (first.replay_count, first.play_error_count) == (0, 0)

    dashboard = new_page()
    dashboard.context.add_cookies(
        [{"name": "studio_experimenter", "value": experimenter_cookie, "url": invited.address}]
    )
    dashboard.goto(f"{invited.address}/studies/{invited.study.slug}")
    row = dashboard.get_by_role("row").filter(has_text="P01")
    expect(row).to_contain_text("finished")
    expect(row).to_contain_text("10 of 10")
    assert serious_findings(dashboard) == []
    dashboard.get_by_role("link", name="P01").click()
    expect(dashboard.get_by_label("Answers by kind")).to_contain_text("Can\u2019t tell")
    assert serious_findings(dashboard) == []


@pytest.mark.parametrize("invited", [{"asks_what_mattered": True}], indirect=True)
def test_what_mattered_is_said_by_a_key_after_the_answer_or_passed_over(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press(KEYS["left"])
    dialog = page.get_by_role("dialog", name="What made the difference?")
    expect(dialog).to_be_visible()
    assert serious_findings(page) == []
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    assert invited.events() == []
    page.keyboard.press(KEYS["right"])
    page.keyboard.press("3")
    wait_ready(page, 1)
    page.keyboard.press(KEYS["left"])
    page.keyboard.press("Enter")
    wait_ready(page, 2)
    page.keyboard.press(KEYS["equal"])
    wait_ready(page, 3)
    said = [(event.response, event.mattered) for event in invited.events()]
    assert said == [("right", "force"), ("left", None), ("equal", None)]


@pytest.mark.parametrize("invited", [{"asks_for_hints": True, "introduction_pairs": 0}], indirect=True)
def test_hints_are_asked_for_between_two_pairs_and_given_by_keyboard(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    for number in range(3):
        wait_ready(page, number)
        page.keyboard.press(KEYS["left"])
    expect(page.get_by_role("heading", name="the robot should do")).to_be_visible()
    assert serious_findings(page) == []
    box = page.get_by_role("checkbox", name="slower near me")
    while not box.evaluate("box => box === document.activeElement"):
        page.keyboard.press("Tab")
    page.keyboard.press("Space")
    page.keyboard.press("Enter")
    wait_ready(page, 3)
    assert serious_findings(page) == []
    page.get_by_role("link", name="Hints").click()
    expect(box).to_be_checked()


def test_both_clips_start_together_and_loop_together(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    seen = page.evaluate(
        """async () => {
            const [left, right] = document.querySelectorAll('video');
            const starts = [];
            let before = 0;
            while (starts.length < 2) {
                await new Promise(requestAnimationFrame);
                if (left.currentTime < before - 0.5) starts.push(Math.abs(left.currentTime - right.currentTime));
                before = left.currentTime;
            }
            return starts;
        }"""
    )
    assert max(seen) <= 1 / factories.FPS


def test_a_clip_that_plays_too_slowly_catches_up_within_the_round(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    drift = page.evaluate(
        """async () => {
            const [left, right] = document.querySelectorAll('video');
            const until = async (holds) => { while (!holds()) await new Promise(requestAnimationFrame); };
            await until(() => left.currentTime > 1);
            await until(() => left.currentTime < 0.3 && !left.paused);
            right.playbackRate = 0.85;  // a decoder that cannot keep up; 0.18 s at the end of the round
            await until(() => left.currentTime > 1.5);
            return Math.abs(left.currentTime - right.currentTime);
        }"""
    )
    assert drift <= 1 / factories.FPS


def test_the_next_pair_is_already_loaded(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.wait_for_load_state("networkidle")
    fetched: list[str] = []
    page.on("request", lambda request: fetched.append(request.url))
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    sources = page.eval_on_selector_all("video", "videos => videos.map(video => video.src)")
    assert all(source.startswith("blob:") for source in sources)
    assert fetched[0].endswith("/label")


def test_a_held_key_and_a_double_press_answer_one_pair(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.down("ArrowLeft")
    wait_ready(page, 1)
    for _ in range(5):
        page.keyboard.down("ArrowLeft")  # a key that is already down repeats
    page.keyboard.up("ArrowLeft")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    wait_ready(page, 2)
    assert invited.responses() == ["left", "right"]


def test_undo_shows_the_pair_again(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    expect(page.get_by_role("button", name="Undo")).to_be_hidden()
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    page.keyboard.press("z")
    wait_ready(page, 0)
    page.get_by_role("button", name="Right").click()
    wait_ready(page, 1)
    assert invited.responses() == ["right"]
    assert [event.response for event in invited.events()] == ["left", None, "right"]


def test_replays_are_counted(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("r")
    page.get_by_role("button", name="Replay").click()
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert invited.events()[0].replay_count == 2


def test_without_network_the_answer_is_kept_and_sent_again_with_the_same_uuid(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.post_data or "") if request.method == "POST" else None)
    page.context.set_offline(True)
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("status")).to_contain_text("Not saved yet. Trying again")
    expect(page.locator("[data-count]")).to_have_text("0 of 10")
    page.keyboard.press("ArrowLeft")  # changes nothing: the answer was given
    page.context.set_offline(False)
    wait_ready(page, 1)
    assert invited.responses() == ["right"]
    assert len(set(sent)) == 1
    assert page.evaluate("Object.keys(localStorage).length") == 0


def test_a_lost_response_does_not_double_the_answer(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    lost: list[int] = []

    def lose_the_first(route: Route) -> None:
        if lost:
            route.continue_()
        else:
            lost.append(route.fetch().status)  # it reached the server
            route.abort()

    page.route("**/label", lose_the_first)
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert lost == [200]
    assert [event.response for event in invited.events()] == ["left"]


def test_an_answer_that_was_not_saved_survives_closing_the_page(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(invited.link)
    wait_ready(page, 0)
    page.route("**/label", lambda route: route.abort())
    page.keyboard.press("ArrowDown")
    expect(page.get_by_role("status")).to_contain_text("Not saved yet")
    again = page.context.new_page()
    page.close()
    again.goto(invited.link)
    wait_ready(again, 1)
    assert invited.responses() == ["equal"]


def test_the_back_button_neither_loses_nor_doubles(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.goto(f"{invited.address}/login")
    page.goto(invited.link)
    wait_ready(page, 0)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    page.go_back()
    page.go_forward()
    wait_ready(page, 1)
    page.reload()
    wait_ready(page, 1)
    page.keyboard.press("ArrowRight")
    wait_ready(page, 2)
    assert invited.responses() == ["left", "right"]


def test_clips_that_cannot_be_loaded_can_be_loaded_again_and_are_counted(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.route("**/media/*.mp4", lambda route: route.abort())
    page.goto(invited.link)
    expect(page.get_by_text("These videos could not be loaded.")).to_be_visible()
    page.keyboard.press("ArrowLeft")  # nobody can prefer what they have not seen
    assert invited.responses() == []
    page.unroute("**/media/*.mp4")
    page.get_by_role("button", name="Load them again").click()
    wait_ready(page, 0)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert invited.events()[0].play_error_count == 1


def test_a_pair_whose_clip_is_damaged_gives_way_to_the_next(
    invited: Invited, new_page: NewPage, store: ArtefactStore
) -> None:
    page = new_page()
    page.route("**/media/*.mp4", lambda route: route.abort())
    page.goto(invited.link)
    expect(page.get_by_text("These videos could not be loaded.")).to_be_visible()
    with invited.database.reading() as session:
        first, second = session.scalars(select(Query).order_by(Query.ordinal).limit(2))
        clip = session.get_one(Clip, first.left_clip_id)
    stored_files.overwrite(store, clip.video_sha256, b"no video")
    page.unroute("**/media/*.mp4")
    page.get_by_role("button", name="Load them again").click()
    wait_ready(page, 0)
    page.keyboard.press("ArrowLeft")
    wait_ready(page, 1)
    assert [event.query_id for event in invited.events()] == [second.id]


def test_clips_that_never_load_can_be_passed_over(invited: Invited, new_page: NewPage) -> None:
    page = new_page()
    page.route("**/media/*.mp4", lambda route: route.abort())
    page.goto(invited.link)
    expect(page.get_by_text("These videos could not be loaded.")).to_be_visible()
    page.keyboard.press("s")
    expect(page.locator("[data-count]")).to_have_text("1 of 10")
    assert invited.responses() == ["skip"]
    assert invited.events()[0].response_time_ms is None


def test_whoever_prefers_stillness_plays_on_demand(invited: Invited, new_page: NewPage) -> None:
    page = new_page(reduced_motion="reduce")
    page.goto(invited.link)
    play = page.get_by_role("button", name="Play both")
    expect(play).to_be_visible()
    assert page.eval_on_selector_all("video", "videos => videos.every(video => video.paused)")
    page.keyboard.press("ArrowLeft")
    assert invited.responses() == []
    play.click()
    wait_ready(page, 0)
    expect(page.get_by_role("button", name="Play again")).to_be_visible()
    page.keyboard.press("ArrowLeft")
    expect(page.locator("[data-count]")).to_have_text("1 of 10")


def test_everything_works_without_script(invited: Invited, new_page: NewPage) -> None:
    page = new_page(java_script_enabled=False)
    page.goto(invited.link)
    for number, name in enumerate(["Left", "Right", "Undo", "Can\u2019t tell"]):
        the_only(page.get_by_role("button", name=name)).click()
        expect(page.locator("[data-count]")).to_have_text(f"{[1, 2, 1, 2][number]} of 10")
    assert invited.responses() == ["left", "skip"]


@pytest.mark.parametrize(
    ("width", "height"), [(1366, 768), (1366, 650), (390, 844), (390, 664), (360, 640), (844, 390)]
)
def test_nothing_scrolls_and_everything_is_in_reach(
    invited: Invited, new_page: NewPage, width: int, height: int
) -> None:
    page = new_page(viewport={"width": width, "height": height}, has_touch=width < 900, is_mobile=width < 900)
    page.goto(invited.link)
    wait_ready(page, 0)
    assert overflow(page) == [0, 0]
    for box in [each.bounding_box() for each in page.locator("video, button:visible").all()]:
        assert box is not None
        assert box["x"] >= 0
        assert box["y"] >= 0
        assert box["x"] + box["width"] <= width
        assert box["y"] + box["height"] <= height
    for button in page.locator(".answer").all():
        size = button.bounding_box()
        assert size is not None
        assert size["height"] >= 44
    clips = [each.bounding_box() for each in page.locator("video").all()]
    assert all(clip is not None and clip["width"] >= 150 for clip in clips)


@pytest.mark.parametrize(
    "invited",
    [{"asks_for_hints": True, "introduction_pairs": 0, "language": language} for language in ("en", "de")],
    indirect=True,
)
def test_whatever_can_be_done_below_a_pair_fits_in_one_row_of_a_narrow_phone(
    invited: Invited, new_page: NewPage
) -> None:
    page = new_page(viewport={"width": 360, "height": 640}, has_touch=True, is_mobile=True)
    page.goto(invited.link)
    expect(page.locator("[data-phase=ready]")).to_be_visible()
    page.keyboard.press(KEYS["left"])
    foot = page.locator(".stage-foot > :is(button, form, a):visible")
    expect(foot).to_have_count(4)
    boxes = [box for each in foot.all() if (box := each.bounding_box())]
    assert len({round(box["y"] + box["height"] / 2) for box in boxes}) == 1
    assert max(box["height"] for box in boxes) <= 44, "two lines of words at most"


def test_a_phone_answers_by_touch_and_names_the_clips_by_where_they_are(invited: Invited, new_page: NewPage) -> None:
    page = new_page(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page.goto(invited.link)
    wait_ready(page, 0)
    page.get_by_role("button", name="Top").tap()
    wait_ready(page, 1)
    page.get_by_role("button", name="Bottom").tap()
    wait_ready(page, 2)
    assert invited.responses() == ["left", "right"]


def test_waiting_goes_on_by_itself_when_a_pair_is_ready(
    invited: Invited, new_page: NewPage, store: ArtefactStore
) -> None:
    with invited.database.writing() as session:
        participant, token = factories.make_participant(session, invited.study)
    page = new_page()
    page.goto(f"{invited.address}/p/{token}")
    expect(page.get_by_role("heading", name="being prepared")).to_be_visible()
    assert serious_findings(page) == []
    with invited.database.writing() as session:
        factories.make_queries(session, store, participant, 2)
    wait_ready(page, 0)
