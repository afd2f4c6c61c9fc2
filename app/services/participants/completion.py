"""The end of the way: when it was reached, and where a recruitment panel wants its people back."""

import re
from urllib.parse import quote

from app.db import now
from app.domain.designs import Ending
from app.domain.studies import Participant

_PLACE = re.compile(r"\{([A-Za-z][A-Za-z0-9_]*)\}")


def complete(participant: Participant) -> bool:
    """Note that the last stage is finished; whether this is the first time."""
    if participant.completed_at is not None:
        return False
    participant.completed_at = now()
    return True


def code_of(participant: Participant) -> str:
    """What the recruitment panel wants to hear; empty where the study has no such code. The study is loaded."""
    settings = participant.study.settings
    codes = {
        Ending.SCREENED_OUT: settings.screen_out_code,
        Ending.FULL: settings.screen_out_code,
        Ending.INATTENTIVE: settings.attention_code,
    }
    return settings.completion_code if participant.ended_as is None else codes[Ending(participant.ended_as)]


def return_address(participant: Participant) -> str | None:
    """The study's return URL with {code}, {panel_id} and every parameter of the panel filled in; None when it has none.

    What is not known is left empty: a panel copes with that better than a person with a dead link.
    """
    settings = participant.study.settings
    if not settings.return_url:
        return None
    known = {name: str(value) for name, value in (participant.panel_parameters or {}).items()}
    known |= {"code": code_of(participant), "panel_id": participant.panel_id or ""}
    return _PLACE.sub(lambda place: quote(known.get(place[1], ""), safe=""), settings.return_url)
