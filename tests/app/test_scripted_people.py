"""Scripted people go through every page that a study can have, and what they say there is what is stored."""

import io
from dataclasses import dataclass
from typing import Any

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.designs import Ending
from app.domain.evaluation import HeadToHeadAnswer, Rating, Trial
from app.domain.hints import HintEvent
from app.domain.preferences import Purpose
from app.domain.protocol import MADE_FOR_YOU, EvaluatedMethod, EvaluationSettings, FormItem, Stage
from app.domain.self_setting import SelfSetting
from app.domain.studies import Participant, Study
from app.installed_tasks import hints
from app.services.answers import form_answers
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore
from tests import factories
from tests.worker.conftest import make_trajectory
from worker.ml.teachers import TASTES, Manner
from worker.rehearsal.browser import OVER, WAITING, FormBrowser
from worker.rehearsal.participant_steps import ScriptedPerson

STEPS, MOST_PAGES = 20, 120
OWN, REFERENCE, SET = EvaluatedMethod.PBARL, EvaluatedMethod.REFERENCE, EvaluatedMethod.SELF_SET
QUESTIONS = (
    FormItem(name="age", kind="number"),
    FormItem(name="hand", kind="choice", question="Which hand do you use?", choices=("left", "right")),
    FormItem(name="robot_experience", kind="likert"),
    FormItem(name="gender", kind="text"),
)


@dataclass
class Scene:
    """A studio whose clips and films show noise, and people who are sent through its pages."""

    address: str
    database: Database
    store: ArtefactStore

    def open(self, **settings: Any) -> Study:
        """A study with four clips and one slider."""
        with self.database.writing() as session:
            study = factories.make_study(session, languages=("en",), clip_steps=STEPS, **settings)
            for number in range(4):
                clip = factories.make_clip(session, self.store, study)
                session.get_one(Rollout, clip.rollout_id).trajectory_sha256 = self._noise(number)
            factories.make_previews(session, self.store, study, [{}])
            study.mode_axes = {"speed_far": [-0.5, 0.4]}
        return study

    def send(self, study: Study, **manner: float) -> tuple[int, ScriptedPerson]:
        """One person, to the end or to where they are sent back: their id, and who played them."""
        with self.database.writing() as session:
            participant, token = factories.make_participant(session, study, ready=False)
            self._ask(session, study, participant)
        person = ScriptedPerson(self.database, self.store, study, TASTES["cautious"], Manner(**manner), participant.id)
        with FormBrowser(self.address, f"/p/{token}") as visitor:
            for _ in range(MOST_PAGES):
                if visitor.page in WAITING:
                    self._show_robots(participant.id)
                if visitor.page not in OVER:
                    visitor.act(person)
            assert visitor.page in OVER
        return participant.id, person

    def _ask(self, session: Session, study: Study, participant: Participant) -> None:
        """Every pair there will be; catch pairs come first."""
        clips = session.scalars(select(Clip).order_by(Clip.id)).all()
        for number in range(study.settings.question_count):
            query = factories.make_query(session, participant, clips[number % 4], clips[(number + 1) % 4])
            if number < study.settings.catch_pairs:
                query.purpose, query.expected = Purpose.CATCH, "right"

    def _show_robots(self, participant_id: int) -> None:
        with self.database.writing() as session:
            participant = session.get_one(Participant, participant_id)
            study = session.get_one(Study, participant.study_id)
            for trial in factories.make_robots(session, self.store, study, participant, picture=0):
                assert trial.film is not None
                trial.film.trajectory_sha256 = self._noise(trial.film.id)

    def _noise(self, number: int) -> str:
        target = io.BytesIO()
        make_trajectory(number, 0, STEPS).save(target)
        return self.store.put(target.getvalue())


@pytest.fixture
def scene(address: str, database: Database, store: ArtefactStore) -> Scene:
    return Scene(address, database, store)


def test_hints_are_given_that_are_true(scene: Scene) -> None:
    study = scene.open(asks_for_hints=True, introduction_pairs=0)
    participant_id, _ = scene.send(study)
    with scene.database.reading() as session:
        [said] = session.scalars(select(HintEvent).where(HintEvent.participant_id == participant_id)).all()
    given = [hints.of_task(study.task)[name] for name in said.hints.split()]
    minded = {
        "distance_m",
        "speed_squared_m2_s2",
        *["force_away_n", "high_force_n", "spilled_on_person", "intake_speed_m_s"],
    }
    assert len(given) == hints.MOST
    assert all(minded & set(each.less) for each in given)


