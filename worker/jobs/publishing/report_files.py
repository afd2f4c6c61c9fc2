"""Reports: statistics and figures of a study, made again when there is something newer than the last one.

A study that is blinded gets a report by letters, without tests between methods: a letter is another method for each
participant. Old reports go when a new one is there.
"""

import hashlib
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.evaluation import HeadToHead, HeadToHeadAnswer, Rating, Trial
from app.domain.models import Model, Report, Run, RunKind, RunStatus
from app.domain.participation import FormAnswer
from app.domain.preferences import Exclusion, LabelEvent, Query
from app.domain.protocol import LETTERS, MADE_FOR_YOU, EvaluatedMethod, Stage
from app.domain.run_keys import BASIS, RunKey
from app.domain.studies import Participant, Study
from app.questionnaires import library
from app.questionnaires.library import Instrument
from app.services.answers import accuracy, answer_figures, form_answers
from app.services.evaluation import evaluation_plan, unblinding
from app.services.exports import export_formats, export_tables, whose_rows
from app.services.participants import forms, withdrawal
from app.services.runs.reports import VERSION
from app.services.studies import preregistration
from worker.analysis.study.report import Tables, make_report
from worker.compute.pools import Lane
from worker.jobs.runtime import records
from worker.jobs.runtime.context import Step, WorkerContext
from worker.jobs.runtime.records import Job

AT_MOST_EVERY = timedelta(seconds=20)
"""While people answer, something is newer all the time."""
REST = 6
"""Times as long as the last one took: on a busy machine people's models would wait for it, in the same lane."""
LONGEST_REST = timedelta(minutes=1)
RUNS_AT_ONCE = (RunStatus.RUNNING, RunStatus.RETRY)


def due(session: Session, study: Study) -> list[Job]:
    """The report that is missing, unless one has just been made or is being made."""
    last = session.scalar(select(Report).where(Report.study_id == study.id).order_by(Report.id.desc()).limit(1))
    if last is not None and now() < _rested(session, study, last):
        return []
    basis = basis_of(session, study)
    if basis is None or (last is not None and last.basis == basis):
        return []
    job = Job(RunKey(RunKind.REPORT, study.id, subject=BASIS, mark=basis[:16]), study.id)
    others = select(Run.id).where(Run.study_id == study.id, Run.kind == RunKind.REPORT, Run.workflow_id != job.key)
    if session.scalar(others.where(Run.status.in_(RUNS_AT_ONCE)).limit(1)) is not None:
        return []
    return [job]


def _rested(session: Session, study: Study, last: Report) -> datetime:
    """From when on a newer report may be made; at once when somebody has unblinded the study and is waiting for it."""
    if study.unblinded_at is not None and study.unblinded_at > last.created_at:
        return study.unblinded_at
    run = session.get_one(Run, last.run_id)
    took = run.finished_at - run.started_at if run.finished_at else timedelta(0)
    return last.created_at + max(AT_MOST_EVERY, min(REST * took, LONGEST_REST))


def basis_of(session: Session, study: Study) -> str | None:
    """Fingerprint of everything a report is made from; None while there is nothing to report."""
    people = select(Participant.id).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    newest = [
        session.scalar(select(func.max(LabelEvent.id)).join(Query).where(Query.participant_id.in_(people))),
        session.scalar(select(func.max(Rating.id)).join(Trial).where(Trial.participant_id.in_(people))),
        session.scalar(
            select(func.max(HeadToHeadAnswer.id)).join(HeadToHead).where(HeadToHead.participant_id.in_(people))
        ),
        session.scalar(select(func.max(Model.id)).where(Model.participant_id.in_(people))),
    ]
    if not any(newest):
        return None
    words = select(func.max(Exclusion.id)).join(LabelEvent).join(Query).where(Query.participant_id.in_(people))
    newest.append(session.scalar(words))
    if study.settings.all_instruments:
        filled_in = select(func.max(FormAnswer.id)).where(FormAnswer.participant_id.in_(people))
        newest.append(session.scalar(filled_in.where(FormAnswer.form.in_(study.settings.all_instruments))))
    if _asks_whose(study):
        said = select(func.max(FormAnswer.id)).where(FormAnswer.participant_id.in_(people))
        newest.append(session.scalar(said.where(FormAnswer.item == MADE_FOR_YOU)))
    gone = session.scalars(people.where(Participant.withdrawn_at.is_not(None)).order_by(Participant.id)).all()
    blinded, plan = unblinding.is_blinded(study), _plan(session, study)
    basis = (VERSION, newest, list(gone), blinded, study.lock_hash, study.stored_settings, plan)
    return hashlib.sha256(repr(basis).encode()).hexdigest()


def make(context: WorkerContext, job: Job, run_id: int, step: Step) -> None:
    """Statistics and figures; one step, for it takes seconds. Returns the artefacts, so that an erasure finds them."""
    step("make", _make, context, job.study_id, run_id)


