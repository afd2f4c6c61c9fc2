"""Whose filter somebody is shown as not their own: balanced, drawn from the secret, logged, and given back."""

from collections import Counter

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database, now
from app.domain.evaluation import Controller, DonorDraw, DonorRule, Film, Trial
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.protocol import EvaluatedMethod, EvaluationSettings
from app.domain.studies import PREVIEW_NUMBERS, Participant, Study
from app.services.evaluation import donors, evaluation_plan
from app.services.exports import export_tables
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories

SOMEBODY_ELSE, AVERAGE = EvaluatedMethod.SOMEBODY_ELSE, EvaluatedMethod.AVERAGE
TYPES = ("neutral", "cautious", "impatient")
METHODS = (EvaluatedMethod.PBARL, SOMEBODY_ELSE, AVERAGE)


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, evaluation=EvaluationSettings(methods=METHODS, trials=1))


def arrive(session: Session, study: Study, *, labels: int = 10, **columns: object) -> Participant:
    """Somebody with a filter of so many labels."""
    person, _ = factories.make_participant(session, study)
    for name, value in columns.items():
        setattr(person, name, value)
    factories.make_model(session, study, person, ModelKind.FILTER, {}, labels)
    return person


def draw(session: Session, study: Study, person: Participant, method: EvaluatedMethod = SOMEBODY_ELSE) -> DonorDraw:
    return donors.draw(session, study, person, method, TYPES)


def test_nobody_is_lent_far_more_often_than_others_nor_always_to_the_next(database: Database, study: Study) -> None:
    with database.writing() as session:
        people = [arrive(session, study)]
        for _ in range(40):
            person = arrive(session, study)
            drawn = draw(session, study, person)
            assert drawn.rule == DonorRule.BY_LOT
            assert drawn.donors.candidates == tuple(each.number for each in people)
            assert drawn.donors.people[0] in drawn.donors.candidates, "and so never their own"
            people.append(person)
        lent = [each.donors.people[0] for each in session.scalars(select(DonorDraw).order_by(DonorDraw.id))]
    counts = Counter(lent)
    assert max(counts.values()) <= 3
    assert sum(number == next_one - 1 for number, next_one in zip(lent, range(2, 42), strict=True)) < 30


def test_the_same_secret_draws_the_same_and_drawing_again_changes_nothing(database: Database, study: Study) -> None:
    def sequence(secret: str) -> list[int]:
        with database.writing() as session:
            again = factories.make_study(session, "Again", evaluation=study.settings.evaluation)
            again.key_secret = secret
            people = [arrive(session, again) for _ in range(8)]
            drawn = [draw(session, again, person).donors.people[0] for person in people]
            assert [draw(session, again, person).donors.people[0] for person in people] == drawn
            return drawn

    assert sequence("1") == sequence("1")
    assert len({tuple(sequence(str(secret))) for secret in range(4)}) == 4


def test_only_who_is_like_them_finished_and_there_can_be_drawn(
    database: Database, store: ArtefactStore, study: Study
) -> None:
    with database.writing() as session:
        arrive(session, study, labels=9)
        arrive(session, study, scripted_as="cautious")
        arrive(session, study, is_preview=True, number=PREVIEW_NUMBERS)
        gone, finished, own = (arrive(session, study) for _ in range(3))
        program = arrive(session, study, scripted_as="impatient")
        preview = arrive(session, study, is_preview=True, number=PREVIEW_NUMBERS + 1)
        arrive(session, factories.make_study(session, "Another"))
        withdrawal.withdraw(session, store, gone, gone.code)
        assert donors.candidates(session, study, own) == [finished.number]
        assert donors.candidates(session, study, program) == [2]
        assert draw(session, study, preview).rule == DonorRule.TYPE_OF_USER


