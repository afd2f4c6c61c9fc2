"""Rating robots: each rating is stored exactly once, of what was shown, and nothing is lost or overwritten."""

import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from threading import Barrier
from typing import Any
from uuid import UUID, uuid4

import httpx2
import pytest
from fastapi.testclient import TestClient
from httpx2 import Response as Answer
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.evaluation import Rating, Trial
from app.domain.models import ModelKind, RunKind, RunStatus
from app.domain.protocol import EvaluatedMethod, EvaluationMode, EvaluationSettings
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import JSON
from tests.made_once import made_once
from tests.waiting import PATIENCE_S

METHODS = (EvaluatedMethod.REFERENCE, EvaluatedMethod.PREFFT, EvaluatedMethod.PBARL)


@dataclass
class AtTheRobots:
    """A participant who has answered every pair."""

    browser: TestClient
    participant: Participant
    token: str
    study: Study
    trials: Sequence[Trial]
    database: Database

    def look(self) -> str:
        """The page of the evaluation."""
        page: str = self.browser.get("/p/evaluation").text
        return page

    def rate(self, trial: Trial, satisfaction: int = 4, uuid: UUID | None = None, **fields: Any) -> Answer:
        """Send a rating as the page's script does."""
        usual = {"satisfaction": satisfaction, "personalisation": 2, "client_uuid": str(uuid or uuid4())}
        return self.browser.post(f"/p/evaluation/trials/{trial.id}/rating", data={**usual, **fields}, headers=JSON)

    def ratings(self, trial: Trial) -> list[tuple[int, int, int]]:
        """Revision and values of everything stored about a trial."""
        with self.database.reading() as session:
            rows = session.scalars(select(Rating).where(Rating.trial_id == trial.id).order_by(Rating.revision))
            return [(row.revision, row.satisfaction, row.personalisation) for row in rows]


@pytest.fixture
def begin(
    database: Database, store: ArtefactStore, new_browser: Callable[[], TestClient]
) -> Callable[..., AtTheRobots]:
    """Puts somebody before the evaluation; ``robots`` says whether films or controllers are there."""

    def start(*, robots: bool = True, **settings: Any) -> AtTheRobots:
        with database.writing() as session:
            made, token = made_once(_before_the_robots, session, store, robots, **settings)
            participant = session.get_one(Participant, made)
            study = session.get_one(Study, participant.study_id)
            trials = evaluation_plan.trials_of(session, participant.id)
        browser = new_browser()
        browser.get(f"/p/{token}")
        return AtTheRobots(browser, participant, token, study, trials, database)

    return start


def _before_the_robots(session: Session, store: ArtefactStore, /, robots: bool, **settings: Any) -> tuple[int, str]:
    study = factories.make_study(session, evaluation=EvaluationSettings(methods=METHODS, **settings))
    participant, token = factories.make_participant(session, study)
    factories.answer_everything(session, store, study, participant)
    if robots:
        factories.make_robots(session, store, study, participant)
    return participant.id, token


@pytest.fixture
def rating(begin: Callable[..., AtTheRobots]) -> AtTheRobots:
    return begin()


def test_after_the_last_pair_the_evaluation_is_next(rating: AtTheRobots) -> None:
    assert rating.browser.get("/p/next").headers["location"] == "/p/evaluation"
    page = rating.look()
    assert "Robot A" in page
    assert "Round 1 of 3 with this robot" in page
    assert f'action="/p/evaluation/trials/{rating.trials[0].id}/rating"' in page


def test_no_page_of_the_participant_names_a_method(rating: AtTheRobots) -> None:
    seen = []
    for trial in rating.trials:
        seen.append(rating.look())
        rating.rate(trial)
    seen.append(rating.browser.get("/p/evaluation/done").text)
    for page in seen:
        words = page.replace("PbARL Studio", "").lower()
        assert [method for method in EvaluatedMethod if re.search(rf"\b{method}\b", words)] == []


def test_a_rating_is_stored_and_leads_to_the_next_robot(rating: AtTheRobots) -> None:
    rating.look()
    answer = rating.rate(rating.trials[0], 5, personalisation=1, response_time_ms=8123)
    assert (answer.status_code, answer.json()["next_path"]) == (200, "/p/evaluation")
    assert rating.ratings(rating.trials[0]) == [(1, 5, 1)]
    assert "Round 2 of 3" in rating.look()
    with rating.database.reading() as session:
        assert session.scalars(select(Rating)).one().response_time_ms == 8123


