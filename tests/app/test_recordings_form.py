"""The form of a study that shows recordings: it has no simulator, and asks nothing that would need one."""

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.studies import Study
from app.storage import ArtefactStore
from app.web.experimenter.study.study_form.form_fields import SIMULATED
from tests import factories
from tests.app.study_pages import controls, typed

SETTINGS = "/studies/handover/settings"


@pytest.fixture
def recorded(database: Database, store: ArtefactStore) -> Study:
    with database.writing() as session:
        study = factories.make_study(session, "Handover", behaviours_per_scenario=3, pool_scenarios=100)
        study.task, study.material = "handover", {"signals": [{"name": "force_n"}]}
        factories.make_clip(session, store, study)
        return study


@pytest.mark.parametrize("address", [SETTINGS, "/studies/new?like=handover"])
def test_nothing_is_asked_that_needs_a_simulator(experimenter: TestClient, recorded: Study, address: str) -> None:
    page = experimenter.get(address).text
    asked = set(controls(page))
    assert {"question", "labels_per_participant", "strategy", "questionnaire"} <= asked
    assert not asked & SIMULATED
    assert not [name for name in SIMULATED if f'id="{name}"' in page]
    assert "Blinded evaluation" not in page
    assert 'value="contested"' not in page
    assert "catch pairs" not in page
    assert "task-picture" not in page, "there is no seated person in somebody's recordings"
    assert page.count('class="task-card"') == 1, "a copy shows the same recordings"


def test_what_is_not_asked_stays_as_it_is(experimenter: TestClient, database: Database, recorded: Study) -> None:
    sent = experimenter.post(SETTINGS, data=typed(experimenter, SETTINGS, labels_per_participant="20"))
    assert sent.status_code == 303
    experimenter.post("/studies/new", data=typed(experimenter, "/studies/new?like=handover"))
    with database.reading() as session:
        changed, copy = session.scalars(select(Study).order_by(Study.id)).all()
    before = recorded.settings.model_copy(update={"labels_per_participant": 20})
    assert changed.settings == before
    assert copy.settings == before


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        ({"evaluation": "yes"}, "evaluation"),
        ({"debrief": "yes"}, "debrief"),
        ({"catch_pairs": "2"}, "catch pairs"),
        ({"reward_kind": "mlp"}, "reward kind"),
        ({"strategy": "contested"}, "strategy"),
        ({"following_share": "20"}, "following share"),
    ],
)
def test_whoever_sends_it_nevertheless_is_refused_in_words(
    experimenter: TestClient, database: Database, recorded: Study, sent: dict[str, str], said: str
) -> None:
    for address in (SETTINGS, "/studies/new?like=handover"):
        answer = experimenter.post(address.partition("?")[0], data=typed(experimenter, address, **sent))
        assert answer.status_code == 422
        assert "A study of recordings has no simulator, which is needed for:" in answer.text
        assert said in answer.text
    with database.reading() as session:
        assert session.scalars(select(Study)).one().settings == recorded.settings


def test_what_is_wrong_with_a_setting_without_a_field_is_said_at_the_top(
    experimenter: TestClient, recorded: Study
) -> None:
    answer = experimenter.post(SETTINGS, data=typed(experimenter, SETTINGS, pool_scenarios="0"))
    assert (answer.status_code, "Enter at least 1" in answer.text) == (422, True)
