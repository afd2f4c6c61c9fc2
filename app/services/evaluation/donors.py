"""Whose filter somebody is shown as ``somebody_else`` and ``average``: drawn once, logged, given back on withdrawal.

A donor is a participant of the same study with a filter of all their answers. ``somebody_else`` is a yoked control:
what another participant has taught. The rules, and why they are these: docs/decisions.md, 103.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TypeVar

from sqlalchemy import Select, delete, select
from sqlalchemy.orm import Session

from app.domain.evaluation import Controller, DonorDraw, DonorRule, Donors, Film, SharedFilter, Trial
from app.domain.models import Model, ModelKind, Run, RunKind, RunStatus
from app.domain.protocol import EvaluatedMethod
from app.domain.run_keys import CONTROLLERS, LENT, OTHERS, SHARED_FILTER, TRIALS, RunKey, read
from app.domain.studies import Participant, Study
from app.services.evaluation import evaluation_plan, unblinding

FEWEST_PEOPLE = 3
"""An average of fewer would tell too much about each of them."""
SLACK = 1
"""Loans by which one donor may be ahead of another and still be drawn. Where everybody who has finished has been lent
more often, types of users stand in: a robot that all others are shown says more of its one donor than of strangers."""
Name = TypeVar("Name", int, str)


def draw(
    session: Session, study: Study, participant: Participant, method: EvaluatedMethod, types: Sequence[str]
) -> DonorDraw:
    """Draw whose filter the participant is shown, or give what was drawn before. ``types``: of users, by name.

    What only stood in is drawn again, if it is_superseded().
    """
    session.scalar(select(Study.id).where(Study.id == study.id).with_for_update())  # one at a time: loans are counted
    known = find(session, participant.id, method)
    if known is not None and not is_superseded(session, study, participant, known):
        return known
    if known is not None:
        _take_back(session, participant.id, method, Counter())
        session.delete(known)
        session.flush()
    rule, donors = foresee(session, study, participant, method, types)
    drawn = DonorDraw(
        participant_id=participant.id, method=method, rule=rule, stored_donors=donors.model_dump(mode="json")
    )
    session.add(drawn)
    session.flush()
    return drawn


def foresee(
    session: Session, study: Study, participant: Participant, method: EvaluatedMethod, types: Sequence[str]
) -> tuple[DonorRule, Donors]:
    """What would be drawn now."""
    people = candidates(session, study, participant)
    if method is EvaluatedMethod.SOMEBODY_ELSE:
        return _one(session, study, participant, people, types)
    if len(people) >= FEWEST_PEOPLE:
        return DonorRule.MEAN_OF_PEOPLE, Donors(people=tuple(people), candidates=tuple(people))
    return DonorRule.MEAN_OF_TYPES, Donors(types=tuple(types), candidates=tuple(people))


def is_superseded(session: Session, study: Study, participant: Participant, drawn: DonorDraw) -> bool:
    """Whether types of users were drawn, before enough people had finished, and by now they have."""
    if drawn.rule not in (DonorRule.TYPE_OF_USER, DonorRule.MEAN_OF_TYPES):
        return False
    people = candidates(session, study, participant)
    if drawn.method == EvaluatedMethod.SOMEBODY_ELSE:
        return _can_lend(people, _loans(session, study))
    return len(people) >= FEWEST_PEOPLE


def find(session: Session, participant_id: int, method: str) -> DonorDraw | None:
    """What was drawn for somebody; None while nothing was."""
    theirs = select(DonorDraw).where(DonorDraw.participant_id == participant_id, DonorDraw.method == method)
    return session.scalar(theirs)


def candidates(session: Session, study: Study, participant: Participant) -> Sequence[int]:
    """Numbers of those whose filter may be lent to the participant, ascending.

    People and scripted participants are never mixed: what a program has taught is no control for a person. A preview
    borrows from nobody, for the experimenter who tries the study out knows who has finished.
    """
    if participant.is_preview:
        return []
    scripted = Participant.scripted_as.is_not(None)
    others = _finished(study).where(
        Participant.id != participant.id, scripted if participant.scripted_as is not None else ~scripted
    )
    return session.scalars(others.order_by(Participant.number)).all()


def has_finished(session: Session, study: Study) -> bool:
    """Whether anybody's filter, be it a scripted participant's, may be lent."""
    return session.scalar(_finished(study).limit(1)) is not None


def _finished(study: Study) -> Select[int]:
    """Numbers of those who have a filter of all their answers."""
    has_filter = (
        select(Model.id)
        .where(
            Model.participant_id == Participant.id,
            Model.kind == ModelKind.FILTER,
            Model.label_count >= study.settings.labels_per_participant,
        )
        .exists()
    )
    return select(Participant.number).where(
        Participant.study_id == study.id,
        Participant.withdrawn_at.is_(None),
        Participant.is_preview.is_(False),
        Participant.ended_as.is_(None),
        has_filter,
    )


def _one(
    session: Session, study: Study, participant: Participant, people: Sequence[int], types: Sequence[str]
) -> tuple[DonorRule, Donors]:
    """One donor, by lot among those lent at most SLACK times more than whoever was lent least.

    With no slack, people who finish one after the other would each get the filter of the one before.
    """
    lent = _loans(session, study)

    def drawn(names: Sequence[Name]) -> Name:
        least = min(lent[name] for name in names)
        eligible = [name for name in names if lent[name] <= least + SLACK]
        return min(eligible, key=lambda name: evaluation_plan.mark(study.key_secret, "donor", participant.number, name))

    if _can_lend(people, lent):
        return DonorRule.BY_LOT, Donors(people=(drawn(people),), candidates=tuple(people))
    return DonorRule.TYPE_OF_USER, Donors(types=(drawn(types),), candidates=tuple(people))


def _loans(session: Session, study: Study) -> Counter[int | str]:
    """How often each person and each type of user is lent as somebody else."""
    drawn = select(DonorDraw).join(Participant, Participant.id == DonorDraw.participant_id)
    drawn = drawn.where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    lent = Counter[int | str]()
    for each in session.scalars(drawn.where(DonorDraw.method == EvaluatedMethod.SOMEBODY_ELSE)):
        lent.update(each.donors.people)
        lent.update(each.donors.types)
    return lent


def _can_lend(people: Sequence[int], lent: Counter[int | str]) -> bool:
    """Whether any of these has not been lent too often yet."""
    return any(lent[number] <= SLACK for number in people)


def shared_filters(session: Session, study: Study) -> Sequence[SharedFilter]:
    """Those of several people or types of users, fitted or not, the first that was asked for first."""
    theirs = select(SharedFilter).where(SharedFilter.study_id == study.id)
    return session.scalars(theirs.order_by(SharedFilter.id)).all()


def shared_filter(session: Session, study: Study, whose: Donors) -> SharedFilter | None:
    """The one for these donors; None while nobody has asked for it."""
    alike = (each for each in shared_filters(session, study) if each.donors == whose.without_candidates)
    return next(alike, None)


def awaited_by(session: Session, participant: Participant, method: str) -> SharedFilter | None:
    """What is still to be fitted before the participant can be lent it; None when there is nothing. Loads the study."""
    drawn = find(session, participant.id, method)
    if drawn is None or not drawn.donors.share_a_filter:
        return None
    shared = shared_filter(session, session.get_one(Study, participant.study_id), drawn.donors)
    return shared if shared is not None and shared.artefact_sha256 is None else None


def key_of(shared: SharedFilter) -> RunKey:
    """The key of the run that fits it; with the moment, for ids may be given again."""
    moment = f"{round(shared.asked_at.timestamp() * 1000):x}"
    return RunKey(RunKind.SHARED, study_id=shared.study_id, subject=SHARED_FILTER, number=shared.id, mark=moment)


def key_of_films(drawn: DonorDraw) -> RunKey:
    """The key of the run that films what was drawn while its borrower still answers."""
    moment = f"{round(drawn.created_at.timestamp() * 1000):x}"
    return RunKey(RunKind.FILMS, participant_id=drawn.participant_id, subject=LENT, number=drawn.id, mark=moment)


def counts(session: Session, study: Study) -> dict[str, Counter[str]]:
    """How many participants were lent a filter by which rule, by method; nothing while the study is blinded."""
    if unblinding.is_blinded(study):
        return {}
    drawn = select(DonorDraw.method, DonorDraw.rule).join(Participant, Participant.id == DonorDraw.participant_id)
    drawn = drawn.where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    found: dict[str, Counter[str]] = {}
    for method, rule in session.execute(drawn.order_by(DonorDraw.id)):
        found.setdefault(method, Counter())[rule] += 1
    return found


def numbers_in(draws: Iterable[DonorDraw]) -> set[int]:
    """Everybody who is named in these draws."""
    return {number for each in draws for number in (*each.donors.people, *each.donors.candidates)}


def release(session: Session, participant: Participant) -> tuple[dict[str, int], set[str]]:
    """Take the participant, who has withdrawn, out of what was drawn for others; doing it again changes nothing.

    What was made of their filter for somebody who has not begun to look is erased, to be drawn and made anew; an
    average of enough others stays. Returns the erased rows by table, and the files that they named.
    """
    study = session.get_one(Study, participant.study_id)
    begun = evaluation_plan.begun(session, study)
    theirs = select(DonorDraw).join(Participant, Participant.id == DonorDraw.participant_id)
    theirs = theirs.where(Participant.study_id == study.id, DonorDraw.participant_id != participant.id)
    rows, files = Counter[str](), set[str]()
    for each in session.scalars(theirs).all():
        if participant.number not in numbers_in([each]):
            continue
        was = each.donors
        each.stored_donors = was.without(participant.number).model_dump(mode="json")
        if participant.number not in was.people:
            continue
        if each.method == EvaluatedMethod.AVERAGE and len(was.people) > FEWEST_PEOPLE:
            continue
        if each.participant_id in begun:
            each.rule = DonorRule.WITHDREW if each.method == EvaluatedMethod.SOMEBODY_ELSE else each.rule
            continue
        files |= _take_back(session, each.participant_id, each.method, rows)
        session.delete(each)
        rows[DonorDraw.__tablename__] += 1
    for shared in shared_filters(session, study):
        if participant.number in shared.donors.people:
            files |= {shared.artefact_sha256} if shared.artefact_sha256 else set()
            session.delete(shared)
            rows[SharedFilter.__tablename__] += 1
    session.flush()
    return dict(rows), files


def _take_back(session: Session, borrower_id: int, method: str, rows: Counter[str]) -> set[str]:
    """Erase what was made of a loan, and have it made again. Returns the files."""
    films = session.scalars(select(Film).where(Film.participant_id == borrower_id, Film.method == method)).all()
    controllers = session.scalars(
        select(Controller).where(Controller.participant_id == borrower_id, Controller.method == method)
    ).all()
    made = select(Model).where(Model.participant_id == borrower_id, Model.kind == ModelKind.METHOD)
    models = [model for model in session.scalars(made) if model.metrics.get("method") == method]
    files = {film.trajectory_sha256 for film in films} | {film.video_sha256 for film in films}
    files |= {film.poster_sha256 for film in films}
    files |= {each.artefact_sha256 for each in controllers} | {each.artefact_sha256 for each in models}
    gone = {film.id for film in films}
    for trial in session.scalars(select(Trial).where(Trial.film_id.in_(gone))):
        trial.film_id = None
    session.flush()
    session.execute(delete(Film).where(Film.id.in_(gone)))
    session.execute(delete(Controller).where(Controller.id.in_([each.id for each in controllers])))
    session.execute(delete(Model).where(Model.id.in_([each.id for each in models])))
    rows.update({"film": len(films), "controller": len(controllers), "model": len(models)})
    _make_again(session, borrower_id, method)
    return files


def _make_again(session: Session, borrower_id: int, method: str) -> None:
    """Their runs are due once more: the method, and what shows it."""
    for run in session.scalars(select(Run).where(Run.participant_id == borrower_id)):
        about = read(run.workflow_id)
        of_loan = about is not None and (
            (about.kind is RunKind.METHOD and about.subject == method)
            or (about.kind is RunKind.FILMS and about.subject in (TRIALS, OTHERS, CONTROLLERS))
        )
        if of_loan and run.status == RunStatus.SUCCEEDED:
            run.status = RunStatus.RETRY
            run.attempt += 1  # the engine does nothing twice under one name
