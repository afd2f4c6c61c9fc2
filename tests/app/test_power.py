"""Planning how many people a study needs: asked for on a page, simulated by the worker, kept."""

import hashlib
import re
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.power_plan import PowerInputs, PowerPlan
from app.domain.studies import Study
from app.services.studies import power
from tests import factories

ROW = {"people": 8, "completed": 7.2, "ratings": {"power": 0.41, "low": 0.37, "high": 0.45}, "head_to_heads": None}


@pytest.fixture
def study(database: Database) -> Study:
    with database.writing() as session:
        return factories.make_study(session, evaluation={"methods": ["reference", "pbarl"]})


@pytest.fixture
def ask(experimenter: TestClient, study: Study) -> Callable[..., str]:
    """Send the form as the page has it, but for what is typed; gives the page that follows."""

    def send(**typed: str) -> str:
        address = f"/studies/{study.slug}/power"
        page = experimenter.get(address).text
        fields = dict(re.findall(r'<input id="(\w+)" name="\w+" type="text" inputmode="decimal" value="([^"]*)"', page))
        chosen = {"better": "pbarl", "compared": "reference", "test": "difference"}
        sent = experimenter.post(address, data={**fields, **chosen, **typed})
        return sent.text if sent.status_code == 422 else experimenter.get(address).text

    return send


def plans(database: Database) -> list[PowerPlan]:
    with database.reading() as session:
        return list(session.scalars(select(PowerPlan).order_by(PowerPlan.id)))


def test_what_is_asked_twice_is_simulated_once(ask: Callable[..., str], database: Database) -> None:
    assert "Waits for the worker" in ask(effect="0,8")
    ask(effect="0.8")
    ask(effect="0.9")
    assert [plan.inputs.effect for plan in plans(database)] == [0.8, 0.9]


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ({"effect": "5"}, "Enter at most 4."),
        ({"effect": "much"}, "Enter a number."),
        ({"most_people": "8.5"}, "Enter a whole number."),
        ({"most_people": "4"}, "Enter at least 8."),
        ({"compared": "prefft"}, "Choose two different methods of this study."),
        ({"compared": "pbarl"}, "Choose two different methods of this study."),
        ({"better": "nothing"}, "Choose a method."),
        ({"effect": "nan"}, "Enter a"),
        ({"test": "nothing"}, "Choose what is to be shown."),
        ({"test": "equivalence"}, "Enter less than the study"),
    ],
)
def test_what_cannot_be_simulated_is_said_beside_its_field(
    ask: Callable[..., str], database: Database, typed: dict[str, str], said: str
) -> None:
    assert said in ask(**typed)
    assert plans(database) == []


def test_a_finished_plan_has_figure_numbers_and_answer_and_says_when_the_design_has_changed(
    ask: Callable[..., str], experimenter: TestClient, study: Study, database: Database
) -> None:
    ask()
    with database.writing() as session:
        plan = session.scalars(select(PowerPlan)).one()
        enough = {"ratings": 8, "head_to_heads": None}
        plan.contents = {"paired": True, "comparisons": 1, "studies": 500, "rows": [ROW], "enough": enough}
    page = experimenter.get(f"/studies/{study.slug}/power").text
    assert "41\N{NO-BREAK SPACE}%" in page
    assert "[37\N{NO-BREAK SPACE}%, 45\N{NO-BREAK SPACE}%]" in page
    assert "with 8 people or more" in page
    assert "<polyline" in page
    assert "changed since" not in page
    with database.writing() as session:
        here = session.get_one(Study, study.id)
        evaluation = {**here.stored_settings["evaluation"], "trials": 5}
        here.stored_settings = {**here.stored_settings, "evaluation": evaluation}
    assert "The design has changed since" in experimenter.get(f"/studies/{study.slug}/power").text


def test_a_study_that_compares_nothing_says_what_to_do(experimenter: TestClient, database: Database) -> None:
    with database.writing() as session:
        plain = factories.make_study(session, "Plain")
    assert "Nothing to compare" in experimenter.get(f"/studies/{plain.slug}/power").text
    assert experimenter.post(f"/studies/{plain.slug}/power", data={"better": "pbarl"}).status_code in (409, 422)


def test_arms_are_part_of_the_design(database: Database) -> None:
    arms = [{"name": "own", "methods": ["pbarl"]}, {"name": "usual", "methods": ["reference"]}]
    with database.writing() as session:
        study = factories.make_study(session, evaluation={"methods": ["reference", "pbarl"]}, arms=arms)
        assert power.design_of(study)["arms"] == [[1], [0]]


@pytest.fixture
def arms() -> list[dict[str, object]]:
    return [{"name": "own", "methods": ["pbarl"]}, {"name": "usual", "methods": ["reference"]}]


def test_the_form_begins_with_what_the_study_plans_and_the_answer_names_its_test(
    experimenter: TestClient, database: Database, arms: list[dict[str, object]]
) -> None:
    with database.writing() as session:
        study = factories.make_study(
            session,
            evaluation={"methods": ["reference", "pbarl"]},
            arms=arms,
            planned_tests=("permutation", "equivalence_between", "welch_t"),
            equivalence_bound=0.4,
        )
    address = f"/studies/{study.slug}/power"
    page = experimenter.get(address).text
    assert '<option value="equivalence" selected>' in page
    assert re.search(r'<input id="effect"[^>]* value="0"', page)
    fields = dict(re.findall(r'<input id="(\w+)" name="\w+" type="text" inputmode="decimal" value="([^"]*)"', page))
    fields |= {"better": "pbarl", "compared": "reference", "test": "equivalence"}
    experimenter.post(address, data=fields)
    assert "Less than 0.4 apart, truly 0" in experimenter.get(address).text
    with database.writing() as session:
        plan = session.scalars(select(PowerPlan)).one()
        enough = {"ratings": 8, "head_to_heads": None}
        found = {"paired": False, "bound": 0.4, "comparisons": 1, "studies": 500, "rows": [ROW], "enough": enough}
        plan.contents = found
    page = experimenter.get(address).text
    assert "at least 80 % of studies show it" in page
    assert "ratings by: Equivalence, two one-sided Welch t, between people" in page
    said = experimenter.get(f"/studies/{study.slug}/preregistration.md").text
    assert "tested by Equivalence, two one-sided Welch t, between people (bounds ±0.4 points): PbARL better" in said
    with database.writing() as session:
        here = session.get_one(Study, study.id)
        here.stored_settings = {**here.stored_settings, "equivalence_bound": 0.6}
    assert "The design has changed since" in experimenter.get(address).text


def test_a_plan_of_a_difference_of_means_stands_whatever_else_can_be_planned_since(database: Database) -> None:
    """A preregistration that was made from it keeps its words: neither the choice nor the bound is part of it."""
    with database.writing() as session:
        study = factories.make_study(session, evaluation={"methods": ["reference", "pbarl"]})
        supposed = PowerInputs().model_dump(mode="json")
        assert supposed.pop("test") == "difference"
        before = hashlib.sha256(repr((2, supposed, power.design_of(study))).encode()).hexdigest()
        assert power.basis_of(study, PowerInputs()) == before
        plan = power.ask(session, study, PowerInputs(), "Ada")
        plan.stored_inputs = supposed
        study.stored_settings = {**study.stored_settings, "equivalence_bound": 0.7}
        assert power.is_current(study, plan)
