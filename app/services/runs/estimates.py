"""How long work still takes, from how long such work took on this machine before. What is not known is None."""

from datetime import timedelta
from statistics import median

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import now
from app.domain import run_keys
from app.domain.models import Model, Run, RunKind, RunStatus
from app.domain.run_keys import SCENARIO
from app.domain.studies import Participant, Study
from app.domain.study_settings import StudySettings

RECENT = 9
"""Runs whose median is taken, the newest."""
LOOKED_AT = 60
"""Runs among which those are looked for."""
LEAST_PROGRESS = 0.15
"""Before it, a run that nobody has the like of says nothing about itself."""
TRUST_IN_USUAL = 0.25
"""How much the usual pace counts beside a run's own, as a share of a whole run."""
FILMS_AT_A_TIME = 2
"""The worker shows films to the participant in steps of so many."""
PRESENT_WITHIN = timedelta(seconds=90)
"""Waiting pages look again every few seconds, browsers let hidden ones do so once a minute."""


def usual_s(session: Session, study: Study, kind: RunKind, what: str = "") -> float | None:
    """Median seconds of the newest runs of the same work: same task, same settings that matter, first attempts.

    ``what``: the method that is trained, or what the films are for. Trainings that left no model were given up. Those
    for all of somebody's labels count where there are any, and filters for fewer never do: these are found in a minute.
    """
    runs = (
        select(Run, Study)
        .join(Study, Study.id == Run.study_id)
        .where(Run.kind == kind, Run.status == RunStatus.SUCCEEDED, Run.attempt == 1, Study.task == study.task)
    )
    if kind in (RunKind.REWARD, RunKind.FILTER, RunKind.METHOD):
        runs = runs.join(Model, Model.run_id == Run.id)
    rows = session.execute(runs.order_by(Run.id.desc()).limit(LOOKED_AT)).all()
    alike = {of.id: _what_matters(kind, of.settings) for of in {of for _, of in rows} | {study}}
    same = [(run, of) for run, of in rows if _what(run) == what and alike[of.id] == alike[study.id]]
    last = [(run, of) for run, of in same if _labels(run) == of.settings.labels_per_participant]
    alike_ones = last if kind is RunKind.FILTER else last or same
    seconds = [(run.finished_at - run.started_at).total_seconds() for run, _ in alike_ones if run.finished_at]
    return median(seconds[:RECENT]) if seconds else None


def left_s(run: Run | None, usual: float | None) -> float | None:
    """Seconds a piece of work still takes: all of it before it began; then at a pace between the usual and its own."""
    if run is None or run.status != RunStatus.RUNNING:
        return usual
    elapsed, done = (now() - run.started_at).total_seconds(), run.progress
    if usual is None:
        return elapsed / done * (1 - done) if done >= LEAST_PROGRESS else None
    pace = (elapsed + TRUST_IN_USUAL * usual) / (done * usual + TRUST_IN_USUAL * usual)
    return (1 - done) * usual * (pace if done > 0 else 1.0)


def newest_run(session: Session, participant: Participant, kind: RunKind, what: str = "") -> Run | None:
    """The participant's newest run of this work for all their labels; the study is loaded."""
    labels = participant.study.settings.labels_per_participant
    theirs = select(Run).where(Run.participant_id == participant.id, Run.kind == kind)
    runs = session.scalars(theirs.order_by(Run.id.desc())).all()
    return next((run for run in runs if _what(run) == what and _labels(run) == labels), None)


def until_pair_s(session: Session, study: Study) -> float | None:
    """Seconds until a study without pairs has two clips of one scenario."""
    usual = usual_s(session, study, RunKind.CLIPS)
    return None if usual is None else usual * FILMS_AT_A_TIME / study.settings.behaviours_per_scenario


def are_others_first(session: Session, participant: Participant) -> bool:
    """Whether somebody else looks at a waiting page who has waited longer."""
    others = select(Participant.id).where(
        Participant.id != participant.id,
        Participant.waiting_since < (participant.waiting_since or now()),
        Participant.last_seen_at > now() - PRESENT_WITHIN,
    )
    return session.scalar(others.limit(1)) is not None


def _what(run: Run) -> str:
    """The subject of its key; clips of a scenario are the usual work of their kind."""
    key = run_keys.read(run.workflow_id)
    return "" if key is None or key.subject == SCENARIO else key.subject


def _labels(run: Run) -> int | None:
    key = run_keys.read(run.workflow_id)
    return None if key is None else key.labels


def _what_matters(kind: RunKind, settings: StudySettings) -> tuple[object, ...]:
    """The settings by which the time of a kind of work differs."""
    evaluation = settings.evaluation
    match kind:
        case RunKind.REWARD:
            return (settings.reward_kind,)
        case RunKind.FILTER | RunKind.SHARED:
            return settings.method, settings.evaluation_scenarios, settings.refinement_steps
        case RunKind.METHOD:
            return evaluation.fine_tuning_steps if evaluation else None, settings.evaluation_scenarios
        case RunKind.FILMS:
            return evaluation.trial_count if evaluation else None, evaluation.mode if evaluation else None
        case RunKind.CLIPS:
            return settings.behaviours_per_scenario, settings.clip_steps
    return ()
