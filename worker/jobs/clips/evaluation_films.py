"""What an evaluation shows: films of the robots in scenarios that nothing else uses, or controllers for a real one.

Six kinds of runs: ``before-after`` (the participant's robot beside the reference, for debriefing and experimenters),
``trials`` (everything that is rated in video mode), ``others`` (what of it is not their own robot, while that is still
learning), ``ahead`` (what of both is the reference, while they still answer), ``lent`` (what of the trials is one robot
of others, while they still answer), ``controllers`` (one file per letter in physical mode).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.domain.evaluation import Controller, DonorDraw, Film, Trial
from app.domain.models import Model, ModelKind, RunKind
from app.domain.protocol import EvaluatedMethod
from app.domain.run_keys import AHEAD, BEFORE_AFTER, CONTROLLERS, LENT, OTHERS, TRIALS
from app.domain.studies import Participant, Study
from app.services.evaluation import donors, evaluation_plan
from worker.compute import baseline_fitting, simulation
from worker.compute.pools import Lane
from worker.compute.simulation import RecordedClip
from worker.jobs.clips import repairs
from worker.jobs.clips.stored_video import video_columns
from worker.jobs.learning import lent_filters
from worker.jobs.learning.filters import NothingToLearnFrom
from worker.jobs.learning.lent_filters import LoanEnded
from worker.jobs.runtime import due_work, records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

SHOWN = (TRIALS, BEFORE_AFTER)
"""Runs whose films are given to the trials they fit; all of somebody's robots are shown, or none."""
AT_A_TIME = 2
"""Films between two marks of progress."""
_FILES = ("trajectory_sha256", "video_sha256", "poster_sha256")


@dataclass(frozen=True)
class ShownRobot:
    """One method as it is shown to one participant."""

    method: str
    model_id: int | None
    controller: bytes


