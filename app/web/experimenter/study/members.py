"""Members of a study: who they are, inviting an account by its name, changing a role, shutting somebody out."""

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Form, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, StudyRole
from app.domain.studies import Study
from app.errors import AppError
from app.services.studies import membership, studies
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentExperimenter, ReadingSession, RowId, Slug, StudyOwner, WritingSession
from app.web.texts.templating import page

router = APIRouter(prefix="/studies/{slug}/members", route_class=AuthorizedRoute)


@router.get("", name="show_members")
def show_members(request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """Everybody whose study this is; for owners, with the means to change that."""
    return _page(request, session, studies.find_study(session, slug), experimenter)


@router.post("", name="admit_member")
def admit_member(
    request: Request,
    slug: Slug,
    name: Annotated[str, Form(max_length=200)],
    role: Annotated[StudyRole, Form()],
    owner: StudyOwner,
    session: WritingSession,
) -> Response:
    """Make an account a member, or give a member another role."""
    study = studies.find_study(session, slug)
    try:
        membership.admit(session, study, name, role, owner.name)
    except (membership.AccountUnknown, membership.ReaderCannotEdit) as error:
        return _page(request, session, study, owner, typed=name, error=error)
    return _onward(request, session, study, owner)


@router.post("/{account_id}/remove", name="remove_member")
def remove_member(
    request: Request, slug: Slug, account_id: RowId, owner: StudyOwner, session: WritingSession
) -> Response:
    """Shut a member out at once."""
    study = studies.find_study(session, slug)
    membership.remove(session, study, account_id, owner.name)
    session.flush()
    return _onward(request, session, study, owner)


def _page(
    request: Request,
    session: Session,
    study: Study,
    experimenter: Experimenter,
    *,
    typed: str = "",
    error: AppError | None = None,
) -> Response:
    context = {
        "study": study,
        "experimenter": experimenter,
        "members": membership.members(session, study),
        "roles": list(StudyRole),
        "may_manage": request.state.may_manage,
        "typed": typed,
        "error": None if error is None else error.message,
    }
    return page(request, "experimenter/members.html", context, 200 if error is None else error.status)


def _onward(request: Request, session: Session, study: Study, owner: Experimenter) -> Response:
    """To the members, or to the list of studies for those who have left."""
    stays = membership.role_in(session, owner, study) is not None
    here = request.app.url_path_for("show_members", slug=study.slug)
    return RedirectResponse(here if stays else request.app.url_path_for("show_studies"), HTTPStatus.SEE_OTHER)