def _make(context: WorkerContext, study_id: int, run_id: int) -> list[str]:
    with context.database.reading() as session:
        study = session.get_one(Study, study_id)
        basis, gone = basis_of(session, study), records.withdrawn_ids(session, study_id)
        tables = tables_of(session, study)
    if basis is None:
        return []
    context.report(run_id, "computing statistics and drawing figures", 0.2)
    contents, files = context.compute.run(Lane.LEARNING, context.beat(run_id), make_report, tables)
    figures = {name: {kind: context.store.put(file) for kind, file in each.items()} for name, each in files.items()}
    stored = [sha256 for each in figures.values() for sha256 in each.values()]
    with context.database.writing() as session:
        if (
            records.withdrawn_ids(session, study_id) == gone
        ):  # else somebody has withdrawn meanwhile, and is in these numbers
            _save(context, session, run_id, Report(basis=basis, contents=contents, figures=figures))
        for sha256 in set(stored) - withdrawal.in_use(session, stored):
            context.store.delete(sha256)
    return stored


def tables_of(session: Session, study: Study) -> Tables:
    """What the statistics are computed from: the rows that are exported, and the dashboard's figures of each person."""
    settings, blinded = evaluation_plan.settings_of(study), unblinding.is_blinded(study)
    groups: Sequence[str] = [method.value for method in settings.methods] if settings else []
    wanted = {name: export_tables.BY_NAME[name] for name in ("ratings", "evaluations", "headtoheads")}
    provenance = export_formats.provenance_of(session, study)
    rows = {name: list(export_formats.records(table, session, study, provenance)) for name, table in wanted.items()}
    people = [each for each in whose_rows.everybody(session, study) if each.withdrawn_at is None]
    return Tables(
        participants=[each.code for each in people],
        answers=[answer_figures.figures_of(session, each) for each in people],
        window=accuracy.WINDOW,
        version=VERSION,
        groups=list(LETTERS[: len(groups)]) if blinded else groups,
        blinded=blinded,
        plan=_plan(session, study),
        columns={name: [column.name for column in table.all_columns] for name, table in wanted.items()},
        ratings=rows["ratings"],
        evaluations=rows["evaluations"],
        between=bool(study.settings.arms),
        bound=study.settings.equivalence_bound,
        head_to_heads=rows["headtoheads"] if settings and settings.head_to_heads and not blinded else None,
        guesses=_guesses(session, study) if _asks_whose(study) else None,
        instruments=_instruments(session, study),
    )


def _instruments(session: Session, study: Study) -> list[dict[str, Any]]:
    """Every standard questionnaire of the study with what everybody filled in; about a robot by method or letter."""
    methods = None if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in study.settings.all_instruments}
    for person in whose_rows.everybody(session, study):
        for each in form_answers.filled_in(session, person.id) if person.withdrawn_at is None else ():
            group = each.letter if methods is None or each.letter is None else methods.get((person.id, each.letter))
            keyed = {item.name: each.instrument.keyed(item.name, each.answers) for item in each.instrument.items}
            row = {"participant": person.code, "group": group, "scores": each.scores, "items": keyed}
            rows.setdefault(each.instrument.name, []).append(row)
    return [_instrument(library.every()[name], filled_in) for name, filled_in in rows.items()]


def _instrument(known: Instrument, filled_in: list[dict[str, Any]]) -> dict[str, Any]:
    scores = []
    for score in known.scores:
        low, high = known.range_of(score)
        words = {"name": score.name, "title": score.title, "items": list(score.items)}
        scores.append(words | {"lowest": low, "highest": high})
    words = {"name": known.name, "title": known.title, "measures": known.measures}
    return words | {"scores": scores, "filled_in": filled_in}


def _asks_whose(study: Study) -> bool:
    settings = evaluation_plan.settings_of(study)
    return settings is not None and settings.ask_which_is_theirs


def _guesses(session: Session, study: Study) -> list[dict[str, Any]]:
    """Who named which robot as theirs, and whether it is; that is None while the study is blinded."""
    methods = {} if unblinding.is_blinded(study) else unblinding.methods_by_letter(session, study)
    found = []
    for person in whose_rows.everybody(session, study):
        letter = forms.answers_of(session, person, Stage.QUESTIONNAIRE).get(MADE_FOR_YOU)
        if person.withdrawn_at is None and letter is not None:
            method = methods.get((person.id, letter))
            right = None if method is None else method == EvaluatedMethod.PBARL
            found.append({"participant": person.code, "letter": letter, "right": right})
    return found


def _plan(session: Session, study: Study) -> dict[str, Any]:
    plan = preregistration.plan_of(session, study)
    return {"standing": plan.standing.value, "planned": list(plan.planned), "in_words": plan.in_words}


def _save(context: WorkerContext, session: Session, run_id: int, report: Report) -> None:
    """Keep the report; older ones, their runs and their pictures go. Doing it twice changes nothing."""
    if session.scalar(select(Report.id).where(Report.run_id == run_id)) is not None:
        return
    report.run_id, report.study_id = run_id, session.get_one(Run, run_id).study_id
    older = session.scalars(select(Report).where(Report.study_id == report.study_id)).all()
    runs = [each.run_id for each in older]
    pictures = {sha256 for each in older for formats in each.figures.values() for sha256 in formats.values()}
    session.execute(delete(Report).where(Report.id.in_([each.id for each in older])))
    session.execute(delete(Run).where(Run.id.in_(runs)))
    session.add(report)
    session.flush()
    for sha256 in pictures - withdrawal.in_use(session, pictures):
        context.store.delete(sha256)
