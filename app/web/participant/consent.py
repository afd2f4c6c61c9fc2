"""Welcome and consent, and a copy of the text to keep."""

from typing import Annotated, Any

from fastapi import APIRouter, Form, Request
from fastapi.responses import PlainTextResponse, Response

from app.domain.participation import ConsentRecord
from app.domain.protocol import Stage
from app.domain.studies import Participant
from app.services.participants import consent, stages
from app.web.http.authorized_route import AuthorizedRoute
from app.web.http.deps import CurrentParticipant, WritingSession
from app.web.participant.pages import go, participant_page
from app.web.texts.consent_text import consent_text
from app.web.texts.languages import wording_of
from app.web.texts.templating import moment
from app.web.texts.wording import Wording

router = APIRouter(prefix="/p", route_class=AuthorizedRoute)


@router.get("/consent", name="show_consent")
def show_consent(request: Request, participant: CurrentParticipant, session: WritingSession) -> Response:
    """What taking part means; agreeing comes before everything else."""
    if stages.current_stage(session, participant) is not Stage.CONSENT:
        return go(request, "show_next")
    return _consent_page(request, participant, changed=participant.consented_at is not None)


@router.post("/consent", name="give_consent")
def give_consent(
    request: Request,
    participant: CurrentParticipant,
    session: WritingSession,
    shown: Annotated[str, Form(max_length=64)],
) -> Response:
    """Store the agreement to the text that was on the screen; if it has changed meanwhile, show the new one."""
    wording = wording_of(request, participant)
    text = consent_text(wording, participant).whole
    if shown != consent.fingerprint(text):
        return _consent_page(request, participant, changed=True)
    consent.give(session, participant, text, wording.language)
    return go(request, "show_next")


@router.get("/consent/copy", name="show_consent_copy")
def show_consent_copy(request: Request, participant: CurrentParticipant, session: WritingSession) -> Response:
    """The text to keep: as it was agreed to, or as it will be asked."""
    record = consent.newest(session, participant)
    text = record.text if record else consent_text(wording_of(request, participant), participant).whole
    context = {"record": record, "text": text, "language_of_text": record.language if record else None}
    return participant_page(request, "participant/consent_copy.html", participant, context)


@router.get("/consent/copy.txt", name="save_consent_copy")
def save_consent_copy(request: Request, participant: CurrentParticipant, session: WritingSession) -> Response:
    """The same as a file."""
    record = consent.newest(session, participant)
    wording = wording_of(request, participant)
    text = record.text if record else consent_text(wording, participant).whole
    lines = [participant.code, *([_agreed(wording, record)] if record else []), "", text, ""]
    name = f"{wording('consent-copy-file')}-{participant.code}.txt"
    headers = {"content-disposition": f'attachment; filename="{_plain(name)}"'}
    return PlainTextResponse("\n".join(lines), headers=headers)


def _consent_page(request: Request, participant: Participant, *, changed: bool) -> Response:
    text = consent_text(wording_of(request, participant), participant)
    context: dict[str, Any] = {"text": text, "shown": consent.fingerprint(text.whole), "changed": changed}
    return participant_page(request, "participant/consent.html", participant, context)


def _agreed(wording: Wording, record: ConsentRecord) -> str:
    return wording("consent-copy-agreed", date=moment(record.agreed_at))


def _plain(name: str) -> str:
    """A file name that fits into a header, whatever a study calls its consent."""
    return "".join(letter for letter in name if letter.isascii() and (letter.isalnum() or letter in "-_."))
