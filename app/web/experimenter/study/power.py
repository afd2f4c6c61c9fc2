"""How many people a study needs: what is supposed, and what the worker's simulation of its design came to."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from pydantic import ValidationError
from sqlalchemy.orm import Session

from app.domain.people import Experimenter
from app.domain.power_plan import PowerInputs, PowerPlan, PowerTest
from app.domain.studies import Study
from app.services.evaluation.unblinding import NAMES
from app.services.studies import power, studies
from app.services.studies.preregistration import TEST_NAMES
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import ActingExperimenter, CurrentExperimenter, ReadingSession, Slug, Typed, WritingSession
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}", route_class=AuthorizedRoute)

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 560, 280, 48, 40, 12
"""Of the figure, in its own units."""
NUMBERS = ("effect", "spread", "levels", "noise", "dropout_percent", "most_people")
SERIES = {"ratings": "Ratings", "head_to_heads": "Head-to-heads"}
_BOUNDS = {"greater_than_equal": ("ge", "at least"), "less_than_equal": ("le", "at most")}


@dataclass(frozen=True)
class Point:
    """One number of people in the figure."""

    x: float
    y: float
    low: float
    high: float
    people: int


@router.get("/power", name="show_power")
def show_power(request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """What can be supposed, and the plans that were made."""
    return _power_page(request, session, studies.find_study(session, slug), experimenter)


@router.post("/power", name="ask_power")
def ask_power(
    request: Request, slug: Slug, typed: Typed, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Ask the worker for a plan, or show the form again."""
    study = studies.find_study(session, slug)
    given = {name: typed.get(name, "").strip().replace(",", ".") for name in PowerInputs.model_fields}
    try:
        power.ask(session, study, PowerInputs.model_validate(given), experimenter.name)
    except ValidationError as found:
        errors = {str(error["loc"][0]): _in_words(error) for error in found.errors()}
        return _power_page(request, session, study, experimenter, given, errors)
    except (power.NotCompared, power.TooDifferent) as refused:
        field = "compared" if isinstance(refused, power.NotCompared) else "effect"
        return _power_page(request, session, study, experimenter, given, {field: refused.message})
    return RedirectResponse(request.app.url_path_for("show_power", slug=slug), HTTPStatus.SEE_OTHER)


def _in_words(error: Mapping[str, Any]) -> str:
    if error["type"] in _BOUNDS:
        key, word = _BOUNDS[error["type"]]
        return f"Enter {word} {error['ctx'][key]:g}."
    whole = error["type"].startswith("int")
    if error["loc"] == ("test",):
        return "Choose what is to be shown."
    return "Enter a whole number." if whole else "Enter a number." if "float" in error["type"] else "Choose a method."


def _power_page(
    request: Request,
    session: Session,
    study: Study,
    experimenter: Experimenter,
    given: Mapping[str, str] | None = None,
    errors: Mapping[str, str] | None = None,
) -> Response:
    evaluation = study.settings.evaluation
    plans = [(plan, power.run_of(session, plan), _figure(plan)) for plan in power.of_study(session, study)]
    current = [each for each in plans if power.is_current(study, each[0])]
    context = {
        "study": study,
        "experimenter": experimenter,
        "methods": [(method.value, NAMES[method]) for method in evaluation.methods] if evaluation else [],
        "names": {method.value: name for method, name in NAMES.items()},
        "values": given or _usual(study, plans[0][0] if plans else None),
        "tests": [(each.value, each.label) for each in PowerTest],
        "test_names": TEST_NAMES,
        "errors": errors or {},
        "numbers": [(name, PowerInputs.model_fields[name].title) for name in NUMBERS],
        "plans": plans,
        "current": {plan.id for plan, _, _ in current},
        "waiting": any(plan.contents is None for plan, _, _ in current),
        "series": SERIES,
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if errors else HTTPStatus.OK
    return page(request, "experimenter/power.html", context, status)


def _usual(study: Study, last: PowerPlan | None) -> Mapping[str, str]:
    """What the form says at first: what was supposed last, or what is usual."""
    found = last.inputs if last is not None else _unasked(study)
    methods = list(study.settings.evaluation.methods) if study.settings.evaluation else []
    values = {name: f"{getattr(found, name):g}" for name in NUMBERS}
    better = found.better if found.better in methods or not methods else methods[-1]
    others = [method for method in methods if method != better]
    compared = found.compared if found.compared in others or not others else others[0]
    return values | {"better": better.value, "compared": compared.value, "test": found.test.value}


def _unasked(study: Study) -> PowerInputs:
    """What is usual for the first test that the study plans; where it is to show that methods are alike, they are."""
    planned = study.settings.planned_tests
    kinds = {kind.planned(paired=paired): kind for kind in PowerTest for paired in (True, False)}
    test = next((kinds[each] for each in planned if each in kinds), PowerTest.DIFFERENCE)
    return PowerInputs(test=test, effect=0.0) if test is PowerTest.EQUIVALENCE else PowerInputs(test=test)


def _figure(plan: PowerPlan) -> dict[str, Any] | None:
    """Power against number of people, in the figure's units; None while there is none."""
    if plan.contents is None:
        return None
    rows: Sequence[dict[str, Any]] = plan.contents["rows"]
    most = max(int(row["people"]) for row in rows)

    def across(people: int) -> float:
        return LEFT + (WIDTH - LEFT - 16) * people / most

    def up(share: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - BOTTOM - TOP) * share

    lines = {
        what: [
            Point(
                across(row["people"]),
                up(row[what]["power"]),
                up(row[what]["low"]),
                up(row[what]["high"]),
                row["people"],
            )
            for row in rows
        ]
        for what in SERIES
        if rows[0][what] is not None
    }
    ticks = [(up(share / 100), f"{share} %") for share in (0, 20, 40, 60, 80, 100)]
    axis = {"left": LEFT, "right": WIDTH - 16, "bottom": HEIGHT - BOTTOM, "top": TOP}
    return {"width": WIDTH, "height": HEIGHT, "lines": lines, "ticks": ticks, "wanted": up(0.8), **axis}
