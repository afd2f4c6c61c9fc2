"""Head-to-heads: two rated robots side by side, drawn in balance, each answered exactly once; and reasons in words."""

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from pydantic import ValidationError
from sqlalchemy import select

from app.db import Database
from app.domain.evaluation import LONGEST_REASON, HeadToHead, HeadToHeadAnswer, Rating
from app.domain.people import AuditEvent
from app.domain.protocol import LETTERS, EvaluatedMethod, EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan, head_to_heads
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import JSON

METHODS = tuple(EvaluatedMethod)
HOSTILE = '</textarea><script>alert("x")</script>\r\n=1+1 & "so" \N{GRINNING FACE}'


@dataclass
class SideBySide:
    """A participant who has rated every robot."""

    browser: TestClient
    participant: Participant
    trials: list[int]
    meant: list[int]
    database: Database

    def look(self) -> str:
        """The page that comes next."""
        page: str = self.browser.get("/p/evaluation", follow_redirects=True).text
        return page

    def rate(self, trial: int, **fields: Any) -> Answer:
        usual = {"satisfaction": 4, "personalisation": 2, "client_uuid": str(uuid4())}
        return self.browser.post(f"/p/evaluation/trials/{trial}/rating", data={**usual, **fields}, headers=JSON)

    def answer(
        self, number: int, response: str = "left", uuid: UUID | None = None, corrects: int = 0, **fields: Any
    ) -> Answer:
        """Send an answer as the page's script does."""
        path = f"/p/head-to-heads/{self.meant[number]}/answer"
        data = {"response": response, "client_uuid": str(uuid or uuid4()), **fields}
        return self.browser.post(f"{path}?corrects={corrects}" if corrects else path, data=data, headers=JSON)

    def answer_next(self, response: str = "left", **fields: Any) -> Answer:
        """Look at the next two, and answer."""
        number = int(re.findall(r'action="/p/head-to-heads/(\d+)/answer', self.look())[0])
        return self.answer(self.meant.index(number), response, **fields)

    def stored(self, number: int = 0) -> list[tuple[int, str, str | None]]:
        """Revision, response and reason of everything stored about one."""
        with self.database.reading() as session:
            rows = select(HeadToHeadAnswer).where(HeadToHeadAnswer.head_to_head_id == self.meant[number])
            found = session.scalars(rows.order_by(HeadToHeadAnswer.revision))
            return [(row.revision, row.response, row.reason) for row in found]


Begin = Callable[..., SideBySide]


@pytest.fixture
def begin(database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]) -> Begin:
    """Puts somebody before the first head-to-head, or (``rated`` False) before the first robot to rate."""

    def start(*, rated: bool = True, **settings: Any) -> SideBySide:
        usual: dict[str, Any] = {"methods": METHODS[:3], "trials": 1, "head_to_heads": 1}
        with database.writing() as session:
            study = factories.make_study(session, evaluation=EvaluationSettings(**{**usual, **settings}))
            participant, token = factories.make_participant(session, study)
            factories.answer_everything(session, store, study, participant)
            trials = [trial.id for trial in factories.make_robots(session, store, study, participant)]
            meant = [each.id for each in head_to_heads.of_participant(session, participant.id)]
        browser = new_browser()
        browser.get(f"/p/{token}")
        there = SideBySide(browser, participant, trials, meant, database)
        for trial in trials if rated else []:
            there.look()
            assert there.rate(trial).status_code == 200
        return there

    return start


@pytest.fixture
def side_by_side(begin: Begin) -> SideBySide:
    return begin()


# --- how they are drawn ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("methods", [2, 3, 4, 5])
def test_every_two_robots_meet_equally_often_in_different_scenarios_and_take_turns_on_the_left(methods: int) -> None:
    settings = EvaluationSettings(methods=METHODS[:methods], trials=4, head_to_heads=3)
    for seed in range(20):
        meant = evaluation_plan.meetings(seed, settings)
        assert len(meant) == settings.head_to_head_count
        left = Counter(each.left for each in meant)
        assert max(left[letter] for letter in LETTERS[:methods]) - min(left[letter] for letter in left) <= 1
        for one, other in combinations(LETTERS[:methods], 2):
            theirs = [each for each in meant if {each.left, each.right} == {one, other}]
            assert len({each.repetition for each in theirs}) == len(theirs) == 3
            assert sorted(Counter(each.left for each in theirs).values()) == [1, 2]


