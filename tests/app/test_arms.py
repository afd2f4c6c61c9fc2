"""Studies between subjects: who comes into which arm, what they then meet, and who is sent back before the end."""

from collections import Counter
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.participation import Allocation
from app.domain.preferences import Purpose, Response
from app.domain.protocol import FormItem
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings
from app.services.evaluation import evaluation_plan
from app.services.participants import admission, arms, enrolment
from app.services.participants.arms import Load, choose
from app.services.studies import locking
from app.storage import ArtefactStore
from app.web.experimenter.study.study_form.study_form import FormInvalid, form_of, typed_study
from tests import factories
from tests.app.conftest import agree
from tests.benchmarks import arms as simulation

OWN, USUAL = {"name": "own", "methods": ["pbarl"]}, {"name": "usual", "methods": ["reference"]}
BETWEEN: dict[str, Any] = {"evaluation": {"methods": ["reference", "pbarl"]}, "arms": [OWN, USUAL]}
SCREENED: dict[str, Any] = {
    "demographics": [
        FormItem(name="age", kind="number"),
        FormItem(name="hand", kind="choice", choices=("left", "right")),
    ],
    "screening": [{"name": "age", "low": 18, "high": 75}, {"name": "hand", "answers": ["right"]}],
    "screen_out_code": "OUT",
    "attention_code": "LOOK",
    "completion_code": "DONE",
    "return_url": "https://panel.example/back?cc={code}",
}


def arrive(session: Session, study: Study, seen_ago: timedelta = timedelta(0)) -> Participant:
    """Somebody comes in and is allocated."""
    person, _ = factories.make_participant(session, study)
    arms.allocate(session, study, person)
    person.last_seen_at = now() - seen_ago
    session.flush()
    return person


class TestWhoComesIntoWhichArm:
    def test_the_arm_that_is_behind_is_next_and_a_lot_decides_where_arms_are_level(self) -> None:
        level = {name: Load(3, 1, True) for name in "abc"}
        assert Counter(choose(level, lot) for lot in np.arange(0.0, 1.0, 1 / 300)) == {"a": 100, "b": 100, "c": 100}
        assert {choose(level | {"b": Load(3, 0, True)}, lot) for lot in (0.0, 0.5, 0.999)} == {"b"}
        assert {choose(level | {"b": Load(0, 0, False)}, lot) for lot in (0.0, 0.999)} == {"a", "c"}
        assert choose({"a": Load(3, 1, False)}, 0.5) is None

    def test_whoever_has_been_silent_for_ten_minutes_decides_between_level_arms_only(self, database: Database) -> None:
        assert choose({"a": Load(3, 9, True, silent=7), "b": Load(3, 3, True)}, 0.999) == "a"
        assert choose({"a": Load(3, 9, True, silent=7), "b": Load(3, 3, True, silent=1)}, 0.0) == "b"
        assert choose({"a": Load(3, 9, True, silent=7), "b": Load(3, 2, True)}, 0.0) == "b"
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN)
            arm = arrive(session, study, seen_ago=timedelta(minutes=11)).arm or ""
            there = arms.loads(session, study, now())[arm]
            assert (there.on_their_way, there.silent) == (1, 1)
            assert arrive(session, study, seen_ago=timedelta(minutes=9)).arm != arm
            assert arrive(session, study).arm == arm, "who is behind without whoever is silent"

    def test_fifty_at_once_leave_arms_level_within_a_few_although_half_drop_out(self) -> None:
        assert simulation.row(2, 50.0, 0.5, 3000, 2, 0)["apart_at_end"] <= 8

    @pytest.mark.parametrize("dropout", [0.1, 0.3, 0.6])
    def test_completed_arms_stay_within_two_with_dropouts(self, dropout: float) -> None:
        found = simulation.row(3, 0.0, dropout, 2000, 1, 0)
        assert found["most_apart"] <= 2
        with_quota = simulation.row(3, 10.0, dropout, 2000, 1, 50)
        assert with_quota["apart_at_end"] == 0

    def test_dropouts_are_replaced_and_previews_and_those_who_withdrew_are_nobody(self, database: Database) -> None:
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN)
            first = arrive(session, study, seen_ago=timedelta(hours=2))
            second = arrive(session, study)
            preview, _ = enrolment.add_preview(session, study, "Ada")
            arms.allocate(session, study, preview)
            preview.last_seen_at = now()
            arrive(session, study).withdrawn_at = now()
            session.flush()
            counts = {
                name: (load.completed, load.on_their_way) for name, load in arms.loads(session, study, now()).items()
            }
            assert counts[second.arm or ""] == (0, 1)
            if first.arm != second.arm:
                assert counts[first.arm or ""] == (0, 0)
            first.completed_at = now()
            session.flush()
            assert arms.loads(session, study, now())[first.arm or ""].completed == 1

    def test_quotas_and_stops_close_arms(self, database: Database, store: ArtefactStore) -> None:
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN, arm_quota=1)
            people = [arrive(session, study) for _ in range(3)]
            assert {people[0].arm, people[1].arm} == {"own", "usual"}
            assert people[2].arm is None
            settings = study.settings.model_copy(update={"arm_quota": 0, "stopped_arms": ("own",)})
            changed = locking.change(
                session, store, study, name=study.name, task=study.task, seed=None, settings=settings, actor="Ada"
            )
            assert changed == ["stopped_arms", "arm_quota"]
            assert {arrive(session, study).arm for _ in range(4)} == {"usual"}
            renamed = settings.arms[1].model_copy(update={"name": "x"})
            other = settings.model_copy(update={"arms": (settings.arms[0], renamed)})
            with pytest.raises(locking.SettingsFixed, match="allocated to an arm"):
                locking.change(
                    session, store, study, name=study.name, task=study.task, seed=None, settings=other, actor="Ada"
                )

    def test_the_lot_is_kept_with_the_counts_and_can_be_drawn_again(self, database: Database) -> None:
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN)
            for _ in range(6):
                person = arrive(session, study)
                row = session.scalars(select(Allocation).where(Allocation.participant_id == person.id)).one()
                assert row.lot == arms.lot_of(study, person.number)
                assert person.arm == choose({name: Load(**each) for name, each in row.considered.items()}, row.lot)
            assert arms.allocate(session, study, person)
            places = select(Participant.arm, Allocation.place).join(Allocation).order_by(Allocation.id)
            assert sorted(session.execute(places).all()) == [(name, n) for name in ("own", "usual") for n in (1, 2, 3)]


