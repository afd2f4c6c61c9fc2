"""Saving where sliders stand: append-only, each setting exactly once, until the person goes on."""

from collections.abc import Mapping
from http import HTTPStatus
from uuid import UUID

from sqlalchemy import select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.domain.protocol import Stage
from app.domain.self_setting import SelfSetting
from app.domain.studies import Participant
from app.errors import AppError
from app.services.evaluation import self_setting
from app.services.evaluation.self_setting import SettingInvalid
from app.services.participants import stages
from app.storage import ArtefactStore

MOST_REVISIONS = 2000
"""Of one participant; a browser gone wild is stopped there, and can still go on."""


class SettingOver(AppError):
    """You have gone on already, and the setting that you had then counts. Please go on with what you are shown."""

    status = HTTPStatus.CONFLICT


class SettingChangedTooOften(AppError):
    """The sliders were moved so often that no more is saved. Please go on with the setting as it is."""

    status = HTTPStatus.CONFLICT


def save(
    session: Session,
    store: ArtefactStore,
    participant: Participant,
    stops: Mapping[str, int],
    client_uuid: UUID,
    *,
    goes_on: bool,
    moved: str | None = None,
    response_time_ms: int | None = None,
    by_script: bool = False,
) -> None:
    """Keep a setting; sent again, it is the same one. ``goes_on``: the person is content, and the stage is over.

    The study is loaded. Raises SettingInvalid, SettingOver and SettingChangedTooOften.
    """
    session.scalar(select(Participant.id).where(Participant.id == participant.id).with_for_update())  # one at a time
    if _was_sent(session, participant, client_uuid):
        return
    if stages.current_stage(session, participant) is not Stage.SELF_SETTING:
        raise SettingOver
    mode = self_setting.mode_at(self_setting.sliders_of(participant.study), stops)
    known = self_setting.newest(session, participant.id)
    revision = known.revision + 1 if known else 1
    if revision > MOST_REVISIONS and not goes_on:
        raise SettingChangedTooOften
    shown = self_setting.preview_of(session, store, participant, mode)
    row = SelfSetting(
        participant_id=participant.id,
        revision=revision,
        mode=mode,
        moved=moved if moved in mode else None,
        filmed=shown is not None and shown.exact,
        client_uuid=str(client_uuid),
        response_time_ms=response_time_ms,
        by_script=by_script,
    )
    try:
        with session.begin_nested():
            session.add(row)
    except IntegrityError as error:  # the unique constraints are the last judge
        if not _was_sent(session, participant, client_uuid):
            raise SettingInvalid from error
    if goes_on:
        stages.finish(session, participant, Stage.SELF_SETTING)


def _was_sent(session: Session, participant: Participant, client_uuid: UUID) -> bool:
    """Whether this very setting is stored already. Raises SettingInvalid for somebody else's."""
    known = session.scalar(select(SelfSetting).where(SelfSetting.client_uuid == str(client_uuid)))
    if known is not None and known.participant_id != participant.id:
        raise SettingInvalid
    return known is not None
