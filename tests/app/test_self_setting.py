"""A robot that people set themselves: after the comparisons, every setting kept, and nobody is told which it is."""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from html import unescape
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from pydantic import ValidationError
from sqlalchemy import select

from app.db import Database
from app.domain.participation import StageRecord
from app.domain.protocol import EvaluatedMethod, EvaluationMode, EvaluationSettings, Language, Stage
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.services.evaluation import self_setting
from app.services.evaluation.self_setting import STOPS, Slider
from app.services.exports.export_tables import TABLES
from app.services.participants import withdrawal
from app.services.participants.sliders import MOST_REVISIONS
from app.storage import ArtefactStore
from app.web.texts import slider_words
from app.web.texts.wording import Wording
from tests import factories
from tests.app.conftest import JSON
from worker.tasks import registry

METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PBARL, EvaluatedMethod.SELF_SET)
MIDDLE = {"speed_far": 0, "press": 0, "hesitate": 0}
FILMED: list[dict[str, float]] = [{}, {"speed_far": -0.5}, {"speed_far": 0.4}, {"press": 0.4}]


@dataclass
class AtSliders:
    """Somebody at the sliders, as the page's script acts."""

    browser: TestClient
    participant: Participant
    study: Study
    database: Database

    def look(self) -> dict[str, Any]:
        answer: dict[str, Any] = self.browser.get("/p/setting", headers=JSON).json()
        return answer

    def move(self, *, uuid: UUID | None = None, script: bool = True, **changed: Any) -> Answer:
        """Let go of sliders (by axis), or with ``goes_on`` go on."""
        more: dict[str, Any] = {
            name: changed.pop(name) for name in ("goes_on", "moved", "response_time_ms") if name in changed
        }
        stops: dict[str, Any] = {**MIDDLE, **changed}
        fields = {f"axis-{axis}": stop for axis, stop in stops.items() if stop is not None}
        data: dict[str, Any] = {"client_uuid": str(uuid or uuid4()), **fields, **more}
        return self.browser.post("/p/setting", data=data, headers=JSON if script else {})

    def stored(self) -> list[SelfSetting]:
        with self.database.reading() as session:
            theirs = select(SelfSetting).where(SelfSetting.participant_id == self.participant.id)
            return list(session.scalars(theirs.order_by(SelfSetting.revision)))


Begin = Callable[..., AtSliders]


