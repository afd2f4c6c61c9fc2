"""The table of a study's participants: sorted and narrowed by the address, acted on for several people at once."""

import io
import re
import zipfile
from collections.abc import Callable
from datetime import timedelta

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database, now
from app.domain.models import ModelKind, RunKind, RunStatus
from app.domain.participation import FormAnswer
from app.domain.people import AuditEvent
from app.domain.preferences import Response
from app.domain.protocol import FormItem
from app.domain.studies import Participant, Study
from app.services.monitoring import form_summaries
from app.services.participants import withdrawal
from app.storage import ArtefactStore
from tests import factories

QUESTIONS = (
    FormItem(name="age", kind="number"),
    FormItem(name="hand", kind="choice", question="Which hand?", choices=("left", "right", "both")),
    FormItem(name="robot_experience", kind="likert"),
    FormItem(name="comments", kind="text"),
)


@pytest.fixture
def study(database: Database, store: ArtefactStore) -> Study:
    """P01 has answered 2 pairs, P02 5, P03 none and their training failed, P04 never came, P05 has withdrawn."""
    with database.writing() as session:
        study = factories.make_study(session, "Pilot", demographics=QUESTIONS)
        people = [factories.make_participant(session, study, ready=number != 4)[0] for number in range(1, 6)]
        for person, count in zip(people, (2, 5), strict=False):
            for query in factories.make_queries(session, store, person, count):
                factories.make_label(session, query, Response.LEFT if query.ordinal % 2 else Response.RIGHT)
        people[0].last_seen_at = now() - timedelta(hours=2)
        people[1].last_seen_at = now() - timedelta(hours=1)
        factories.make_run(session, study, people[2], kind=RunKind.REWARD, status=RunStatus.FAILED, error="lost")
        withdrawal.withdraw(session, store, people[4], "P05")
        session.refresh(study)
    return study


def rows(browser: TestClient, address: str = "") -> list[str]:
    """The codes of the table's rows from top to bottom, without those who never came."""
    text = browser.get(f"/studies/pilot{address}").text.split('class="card never-came"')[0]
    return re.findall(r'<tr data-row="(P\d+)">', text)


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("", ["P03", "P01", "P02", "P05"]),
        ("?sort=code", ["P01", "P02", "P03", "P05"]),
        ("?sort=answers&backwards=yes", ["P02", "P01", "P05", "P03"]),
        ("?sort=seen", ["P02", "P01", "P03", "P05"]),
        ("?show=attention", ["P03"]),
        ("?show=withdrawn", ["P05"]),
        ("?find=p02", ["P02"]),
        ("?show=invited", []),
    ],
)
def test_the_address_says_what_is_shown_and_in_which_order(
    experimenter: TestClient, study: Study, address: str, expected: list[str]
) -> None:
    assert rows(experimenter, address) == expected


def test_who_never_came_is_apart(experimenter: TestClient, study: Study) -> None:
    apart = experimenter.get("/studies/pilot").text.split('class="card never-came"')[1]
    assert re.findall(r'<li data-row="(P\d+)">', apart) == ["P04"]


def test_the_live_part_is_asked_for_in_the_same_view(experimenter: TestClient, study: Study) -> None:
    text = experimenter.get("/studies/pilot?sort=seen&show=comparing").text
    assert 'data-live="/studies/pilot/live?sort=seen&amp;show=comparing"' in text


def test_everybody_shown_can_be_ticked_without_script(experimenter: TestClient, study: Study) -> None:
    text = experimenter.get("/studies/pilot?show=comparing&tick=all").text
    ticked = re.findall(r'value="(P\d+)" form="selection"[^>]*checked', text)
    assert ticked == rows(experimenter, "?show=comparing")


def test_links_of_everybody_who_is_ticked_are_renewed_at_once(
    experimenter: TestClient, database: Database, study: Study, new_browser: Callable[[], TestClient]
) -> None:
    answer = experimenter.post("/studies/pilot/selection/links", data={"code": ["P01", "P04", "P05"]})
    assert answer.status_code == 303
    links = re.findall(r'value="http://testserver(/p/[\w-]+)"', experimenter.get(answer.headers["location"]).text)
    assert len(links) == 2, "whoever has withdrawn gets none"
    assert [new_browser().get(link).headers["location"] for link in links] == ["/p/next"] * 2


