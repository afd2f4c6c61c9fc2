"""A setting is written once: the form, locking and the API have every one, with the same default and bounds."""

from collections.abc import Iterator, Sequence
from html import unescape
from typing import Any

import pytest
from fastapi.testclient import TestClient
from pydantic import BaseModel

from app.domain.choices import Choice
from app.domain.described import bounds_of, settings_of
from app.domain.protocol import EvaluationSettings
from app.domain.study_settings import PAPER_PROTOCOL, StudySettings
from app.installed_tasks import catalogue
from app.services.studies import locking
from app.web.api.openapi import described
from app.web.experimenter.study.study_form.form_fields import BY_NAME, FIELDS, Kind
from app.web.experimenter.study.study_form.study_form import (
    FormInvalid,
    StudyForm,
    form_of,
    form_with_defaults,
    typed_study,
)

NOT_ON_THE_FORM: dict[str, str] = {}
"""Settings that the form leaves out, each with the reason; all are on it so far."""


def settings() -> Iterator[tuple[type[BaseModel], str, str]]:
    """Every setting: its model, its name there, and the name of its field."""
    for name in StudySettings.model_fields:
        yield StudySettings, name, name
    for name in EvaluationSettings.model_fields:
        yield EvaluationSettings, name, f"evaluation_{name}"


def bounds() -> Iterator[tuple[str, str, float]]:
    """Field, "minimum" or "maximum", and the bound of every number."""
    models: Sequence[type[BaseModel]] = (StudySettings, EvaluationSettings)
    schemas = {model: model.model_json_schema()["properties"] for model in models}
    for model, name, field in settings():
        schema = schemas[model][name]
        for end in ("minimum", "maximum"):
            if end in schema:
                yield field, end, schema[end]


def form(**typed: Any) -> StudyForm:
    """What is filled in, with an evaluation and clips enough for anybody, but for what is typed."""
    enough = {"name": "Pilot", "evaluation": "yes", "pool_scenarios": "500"}
    return form_with_defaults().model_copy(update={**enough, **typed})


def complaint(field: str, value: float) -> str | None:
    """What the form says about a number in a field, as people would type it."""
    typed = f"{value * 100:g}" if BY_NAME[field].kind is Kind.PERCENT else str(int(value))
    try:
        typed_study(form(**{field: typed}))
    except FormInvalid as invalid:
        return invalid.errors.get(field)
    return None


def test_every_setting_is_on_the_page_with_its_words(experimenter: TestClient) -> None:
    page = unescape(experimenter.get("/studies/new").text)
    for _, name, field in settings():
        if name in NOT_ON_THE_FORM:
            continue
        shown = BY_NAME[field].shown
        assert f'name="{field}"' in page
        assert all(words in page for words in (shown.label, shown.unit)), field
        assert all(label in page and hint in page for _, label, hint in BY_NAME[field].options), field


def test_the_form_fills_settings_and_nothing_else_but_what_a_study_is_called_and_drawn_from() -> None:
    assert {each.name for each in FIELDS if each.setting is None} == {"task", "name", "consent_text", "seed"}
    assert {(each.part or each.setting) for each in FIELDS} - {None} == {
        *StudySettings.model_fields,
        *EvaluationSettings.model_fields,
    } - NOT_ON_THE_FORM.keys()


@pytest.mark.parametrize("wanted", [StudySettings(), PAPER_PROTOCOL])
def test_what_is_filled_in_are_the_defaults_of_the_settings(wanted: StudySettings) -> None:
    assert typed_study(form_of("Pilot", catalogue.usual(), None, wanted)).settings == wanted


def test_defaults_keep_their_own_bounds() -> None:
    for wanted in (StudySettings(), EvaluationSettings()):
        assert type(wanted).model_validate(wanted.model_dump()) == wanted


@pytest.mark.parametrize(("field", "end", "bound"), list(bounds()))
def test_the_form_has_the_bounds_of_the_settings(field: str, end: str, bound: float) -> None:
    beyond = bound + (-1 if end == "minimum" else 1) * (0.01 if BY_NAME[field].kind is Kind.PERCENT else 1)
    assert complaint(field, beyond) is not None
    if field in {"clip_steps", "evaluation_head_to_heads"} and end == "maximum":
        return  # the episodes and trials that are filled in are over before
    assert complaint(field, bound) is None
    if beyond >= 0:  # a minus is no number to the form
        number = f"{bound * 100:g} %" if BY_NAME[field].kind is Kind.PERCENT else str(int(bound))
        assert complaint(field, beyond) == f"Enter at {'least' if end == 'minimum' else 'most'} {number}."


def test_the_api_describes_the_settings_as_they_are(client: TestClient) -> None:
    schemas = client.get("/api/v1/openapi.json").json()["components"]["schemas"]
    assert schemas["StudyAnswer"]["properties"]["settings"] == {"$ref": "#/components/schemas/StudySettings"}
    for model in (StudySettings, EvaluationSettings):
        shown = schemas[model.__name__]["properties"]
        own = model.model_json_schema(mode="serialization", ref_template="#/components/schemas/{model}")["properties"]
        for each in own.values():
            if each.get("default", ...) is None:
                del each["default"]  # the document leaves out what is null
        assert shown == own


def test_the_example_in_the_api_s_documentation_are_settings_that_a_study_can_have(client: TestClient) -> None:
    operations = described(client.get("/api/v1/openapi.json").json(), "")
    (gives,) = (each["gives"] for each in operations if (each["method"], each["path"]) == ("GET", "/studies/{slug}"))
    assert StudySettings.model_validate(gives["settings"]).evaluation == EvaluationSettings()


def test_whatever_can_be_chosen_has_a_name_for_people() -> None:
    for enumeration in Choice.__subclasses__():
        assert all(each.label for each in enumeration), enumeration


def test_the_bounds_of_a_setting_can_be_asked_for() -> None:
    assert bounds_of(StudySettings, "behaviours_per_scenario") == (2, 8)
    assert bounds_of(StudySettings, "question") == (None, None)


def test_a_setting_without_words_is_refused() -> None:
    class Forgotten(BaseModel):
        volume: int = 3

    with pytest.raises(TypeError, match="volume"):
        list(settings_of(Forgotten))


def test_what_is_fixed_are_settings_that_exist() -> None:
    assert {"task", "seed", "clip_steps", "labels_per_participant", "evaluation"} <= set(locking.FIXED_BY)
    assert set(locking.FIXED_BY) <= {"task", "seed", *StudySettings.model_fields}