class TestWhatPeopleOfAnArmMeet:
    def test_only_its_methods(self, database: Database) -> None:
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN)
            for _ in range(4):
                person = arrive(session, study)
                evaluation_plan.draw(session, study, person)
                met = [(each.letter, each.method) for each in evaluation_plan.assignments_of(session, person.id)]
                assert met == [("A", "pbarl" if person.arm == "own" else "reference")]
                assert len(evaluation_plan.trials_of(session, person.id)) == 3

    def test_nothing_is_drawn_before_there_is_an_arm(self, database: Database) -> None:
        with database.writing() as session:
            study = factories.make_study(session, **BETWEEN)
            person, _ = factories.make_participant(session, study)
            evaluation_plan.draw(session, study, person)
            assert not evaluation_plan.assignments_of(session, person.id)


@pytest.fixture
def come(database: Database, new_browser: Callable[[], TestClient]) -> Callable[..., tuple[TestClient, Participant]]:
    """Somebody opens the link of a study with these settings, agrees and answers the questions at the start."""

    def make(answers: dict[str, str] | None = None, study: Study | None = None, **settings: Any) -> Any:
        with database.writing() as session:
            here = study or factories.make_study(session, **settings)
            person, token = factories.make_participant(session, session.get_one(Study, here.id), ready=False)
        browser = new_browser()
        browser.get(f"/p/{token}")
        agree(browser)
        if answers is not None:
            browser.post("/p/demographics", data=answers)
        return browser, person

    return make


def ended_as(database: Database, person: Participant) -> str | None:
    with database.reading() as session:
        return session.get_one(Participant, person.id).ended_as