def test_while_there_is_nobody_types_of_users_are_lent_in_turn(database: Database, study: Study) -> None:
    with database.writing() as session:
        people = [factories.make_participant(session, study)[0] for _ in range(12)]
        drawn = [draw(session, study, person) for person in people]
        averages = draw(session, study, people[0], AVERAGE)
    counts = Counter(each.donors.types for each in drawn)
    assert {each.rule for each in drawn} == {DonorRule.TYPE_OF_USER}
    assert len(counts) == 3
    assert max(counts.values()) - min(counts.values()) <= donors.SLACK + 1
    assert (averages.rule, averages.donors.types) == (DonorRule.MEAN_OF_TYPES, TYPES)


def test_types_of_users_only_stand_in_until_enough_people_have_finished(
    database: Database, store: ArtefactStore, study: Study
) -> None:
    with database.writing() as session:
        person, _ = factories.make_participant(session, study)
        stood_in = [draw(session, study, person, method) for method in (SOMEBODY_ELSE, AVERAGE)]
        factories.make_film(session, store, person, SOMEBODY_ELSE)
        assert [each.rule for each in stood_in] == [DonorRule.TYPE_OF_USER, DonorRule.MEAN_OF_TYPES]
        first = arrive(session, study)
        drawn = draw(session, study, person)
        assert (drawn.rule, drawn.donors.people) == (DonorRule.BY_LOT, (first.number,))
        assert session.scalars(select(Film)).all() == [], "what was filmed was another robot"
        assert draw(session, study, person, AVERAGE) is stood_in[1]
        for _ in range(2):
            arrive(session, study)
        assert draw(session, study, person, AVERAGE).rule == DonorRule.MEAN_OF_PEOPLE
        assert draw(session, study, person) is drawn, "people stay drawn, whoever comes after them"


def test_one_finished_person_is_not_lent_to_everybody_who_waits(database: Database, study: Study) -> None:
    with database.writing() as session:
        waiting = [factories.make_participant(session, study)[0] for _ in range(8)]
        strangers = []
        for _ in range(4):
            drawn = [draw(session, study, person) for person in waiting]
            strangers.append(sum(each.rule == DonorRule.BY_LOT for each in drawn))
            lent = Counter(each.donors.people for each in drawn if each.donors.people)
            assert max(lent.values(), default=0) <= 3
            arrive(session, study)
    assert strangers[:2] == [0, 2], "the others still meet a type of user"
    assert 4 <= strangers[2] < strangers[3]


def test_an_average_is_of_three_others_at_least(database: Database, study: Study) -> None:
    with database.writing() as session:
        people = [arrive(session, study) for _ in range(4)]
        few = draw(session, study, people[0], AVERAGE)
        assert (few.rule, few.donors.people) == (DonorRule.MEAN_OF_PEOPLE, (2, 3, 4))
        people[3].withdrawn_at = now()
        assert draw(session, study, people[1], AVERAGE).rule == DonorRule.MEAN_OF_TYPES


