"""Making a study, changing it, looking at it as a participant would, and locking it."""

from collections.abc import Collection, Mapping
from datetime import timedelta
from http import HTTPStatus
from typing import Annotated, Any

from fastapi import APIRouter, Form, Query, Request
from fastapi.responses import RedirectResponse, Response
from sqlalchemy.orm import Session

from app.domain.people import Experimenter, StudyRole
from app.domain.protocol import Language
from app.domain.studies import NAME_LENGTH, Study
from app.errors import AppError
from app.installed_tasks import catalogue
from app.services.accounts import browser_sessions
from app.services.paper import osf
from app.services.participants import enrolment, visits
from app.services.studies import locking, membership, preregistration, studies
from app.web.experimenter.study.study_form import study_form
from app.web.experimenter.study.study_form.form_fields import FIELDS, OF_RECORDINGS, SECTIONS, SIMULATED
from app.web.experimenter.study.study_form.study_form import FormInvalid, Preset, StudyForm, Typed, TypedStudy
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import (
    PARTICIPANT_COOKIE,
    ActingExperimenter,
    CurrentExperimenter,
    ReadingSession,
    Slug,
    StudioDep,
    WritingSession,
    set_cookie,
)
from app.web.texts import task_words
from app.web.texts.templating import page
from app.web.texts.wording import built_in_texts, plain_text

router = APIRouter(prefix="/studies", route_class=AuthorizedRoute)

PREVIEW_LASTS = timedelta(hours=2)
_Reason = Annotated[str, Form(max_length=2000)]


@router.get("/new", name="show_new_study")
def show_new_study(
    request: Request,
    experimenter: CurrentExperimenter,
    session: ReadingSession,
    preset: Preset = Preset.LEARNING,
    like: Annotated[str, Query(max_length=80)] = "",
) -> Response:
    """The form, filled in with what usually works, with the paper's protocol, or with another study's settings."""
    if like:
        source = _source(session, experimenter, like)
        return _form_page(request, experimenter, _form_like(source), own_task=_own_task(source))
    form = study_form.form_with_defaults(preset).model_copy(update={"preset": preset.value})
    return _form_page(request, experimenter, form)


@router.post("/new", name="create_study")
def create_study(
    request: Request, form: TypedStudy, experimenter: ActingExperimenter, session: WritingSession
) -> Response:
    """Open the study, or show the form again: with what is wrong with it, or started from another preset."""
    source = _source(session, experimenter, form.like) if form.like else None
    own_task = _own_task(source) if source else None
    if source is not None:
        form = _with_unasked(source, form)
    if form.switch_to in set(Preset):
        started = study_form.with_preset(form, Preset(form.switch_to))
        return _form_page(request, experimenter, started, own_task=own_task)
    try:
        typed = study_form.typed_study(form, own_task, recorded=own_task is not None)
        _check_name(session, experimenter, form, typed.name)
        _check_visit(session, experimenter, typed)
    except FormInvalid as invalid:
        return _form_page(request, experimenter, form, errors=invalid.errors, own_task=own_task)
    study = studies.create_study(
        session, typed.name, typed.settings, seed=typed.seed, actor=experimenter.name, task=typed.task, like=source
    )
    membership.begin(session, study, experimenter)
    return _see(request, "show_study", slug=study.slug)


@router.get("/texts", name="show_texts")
def show_texts(request: Request, experimenter: CurrentExperimenter, language: Language = Language.ENGLISH) -> Response:
    """Every text that a study may say in its own words, as one would type it."""
    texts = {name: plain_text(name, language) for name in built_in_texts(language)}
    context = {"experimenter": experimenter, "texts": texts, "language": language, "languages": list(Language)}
    return page(request, "experimenter/texts.html", context)