class TestWhoIsSentBack:
    @pytest.mark.parametrize(
        ("answers", "stays"),
        [
            ({"age": "18", "hand": "right"}, True),
            ({"age": "", "hand": ""}, True),
            ({"age": "17,5", "hand": "right"}, False),
            ({"age": "40", "hand": "left"}, False),
        ],
    )
    def test_by_the_questions_at_the_start_with_a_code_of_their_own(
        self, come: Callable[..., Any], database: Database, answers: dict[str, str], stays: bool
    ) -> None:
        browser, person = come(answers, **SCREENED)
        page = browser.get("/p/next")
        assert ended_as(database, person) == (None if stays else "screened_out")
        if not stays:
            assert 'value="OUT"' in page.text
            assert "https://panel.example/back?cc=OUT" in page.text
            assert "DONE" not in page.text
            assert browser.get("/p/instructions").headers["location"] == "/p/next"
            assert browser.get("/p/finished").headers["location"] == "/p/next"
            assert browser.get("/p/withdraw").status_code == 200

    def test_and_the_experimenter_sees_why(
        self, come: Callable[..., Any], experimenter: TestClient, database: Database
    ) -> None:
        browser, person = come({"age": "17", "hand": "right"}, **SCREENED)
        browser.get("/p/next")
        with database.reading() as session:
            slug = session.get_one(Study, person.study_id).slug
        assert experimenter.get(f"/studies/{slug}").text.count("screened out") == 2, "in the list, and counted"

    def test_where_no_arm_is_open_after_the_questions_and_nobody_reads_the_name_of_an_arm(
        self, come: Callable[..., Any], database: Database
    ) -> None:
        names = [{**OWN, "name": "secret_one"}, {**USUAL, "name": "secret_two"}]
        between = {**BETWEEN, "arms": names}
        browser, person = come(**between)
        pages = [browser.get(path).text for path in ("/p/next", "/p/instructions", "/p/consent/copy", "/p/withdraw")]
        assert not any("secret_" in page for page in pages)
        with database.reading() as session:
            assert session.get_one(Participant, person.id).arm in ("secret_one", "secret_two")
        with database.writing() as session:
            study = session.get_one(Study, person.study_id)
            study.stored_settings = {**study.stored_settings, "stopped_arms": ["secret_one", "secret_two"]}
        late, latecomer = come(study=study)
        assert "As many people as are needed" in late.get("/p/next").text
        assert ended_as(database, latecomer) == "full"

    def test_who_misses_so_many_catch_pairs(
        self, come: Callable[..., Any], database: Database, store: ArtefactStore
    ) -> None:
        browser, person = come(
            {"age": "30", "hand": "right"}, **SCREENED, catch_pairs=3, end_after_misses=2, pool_scenarios=20
        )
        browser.post("/p/instructions")
        with database.writing() as session:
            here = session.get_one(Participant, person.id)
            caught = factories.make_queries(session, store, here, 3)
            for query in caught:
                query.purpose, query.expected = Purpose.CATCH, "left"
            factories.make_label(session, caught[0], Response.RIGHT)
            factories.make_label(session, caught[1], Response.SKIP)
        assert browser.get("/p/next").status_code == 200
        assert ended_as(database, person) is None
        sent = {"response": "right", "client_uuid": "00000000-0000-4000-8000-000000000001"}
        answer = browser.post(f"/p/queries/{caught[2].id}/label", data=sent, headers={"accept": "application/json"})
        assert answer.json()["state"] == "finished"
        assert ended_as(database, person) == "inattentive"
        page = browser.get("/p/next").text
        assert 'value="LOOK"' in page

    def test_an_answer_that_is_taken_back_is_no_miss(self, database: Database, store: ArtefactStore) -> None:
        with database.writing() as session:
            study = factories.make_study(session, catch_pairs=2)
            person, _ = factories.make_participant(session, study)
            (query,) = factories.make_queries(session, store, person, 1)
            query.purpose, query.expected = Purpose.CATCH, "left"
            factories.make_label(session, query, Response.RIGHT)
            assert admission.misses(session, person) == 1
            factories.make_label(session, query, Response.LEFT)
            assert admission.misses(session, person) == 0


class TestSettings:
    def test_what_was_typed_is_what_is_stored_and_back(self) -> None:
        settings = StudySettings.model_validate({**BETWEEN, **SCREENED, "stopped_arms": ["own"], "arm_quota": 12})
        form = form_of("Arms", "feeding", 1, settings)
        assert (form.arms, form.stopped_arms) == ("own | pbarl\nusual | reference", "own")
        assert form.screening == "age | 18 to 75\nhand | right"
        assert typed_study(form).settings == settings

    @pytest.mark.parametrize(
        ("typed", "field", "said"),
        [
            ({"arms": "own pbarl"}, "arms", "Line 1: write a name"),
            ({"arms": "own | pbarl\nusual | nothing"}, "arms", "Line 2: there is no method nothing"),
            ({"arms": "own | pbarl"}, "", "Name two arms at least"),
            ({"arms": "own | pbarl\nprefft | prefft"}, "", "unlike prefft, reference"),
            ({"arms": "own | pbarl\nusual | reference", "stopped_arms": "mine"}, "", "There is no arm mine"),
            ({"screening": "age | 75 to 18"}, "screening", "smallest number comes first"),
            ({"screening": "height | 1 to 2"}, "", "screened by a question at the start"),
            ({"end_after_misses": "2"}, "", "Nobody can miss 2 of 0 catch pairs"),
        ],
    )
    def test_what_cannot_be_meant_is_said_in_words(self, typed: dict[str, str], field: str, said: str) -> None:
        settings = StudySettings.model_validate({"evaluation": BETWEEN["evaluation"]})
        form = form_of("Arms", "feeding", 1, settings).model_copy(update=typed)
        with pytest.raises(FormInvalid) as found:
            typed_study(form)
        assert said in found.value.errors[field]