class TestADonorWithdraws:
    """Whoever is looking at the robot goes on; for everybody else it is gone."""

    @pytest.fixture
    def lent(self, database: Database, store: ArtefactStore, study: Study) -> tuple[Participant, Participant]:
        """A donor, and somebody for whom everything has been made of that donor's filter."""
        with database.writing() as session:
            donor, borrower = arrive(session, study), arrive(session, study)
            draw(session, study, borrower)
            evaluation_plan.draw(session, study, borrower)
            model = factories.make_model(session, study, borrower, ModelKind.METHOD, {"method": SOMEBODY_ELSE.value})
            model.artefact_sha256 = store.put(b"the donor's filter as a controller")
            keys = {
                RunKind.METHOD: f"method/participant-{borrower.id}/somebody_else/labels-10/answer-1",
                RunKind.FILMS: f"films/participant-{borrower.id}/trials/labels-10/answer-1",
            }
            session.get_one(Run, model.run_id).workflow_id = keys[RunKind.METHOD]
            factories.make_run(session, study, borrower, kind=RunKind.FILMS, workflow_id=keys[RunKind.FILMS])
            methods = {each.letter: each.method for each in evaluation_plan.assignments_of(session, borrower.id)}
            for trial in evaluation_plan.trials_of(session, borrower.id):
                of_loan = methods[trial.letter] == SOMEBODY_ELSE
                made_of = model if of_loan else None
                film = factories.make_film(session, store, borrower, methods[trial.letter], made_of, trial.scenario)
                trial.film_id = film.id
            factories.make_controller(session, store, borrower, SOMEBODY_ELSE)
        return donor, borrower

    def withdraw(self, database: Database, store: ArtefactStore, donor: Participant) -> None:
        with database.writing() as session:
            withdrawal.withdraw(session, store, session.get_one(Participant, donor.id), donor.code)

    def files(self, database: Database) -> set[str]:
        with database.reading() as session:
            films = session.scalars(select(Film).where(Film.method == SOMEBODY_ELSE)).all()
            controllers = session.scalars(select(Controller).where(Controller.method == SOMEBODY_ELSE)).all()
            models = session.scalars(select(Model).where(Model.kind == ModelKind.METHOD)).all()
        return (
            {film.video_sha256 for film in films}
            | {each.artefact_sha256 for each in controllers}
            | {each.artefact_sha256 for each in models}
        )

    def test_what_nobody_has_begun_to_look_at_is_erased_and_due_again(
        self, database: Database, store: ArtefactStore, lent: tuple[Participant, Participant]
    ) -> None:
        donor, borrower = lent
        files = self.files(database)
        assert len(files) == 3
        self.withdraw(database, store, donor)
        assert not any(store.has(sha256) for sha256 in files)
        assert self.files(database) == set()
        with database.reading() as session:
            runs = session.scalars(select(Run).where(Run.workflow_id.contains("/labels-10/")))
            assert {(run.status, run.attempt) for run in runs} == {(RunStatus.RETRY, 2)}
            trials = evaluation_plan.trials_of(session, borrower.id)
            assert sorted(trial.film is None for trial in trials) == [False, False, True]
            assert donors.find(session, borrower.id, SOMEBODY_ELSE) is None
        with database.writing() as session:
            study = session.get_one(Study, borrower.study_id)
            again = draw(session, study, session.get_one(Participant, borrower.id))
            assert again.rule == DonorRule.TYPE_OF_USER

    def test_who_has_begun_goes_on_and_nothing_says_whose_it_was(
        self, database: Database, store: ArtefactStore, lent: tuple[Participant, Participant]
    ) -> None:
        donor, borrower = lent
        with database.writing() as session:
            first = session.scalars(select(Trial).where(Trial.participant_id == borrower.id)).first()
            assert first is not None
            first.shown_at = now()
        files = self.files(database)
        self.withdraw(database, store, donor)
        assert self.files(database) == files
        assert all(store.has(sha256) for sha256 in files)
        with database.reading() as session:
            drawn = donors.find(session, borrower.id, SOMEBODY_ELSE)
            assert drawn is not None
            assert (drawn.rule, donors.numbers_in([drawn])) == (DonorRule.WITHDREW, set())

    def test_the_table_of_donors_has_rows_after_unblinding_and_names_nobody_who_left(
        self, database: Database, store: ArtefactStore, lent: tuple[Participant, Participant]
    ) -> None:
        donor, borrower = lent
        with database.writing() as session:
            third = arrive(session, session.get_one(Study, donor.study_id))
            draw(session, session.get_one(Study, donor.study_id), third)

        def rows() -> list[tuple[object, ...]]:
            with database.reading() as session:
                study = session.get_one(Study, donor.study_id)
                return [tuple(row) for row in export_tables.BY_NAME["donors"].rows(session, study)]

        assert rows() == []
        with database.writing() as session:
            session.get_one(Study, donor.study_id).unblinded_at = now()
        assert [row[0] for row in rows()] == [borrower.code, third.code]
        assert rows()[1][5] == f"{donor.code} {borrower.code}"
        self.withdraw(database, store, donor)
        assert not any(donor.code in str(cell).split() for row in rows() for cell in row)
