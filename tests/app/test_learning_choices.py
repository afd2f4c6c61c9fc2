"""Every reward model, way of choosing pairs and start that a study can have is offered and stored."""

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.choices import RewardKind, Strategy
from app.domain.studies import Study
from app.web.experimenter.study.study_form.study_form import form_with_defaults

CHOICES = [
    *(("strategy", each.value) for each in Strategy),
    *(("reward_kind", each.value) for each in RewardKind),
    *(("pooled_prior", each) for each in ("yes", "no")),
]


@pytest.mark.parametrize(("field", "value"), CHOICES)
def test_a_choice_is_offered_and_stored(experimenter: TestClient, database: Database, field: str, value: str) -> None:
    assert f'name="{field}" value="{value}"' in experimenter.get("/studies/new").text
    form = {**form_with_defaults().model_dump(), "name": "Pilot", field: value}
    assert experimenter.post("/studies/new", data=form).headers["location"] == "/studies/pilot"
    with database.reading() as session:
        settings = session.scalars(select(Study)).one().settings
    stored = getattr(settings, field)
    assert stored == ((value == "yes") if field == "pooled_prior" else value)
