"""The participant's sliders: set the robot yourself, with a film that follows."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Annotated, Any
from uuid import UUID, uuid4

from fastapi import APIRouter, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, RedirectResponse, Response
from pydantic import BaseModel, ValidationError
from sqlalchemy.orm import Session

from app.domain.protocol import Stage
from app.domain.studies import Awaited, Participant
from app.services.answers import next_query
from app.services.evaluation import self_setting
from app.services.evaluation.self_setting import Preview
from app.services.participants import sliders, stages
from app.storage import ArtefactStore
from app.web.error_pages import wants_json
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import StudioDep, Typed, WritingSession
from app.web.participant.evaluation import Milliseconds
from app.web.participant.pages import go, has_reached, is_in, participant_page
from app.web.texts import slider_words
from app.web.texts.languages import wording_of

router = APIRouter(prefix="/p/setting", route_class=AuthorizedRoute)

InSetting = Annotated[Participant, is_in(Stage.SELF_SETTING)]
AtSetting = Annotated[Participant, has_reached(Stage.SELF_SETTING)]

AXIS = "axis-"
"""Before the name of an axis in the name of its slider's field."""


class SettingForm(BaseModel):
    """One setting, beside the sliders themselves. What the browser could not measure comes empty."""

    client_uuid: UUID
    goes_on: bool = False
    moved: str = ""
    response_time_ms: Milliseconds = None
    stops: dict[str, int]


@router.get("", name="show_self_setting")
def show_self_setting(request: Request, participant: InSetting, session: WritingSession, studio: StudioDep) -> Response:
    """The sliders with the film of their setting; a waiting page while there is no film at all."""
    next_query.seen(participant)
    mode = _mode_of(session, participant)
    preview = self_setting.preview_of(session, studio.store, participant, mode)
    next_query.waits(participant, None if preview is not None and preview.exact else Awaited.PREVIEW)
    if wants_json(request):
        return JSONResponse(_for_script(request, participant, mode, preview))
    if preview is None:
        return participant_page(request, "participant/self_setting_waiting.html", participant)
    context: dict[str, Any] = {
        "sliders": _sliders(request, participant, mode),
        "state": _for_script(request, participant, mode, preview),
        "film": preview.film,
        "client_uuid": uuid4(),
    }
    return participant_page(request, "participant/self_setting.html", participant, context)


@router.post("", name="save_self_setting")
def save_self_setting(
    request: Request, participant: AtSetting, session: WritingSession, studio: StudioDep, typed: Typed
) -> Response:
    """Keep the setting; the transaction is committed before this response leaves."""
    form = _form(typed)
    sliders.save(
        session,
        studio.store,
        participant,
        form.stops,
        form.client_uuid,
        goes_on=form.goes_on,
        moved=form.moved or None,
        response_time_ms=form.response_time_ms,
        by_script=wants_json(request),
    )
    next_query.seen(participant)
    over = stages.current_stage(session, participant) is not Stage.SELF_SETTING
    if not wants_json(request):
        return go(request, "show_next") if over else _again(request)
    if over:
        next_query.waits(participant, None)
        return JSONResponse({"next_path": request.app.url_path_for("show_next")})
    return JSONResponse(_state(request, session, studio.store, participant))


def _again(request: Request) -> RedirectResponse:
    """Back to the sliders and their film, where there is no script."""
    return RedirectResponse(f"{request.app.url_path_for('show_self_setting')}#film", HTTPStatus.SEE_OTHER)


def _state(request: Request, session: Session, store: ArtefactStore, participant: Participant) -> dict[str, Any]:
    mode = _mode_of(session, participant)
    preview = self_setting.preview_of(session, store, participant, mode)
    next_query.waits(participant, None if preview is not None and preview.exact else Awaited.PREVIEW)
    return _for_script(request, participant, mode, preview)


def _form(typed: Mapping[str, str]) -> SettingForm:
    """What was sent; which sliders there are depends on the task."""
    sent: dict[str, Any] = {name: value for name, value in typed.items() if not name.startswith(AXIS)}
    stops = {name.removeprefix(AXIS): value for name, value in typed.items() if name.startswith(AXIS)}
    try:
        return SettingForm.model_validate({**sent, "stops": stops})
    except ValidationError as error:
        raise RequestValidationError([{**each, "loc": ("body", *each["loc"])} for each in error.errors()]) from None


def _mode_of(session: Session, participant: Participant) -> dict[str, float]:
    """As it stands now: the last setting, or the reference policy's own way."""
    given = self_setting.newest(session, participant.id)
    axes = self_setting.sliders_of(participant.study)
    stops = self_setting.stops_of(axes, given.mode if given else {})
    return self_setting.mode_at(axes, stops) if axes else {}


def _for_script(
    request: Request, participant: Participant, mode: Mapping[str, float], preview: Preview | None
) -> dict[str, Any]:
    """The film to be shown, and where the sliders stand in it."""
    axes = self_setting.sliders_of(participant.study)
    if preview is None:
        return {"film": None, "exact": False, "filmed": {}, "stops": self_setting.stops_of(axes, mode)}
    film = preview.film
    return {
        "film": {
            "video": request.app.url_path_for("show_video", sha256=film.video_sha256),
            "poster": request.app.url_path_for("show_poster", sha256=film.poster_sha256),
        },
        "exact": preview.exact,
        "filmed": self_setting.stops_of(axes, film.mode),
        "stops": self_setting.stops_of(axes, mode),
    }


def _sliders(request: Request, participant: Participant, mode: Mapping[str, float]) -> list[dict[str, Any]]:
    """What the page needs of each: its words, places, and what each place is called."""
    wording, found = wording_of(request, participant), []
    axes = self_setting.sliders_of(participant.study)
    stops = self_setting.stops_of(axes, mode)
    for each in axes:
        words = slider_words.words_of(wording, participant.study.task, each.name)
        places = range(each.lowest, each.highest + 1)
        found.append(
            {
                "name": each.name,
                "field": f"{AXIS}{each.name}",
                "words": words,
                "lowest": each.lowest,
                "highest": each.highest,
                "stop": stops[each.name],
                "places": {stop: slider_words.place_in_words(wording, words, stop) for stop in places},
            }
        )
    return found