def test_sides_and_order_differ_between_people_and_are_the_same_when_drawn_again() -> None:
    settings = EvaluationSettings(methods=METHODS[:3], trials=2, head_to_heads=2)
    drawn = [tuple(evaluation_plan.meetings(seed, settings)) for seed in range(40)]
    assert drawn == [tuple(evaluation_plan.meetings(seed, settings)) for seed in range(40)]
    assert len(set(drawn)) > 20
    first = Counter(frozenset(each[0][:2]) for each in drawn)
    assert len(first) == 3
    assert {each[0].left for each in drawn} == {"A", "B", "C"}


def test_both_robots_are_shown_in_the_same_scenario(begin: Begin) -> None:
    there = begin(trials=2, head_to_heads=2)
    with there.database.reading() as session:
        for each in head_to_heads.of_participant(session, there.participant.id):
            assert each.left_trial.scenario == each.right_trial.scenario
            assert each.left_trial.letter != each.right_trial.letter


# --- answering -------------------------------------------------------------------------------------------------------


def test_they_come_when_all_is_rated_and_the_evaluation_ends_with_the_last(side_by_side: SideBySide) -> None:
    page = side_by_side.look()
    assert 'data-page="head-to-head"' in page
    assert "without their letters" in page
    assert "Robot A" not in page
    paths = [side_by_side.answer_next().json()["next_path"] for _ in side_by_side.meant]
    assert paths == ["/p/head-to-heads", "/p/head-to-heads", "/p/evaluation/done"]
    assert "3 comparisons" in side_by_side.browser.get("/p/evaluation/done").text
    assert side_by_side.browser.get("/p/next").headers["location"] != "/p/evaluation"


def test_before_the_ratings_there_is_nothing_to_compare(begin: Begin) -> None:
    there = begin(rated=False)
    assert there.browser.get("/p/head-to-heads").headers["location"] == "/p/evaluation"
    assert there.answer(0).status_code == 409
    assert there.stored() == []


def test_no_page_names_a_method_or_a_letter(side_by_side: SideBySide) -> None:
    for _ in side_by_side.meant:
        page = side_by_side.look()
        words = page.replace("PbARL Studio", "").lower()
        assert [method for method in EvaluatedMethod if re.search(rf"\b{method}\b", words)] == []
        assert not re.search(r"\b(Robot|letter) [A-E]\b", page)
        side_by_side.answer_next()


def test_an_answer_sent_twice_counts_once(side_by_side: SideBySide) -> None:
    side_by_side.look()
    uuid = uuid4()
    assert [side_by_side.answer(0, "right", uuid).status_code for _ in range(3)] == [200, 200, 200]
    assert side_by_side.stored() == [(1, "right", None)]
    assert side_by_side.answer(0, "left", uuid).status_code == 409
    assert side_by_side.answer(1, "right", uuid).status_code == 409


def test_an_old_page_sent_again_changes_nothing(side_by_side: SideBySide) -> None:
    side_by_side.look()
    side_by_side.answer(0, "left")
    assert side_by_side.answer(0, "right").status_code == 409
    assert side_by_side.stored() == [(1, "left", None)]


def test_the_last_answer_can_be_changed_and_the_first_one_is_kept(side_by_side: SideBySide) -> None:
    side_by_side.look()
    side_by_side.answer(0, "left")
    page = side_by_side.browser.get(f"/p/head-to-heads/{side_by_side.meant[0]}").text
    assert "which was: Left" in page
    assert "corrects=1" in page
    side_by_side.answer(0, "equal", corrects=1)
    assert side_by_side.stored() == [(1, "left", None), (2, "equal", None)]
    side_by_side.answer_next("right")
    assert side_by_side.answer(0, "left", corrects=2).status_code == 409
    assert side_by_side.browser.get(f"/p/head-to-heads/{side_by_side.meant[0]}").status_code == 409


def test_the_last_rating_can_be_changed_until_the_first_head_to_head_is_answered(side_by_side: SideBySide) -> None:
    last = side_by_side.trials[-1]
    assert f"/p/evaluation/trials/{last}" in side_by_side.look()
    assert side_by_side.rate(last, satisfaction=1, corrects=1).status_code == 200
    side_by_side.answer_next()
    assert side_by_side.rate(last, satisfaction=5, corrects=2).status_code == 409


def test_what_was_not_shown_or_is_not_theirs_cannot_be_answered(side_by_side: SideBySide, begin: Begin) -> None:
    side_by_side.look()
    assert side_by_side.answer(1).status_code == 409
    other = begin()
    other.look()
    assert other.browser.post(
        f"/p/head-to-heads/{side_by_side.meant[0]}/answer",
        data={"response": "left", "client_uuid": str(uuid4())},
        headers=JSON,
    ).status_code in (404, 409)
    assert side_by_side.stored() == []
    assert side_by_side.answer(0, "skip").status_code == 422