def make_films(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Make what the job names; a killed worker loses two films at most."""
    if repairs.is_about(job):
        repairs.make_again(context, job, run_id, step)
        return
    what = job.about.subject
    portions, done = step("plan", _portions, context, job, what), 0
    count = sum(map(len, portions))
    for some in portions:
        if step(f"is-outdated-{done}", _is_outdated, context, job, what):
            return
        context.report(run_id, f"{_DOING[what]} {done + 1} of {count}", done / count)
        step(f"shots-{done}", _pack if what == CONTROLLERS else _film, context, run_id, job, some)
        done += len(some)
    step("check", _check, context, job, what)


def _check(context: WorkerContext, job: Job, what: str) -> None:
    """Somebody may have withdrawn meanwhile whose filter was shown. Raises LoanEnded, so that all is done again."""
    with context.database.reading() as session:
        if what == CONTROLLERS:
            made = len(evaluation_plan.controllers_of(session, job.participant))
            whole = made >= len(evaluation_plan.assignments_of(session, job.participant))
        else:
            trials = evaluation_plan.trials_of(session, job.participant) if what == TRIALS else ()
            whole = all(trial.film is not None for trial in trials)
    if not whole:
        raise LoanEnded


_DOING = {
    BEFORE_AFTER: "filming before and after,",
    TRIALS: "filming robot",
    OTHERS: "filming robot",
    AHEAD: "filming the reference,",
    LENT: "filming robot",
    CONTROLLERS: "packing robot",
}


def _is_outdated(context: WorkerContext, job: Job, what: str) -> bool:
    with context.database.reading() as session:
        own = replace(job.about, kind=RunKind.FILTER, subject="")
        comes_with_the_rest = what == OTHERS and records.has_succeeded(session, str(own))
        return comes_with_the_rest or due_work.is_outdated(session, job)


def _portions(context: WorkerContext, job: Job, what: str) -> list[list[list[Any]]]:
    """What is planned: first all that is filmed already, then the rest, so many at a time that no process is idle."""
    shots = _plan(context, job, what)
    filmed: list[list[Any]] = []
    if what != CONTROLLERS:
        with context.database.reading() as session:
            filmed = [each for each in shots if _film_of(session, job, each) is not None]
    rest = [each for each in shots if each not in filmed]
    portions = [rest[first : first + AT_A_TIME] for first in range(0, len(rest), AT_A_TIME)]
    return [filmed, *portions] if filmed else portions


def _film_of(session: Session, job: Job, shot: Sequence[Any]) -> Film | None:
    method, model_id, scenario = shot
    return evaluation_plan.film_of(session, job.participant, method, scenario, model_id)


def _plan(context: WorkerContext, job: Job, what: str) -> list[list[Any]]:
    """[method, model, scenario] of every film in the order of showing, or [method, model, letter] of every controller.

    Draws the evaluation if need be. Whoever has begun to watch sees the models they began with to the end. Controllers
    come in an order of their own: which was made when then tells nothing of the key.
    """
    with context.database.writing() as session:
        study, participant = session.get_one(Study, job.study_id), session.get_one(Participant, job.participant)
        if what == BEFORE_AFTER:
            methods = (EvaluatedMethod.REFERENCE.value, EvaluatedMethod.PBARL.value)
            return [
                [method, _newest_model(session, participant.id, method), scenario]
                for scenario in evaluation_plan.comparison_scenarios(participant)
                for method in methods
            ]
        if what == AHEAD:
            return [[EvaluatedMethod.REFERENCE.value, None, each] for each in _scenarios(study, participant)]
        if what == LENT:
            drawn = _loan(session, job)
            return [[drawn.method, None, each] for each in _rated(study, participant)] if drawn else []
        evaluation_plan.draw(session, study, participant)
        letters = {each.letter: each.method for each in evaluation_plan.assignments_of(session, participant.id)}
        if what == OTHERS:
            letters = {letter: method for letter, method in letters.items() if method != EvaluatedMethod.PBARL}
        trials = evaluation_plan.trials_of(session, participant.id)
        models = {method: _newest_model(session, participant.id, method) for method in letters.values()}
        models |= {trial.film.method: trial.film.model_id for trial in trials if trial.shown_at and trial.film}
        if what == CONTROLLERS:
            shots = [[method, models[method], letter] for letter, method in letters.items()]
            return sorted(shots, key=lambda shot: evaluation_plan.mark(study.key_secret, "made", participant.id, *shot))
        named = [(letters[each.letter], each.scenario) for each in trials if each.letter in letters]
        return [[method, models[method], scenario] for method, scenario in named]


def _scenarios(study: Study, participant: Participant) -> list[int]:
    """Of the trials, then of before and after."""
    return [*_rated(study, participant), *evaluation_plan.comparison_scenarios(participant)]


def _rated(study: Study, participant: Participant) -> list[int]:
    """The scenarios of the trials."""
    settings = evaluation_plan.settings_for(study, participant.arm)
    repetitions = range(1, settings.trials + 1) if settings else ()
    return [evaluation_plan.trial_scenario(participant, repetition) for repetition in repetitions]


def _loan(session: Session, job: Job) -> DonorDraw | None:
    """What was drawn that the job films; None when it is drawn no more."""
    drawn = session.get(DonorDraw, job.number)
    return drawn if drawn is not None and donors.key_of_films(drawn) == job.about else None


def _newest_model(session: Session, participant_id: int, method: str) -> int | None:
    """None: the reference. Raises NothingToLearnFrom when nothing was ever trained."""
    if method == EvaluatedMethod.REFERENCE:
        return None
    if method == EvaluatedMethod.PBARL:
        own = records.newest_model(session, participant_id, ModelKind.FILTER)
        found = None if own is None else own.id
    else:
        trained = records.models_of(session, participant_id, ModelKind.METHOD)
        found = next((model.id for model in trained if model.metrics.get("method") == method), None)
    if found is None:
        raise NothingToLearnFrom
    return found


def _film(context: WorkerContext, run_id: int, job: Job, shots: list[list[Any]]) -> None:
    task = _task(context, job)
    with context.database.reading() as session:
        quality = session.get_one(Study, job.study_id).settings.clip_quality.value
        unfilmed = [each for each in shots if _film_of(session, job, each) is None]
    wanted = dict.fromkeys((method, model_id) for method, model_id, _ in unfilmed)
    is_lent = job.about.subject == LENT
    robots = {
        method: _lent_robot(context, run_id, job) if is_lent else _robot(context, run_id, task, method, model_id)
        for method, model_id in wanted
    }
    missing = [(robots[method], scenario) for method, _, scenario in unfilmed]
    arguments = [(task, quality, robot.controller, scenario) for robot, scenario in missing]
    recorded = context.compute.run_all(Lane.CLIPS, context.beat(run_id), simulation.film, arguments)
    files = [_stored(context, each) for each in recorded]
    with context.database.writing() as session:
        if is_lent and _loan(session, job) is None:
            lent_filters.forget(context, session, [each[name] for each in files for name in _FILES])
            raise LoanEnded
        for (robot, scenario), columns in zip(missing, files, strict=True):
            _save(session, job.participant, robot, scenario, columns)
        for method, model_id, scenario in shots if job.about.subject in SHOWN else ():
            _show(session, job.participant, method, scenario, model_id)


def _stored(context: WorkerContext, recorded: RecordedClip) -> dict[str, Any]:
    return {
        "success": recorded.success,
        "trajectory_sha256": context.store.put(recorded.trajectory),
        **video_columns(context.store, recorded.clip),
    }


def _save(session: Session, participant_id: int, robot: ShownRobot, scenario: int, columns: dict[str, Any]) -> None:
    """Record a film; doing it twice changes nothing."""
    if evaluation_plan.film_of(session, participant_id, robot.method, scenario, robot.model_id) is None:
        film = Film(participant_id=participant_id, method=robot.method, model_id=robot.model_id, scenario=scenario)
        for name, value in columns.items():
            setattr(film, name, value)
        session.add(film)
        session.flush()


def _show(session: Session, participant_id: int, method: str, scenario: int, model_id: int | None) -> None:
    """Give the film to the trial it was made for, unless that has been watched, or another model of the method has."""
    trials = evaluation_plan.trials_of(session, participant_id)
    film = evaluation_plan.film_of(session, participant_id, method, scenario, model_id)
    watched = [trial.film for trial in trials if trial.shown_at is not None and trial.film is not None]
    if film is None or any(each.method == method and each.model_id != model_id for each in watched):
        return
    letters = {each.method: each.letter for each in evaluation_plan.assignments_of(session, participant_id)}
    for trial in trials:
        if trial.letter == letters.get(method) and trial.scenario == scenario and trial.shown_at is None:
            trial.film_id = film.id


def _pack(context: WorkerContext, run_id: int, job: Job, shots: list[list[Any]]) -> None:
    task = _task(context, job)
    with context.database.reading() as session:
        slug, code = session.get_one(Study, job.study_id).slug, session.get_one(Participant, job.participant).code
    for method, model_id, letter in shots:
        robot = _robot(context, run_id, task, method, model_id)
        packed = baseline_fitting.packed(task, slug, code, letter, robot.controller)
        artefact = context.store.put(packed)
        with context.database.writing() as session:
            _keep_controller(session, job.participant, robot, artefact, len(packed))


def _keep_controller(session: Session, participant_id: int, robot: ShownRobot, artefact: str, byte_count: int) -> None:
    """Record a controller; a newer one replaces it until the robot has been started."""
    theirs = select(Controller).where(Controller.participant_id == participant_id, Controller.method == robot.method)
    known = session.scalar(theirs)
    begun = select(Trial.id).where(Trial.participant_id == participant_id, Trial.started_at.is_not(None)).limit(1)
    if known is None:
        known = Controller(participant_id=participant_id, method=robot.method)
        session.add(known)
    elif session.scalar(begun) is not None:
        return
    known.model_id, known.artefact_sha256, known.byte_count = robot.model_id, artefact, byte_count


def _lent_robot(context: WorkerContext, run_id: int, job: Job) -> ShownRobot:
    """What was drawn, which is no model of the borrower's yet. Raises LoanEnded."""
    with context.database.reading() as session:
        drawn = _loan(session, job)
    if drawn is None:
        raise LoanEnded
    controller, _ = lent_filters.controller_of(context, job, run_id, drawn)
    return ShownRobot(drawn.method, None, controller)


def _robot(context: WorkerContext, run_id: int, task: str, method: str, model_id: int | None) -> ShownRobot:
    """A model of the method as a controller."""
    beat = context.beat(run_id)
    if model_id is None:
        return ShownRobot(
            method, None, context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_reference, task)
        )
    with context.database.reading() as session:
        stored = context.store.read(session.get_one(Model, model_id).artefact_sha256)
    if method == EvaluatedMethod.PBARL:
        stored = context.compute.run(Lane.LEARNING, beat, baseline_fitting.controller_of_filter, task, stored)
    return ShownRobot(method, model_id, stored)


def _task(context: WorkerContext, job: Job) -> str:
    with context.database.reading() as session:
        return session.get_one(Study, job.study_id).task