@pytest.fixture
def begin(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> Begin:
    """Puts somebody at the sliders, or (``answered`` False) before the first pair."""

    def start(*, answered: bool = True, filmed: bool = True, **settings: Any) -> AtSliders:
        usual: dict[str, Any] = {"methods": METHODS, "trials": 1}
        with database.writing() as session:
            study = factories.make_study(session, evaluation=EvaluationSettings(**{**usual, **settings}))
            if filmed:
                factories.make_previews(session, store, study, FILMED)
            participant, token = factories.make_participant(session, study)
            if answered:
                factories.answer_everything(session, store, study, participant)
        browser = new_browser()
        browser.get(f"/p/{token}")
        return AtSliders(browser, participant, study, database)

    return start


@pytest.fixture
def there(begin: Begin) -> AtSliders:
    return begin()


# --- where it comes --------------------------------------------------------------------------------------------------


def test_the_sliders_come_after_the_comparisons_and_before_the_robots(begin: Begin) -> None:
    before = begin(answered=False)
    assert before.browser.get("/p/setting").headers["location"] == "/p/next"
    assert before.move(speed_far=1).status_code == 409
    there = begin()
    assert there.browser.get("/p/next").headers["location"] == "/p/setting"
    assert there.browser.get("/p/evaluation").headers["location"] == "/p/next"
    assert there.move(goes_on="true").json() == {"next_path": "/p/next"}
    assert there.browser.get("/p/next").headers["location"] == "/p/evaluation"


def test_studies_without_the_method_have_no_sliders(begin: Begin) -> None:
    there = begin(methods=METHODS[:2])
    assert there.browser.get("/p/next").headers["location"] == "/p/evaluation"


def test_who_sets_a_robot_is_told_so_beforehand(begin: Begin) -> None:
    with_sliders, without = begin(answered=False), begin(answered=False, methods=METHODS[:2])
    for there in (with_sliders, without):
        with there.database.writing() as session:
            session.get_one(Participant, there.participant.id).consented_at = None
    assert "set a robot yourself" in with_sliders.browser.get("/p/consent").text
    assert "set a robot yourself" not in without.browser.get("/p/consent").text


def test_which_robot_is_theirs_cannot_be_asked_where_two_are() -> None:
    with pytest.raises(ValidationError, match="set themselves"):
        EvaluationSettings(methods=METHODS, ask_which_is_theirs=True)


def test_the_method_is_there_for_robots_in_the_room_as_well(begin: Begin) -> None:
    there = begin(mode=EvaluationMode.PHYSICAL)
    assert there.move(goes_on="true").status_code == 200


# --- the sliders -----------------------------------------------------------------------------------------------------


def test_every_slider_is_a_native_one_that_says_in_words_where_it_stands(there: AtSliders) -> None:
    there.move(speed_far=-3)
    page = unescape(there.browser.get("/p/setting").text)
    inputs = re.findall(r'<input\s+id="slider-\d"\s+type="range"(.*?)/>', page, re.DOTALL)
    said = [
        re.search(r'name="axis-(\w+)".*min="(-?\d)".*max="(\d)".*valuetext="(.*?)"', each, re.DOTALL) for each in inputs
    ]
    assert [each.groups() for each in said if each] == [
        ("speed_far", "-4", "4", "slower, clearly"),
        ("press", "-4", "4", "in the middle, unchanged"),
        ("hesitate", "0", "4", "in the middle, unchanged"),
    ]
    assert len(re.findall(r'<label for="slider-\d">', page)) == 3


@pytest.mark.parametrize("task", ["feeding", "drinking", "scratching"])
@pytest.mark.parametrize("language", Language)
def test_participants_read_words_of_their_language_for_every_axis(task: str, language: Language) -> None:
    wording, read = Wording(language), []
    for axis in registry.task(task).modes.names:
        words = slider_words.words_of(wording, task, axis)
        read.append(words.label)
        assert words.low != words.high
        assert axis not in words.label
        assert not re.search("[\N{MINUS SIGN}(+]", f"{words.label}{words.low}{words.high}"), "written for experimenters"
    assert len(set(read)) == len(read)


def test_axes_of_a_laboratory_and_unknown_ones_have_words(monkeypatch: pytest.MonkeyPatch) -> None:
    german = Wording(Language.GERMAN)
    assert slider_words.words_of(german, "reach", "push_x").label == "Unterwegs in Richtung x gedrückt"
    assert slider_words.words_of(german, "reach", "gain_turning").label == "Tempo von turning allein"
    assert slider_words.words_of(german, "reach", "smooth").high == "gleichmäßiger"
    assert slider_words.words_of(german, "not_installed", "wrist_turn").label == "Wrist turn"


def test_a_slider_reaches_both_ends_of_its_axis_and_the_middle_is_the_reference() -> None:
    slider = Slider("speed_far", -0.5, 0.4)
    assert [slider.value_at(stop) for stop in (-STOPS, 0, STOPS)] == [-0.5, 0.0, 0.4]
    for stop in range(slider.lowest, slider.highest + 1):
        assert slider.stop_of(slider.value_at(stop)) == stop
    assert (Slider("hesitate", 0.0, 0.6).lowest, Slider("hesitate", 0.0, 0.6).highest) == (0, STOPS)


# --- what is saved ---------------------------------------------------------------------------------------------------


def test_every_place_that_is_let_go_of_is_kept_in_order_with_what_was_moved(there: AtSliders) -> None:
    there.move(speed_far=-4, moved="speed_far", response_time_ms=1500)
    there.move(speed_far=-4, press=2, moved="press")
    there.move(speed_far=-4, press=2, goes_on="true")
    assert [each.moved for each in there.stored()] == ["speed_far", "press", None]
    assert [each.filmed for each in there.stored()] == [True, False, False]
    assert there.stored()[-1].mode == {"speed_far": -0.5, "press": pytest.approx(0.2), "hesitate": 0.0}
    assert (there.stored()[0].response_time_ms, there.stored()[0].by_script) == (1500, True)


def test_a_setting_sent_again_is_stored_once(there: AtSliders) -> None:
    uuid, last = uuid4(), uuid4()
    assert there.move(uuid=uuid, press=1).json() == there.move(uuid=uuid, press=1).json()
    assert [there.move(uuid=last, press=2, goes_on="true").status_code for _ in range(2)] == [200, 200]
    assert [each.revision for each in there.stored()] == [1, 2]


def test_who_has_gone_on_can_no_longer_change_it(there: AtSliders) -> None:
    there.move(press=1, goes_on="true")
    answer = there.move(press=2)
    assert (answer.status_code, answer.json()["detail"]) == (
        409,
        "You have gone on already, and the setting you had then counts.",
    )
    assert len(there.stored()) == 1
    assert there.browser.get("/p/setting").status_code == 303


@pytest.mark.parametrize("wrong", [{"press": 5}, {"hesitate": -1}, {"press": None}, {"elbow": 1}])
def test_a_slider_that_is_missing_unknown_or_out_of_range_is_refused(there: AtSliders, wrong: dict[str, Any]) -> None:
    assert there.move(**wrong).status_code == 422
    assert there.stored() == []


def test_what_is_no_number_is_refused(there: AtSliders) -> None:
    assert there.move(press="far").status_code == 422
    assert there.browser.post("/p/setting", data={}, headers=JSON).status_code == 422


def test_a_browser_gone_wild_is_stopped_and_can_still_go_on(there: AtSliders) -> None:
    there.move(press=1)
    with there.database.writing() as session:
        session.scalars(select(SelfSetting)).one().revision = MOST_REVISIONS
    assert there.move(press=2).status_code == 409
    assert there.move(press=2, goes_on="true").status_code == 200


def test_nobody_sends_a_setting_under_the_mark_of_somebody_else_s(begin: Begin) -> None:
    one, other, uuid = begin(), begin(), uuid4()
    one.move(uuid=uuid, press=1)
    assert other.move(uuid=uuid, press=2).status_code == 422
    assert other.stored() == []


def test_without_script_the_form_shows_its_film_and_goes_on(there: AtSliders) -> None:
    assert there.move(script=False, speed_far=-4).headers["location"] == "/p/setting#film"
    assert "shows exactly your setting" in there.browser.get("/p/setting").text
    assert there.move(script=False, speed_far=-4, goes_on="true").headers["location"] == "/p/next"
    assert [each.by_script for each in there.stored()] == [False, False]


# --- the film that follows -------------------------------------------------------------------------------------------


def test_the_film_is_the_nearest_and_the_page_says_where_it_differs(there: AtSliders) -> None:
    exact, near = there.move(speed_far=-4).json(), there.move(speed_far=-3, press=1).json()
    assert (exact["exact"], exact["filmed"]) == (True, {"speed_far": -4, "press": 0, "hesitate": 0})
    assert (near["exact"], near["filmed"]) == (False, exact["filmed"])
    assert near["film"] == exact["film"]
    assert there.move(press=4).json()["film"] != near["film"]
    page = there.browser.get("/p/setting").text
    assert "exactly your setting" in page
    there.move(press=3)
    page = there.browser.get("/p/setting").text
    assert "nearest to yours" in page
    assert "In the film: farther, as far as it goes" in page


def test_a_film_of_somebody_s_own_setting_is_shown_to_them_alone(
    begin: Begin, store: ArtefactStore, database: Database
) -> None:
    one, other = begin(), begin()
    one.move(press=3)
    with database.writing() as session:
        setting = one.stored()[0]
        video, poster = factories.moving_picture(999)
        film = session.scalars(select(PreviewFilm).where(PreviewFilm.study_id == one.study.id)).first()
        assert film is not None
        columns = {name: getattr(film, name) for name in ("width", "height", "fps", "duration_ms", "byte_count")}
        stored = {"video_sha256": store.put(video), "poster_sha256": store.put(poster)}
        session.add(
            PreviewFilm(
                study_id=one.study.id, self_setting_id=setting.id, number=0, mode=setting.mode, **columns, **stored
            )
        )
        session.get_one(Participant, other.participant.id).study_id = one.study.id  # the same study
        session.get_one(Participant, other.participant.id).number = 2
    there, elsewhere = one.look(), other.look()
    assert there["exact"]
    assert one.browser.get(there["film"]["video"]).status_code == 200
    assert other.move(press=3).json()["exact"] is False
    assert other.browser.get(there["film"]["video"]).status_code == 404
    assert elsewhere["film"] != there["film"]
    with database.writing() as session:
        withdrawal.withdraw(session, store, session.get_one(Participant, one.participant.id), "themselves")
    assert not store.has(stored["video_sha256"])
    with database.reading() as session:
        assert session.scalars(select(SelfSetting).where(SelfSetting.participant_id == one.participant.id)).all() == []


def test_a_lost_film_gives_way_to_the_next_one(there: AtSliders, store: ArtefactStore) -> None:
    with there.database.reading() as session:
        gone = session.scalars(select(PreviewFilm).where(PreviewFilm.number == 1)).one()
    store.delete(gone.video_sha256)
    assert there.move(speed_far=-4).json()["exact"] is False


def test_while_there_is_no_film_the_page_waits_and_says_so(begin: Begin) -> None:
    there = begin(filmed=False)
    page = there.browser.get("/p/setting").text
    assert "The sliders are being prepared" in page
    assert 'data-refresh-s="4"' in page
    assert there.look()["film"] is None
    assert there.move(goes_on="true").status_code == 422, "nothing was set"


# --- what is not told, and what is ------------------------------------------------------------------------------------


def test_nothing_tells_which_of_the_robots_is_theirs(begin: Begin, store: ArtefactStore) -> None:
    there = begin()
    there.move(press=4, goes_on="true")
    with there.database.writing() as session:
        study, person = session.get_one(Study, there.study.id), session.get_one(Participant, there.participant.id)
        factories.make_robots(session, store, study, person)
    page = there.browser.get("/p/evaluation").text
    assert "Robot A" in page
    assert not re.search(r"self_set|set by|slider|setting", page, re.IGNORECASE)


def test_settings_are_exported_with_the_one_that_counts(there: AtSliders) -> None:
    (table,) = (each for each in TABLES if each.name == "settings")
    names = [column.name for column in table.columns]

    def rows() -> list[dict[str, Any]]:
        with there.database.reading() as session:
            study = session.get_one(Study, there.study.id)
            return [dict(zip(names, row, strict=True)) for row in table.rows(session, study)]

    there.move(press=-2, moved="press")
    assert {row["counts"] for row in rows()} == {False}
    there.move(press=4, goes_on="true")
    (counts,) = (row for row in rows() if row["counts"] and row["axis"] == "press")
    assert (counts["revision"], counts["place"], counts["value"]) == (2, 4, 0.4)
    assert len(rows()) == 2 * len(MIDDLE)


def test_time_at_the_sliders_is_known(there: AtSliders) -> None:
    there.look()
    there.move(goes_on="true")
    with there.database.reading() as session:
        record = session.scalars(select(StageRecord).where(StageRecord.stage == Stage.SELF_SETTING)).one()
        assert record.finished_at is not None
        assert self_setting.who_have_set(session, session.get_one(Study, there.study.id)) == {there.participant.id}


def test_the_page_state_is_what_its_script_reads(there: AtSliders) -> None:
    said = re.search(r'data-state="(.*?)"', there.browser.get("/p/setting").text)
    assert said is not None
    assert json.loads(unescape(said[1])) == there.look()
