"""Members of a study and their roles: owner over editor over viewer. This is asked before every page and API answer."""

import re
from collections.abc import Sequence
from http import HTTPStatus

from sqlalchemy import ColumnElement, func, select, true
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, Role, StudyMember, StudyRole
from app.domain.studies import Study
from app.errors import AppError, Refused
from app.services import audit
from app.services.accounts import accounts
from app.services.accounts.roles import RoleTooLow
from app.services.studies.studies import StudyNotFound, find_study

_RANKS = {StudyRole.VIEWER: 0, StudyRole.EDITOR: 1, StudyRole.OWNER: 2}
_SLUG = re.compile(r"[a-z0-9-]{1,80}")


class StudyRoleTooLow(Refused):
    """Your role in this study allows looking at this, but not doing it. Ask an owner of the study."""


class OthersStudy(StudyNotFound, Refused):
    __doc__ = StudyNotFound.__doc__  # whoever has no part in a study is not told that there is one


class AccountUnknown(AppError):
    """There is no account of this name. An administrator of this studio adds accounts."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class ReaderCannotEdit(AppError):
    """The account of this name is a reader's, who can only be a viewer."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class MemberNotFound(AppError):
    """This account is not a member of the study."""

    status = HTTPStatus.NOT_FOUND


class StudyOwnerNeeded(AppError):
    """The study would have no owner. Make another member an owner first."""

    status = HTTPStatus.CONFLICT


def role_in(session: Session, experimenter: Experimenter, study: Study) -> StudyRole | None:
    """What this experimenter is in the study; None: it is not theirs. Administrators are owners of every study."""
    if experimenter.role == Role.ADMINISTRATOR:
        return StudyRole.OWNER
    member = _member(session, study, experimenter.id)
    if member is None:
        return None
    return StudyRole.VIEWER if experimenter.role == Role.READER else StudyRole(member.role)


def is_at_least(role: StudyRole | None, needed: StudyRole) -> bool:
    """Whether the role is this one or a higher one."""
    return role is not None and _RANKS[role] >= _RANKS[needed]


def enter(session: Session, experimenter: Experimenter, slug: str, needed: StudyRole) -> StudyRole:
    """The role of the experimenter in the study. Raises StudyNotFound, also to those who may not know of it.

    Raises RoleTooLow for readers' accounts and StudyRoleTooLow for members who may look only.
    """
    if not _SLUG.fullmatch(slug):
        raise StudyNotFound
    role = role_in(session, experimenter, find_study(session, slug))
    if role is None:
        raise OthersStudy
    if not is_at_least(role, needed):
        raise RoleTooLow if experimenter.role == Role.READER else StudyRoleTooLow
    return role


def visible_to(experimenter: Experimenter) -> ColumnElement[bool]:
    """The condition on studies that they are this experimenter's to look at."""
    if experimenter.role == Role.ADMINISTRATOR:
        return true()
    return Study.id.in_(select(StudyMember.study_id).where(StudyMember.experimenter_id == experimenter.id))


def members(session: Session, study: Study) -> Sequence[tuple[StudyMember, Experimenter]]:
    """Everybody who is a member, by name."""
    rows = (
        select(StudyMember, Experimenter)
        .join(Experimenter, Experimenter.id == StudyMember.experimenter_id)
        .where(StudyMember.study_id == study.id)
        .order_by(Experimenter.name)
    )
    return [(member, account) for member, account in session.execute(rows)]


def begin(session: Session, study: Study, experimenter: Experimenter) -> None:
    """Whoever makes or imports a study owns it."""
    session.add(StudyMember(study_id=study.id, experimenter_id=experimenter.id, role=StudyRole.OWNER))


def admit(session: Session, study: Study, name: str, role: StudyRole, actor: str) -> Experimenter:
    """Make the account of this name a member, or give a member another role.

    Raises AccountUnknown, ReaderCannotEdit and StudyOwnerNeeded.
    """
    account = accounts.by_name(session, " ".join(name.split()))
    if account is None:
        raise AccountUnknown
    if account.role == Role.READER and role is not StudyRole.VIEWER:
        raise ReaderCannotEdit
    member = _member(session, study, account.id)
    subject = f"{study.slug}: {account.name} ({role})"
    if member is None:
        session.add(StudyMember(study_id=study.id, experimenter_id=account.id, role=role))
        session.flush()
        audit.record(session, actor, "member added", subject, study=study)
    elif member.role != role:
        _leave_an_owner(session, study, member)
        member.role = role
        audit.record(session, actor, "member role changed", subject, study=study)
    return account


def remove(session: Session, study: Study, account_id: int, actor: str) -> None:
    """Shut a member out of the study at once. Raises MemberNotFound and StudyOwnerNeeded."""
    member = _member(session, study, account_id)
    if member is None:
        raise MemberNotFound
    _leave_an_owner(session, study, member)
    name = session.get_one(Experimenter, account_id).name
    session.delete(member)
    audit.record(session, actor, "member removed", f"{study.slug}: {name}", study=study)


def _member(session: Session, study: Study, account_id: int) -> StudyMember | None:
    theirs = select(StudyMember).where(StudyMember.study_id == study.id, StudyMember.experimenter_id == account_id)
    return session.scalar(theirs)


def _leave_an_owner(session: Session, study: Study, member: StudyMember) -> None:
    others = select(func.count(StudyMember.id)).where(
        StudyMember.study_id == study.id, StudyMember.role == StudyRole.OWNER, StudyMember.id != member.id
    )
    if member.role == StudyRole.OWNER and not session.scalar(others):
        raise StudyOwnerNeeded
