"""Which runs deserve a line on the dashboard: those at work, and failures that no later success has made good."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session

from app.domain import run_keys
from app.domain.models import Run, RunStatus
from app.domain.studies import Participant, Study


@dataclass(frozen=True)
class NoteworthyRun:
    """A run that deserves a line: at work, about to be tried again, or failed and not made good since."""

    run: Run
    code: str | None
    """Whom it is for; None: the whole study."""


class Glance(NamedTuple):
    """What it takes to know whether a run deserves a line. Of thousands, whole ones take their time to load."""

    id: int
    kind: str
    workflow_id: str
    status: str
    study_id: int
    participant_id: int | None


_R = TypeVar("_R", Run, Glance)


def of_study(session: Session, study: Study) -> Sequence[NoteworthyRun]:
    """Of everybody still in the study, and of the study itself."""
    mine = Run.study_id == study.id
    at_work = _present_runs(session, mine, Run.status.in_((RunStatus.RUNNING, RunStatus.RETRY)))
    ids = [
        *(run.id for run in sorted(failures(session, mine), key=lambda run: -run.id)),
        *(run.id for run in reversed(at_work)),
    ]
    runs = _whole(session, ids)
    people = select(Participant).where(Participant.id.in_([run.participant_id for run in runs.values()]))
    codes = {person.id: person.code for person in session.scalars(people)}
    return [NoteworthyRun(runs[each], codes.get(runs[each].participant_id or 0)) for each in ids]


def of_people(session: Session, participant_ids: Sequence[int]) -> dict[int, Run]:
    """Per participant the newest run at work; where none is, the newest failure that no later success has made good."""
    by_person: dict[int, list[Glance]] = defaultdict(list)
    for run in _glances(session, Run.participant_id.in_(participant_ids)):
        if run.participant_id is not None:
            by_person[run.participant_id].append(run)
    chosen = {person: noteworthy(theirs) for person, theirs in by_person.items()}
    whole = _whole(session, [run.id for run in chosen.values() if run is not None])
    return {person: whole[run.id] for person, run in chosen.items() if run is not None}


def noteworthy(runs: Sequence[_R]) -> _R | None:
    """Of runs in their order: one at work, else a failure that still stands."""
    working = [run for run in runs if run.status in (RunStatus.RUNNING, RunStatus.RETRY)]
    if working:
        return working[-1]
    newest = {_work_of(run): run for run in runs}
    return next((run for run in newest.values() if run.status == RunStatus.FAILED), None)


def failures(session: Session, *which: ColumnElement[bool]) -> Sequence[Glance]:
    """Failures that no later success has made good."""
    newest = {(_work_of(run), run.study_id, run.participant_id): run for run in _present_runs(session, *which)}
    return [run for run in newest.values() if run.status == RunStatus.FAILED]


def _glances(session: Session, *which: ColumnElement[bool]) -> Sequence[Glance]:
    """Runs in their order, from the oldest that has not succeeded: what came before has been settled."""
    oldest = select(func.min(Run.id)).where(Run.status != RunStatus.SUCCEEDED, *which).scalar_subquery()
    rows = session.execute(
        select(Run.id, Run.kind, Run.workflow_id, Run.status, Run.study_id, Run.participant_id)
        .where(Run.id >= oldest, *which)
        .order_by(Run.id)
    )
    return [Glance(*row) for row in rows]


def _whole(session: Session, run_ids: Sequence[int]) -> dict[int, Run]:
    return {run.id: run for run in session.scalars(select(Run).where(Run.id.in_(run_ids)))}


def _present_runs(session: Session, *which: ColumnElement[bool]) -> Sequence[Glance]:
    """Runs for everybody still in a study, and for whole studies."""
    of_others = select(Participant.id).where(
        or_(Participant.is_preview.is_(True), Participant.withdrawn_at.is_not(None))
    )
    return _glances(session, or_(Run.participant_id.is_(None), Run.participant_id.not_in(of_others)), *which)


def _work_of(run: Run | Glance) -> str:
    """What a later run of the same work makes good."""
    key = run_keys.read(run.workflow_id)
    return run.kind if key is None else str(key.series)