@router.get("/{slug}/settings", name="show_settings")
def show_settings(request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """The same form with the study's settings."""
    study = studies.find_study(session, slug)
    return _form_page(request, experimenter, _form_of(study), study=study, session=session)


@router.post("/{slug}/settings", name="change_settings")
def change_settings(
    request: Request,
    slug: Slug,
    form: TypedStudy,
    experimenter: ActingExperimenter,
    session: WritingSession,
    studio: StudioDep,
) -> Response:
    """Store the changes, or show the form again; a locked study asks for a reason."""
    study = studies.find_study(session, slug)
    form = _with_unasked(study, _with_fixed(session, study, form))
    try:
        typed = study_form.typed_study(form, study.task, recorded=study.material is not None)
        _check_name(session, experimenter, form, typed.name, study)
        _check_visit(session, experimenter, typed, study)
        locking.change(
            session,
            studio.store,
            study,
            name=typed.name,
            task=typed.task,
            seed=typed.seed,
            settings=typed.settings,
            actor=experimenter.name,
            reason=form.reason,
        )
    except FormInvalid as invalid:
        return _form_page(request, experimenter, form, errors=invalid.errors, study=study, session=session)
    except locking.ReasonMissing as missing:
        errors = {"reason": missing.message}
        return _form_page(request, experimenter, form, errors=errors, study=study, session=session)
    except locking.SettingsFixed as refused:
        return _form_page(request, experimenter, form, errors={"": refused.message}, study=study, session=session)
    return _see(request, "show_study", slug=slug)


@router.post("/{slug}/preview", name="open_preview")
def open_preview(
    request: Request, slug: Slug, experimenter: ActingExperimenter, session: WritingSession, studio: StudioDep
) -> Response:
    """Go in as a participant who counts nowhere. This browser stays logged in as the experimenter as well."""
    study = studies.find_study(session, slug)
    preview, _ = enrolment.add_preview(session, study, experimenter.name)
    cookie = browser_sessions.open_for_participant(session, preview, PREVIEW_LASTS)
    response = _see(request, "show_next")
    set_cookie(response, studio.settings, PARTICIPANT_COOKIE, cookie, PREVIEW_LASTS)
    return response


@router.get("/{slug}/lock", name="show_lock")
def show_lock(request: Request, slug: Slug, experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """What locking would fix, or what was locked and has changed since."""
    return _lock_page(request, session, studies.find_study(session, slug), experimenter)


@router.post("/{slug}/lock", name="lock_study")
def lock_study(
    request: Request,
    slug: Slug,
    typed: Annotated[str, Form(max_length=200)],
    experimenter: ActingExperimenter,
    session: WritingSession,
) -> Response:
    """Lock, when the short name of the study was typed."""
    study = studies.find_study(session, slug)
    try:
        locking.lock(session, study, typed, experimenter.name)
    except locking.NotConfirmed as error:
        return _lock_page(request, session, study, experimenter, error.message, error.status)
    return _see(request, "show_lock", slug=slug)


@router.get("/{slug}/lock.json", name="download_lock")
def download_lock(slug: Slug, _experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """The document, byte for byte as it is hashed: ``sha256sum`` of the file gives the hash."""
    study = studies.find_study(session, slug)
    headers = {"content-disposition": f'attachment; filename="{slug}-lock.json"'}
    contents = study.lock_document or locking.document(study)
    return Response(locking.canonical(contents), media_type="application/json", headers=headers)


@router.get("/{slug}/preregistration.md", name="download_preregistration")
def download_preregistration(slug: Slug, _experimenter: CurrentExperimenter, session: ReadingSession) -> Response:
    """What a preregistration at OSF asks for, as far as the settings answer it."""
    headers = {"content-disposition": f'attachment; filename="{slug}-{osf.FILE_NAME}"'}
    contents = osf.registration(session, studies.find_study(session, slug))
    return Response(contents, media_type="text/markdown; charset=utf-8", headers=headers)


def _lock_page(
    request: Request,
    session: Session,
    study: Study,
    experimenter: Experimenter,
    error: str | None = None,
    status: HTTPStatus = HTTPStatus.OK,
) -> Response:
    contents = study.lock_document or locking.document(study)
    context = {
        "study": study,
        "experimenter": experimenter,
        "contents": contents,
        "hash": study.lock_hash or locking.hash_of(contents),
        "plan": preregistration.plan_of(session, study),
        "error": error,
    }
    return page(request, "experimenter/lock.html", context, status)


def _form_of(study: Study) -> StudyForm:
    return study_form.form_of(study.name, study.task, study.seed, study.settings)


def _form_like(source: Study) -> StudyForm:
    """Everything but what belongs to one study alone: its name, its seed, its people."""
    name = f"{source.name}, copy"[:NAME_LENGTH]
    form = study_form.form_of(name, source.task, None, source.settings)
    return form.model_copy(update={"like": source.slug})


def _own_task(source: Study) -> str | None:
    """The task of clips that were made elsewhere, which a copy of their study takes along."""
    return None if source.material is None else source.task


def _source(session: Session, experimenter: Experimenter, slug: str) -> Study:
    """The study that is copied with its clips: by those who edit it. Raises StudyNotFound and StudyRoleTooLow."""
    membership.enter(session, experimenter, slug, StudyRole.EDITOR)
    return studies.find_study(session, slug)


def _check_name(
    session: Session, experimenter: Experimenter, form: StudyForm, name: str, study: Study | None = None
) -> None:
    """Two studies of one name are told apart by their addresses only. Raises FormInvalid until that is meant."""
    unchanged = study is not None and study.name == name
    theirs = membership.visible_to(experimenter)
    if not unchanged and form.same_name != "yes" and studies.others_named(session, name, theirs, study):
        raise FormInvalid({"name": "Another study has this name. Change it, or say below that it is meant."})


def _check_visit(session: Session, experimenter: Experimenter, typed: Typed, study: Study | None = None) -> None:
    """A study can go on from an older one of the same task that the experimenter may change. Raises FormInvalid."""
    slug = typed.settings.goes_on_from
    if not slug or (study is not None and study.settings.goes_on_from == slug):
        return
    try:
        membership.enter(session, experimenter, slug, StudyRole.EDITOR)
    except AppError as error:
        raise FormInvalid({"goes_on_from": f"You may change no study of the short name {slug}."}) from error
    earlier = studies.find_study(session, slug)
    if not visits.fits(earlier, typed.task) or (study is not None and earlier.id >= study.id):
        raise FormInvalid({"goes_on_from": f"{slug} has to be an older study of the same task, with simulated clips."})


def _with_fixed(session: Session, study: Study, form: StudyForm) -> StudyForm:
    """What cannot be changed any more is not sent by the page, and not taken from anybody."""
    return form.model_copy(update=_stored(study, locking.fixed_settings(session, study)))


def _with_unasked(study: Study, form: StudyForm) -> StudyForm:
    """What the form of a study of recordings does not ask stays as it is; whoever sends it nevertheless is answered."""
    if study.material is None:
        return form
    stored, unasked = _form_of(study), SIMULATED - form.model_fields_set
    return form.model_copy(update=stored.model_dump(include=set(unasked)))


def _stored(study: Study, names: Collection[str]) -> dict[str, Any]:
    stored = _form_of(study).model_dump()
    return {each.name: stored[each.name] for each in FIELDS if each.fixed_with in names}


def _form_page(
    request: Request,
    experimenter: Experimenter,
    form: StudyForm,
    *,
    errors: Mapping[str, str] | None = None,
    study: Study | None = None,
    session: Session | None = None,
    own_task: str | None = None,
) -> Response:
    """``own_task``: may stay although it is not installed here, as that of a ``study`` may."""
    own_task = study.task if study is not None else own_task
    recorded = study.material is not None if study is not None else own_task is not None
    if errors and recorded:
        errors = _at_the_top(errors)
    elsewhere = [own_task] if own_task and (recorded or catalogue.find(own_task) is None) else []
    offered = elsewhere if recorded else [*catalogue.names(), *elsewhere]
    fixed = locking.fixed_settings(session, study) if study is not None and session is not None else {}
    context = {
        "experimenter": experimenter,
        "form": form,
        "errors": errors or {},
        "first_wrong": next((each for each in StudyForm.model_fields if each in (errors or {})), None),
        "sections": OF_RECORDINGS if recorded else SECTIONS,
        "recorded": recorded,
        "tasks": [(name, task_words.words_of(name)) for name in offered],
        "broken_tasks": catalogue.installed().broken,
        "presets": list(Preset),
        "study": study,
        "fixed": {each.name: fixed[each.fixed_with] for each in FIELDS if each.fixed_with in fixed},
    }
    return page(
        request, "experimenter/new_study.html", context, HTTPStatus.UNPROCESSABLE_ENTITY if errors else HTTPStatus.OK
    )


def _at_the_top(errors: Mapping[str, str]) -> Mapping[str, str]:
    """What is wrong with settings for which the form of recordings has no field."""
    hidden = [said for name, said in errors.items() if name in {"", *SIMULATED}]
    shown = {name: said for name, said in errors.items() if name not in {"", *SIMULATED}}
    return {**shown, "": " ".join(hidden)} if hidden else shown


def _see(request: Request, name: str, **parameters: str) -> RedirectResponse:
    return RedirectResponse(request.app.url_path_for(name, **parameters), HTTPStatus.SEE_OTHER)