def test_without_script_the_form_leads_to_the_next_robot(rating: AtTheRobots) -> None:
    form = dict(re.findall(r'name="(client_uuid|corrects)" value="([^"]*)"', rating.look()))
    path = f"/p/evaluation/trials/{rating.trials[0].id}/rating"
    answer = rating.browser.post(path, data={**form, "satisfaction": "3", "personalisation": "3"})
    assert (answer.status_code, answer.headers["location"]) == (303, "/p/evaluation")
    rating.look()
    rating.rate(rating.trials[1])
    with rating.database.reading() as session:
        marks = session.scalars(select(Rating.by_script).order_by(Rating.id)).all()
    assert marks == [False, True]


def test_a_retry_after_a_lost_response_counts_once(rating: AtTheRobots) -> None:
    rating.look()
    uuid = uuid4()
    first, again = (rating.rate(rating.trials[0], 4, uuid) for _ in range(2))
    assert (again.status_code, again.json()) == (200, first.json())
    assert rating.ratings(rating.trials[0]) == [(1, 4, 2)]


def test_an_old_page_with_other_values_is_refused_in_words_and_nothing_is_overwritten(rating: AtTheRobots) -> None:
    rating.look()
    uuid = uuid4()
    rating.rate(rating.trials[0], 4, uuid)
    for answer in (rating.rate(rating.trials[0], 1, uuid), rating.rate(rating.trials[0], 1)):
        assert answer.status_code == 409
        assert "have already rated this robot" in answer.json()["detail"]
    assert rating.ratings(rating.trials[0]) == [(1, 4, 2)]


def test_the_last_rating_can_be_changed_and_both_are_kept(rating: AtTheRobots) -> None:
    rating.look()
    rating.rate(rating.trials[0], 4)
    page = rating.look()
    path = f"/p/evaluation/trials/{rating.trials[0].id}"
    assert path in page
    assert "You are changing your last rating" in rating.browser.get(path).text
    assert rating.rate(rating.trials[0], 2, corrects=1).status_code == 200
    assert rating.ratings(rating.trials[0]) == [(1, 4, 2), (2, 2, 2)]


def test_an_earlier_rating_can_no_longer_be_changed(rating: AtTheRobots) -> None:
    for trial in rating.trials[:2]:
        rating.look()
        rating.rate(trial)
    assert rating.browser.get(f"/p/evaluation/trials/{rating.trials[0].id}").status_code == 409
    assert rating.rate(rating.trials[0], 1, corrects=1).status_code == 409
    assert rating.ratings(rating.trials[0]) == [(1, 4, 2)]


def test_only_what_was_shown_can_be_rated(rating: AtTheRobots) -> None:
    rating.look()
    assert rating.rate(rating.trials[4]).status_code == 409
    assert rating.ratings(rating.trials[4]) == []


def test_another_participants_robot_does_not_exist(
    rating: AtTheRobots, database: Database, store: ArtefactStore
) -> None:
    with database.writing() as session:
        other, _ = factories.make_participant(session, rating.study)
        theirs = factories.make_robots(session, store, rating.study, other)
        theirs[0].shown_at = now()
    assert rating.rate(theirs[0]).status_code == 404
    film = theirs[0].film
    assert film is not None
    assert rating.browser.get(f"/media/{film.video_sha256}.mp4").status_code == 404
    own = rating.trials[0].film
    assert own is not None
    assert rating.browser.get(f"/media/{own.video_sha256}.mp4").status_code == 200


@pytest.mark.parametrize("wrong", [{"satisfaction": 0}, {"personalisation": 6}, {"client_uuid": "x"}])
def test_values_beyond_the_scale_are_refused(rating: AtTheRobots, wrong: dict[str, Any]) -> None:
    rating.look()
    form = {"satisfaction": 4, "personalisation": 2, "client_uuid": str(uuid4()), **wrong}
    path = f"/p/evaluation/trials/{rating.trials[0].id}/rating"
    assert rating.browser.post(path, data=form, headers=JSON).status_code == 422
    assert rating.ratings(rating.trials[0]) == []


def test_after_the_last_rating_the_person_may_change_it_or_go_on(rating: AtTheRobots) -> None:
    for trial in rating.trials:
        rating.look()
        answer = rating.rate(trial)
    assert answer.json()["next_path"] == "/p/evaluation/done"
    page = rating.browser.get("/p/evaluation/done").text
    assert "Your 9 ratings are safely stored" in page
    assert f"/p/evaluation/trials/{rating.trials[-1].id}" in page
    assert rating.rate(rating.trials[-1], 1, corrects=1).json()["next_path"] == "/p/evaluation/done"
    assert rating.browser.get("/p/next").headers["location"] == "/p/finished"
    assert rating.browser.get("/p/evaluation").headers["location"] == "/p/next"


