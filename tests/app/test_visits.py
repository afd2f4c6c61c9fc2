"""Return visits: who has finished one study comes back for the one that goes on from it, by the link they have."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.people import Experimenter, Role, StudyMember, StudyRole
from app.domain.preferences import LabelEvent
from app.domain.studies import Participant, Study
from app.services.exports import export_formats, export_tables
from app.services.participants import recruitment_panel, visits
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import agree
from tests.app.study_pages import typed
from tests.app.test_join_study import press

BEGIN = 'action="/p/visit"'


@dataclass
class Person:
    """Somebody who has finished the first study, in front of its last page."""

    browser: TestClient
    token: str
    database: Database

    def were(self) -> list[Participant]:
        """Who they are in every study, the first one first."""
        with self.database.reading() as session:
            return list(session.scalars(select(Participant).order_by(Participant.id)))


def later(session: Any, **settings: Any) -> Study:
    """A study that goes on from the first one."""
    return factories.make_study(session, "Second visit", **{"goes_on_from": "first-visit", **settings})


@pytest.fixture
def person(database: Database, store: ArtefactStore, client: TestClient) -> Person:
    with database.writing() as session:
        study = factories.make_study(session, "First visit")
        factories.make_participant(session, study)
        participant, token = factories.make_participant(session, study)
        factories.make_queries(session, store, participant, 10)
        factories.finish_everything(session, participant, study)
        participant.completed_at, participant.language = now() - timedelta(days=3), "de"
        participant.panel_id = "abc"
    client.get(f"/p/{token}")
    return Person(client, token, database)


class TestComingBack:
    def test_whoever_has_finished_goes_on_under_their_number_and_begins_with_consent(
        self, person: Person, database: Database
    ) -> None:
        with database.writing() as session:
            study = later(session, days_between_visits=3)
        assert BEGIN in person.browser.get("/p/finished").text
        assert person.browser.post("/p/visit").headers["location"] == "/p/next"
        assert person.browser.get("/p/next").headers["location"] == "/p/consent"
        _, before, after = person.were()
        assert (after.study_id, after.visit, after.earlier_id) == (study.id, 2, before.id)
        assert (after.code, after.language) == (before.code, "de") == ("P02", "de")

    def test_the_text_that_is_agreed_to_says_that_earlier_answers_count(
        self, person: Person, database: Database
    ) -> None:
        with database.writing() as session:
            later(session, days_between_visits=0)
        person.browser.post("/p/visit")
        assert "Sie haben schon einmal teilgenommen." in person.browser.get("/p/consent").text
        agree(person.browser)
        assert person.browser.get("/p/next").headers["location"] == "/p/instructions"

    def test_the_old_link_leads_to_the_newest_visit(
        self, person: Person, database: Database, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            later(session, days_between_visits=0)
        person.browser.post("/p/visit")
        other = new_browser()
        other.get(f"/p/{person.token}")
        assert other.get("/p/next").headers["location"] == "/p/consent"

    def test_coming_back_twice_is_coming_back_once(
        self, person: Person, database: Database, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            later(session, days_between_visits=0)
        other = new_browser()
        other.get(f"/p/{person.token}")
        assert [browser.post("/p/visit").status_code for browser in (person.browser, other)] == [303, 303]
        assert len(person.were()) == 3

    def test_nobody_comes_back_too_early_and_the_page_says_when_they_may(
        self, person: Person, database: Database
    ) -> None:
        with database.writing() as session:
            later(session, days_between_visits=4)
        finished = person.browser.get("/p/finished").text
        assert BEGIN not in finished
        assert f"Ab {(now() + timedelta(days=1)):%Y-%m-%d}" in finished
        assert person.browser.post("/p/visit").status_code == 409
        assert len(person.were()) == 2

    def test_a_number_that_somebody_new_has_is_not_given_again(self, person: Person, database: Database) -> None:
        with database.writing() as session:
            study = later(session, days_between_visits=0)
            for _ in range(2):
                factories.make_participant(session, study)
        person.browser.post("/p/visit")
        assert [each.code for each in person.were() if each.study_id == study.id] == ["P01", "P02", "P03"]

    def test_the_panel_knows_them_again(
        self, person: Person, database: Database, new_browser: Callable[[], TestClient]
    ) -> None:
        with database.writing() as session:
            address = f"/join/{recruitment_panel.open_joining(session, later(session, days_between_visits=0), 'pat')}"
        press(new_browser(), f"{address}?PROLIFIC_PID=abc")
        press(new_browser(), f"{address}?PROLIFIC_PID=somebody-new")
        assert [(each.visit, each.panel_id) for each in person.were()[2:]] == [(2, "abc"), (1, "somebody-new")]


class TestWhoMayNot:
    @pytest.mark.parametrize(("task", "goes_on_from"), [("drinking", "first-visit"), ("feeding", "elsewhere")])
    def test_a_study_of_another_task_or_one_that_goes_on_from_another_gets_nobody(
        self, person: Person, database: Database, task: str, goes_on_from: str
    ) -> None:
        with database.writing() as session:
            study = later(session, days_between_visits=0, goes_on_from=goes_on_from)
            study.task = task
        assert BEGIN not in person.browser.get("/p/finished").text
        assert person.browser.post("/p/visit").status_code == 409

    def test_whoever_has_not_finished_does_not_come_back(self, person: Person, database: Database) -> None:
        with database.writing() as session:
            later(session, days_between_visits=0)
            for each in session.scalars(select(Participant)):
                each.completed_at = None
        assert person.browser.post("/p/visit").status_code == 409

    def test_a_study_of_other_owners_gets_nobody_though_it_names_the_first(
        self, person: Person, database: Database
    ) -> None:
        """Settings come with archives, too."""
        with database.writing() as session:
            stranger = Experimenter(name="stranger", password_hash="-", role=Role.EXPERIMENTER)
            session.add(stranger)
            session.flush()
            study = later(session, days_between_visits=0)
            session.add(StudyMember(study_id=study.id, experimenter_id=stranger.id, role=StudyRole.OWNER))
            first_id, stranger_id = session.scalars(select(Study.id)).first(), stranger.id
        assert person.browser.post("/p/visit").status_code == 409
        with database.writing() as session:
            session.add(StudyMember(study_id=first_id, experimenter_id=stranger_id, role=StudyRole.EDITOR))
        assert person.browser.post("/p/visit").status_code == 303


def test_withdrawing_at_the_second_visit_erases_the_first_as_well(person: Person, database: Database) -> None:
    with database.writing() as session:
        later(session, days_between_visits=0)
    person.browser.post("/p/visit")
    person.browser.post("/p/withdraw")
    _, *were = person.were()
    assert [each.withdrawn_at is not None for each in were] == [True, True]
    with database.reading() as session:
        assert session.scalars(select(LabelEvent)).all() == []


def test_withdrawing_at_the_first_visit_erases_the_second_as_well(person: Person, database: Database) -> None:
    with database.writing() as session:
        later(session, days_between_visits=0)
    with database.writing() as session:
        first = session.scalars(select(Participant).where(Participant.number == 2)).one()
        first.study = session.get_one(Study, first.study_id)
        visits.begin(session, first)
    person.browser.post("/p/withdraw")
    assert [each.withdrawn_at is not None for each in person.were()] == [False, True, True]


def test_the_export_says_which_visit_it_was_and_who_they_were_before(person: Person, database: Database) -> None:
    with database.writing() as session:
        study = later(session, days_between_visits=0)
        factories.make_participant(session, study)
    person.browser.post("/p/visit")
    with database.reading() as session:
        study = session.get_one(Study, study.id)
        provenance = export_formats.provenance_of(session, study)
        rows = list(export_formats.records(export_tables.BY_NAME["participants"], session, study, provenance))
    assert [(row["participant"], row["visit"], row["earlier_participant"]) for row in rows] == [
        ("P01", 1, None),
        ("P02", 2, "P02"),
    ]


class TestTheForm:
    def test_it_takes_an_older_study_of_the_same_task(self, experimenter: TestClient) -> None:
        assert experimenter.post("/studies/new", data=typed(experimenter, name="One")).status_code == 303
        form = typed(experimenter, name="Two", goes_on_from="one", days_between_visits="14")
        assert experimenter.post("/studies/new", data=form).status_code == 303
        assert "Goes on from" in experimenter.get("/studies/two").text

    @pytest.mark.parametrize(
        ("changes", "said"),
        [
            ({"goes_on_from": "nowhere"}, "You may change no study of the short name nowhere."),
            ({"goes_on_from": "one", "task": "drinking"}, "one has to be an older study of the same task"),
            ({"goes_on_from": "Not A Name"}, "Enter the short name of a study"),
        ],
    )
    def test_it_refuses_anything_else_in_words(
        self, experimenter: TestClient, changes: dict[str, str], said: str
    ) -> None:
        experimenter.post("/studies/new", data=typed(experimenter, name="One"))
        form = typed(experimenter) | {"name": ["Two"]} | {name: [value] for name, value in changes.items()}
        answer = experimenter.post("/studies/new", data=form)
        assert answer.status_code == 422
        assert said in answer.text


def test_the_page_of_an_archive_says_that_earlier_visits_are_not_in_it(
    experimenter: TestClient, database: Database
) -> None:
    with database.writing() as session:
        first = factories.make_study(session, "First visit")
        pages = [f"/studies/{each.slug}/export" for each in (first, later(session, days_between_visits=0))]
    assert ["earlier visits is not in it" in experimenter.get(page).text for page in pages] == [False, True]
