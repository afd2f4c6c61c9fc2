"""Studies, their members and their participants, for programs."""

from http import HTTPStatus
from typing import Any

from fastapi import APIRouter, Request
from sqlalchemy import ColumnElement, and_, select, true

from app.domain.people import ApiToken, Experimenter, Role, StudyMember, StudyRole, TokenScope
from app.domain.studies import Study
from app.services.evaluation import unblinding
from app.services.exports import export_formats, export_tables
from app.services.participants import enrolment
from app.services.studies import membership, studies
from app.web.api import schemas as answers
from app.web.api.callers import PREFIX, ActingCaller, AuthorizedCall, Caller, OwningCaller, note_reading
from app.web.http.deps import (
    Code,
    ReadingSession,
    RowId,
    Slug,
    Studio,
    StudioDep,
    WritingSession,
)

router = APIRouter(route_class=AuthorizedCall)


@router.get("/me", tags=["account"])
def show_account(request: Request, caller: Caller, session: ReadingSession) -> answers.Account:
    """Whose token this is, and what it may do."""
    token: ApiToken = request.state.token
    return answers.Account(
        name=caller.name,
        role=Role(caller.role).value,
        scope=TokenScope(token.scope).value,
        study=None if token.study_id is None else session.get_one(Study, token.study_id).slug,
        expires_at=token.expires_at,
        software_version=export_formats.software_version(),
    )


@router.get("/studies", tags=["studies"])
def list_studies(request: Request, caller: Caller, session: ReadingSession) -> list[answers.StudyLine]:
    """Every study that the token opens, the newest first."""
    theirs = select(Study).where(Study.deleted_at.is_(None), _theirs(request, caller))
    found = session.scalars(theirs.order_by(Study.id.desc()))
    return [answers.StudyLine(**_study_line(study)) for study in found]


@router.get("/studies/{slug}", tags=["studies"])
def show_study(slug: Slug, _caller: Caller, session: ReadingSession) -> answers.StudyAnswer:
    """One study with its settings."""
    study = studies.find_study(session, slug)
    return answers.StudyAnswer(
        **_study_line(study),
        seed=study.seed,
        lock_hash=study.lock_hash,
        deviations=export_formats.provenance_of(session, study).deviations,
        unblinded_at=study.unblinded_at,
        settings=study.settings,
    )


def _study_line(study: Study) -> dict[str, Any]:
    return {
        "slug": study.slug,
        "name": study.name,
        "task": study.task,
        "created_at": study.created_at,
        "locked": study.lock_hash is not None,
        "blinded": unblinding.is_blinded(study),
    }


@router.get("/studies/{slug}/participants", tags=["participants"])
def list_participants(
    slug: Slug, caller: Caller, session: ReadingSession, studio: StudioDep
) -> list[answers.ParticipantAnswer]:
    """Everybody in the study, tombstones included."""
    study = studies.find_study(session, slug)
    note_reading(studio, session, caller, "participants", study, slug)
    provenance = export_formats.provenance_of(session, study)
    rows = export_formats.records(export_tables.BY_NAME["participants"], session, study, provenance)
    return [answers.ParticipantAnswer.model_validate(row) for row in rows]


@router.get("/studies/{slug}/members", tags=["members"])
def list_members(slug: Slug, _caller: Caller, session: ReadingSession) -> list[answers.MemberAnswer]:
    """Whose study this is."""
    found = membership.members(session, studies.find_study(session, slug))
    return [_member(member, account) for member, account in found]


@router.post("/studies/{slug}/members", tags=["members"])
def admit_member(
    slug: Slug, wanted: answers.NewMember, caller: OwningCaller, session: WritingSession
) -> list[answers.MemberAnswer]:
    """Make an account a member, or give a member another role. Answers with all members."""
    study = studies.find_study(session, slug)
    membership.admit(session, study, wanted.name, StudyRole(wanted.role), caller.name)
    return [_member(member, account) for member, account in membership.members(session, study)]


@router.delete("/studies/{slug}/members/{account_id}", tags=["members"], status_code=HTTPStatus.NO_CONTENT)
def remove_member(slug: Slug, account_id: RowId, caller: OwningCaller, session: WritingSession) -> None:
    """Shut a member out of the study at once."""
    membership.remove(session, studies.find_study(session, slug), account_id, caller.name)


def _member(member: StudyMember, account: Experimenter) -> answers.MemberAnswer:
    role = StudyRole(member.role).value
    return answers.MemberAnswer(account_id=account.id, name=account.name, role=role, added_at=member.added_at)


@router.post("/studies/{slug}/participants", tags=["participants"], status_code=HTTPStatus.CREATED)
def add_participants(
    request: Request, slug: Slug, wanted: answers.NewParticipants, caller: ActingCaller, session: WritingSession
) -> list[answers.Invitation]:
    """Add people to the study. Their links are in this answer and nowhere else."""
    study = studies.find_study(session, slug)
    added = [enrolment.add_participant(session, study, caller.name) for _ in range(wanted.count)]
    return [answers.Invitation(participant=person.code, link=_personal_link(request, token)) for person, token in added]


def _personal_link(request: Request, token: str) -> str:
    studio: Studio = request.app.state.studio
    base = studio.settings.public_url or str(request.base_url).removesuffix("/").removesuffix(PREFIX)
    return f"{base.rstrip('/')}{request.app.state.path_for('open_link', token=token)}"


@router.delete("/studies/{slug}/participants/{code}/link", tags=["participants"], status_code=HTTPStatus.NO_CONTENT)
def revoke_link(slug: Slug, code: Code, caller: ActingCaller, session: WritingSession) -> None:
    """Switch a personal link off at once, with every browser that used it; a new link brings the participant back."""
    study = studies.find_study(session, slug)
    enrolment.revoke_link(session, study, enrolment.find_by_code(session, study, code), caller.name)


def _theirs(request: Request, caller: Experimenter) -> ColumnElement[bool]:
    only = request.state.token.study_id
    return and_(membership.visible_to(caller), true() if only is None else Study.id == only)
