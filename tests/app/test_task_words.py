"""What pages call a task and its parts: per task, and plainly where there is no word."""

import re

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.models import ModelKind, RunKind, RunStatus
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.services.studies import studies
from tests import factories
from tests.app.conftest import agree
from tests.app.study_pages import typed


@pytest.fixture
def study(database: Database, task: str) -> Study:
    """A study of the task, with a filter and a reward model about it."""
    with database.writing() as session:
        study = studies.create_study(session, "Pilot", StudySettings())
        study.task = task
        person, _ = factories.make_participant(session, study)
        metrics = factories.filter_metrics()
        metrics["mode"] |= {"hop_height": 0.4}
        factories.make_model(session, study, person, ModelKind.FILTER, metrics)
        reward = factories.reward_metrics()
        reward["weights"] |= {name: {"mean": 0.1, "low": 0.0, "high": 0.2} for name in ("strokes", "warmth_k")}
        factories.make_model(session, study, person, ModelKind.REWARD, reward)
        return study


def shown(experimenter: TestClient, path: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", experimenter.get(path).text))


@pytest.mark.parametrize(
    ("task", "said", "unsaid"),
    [
        ("feeding", ["Speed of the spoon", "Food spilled", "goes into the mouth"], ["strokes over", "itch"]),
        ("drinking", ["Speed of the cup", "Water spilled", "force at the mouth"], ["ood", "spoon", "itch"]),
        ("scratching", ["Speed of the scratcher", "presses gently", "strokes over the itch"], ["spilled", "mouth"]),
        ("dressing", ["Speed of the tool", "Food or water spilled", "speed far", "strokes"], ["spoon", "itch"]),
    ],
)
def test_a_filter_and_a_model_are_described_in_words_of_the_task(
    experimenter: TestClient, study: Study, said: list[str], unsaid: list[str]
) -> None:
    page = shown(experimenter, "/studies/pilot/participants/P01")
    for words in said:
        assert words in page
    for words in unsaid:
        assert words not in page
    assert "hop height" in page
    assert "warmth k" in page


@pytest.mark.parametrize(
    ("task", "title"), [("scratching", "Itch scratching"), ("feeding", "Feeding"), ("dress_up", "Dress up")]
)
def test_the_task_is_named_on_the_list_and_on_the_page_of_the_study(
    experimenter: TestClient, study: Study, title: str
) -> None:
    assert f"{title} · since" in shown(experimenter, "/studies")
    assert f"{title} · “" in shown(experimenter, "/studies/pilot"), "above everything, beside the question"


@pytest.mark.parametrize("task", ["dressing"])
def test_a_task_that_this_worker_does_not_know_is_a_failure_with_a_reason(
    experimenter: TestClient, study: Study, database: Database
) -> None:
    reason = "There is no task named 'dressing'; this installation knows feeding, drinking, scratching."
    with database.writing() as session:
        factories.make_run(session, study, kind=RunKind.CLIPS, status=RunStatus.FAILED, error=reason)
    page = experimenter.get("/studies/pilot").text
    assert "There is no task named &#39;dressing&#39;" in page
    assert "Try again" in page


@pytest.mark.parametrize("task", ["dressing"])
def test_a_study_of_an_unknown_task_can_be_changed_and_keeps_it(
    experimenter: TestClient, study: Study, database: Database
) -> None:
    experimenter.post("/studies/pilot/settings", data=typed(experimenter, "/studies/pilot/settings", name="Renamed"))
    with database.reading() as session:
        changed = session.get_one(Study, study.id)
        assert (changed.name, changed.task) == ("Renamed", "dressing")
    for page in (
        "/studies",
        "/studies/pilot",
        "/studies/pilot/results",
        "/studies/pilot/answers",
        "/studies/new?like=pilot",
    ):
        assert experimenter.get(page).status_code == 200


@pytest.mark.parametrize("task", ["dressing"])
def test_a_participant_of_an_unknown_task_still_gets_instructions(
    study: Study, database: Database, client: TestClient
) -> None:
    with database.writing() as session:
        _, token = factories.make_participant(session, study, ready=False)
    client.get(f"/p/{token}")
    agree(client)
    assert "A robot arm helps" in client.get("/p/instructions").text


def test_the_form_offers_every_task_with_one_chosen(experimenter: TestClient) -> None:
    page = experimenter.get("/studies/new").text
    offered = re.findall(r'name="task" value="(\w+)" (checked)?', page)
    assert offered == [("feeding", "checked"), ("drinking", ""), ("scratching", "")]
