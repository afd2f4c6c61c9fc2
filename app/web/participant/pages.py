"""What the participant's pages share: their frame, the way on, and that nobody skips ahead."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from fastapi import Depends, Request
from fastapi.responses import RedirectResponse, Response

from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.domain.study_settings import StudySettings
from app.services.participants import stages
from app.web.http.deps import CurrentParticipant, NotYet, WritingSession
from app.web.texts import languages
from app.web.texts.templating import page

ADDRESSES = {
    Stage.CONSENT: "show_consent",
    Stage.DEMOGRAPHICS: "show_demographics",
    Stage.INSTRUCTIONS: "show_instructions",
    Stage.SELF_SETTING: "show_self_setting",
    Stage.EVALUATION: "show_evaluation",
    Stage.QUESTIONNAIRE: "show_questionnaire",
    Stage.DEBRIEF: "show_debrief",
}
"""Route names of stages with an address of their own; practice and pairs are shown at /p/next itself."""

_READ_AGAIN = {
    Stage.CONSENT: "show_consent_copy",
    Stage.DEMOGRAPHICS: "show_demographics",
    Stage.INSTRUCTIONS: "show_instructions",
    Stage.QUESTIONNAIRE: "show_questionnaire",
}
"""Stages one may go back to from the next; what was compared and rated is left as it was said."""


def participant_page(
    request: Request,
    template: str,
    participant: Participant,
    context: Mapping[str, Any] | None = None,
    status: int = HTTPStatus.OK,
) -> Response:
    """A page with what every participant's page needs: study, settings, participant, wording and languages.

    ``who`` keeps apart what a browser remembers of several people, without naming the study.
    """
    shared = {
        "study": participant.study,
        "settings": participant.study.settings,
        "participant": participant,
        "wording": languages.wording_of(request, participant),
        **languages.switch(request, participant.study.settings.offered_languages),
        "who": f"{participant.code}-{participant.created_at.timestamp():.0f}",
    }
    return page(request, template, {**shared, **(context or {})}, status)


def go(request: Request, name: str) -> RedirectResponse:
    """On to the route of this name, with GET."""
    return RedirectResponse(request.app.url_path_for(name), HTTPStatus.SEE_OTHER)


def has_reached(stage: Stage) -> Any:
    """A dependency that gives the participant, if they are in this stage or through with it; else leads them back."""

    def check(request: Request, participant: CurrentParticipant, session: WritingSession) -> Participant:
        if _closed(request, participant) or not stages.reached(session, participant, stage):
            raise NotYet
        return participant

    return Depends(check, scope="function")


def is_in(stage: Stage) -> Any:
    """A dependency that gives the participant, if this is the stage they are in; else leads them to where they are."""

    def check(request: Request, participant: CurrentParticipant, session: WritingSession) -> Participant:
        if _closed(request, participant) or stages.current_stage(session, participant) != stage:
            raise NotYet
        return participant

    return Depends(check, scope="function")


def _closed(request: Request, participant: Participant) -> bool:
    """Put away, or over for this person: no page is shown; what somebody sends from an open one is still kept."""
    over = participant.study.put_away_at is not None or participant.ended_as is not None
    return over and request.method == "GET"


def back_from(request: Request, settings: StudySettings, stage: Stage) -> str | None:
    """The path of the page before, where going back makes sense."""
    way = stages.stages_of(settings)
    before = way[: way.index(stage)] if stage in way else []
    if not before or before[-1] not in _READ_AGAIN:
        return None
    path: str = request.app.url_path_for(_READ_AGAIN[before[-1]])
    return path