def test_nobody_comes_to_the_robots_before_the_last_pair(
    rating: AtTheRobots, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    with database.writing() as session:
        _, token = factories.make_participant(session, rating.study)
    early = new_browser()
    early.get(f"/p/{token}")
    for path in ("/p/evaluation", "/p/evaluation/done", f"/p/evaluation/trials/{rating.trials[0].id}"):
        assert early.get(path).headers["location"] == "/p/next"


def test_closing_the_browser_and_coming_back_goes_on_where_it_was(
    rating: AtTheRobots, new_browser: Callable[[], TestClient]
) -> None:
    for trial in rating.trials[:4]:
        rating.look()
        rating.rate(trial)
    other_device = new_browser()
    other_device.get(f"/p/{rating.token}")
    page = other_device.get("/p/evaluation").text
    assert "Robot B" in page
    assert "4 of 9 rated" in page


@pytest.mark.parametrize("same", [True, False], ids=["one retried request", "twenty clicks"])
def test_twenty_racing_ratings_of_a_robot_leave_one(
    rating: AtTheRobots, address: str, experimenter_cookie: str, same: bool
) -> None:
    rating.look()
    barrier, uuid = Barrier(20), uuid4()
    cookies = dict(rating.browser.cookies)
    path = f"{address}/p/evaluation/trials/{rating.trials[0].id}/rating"

    def send(number: int) -> int:
        values = 3 if same else 1 + number % 5
        chosen = uuid if same else uuid4()
        form = {"satisfaction": values, "personalisation": values, "client_uuid": str(chosen)}
        with httpx2.Client(cookies=cookies, timeout=PATIENCE_S) as client:
            barrier.wait()
            return client.post(path, data=form, headers=JSON).status_code

    with ThreadPoolExecutor(20) as pool:
        codes = list(pool.map(send, range(20)))
    assert len(rating.ratings(rating.trials[0])) == 1
    assert sorted(set(codes)) == ([200] if same else [200, 409])
    assert codes.count(200) == (20 if same else 1)


# -- waiting ---------------------------------------------------------------------------------------------------------


def test_while_the_robots_are_made_the_page_says_how_far_they_are_and_that_it_may_be_closed(
    begin: Callable[..., AtTheRobots], database: Database
) -> None:
    waiting = begin(robots=False)
    page = waiting.look()
    assert "Learning from your answers" in page
    assert "You may close this page" in page
    with database.writing() as session:
        factories.make_model(session, waiting.study, waiting.participant, ModelKind.FILTER, {})
        factories.make_run(
            session,
            waiting.study,
            waiting.participant,
            kind=RunKind.METHOD,
            status=RunStatus.RUNNING,
            progress=0.5,
            workflow_id=f"method/participant-{waiting.participant.id}/prefft/labels-10/answer-10",
        )
    page = waiting.look()
    assert "Training the robots" in page
    assert "Robots trained: 2 of 3. Overall progress: 50\N{NO-BREAK SPACE}%." in page
    with database.writing() as session:
        factories.make_model(session, waiting.study, waiting.participant, ModelKind.METHOD, {"method": "prefft"})
    assert "Filming the robots" in waiting.look()


def test_when_something_failed_the_waiting_page_says_so(begin: Callable[..., AtTheRobots], database: Database) -> None:
    waiting = begin(robots=False)
    with database.writing() as session:
        factories.make_run(session, waiting.study, waiting.participant, kind=RunKind.METHOD, status=RunStatus.FAILED)
    assert "Something went wrong" in waiting.look()


def test_a_film_whose_file_is_lost_is_waited_for_when_it_is_its_turn(rating: AtTheRobots, store: ArtefactStore) -> None:
    last, first = rating.trials[5].film, rating.trials[0].film
    assert first is not None
    assert last is not None
    store.delete(last.video_sha256)
    assert "Robot A at work" in rating.look()
    store.delete(first.video_sha256)
    assert "Your robots are being prepared" in rating.look()


def test_the_pages_are_there_in_german(rating: AtTheRobots, database: Database) -> None:
    with database.writing() as session:
        session.get_one(Participant, rating.participant.id).language = "de"
    assert "Wie zufrieden sind Sie insgesamt mit diesem Roboter" in rating.look()


# -- a physical robot -------------------------------------------------------------------------------------------------


def test_a_physical_robot_is_rated_when_the_operator_says_that_it_is_done(
    begin: Callable[..., AtTheRobots], experimenter: TestClient
) -> None:
    at = begin(mode=EvaluationMode.PHYSICAL)
    desk = f"/studies/{at.study.slug}/participants/{at.participant.code}"
    assert "Robot A is next" in at.look()
    assert at.rate(at.trials[0]).status_code == 409
    experimenter.post(f"{desk}/trials/1/start")
    assert "Robot A is moving. Please watch." in at.look()
    assert at.rate(at.trials[0]).status_code == 409
    experimenter.post(f"{desk}/trials/1/done")
    assert "Please rate what the robot has just done" in at.look()
    assert at.rate(at.trials[0]).status_code == 200
    assert "Robot A is next" in at.look()
    assert "1 of 9 rated" in at.look()