def test_what_is_called_equal_does_not_depend_on_how_few_clips_there_were_at_the_first_question(scene: Scene) -> None:
    with scene.database.writing() as session:
        study = factories.make_study(session, languages=("en",), clip_steps=STEPS)
        participant, _ = factories.make_participant(session, study)
    person = ScriptedPerson(scene.database, scene.store, study, TASTES["cautious"], Manner(mistakes=0.0), 0)

    def filmed(numbers: range) -> list[Clip]:
        with scene.database.writing() as session:
            clips = [factories.make_clip(session, scene.store, study) for _ in numbers]
            for number, clip in zip(numbers, clips, strict=True):
                session.get_one(Rollout, clip.rollout_id).trajectory_sha256 = scene._noise(number)
        return clips

    def said(pairs: list[tuple[Clip, Clip]]) -> list[str]:
        with scene.database.writing() as session:
            asked = [factories.make_query(session, participant, *pair) for pair in pairs]
        return [person.answer(query.id) for query in asked]

    clips = filmed(range(2))
    assert said([(clips[0], clips[1])])[0] in ("left", "right")
    clips += filmed(range(2, 60))
    answers = said(list(zip(clips[::2], clips[1::2], strict=True)))
    assert answers.count("equal") == 3, "a tenth"


def test_whatever_is_asked_is_answered_and_stored_as_it_was_meant(scene: Scene) -> None:
    evaluation = EvaluationSettings(
        methods=(REFERENCE, OWN),
        trials=1,
        head_to_heads=1,
        ask_which_is_theirs=True,
        ask_reasons=True,
        instruments=("tia",),
    )
    study = scene.open(
        demographics=QUESTIONS,
        screening=({"name": "age", "low": 18, "high": 80},),
        catch_pairs=1,
        end_after_misses=1,
        evaluation=evaluation,
        instruments=("tia", "nasa_tlx"),
        questionnaire=QUESTIONS[1:],
        debrief=True,
    )
    participant_id, person = scene.send(study, mistakes=0.0)
    with scene.database.reading() as session:
        assert session.get_one(Participant, participant_id).completed_at is not None
        said = {
            stage: form_answers.newest(session, session.get_one(Participant, participant_id), stage)
            for stage in (Stage.DEMOGRAPHICS, Stage.QUESTIONNAIRE)
        }
        letters = {each.method: each.letter for each in evaluation_plan.assignments_of(session, participant_id)}
        filled_in = form_answers.filled_in(session, participant_id)
        ratings = session.scalars(select(Rating).order_by(Rating.id)).all()
        compared = session.scalars(select(HeadToHeadAnswer)).all()
    assert all(value for form in said.values() for value in form.values())
    assert said[Stage.DEMOGRAPHICS].keys() == {item.name for item in QUESTIONS}
    assert [(each.satisfaction, each.personalisation) for each in ratings] == [
        (each.satisfaction, each.personalisation) for each in person.rated
    ]
    best = max(person.rated, key=lambda each: each.true_share)
    assert said[Stage.QUESTIONNAIRE][MADE_FOR_YOU] == letters[best.method]
    assert [each.response in ("left", "right") for each in compared] == [True]
    assert all(reason for reason in [*(each.reason for each in ratings), *(each.reason for each in compared)])
    described = [(each.instrument.name, each.letter) for each in filled_in]
    assert sorted(described, key=str) == sorted(
        [("tia", "A"), ("tia", "B"), ("tia", None), ("nasa_tlx", None)], key=str
    )
    assert all(None not in each.answers.values() for each in filled_in)


def test_people_of_an_arm_meet_its_methods_and_set_their_robot_where_it_is_one_of_them(scene: Scene) -> None:
    arms = ({"name": "own", "methods": (OWN,)}, {"name": "themselves", "methods": (SET, REFERENCE)})
    evaluation = EvaluationSettings(methods=(OWN, SET, REFERENCE), trials=1, head_to_heads=1)
    study = scene.open(evaluation=evaluation, arms=arms)
    people = [scene.send(study) for _ in arms]
    with scene.database.reading() as session:
        arms_of = {each.id: each.arm for each in session.scalars(select(Participant))}
        settings = session.scalars(select(SelfSetting)).all()
    assert sorted(map(str, arms_of.values())) == ["own", "themselves"]
    for participant_id, person in people:
        met = {"own": {"pbarl"}, "themselves": {"self_set", "reference"}}[arms_of[participant_id] or ""]
        assert {each.method for each in person.rated} == met
    assert [(arms_of[each.participant_id], list(each.mode)) for each in settings] == [("themselves", ["speed_far"])]


@pytest.mark.parametrize(
    ("design", "mistakes", "ending"),
    [
        ({"demographics": QUESTIONS, "screening": ({"name": "age", "low": 90, "high": 99},)}, 0.0, Ending.SCREENED_OUT),
        ({"catch_pairs": 1, "end_after_misses": 1}, 1.0, Ending.INATTENTIVE),
    ],
)
def test_who_does_not_fit_or_does_not_look_is_sent_back(
    scene: Scene, design: dict[str, Any], mistakes: float, ending: Ending
) -> None:
    participant_id, person = scene.send(
        scene.open(evaluation=EvaluationSettings(trials=1), **design), mistakes=mistakes
    )
    with scene.database.reading() as session:
        assert session.get_one(Participant, participant_id).ended_as == ending
        assert session.scalars(select(Trial)).all() == []
    assert person.rated == []
