"""Planning how many people a study needs: asked for here, simulated by the worker, kept.

Contents of a finished plan: ``paired`` (whether the two methods are met by the same people), ``bound`` (of equivalence;
not in plans of before there was that test), ``comparisons``, ``studies`` (simulated per number of people), ``rows``
(people, completed, ratings and head_to_heads: power, low, high) and ``enough`` (for ratings and head_to_heads from how
many people on the power is 80 %; None: more).
"""

import hashlib
from collections.abc import Sequence
from http import HTTPStatus
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.models import Run, RunKind, RunStatus
from app.domain.power_plan import PowerInputs, PowerPlan, PowerTest
from app.domain.run_keys import PLAN, RunKey
from app.domain.studies import Study
from app.errors import AppError
from app.services import audit

VERSION = 2
"""Of the simulation: a plan of an earlier one is made anew."""


class NothingToPlan(AppError):
    """This study compares no methods. Turn on the evaluation in its settings, then plan how many people it needs."""

    status = HTTPStatus.CONFLICT


class NotCompared(AppError):
    """Choose two different methods of this study."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class TooDifferent(AppError):
    """Enter less than the study's smallest difference that matters, 0 if the two do not differ."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


def ask(session: Session, study: Study, inputs: PowerInputs, actor: str) -> PowerPlan:
    """Ask for a plan; what was asked before of the same design is there already.

    Raises NothingToPlan, NotCompared, TooDifferent.
    """
    methods = design_of(study)["methods"]
    if inputs.better == inputs.compared or not {inputs.better.value, inputs.compared.value} <= set(methods):
        raise NotCompared
    if inputs.test is PowerTest.EQUIVALENCE and inputs.effect >= study.settings.equivalence_bound:
        raise TooDifferent
    basis = basis_of(study, inputs)
    same = select(PowerPlan).where(PowerPlan.study_id == study.id, PowerPlan.basis == basis)
    known = session.scalar(same)
    if known is not None:
        return known
    plan = PowerPlan(
        study_id=study.id, asked_by=actor, basis=basis, stored_inputs=inputs.model_dump(mode="json"), contents=None
    )
    session.add(plan)
    session.flush()
    audit.record(session, actor, "power plan asked for", study.slug, study=study)
    return plan


def basis_of(study: Study, inputs: PowerInputs) -> str:
    """Fingerprint of what is supposed and of what of the design matters."""
    supposed, design = inputs.model_dump(mode="json"), design_of(study)
    if inputs.test is PowerTest.DIFFERENCE:
        del supposed["test"]  # plans of before it could be chosen hold on, and with them what was preregistered
    if inputs.test is PowerTest.EQUIVALENCE:
        design["equivalence_bound"] = study.settings.equivalence_bound
    return hashlib.sha256(repr((VERSION, supposed, design)).encode()).hexdigest()


def design_of(study: Study) -> dict[str, Any]:
    """Of a study with an evaluation, what decides about its power: methods, arms (places of methods), trials, pairs."""
    settings = study.settings
    evaluation = settings.evaluation
    if evaluation is None:
        raise NothingToPlan
    places = {method: place for place, method in enumerate(evaluation.methods)}
    arms = [[places[method] for method in arm.methods] for arm in settings.arms] or [list(places.values())]
    return {
        "methods": [method.value for method in evaluation.methods],
        "arms": arms,
        "trials": evaluation.trials,
        "head_to_heads": evaluation.head_to_heads,
        "ties": evaluation.head_to_head_ties,
    }


def is_current(study: Study, plan: PowerPlan) -> bool:
    """Whether the study is still as it was when the plan was asked for."""
    return study.settings.evaluation is not None and plan.basis == basis_of(study, plan.inputs)


def of_study(session: Session, study: Study) -> Sequence[PowerPlan]:
    """Every plan that was asked for, the newest first."""
    return session.scalars(select(PowerPlan).where(PowerPlan.study_id == study.id).order_by(PowerPlan.id.desc())).all()


def key_of(plan: PowerPlan) -> RunKey:
    """The key of the run that simulates it."""
    return RunKey(RunKind.POWER, plan.study_id, subject=PLAN, number=plan.id)


def run_of(session: Session, plan: PowerPlan) -> Run | None:
    """The run that simulates it, while it works or after it failed."""
    run = session.scalar(select(Run).where(Run.workflow_id == str(key_of(plan))))
    return run if run is not None and run.status != RunStatus.SUCCEEDED else None
