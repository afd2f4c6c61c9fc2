"""Every reward model, way of choosing pairs and start that a study can have is offered and stored."""

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.choices import RewardKind, Strategy
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.web.experimenter.study.study_form.study_form import form_with_defaults

CHOICES = [
    *(("strategy", each.value) for each in Strategy),
    *(("reward_kind", each.value) for each in RewardKind),
    *(("pooled_prior", each) for each in ("yes", "no")),
]


def created(
    experimenter: TestClient, database: Database, changed: dict[str, str], complaint: str | None
) -> StudySettings | None:
    """The settings of the study that the form makes; None where it complains as it should, and makes none."""
    form = {**form_with_defaults().model_dump(), "name": "Pilot", **changed}
    answer = experimenter.post("/studies/new", data=form)
    with database.reading() as session:
        studies = session.scalars(select(Study)).all()
    if complaint is None:
        return studies[0].settings
    assert complaint in answer.text
    assert not studies
    return None


@pytest.mark.parametrize(
    ("share", "changed", "complaint"),
    [
        ("20", {}, None),
        ("80", {}, "more than all"),
        ("20", {"reward_kind": "mlp"}, "structured reward models only"),
    ],
)
def test_a_share_of_the_pairs_can_follow_the_person_beside_the_random_ones(
    experimenter: TestClient, database: Database, share: str, changed: dict[str, str], complaint: str | None
) -> None:
    settings = created(experimenter, database, {"following_share": share, **changed}, complaint)
    if settings is None:
        return
    assert settings.following_share == 0.2
    assert "20 % follow the person" in experimenter.get("/studies/pilot").text


@pytest.mark.parametrize(
    ("steps", "changed", "complaint"),
    [
        ("90000", {}, None),
        ("500", {}, "Must be 0, for none, or at least 8,000."),
        ("90000", {"method": "printed"}, "Only the studio&#39;s own filters are refined"),
    ],
)
def test_the_last_filter_can_be_refined(
    experimenter: TestClient, database: Database, steps: str, changed: dict[str, str], complaint: str | None
) -> None:
    settings = created(experimenter, database, {"refinement_steps": steps, **changed}, complaint)
    if settings is None:
        return
    assert settings.refinement_steps == 90_000
    assert "the last one refined" in experimenter.get("/studies/pilot").text


@pytest.mark.parametrize(("field", "value"), CHOICES)
def test_a_choice_is_offered_and_stored(experimenter: TestClient, database: Database, field: str, value: str) -> None:
    assert f'name="{field}" value="{value}"' in experimenter.get("/studies/new").text
    form = {**form_with_defaults().model_dump(), "name": "Pilot", field: value}
    assert experimenter.post("/studies/new", data=form).headers["location"] == "/studies/pilot"
    with database.reading() as session:
        settings = session.scalars(select(Study)).one().settings
    stored = getattr(settings, field)
    assert stored == ((value == "yes") if field == "pooled_prior" else value)