def test_bundles_of_everybody_who_is_ticked_come_as_one_file(
    experimenter: TestClient, database: Database, store: ArtefactStore, study: Study
) -> None:
    with database.writing() as session:
        first, second, *_ = session.scalars(select(Participant).order_by(Participant.number)).all()
        for version in (1, 2):
            model = factories.make_model(session, study, first, ModelKind.FILTER, factories.filter_metrics())
            factories.make_bundle(session, store, model, b"PK bundle %d" % version)
        model = factories.make_model(session, study, second, ModelKind.FILTER, factories.filter_metrics())
        factories.make_bundle(session, store, model, b"PK another")
    answer = experimenter.post("/studies/pilot/selection/bundles.zip", data={"code": ["P01", "P03"]})
    with zipfile.ZipFile(io.BytesIO(answer.content)) as together:
        assert {name: together.read(name) for name in together.namelist()} == {"pilot-P01-v2.zip": b"PK bundle 2"}
    with database.reading() as session:
        acts = session.execute(select(AuditEvent.action, AuditEvent.subject)).all()
    assert ("bundle downloaded", "pilot/P01/2") in {tuple(act) for act in acts}


@pytest.mark.parametrize("act", ["links", "bundles.zip"])
@pytest.mark.parametrize(("codes", "status"), [([], 422), (["P99"], 404), (["x"], 422), (["P05"], 422)])
def test_a_selection_that_makes_no_sense_says_what_to_do(
    experimenter: TestClient, study: Study, act: str, codes: list[str], status: int
) -> None:
    assert experimenter.post(f"/studies/pilot/selection/{act}", data={"code": codes}).status_code == status


class TestForms:
    """What people said, one by one and together."""

    @pytest.fixture(autouse=True)
    def said(self, database: Database, study: Study) -> None:
        given: dict[str, dict[str, str | None]] = {
            "P01": {"age": "20", "hand": "left", "robot_experience": "1", "comments": "first"},
            "P02": {"age": "30", "hand": "left", "robot_experience": None, "comments": "<b>bold</b>"},
            "P03": {"age": "40", "hand": "both", "robot_experience": "4", "comments": None, "shoes": "43"},
        }
        with database.writing() as session:
            people = {person.code: person.id for person in session.scalars(select(Participant))}
            session.add(FormAnswer(participant_id=people["P01"], form="demographics", item="age", value="99"))
            for code, answers in given.items():
                for item, value in answers.items():
                    session.add(FormAnswer(participant_id=people[code], form="demographics", item=item, value=value))

    def test_each_kind_of_question_has_the_summary_that_fits_it(self, database: Database, study: Study) -> None:
        with database.reading() as session:
            (form,) = form_summaries.summaries_of(session, session.get_one(Study, study.id))
        questions = {each.item.name: each for each in form.questions}
        age = questions["age"].numbers
        assert age is not None
        assert (age.mean, age.median, age.sd, age.low, age.high) == (30, 30, 10, 20, 40), "newest answers only"
        assert questions["hand"].counts == [("left", 2), ("right", 0), ("both", 1)]
        scale = questions["robot_experience"]
        assert (scale.answered, scale.left_out) == (2, 1)
        assert scale.counts == [("1", 1), ("2", 0), ("3", 0), ("4", 1), ("5", 0)]
        assert questions["comments"].texts == [("P01", "first"), ("P02", "<b>bold</b>")]
        assert questions["shoes"].texts == [("P03", "43")], "asked once, and no more"
        assert form.people == 3

    def test_results_show_them_before_any_report_and_texts_stay_texts(
        self, experimenter: TestClient, study: Study
    ) -> None:
        text = experimenter.get("/studies/pilot/results").text
        assert "Which hand?" in text
        assert "&lt;b&gt;bold&lt;/b&gt;" in text

    def test_the_page_of_a_participant_has_their_sheet(self, experimenter: TestClient, study: Study) -> None:
        text = experimenter.get("/studies/pilot/participants/P02").text
        assert "Which hand?" in text
        assert "left out" in text
        assert "first" not in text.split("forms-title")[1].split("</section>")[0]

    def test_who_has_withdrawn_is_in_no_summary(self, database: Database, store: ArtefactStore, study: Study) -> None:
        with database.writing() as session:
            person = session.scalars(select(Participant).where(Participant.number == 1)).one()
            withdrawal.withdraw(session, store, person, "P01")
        with database.reading() as session:
            (form,) = form_summaries.summaries_of(session, session.get_one(Study, study.id))
        assert form.people == 2


def test_every_word_with_a_question_mark_is_explained_on_the_help_page(experimenter: TestClient, study: Study) -> None:
    explained = set(re.findall(r'<div id="(\w+)"><dt>', experimenter.get("/help").text))
    for address in ("/studies/pilot", "/studies/pilot/answers", "/studies/pilot/participants/P01"):
        for term in re.findall(r'popovertarget="term-(\w+)"', experimenter.get(address).text):
            assert term in explained, address
