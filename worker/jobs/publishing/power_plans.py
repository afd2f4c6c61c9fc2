"""Plans of how many people a study needs, simulated as somebody has asked for them."""

from typing import TYPE_CHECKING

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.power_plan import PowerPlan
from app.domain.studies import Study
from app.services.studies import power
from worker.compute.pools import Lane
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

if TYPE_CHECKING:
    from worker.analysis.study.power import Truth

STUDIES = 500
"""Simulated for each number of people: the power is then known within .04."""
STEPS = 8
"""Numbers of people."""
FEWEST = 4


def due(session: Session, study: Study) -> list[Job]:
    """Plans that were asked for and are not there, of the study as it is now."""
    asked = session.scalars(select(PowerPlan).where(PowerPlan.study_id == study.id).order_by(PowerPlan.id))
    waiting = [each for each in asked if each.contents is None and power.is_current(study, each)]
    return [Job(power.key_of(each), study.id) for each in waiting]


def make(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Simulate, one step for every number of people: whoever kills the worker loses one of them."""
    from worker.analysis.study.power import Truth, enough  # takes seconds, and a worker that starts needs none of it

    with context.database.reading() as session:
        plan = session.get_one(PowerPlan, job.number)
        study = session.get_one(Study, plan.study_id)
        design, inputs, seed = power.design_of(study), plan.inputs, study.seed
        bound = study.settings.equivalence_bound
    truth = Truth(
        methods=len(design["methods"]),
        better=design["methods"].index(inputs.better),
        compared=design["methods"].index(inputs.compared),
        arms=tuple(map(tuple, design["arms"])),
        trials=design["trials"],
        head_to_heads=design["head_to_heads"],
        ties=design["ties"],
        effect=inputs.effect,
        spread=inputs.spread,
        levels=inputs.levels,
        noise=inputs.noise,
        dropout=inputs.dropout_percent / 100,
        test=inputs.test.value,
        bound=bound,
    )
    counts = numbers_of_people(inputs.most_people)
    rows = []
    for place, people in enumerate(counts):
        context.report(run_id, f"simulating {STUDIES} studies with {people} people", place / len(counts))
        rows.append(step(f"{people} people", _simulate, context, run_id, truth, people, seed))
    paired = any({truth.better, truth.compared} <= set(arm) for arm in truth.arms)
    found = {"paired": paired, "bound": bound, "comparisons": truth.comparisons, "studies": STUDIES, "rows": rows}
    found["enough"] = {what: enough(rows, what) for what in ("ratings", "head_to_heads")}
    step("save", _save, context, job.number, found)


def numbers_of_people(most: int) -> list[int]:
    """From few to most, evenly, each once."""
    return sorted({round(FEWEST + (most - FEWEST) * place / (STEPS - 1)) for place in range(STEPS)})


def _simulate(context: WorkerContext, run_id: int, truth: "Truth", people: int, seed: int) -> dict[str, object]:
    from worker.analysis.study.power import power_at

    return context.compute.run(Lane.LEARNING, context.beat(run_id), power_at, truth, people, STUDIES, seed)


def _save(context: WorkerContext, plan_id: int, contents: dict[str, object]) -> None:
    with context.database.writing() as session:
        session.get_one(PowerPlan, plan_id).contents = contents