def test_equal_is_an_answer_only_where_the_study_allows_it(begin: Begin) -> None:
    there = begin(head_to_head_ties=False)
    assert 'value="equal"' not in there.look()
    assert there.answer(0, "equal").status_code == 422
    assert there.answer(0, "left").status_code == 200


def test_without_script_the_form_leads_to_the_next_two(side_by_side: SideBySide) -> None:
    action, uuid = re.findall(
        r'<noscript>.*?action="([^"]*)".*?name="client_uuid" value="([^"]*)"', side_by_side.look(), re.DOTALL
    )[-1]
    answer = side_by_side.browser.post(action, data={"response": "left", "client_uuid": uuid})
    assert (answer.status_code, answer.headers["location"]) == (303, "/p/head-to-heads")


def test_two_films_that_were_lost_are_waited_for(side_by_side: SideBySide, store: ArtefactStore) -> None:
    with side_by_side.database.reading() as session:
        film = head_to_heads.of_participant(session, side_by_side.participant.id)[0].left_trial.film
        assert film is not None
    (store.root / film.video_sha256[:2] / film.video_sha256).unlink()
    side_by_side.browser.get(f"/media/{film.video_sha256}.mp4")
    assert "being prepared" in side_by_side.look()


# --- reasons ---------------------------------------------------------------------------------------------------------


def test_nobody_is_asked_for_reasons_and_none_is_kept_unless_the_study_wants_them(begin: Begin) -> None:
    there = begin(rated=False)
    assert "<textarea" not in there.look()
    there.rate(there.trials[0], reason="never asked")
    with there.database.reading() as session:
        assert session.scalars(select(Rating.reason)).all() == [None]


def test_a_reason_is_kept_as_it_was_written_and_shown_as_text(begin: Begin) -> None:
    there = begin(rated=False, ask_reasons=True)
    kept = HOSTILE.replace("\r\n", "\n")
    for trial in there.trials:
        assert "Why? In your own words" in there.look()
        assert there.rate(trial, reason=HOSTILE).status_code == 200
    assert "<script>alert" not in there.browser.get(f"/p/evaluation/trials/{there.trials[-1]}").text
    there.look()
    there.answer(0, "left", reason=HOSTILE)
    assert there.stored() == [(1, "left", kept)]
    page = there.browser.get(f"/p/head-to-heads/{there.meant[0]}").text
    assert "<script>alert" not in page
    assert "&lt;script&gt;alert" in page
    there.answer_next("left", reason="  ")
    assert there.stored(1) == [(1, "left", None)]
    with there.database.reading() as session:
        assert set(session.scalars(select(Rating.reason))) == {kept}


def test_a_reason_has_a_longest_length(begin: Begin) -> None:
    there = begin(ask_reasons=True)
    assert f'maxlength="{LONGEST_REASON}"' in there.look()
    assert there.answer(0, reason="x" * (LONGEST_REASON + 1)).status_code == 422
    assert there.answer(0, reason="\r\n".join("x" * (LONGEST_REASON // 2))).status_code == 200
    assert len(there.stored()[0][2] or "") < LONGEST_REASON


# --- settings --------------------------------------------------------------------------------------------------------


def test_there_are_no_more_head_to_heads_than_trials_and_none_of_robots_in_the_room() -> None:
    assert EvaluationSettings().head_to_head_count == 0
    with pytest.raises(ValidationError, match="3 at most"):
        EvaluationSettings(trials=3, head_to_heads=4)
    with pytest.raises(ValidationError, match="on video only"):
        EvaluationSettings(mode=EvaluationMode.PHYSICAL, head_to_heads=1)


def test_a_study_without_head_to_heads_draws_none(begin: Begin) -> None:
    there = begin(head_to_heads=0)
    with there.database.reading() as session:
        assert session.scalars(select(HeadToHead)).all() == []
    assert there.browser.get("/p/evaluation/done").status_code == 200


def test_whoever_unblinds_is_told_which_of_their_answers_are_still_missing(
    begin: Begin, experimenter: TestClient
) -> None:
    there = begin(trials=2)
    there.answer_next()
    with there.database.reading() as session:
        slug = session.get_one(Study, there.participant.study_id).slug
    page = experimenter.get(f"/studies/{slug}/unblind").text
    assert "<strong>6 of 6</strong> trials rated" in page
    assert "<strong>1 of 3</strong> head-to-heads answered" in page
    assert "can influence the answers that are missing" in page
    experimenter.post(f"/studies/{slug}/unblind", data={"typed": slug})
    with there.database.reading() as session:
        told = session.scalars(select(AuditEvent.subject).where(AuditEvent.action == "study unblinded")).one()
    assert told == f"{slug} (6 of 6 trials rated, 1 of 3 head-to-heads answered)"
