"""The experimenter's page on which a study's own texts are translated."""

from collections.abc import Mapping
from http import HTTPStatus

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response

from app.domain.people import Experimenter
from app.domain.studies import Study
from app.services.studies import locking, studies
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    ActingExperimenter,
    CurrentExperimenter,
    ReadingSession,
    Slug,
    StudioDep,
    Typed,
    WritingSession,
)
from app.web.texts.own_texts import own_texts, with_translations
from app.web.texts.templating import page
from app.web.texts.wording import broken_texts

router = APIRouter(prefix="/studies", route_class=AuthorizedRoute)


@router.get("/{slug}/translations", name="show_translations")
def show_translations(
    request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession
) -> Response:
    """Every text in the study's own words beside its translations."""
    study = studies.find_study(session, slug)
    return _page(request, experimenter, study, study.settings.wording, {})


@router.post("/{slug}/translations", name="save_translations")
def save_translations(
    request: Request,
    slug: Slug,
    typed: Typed,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Store them with the settings, or show the page again; a locked study asks for a reason."""
    study = studies.find_study(session, slug)
    settings = study.settings
    wording = with_translations(settings, typed)
    errors = {key: why for key, why in broken_texts(wording).items() if key in typed}
    if errors:
        return _page(request, experimenter, study, typed, errors)
    try:
        locking.change(
            session,
            studio.store,
            study,
            name=study.name,
            task=study.task,
            seed=study.seed,
            settings=settings.model_copy(update={"wording": wording}),
            actor=experimenter.name,
            reason=typed.get("reason", ""),
        )
    except (locking.ReasonMissing, locking.SettingsFixed) as refused:
        return _page(request, experimenter, study, typed, {"": refused.message})
    return RedirectResponse(request.app.url_path_for("show_study", slug=slug), HTTPStatus.SEE_OTHER)


def _page(
    request: Request, experimenter: Experimenter, study: Study, typed: Mapping[str, str], errors: Mapping[str, str]
) -> Response:
    context = {
        "experimenter": experimenter,
        "study": study,
        "texts": own_texts(study.settings),
        "others": study.settings.offered_languages[1:],
        "typed": typed,
        "errors": errors,
    }
    status = HTTPStatus.UNPROCESSABLE_ENTITY if errors else HTTPStatus.OK
    return page(request, "experimenter/translations.html", context, status)
