"""A robot set with sliders: where its sliders can stand, what is saved of them, and which film shows a setting.

A slider has STOPS places on either side of the reference policy's own way, so an eighth of an axis' range lies between
two of them; people tell two executions apart from about half of it (worker.compute.behaviours.DIFFERENT_ENOUGH).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from uuid import UUID

from sqlalchemy import or_, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.domain.participation import StageRecord
from app.domain.protocol import Stage
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import evaluation_plan
from app.services.participants import stages
from app.storage import ArtefactStore

STOPS = 4
"""Places of a slider on either side of the middle."""
MOST_REVISIONS = 2000
"""Of one participant; a browser gone wild is stopped there, and can still go on."""
_SAME = 1e-6
"""Of an axis' range: settings that differ by less are one."""


class SettingOver(AppError):
    """You have gone on already, and the setting that you had then counts. Please go on with what you are shown."""

    status = HTTPStatus.CONFLICT


class SettingInvalid(AppError):
    """Some slider is missing, or stands where it cannot stand. Please reload the page and set the robot again."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class SettingChangedTooOften(AppError):
    """The sliders were moved so often that no more is saved. Please go on with the setting as it is."""

    status = HTTPStatus.CONFLICT


@dataclass(frozen=True)
class Slider:
    """One axis of the task's execution modes, in its own unit; 0 is the reference policy's own way."""

    name: str
    low: float
    high: float

    @property
    def lowest(self) -> int:
        """The first place the slider can stand in."""
        return -STOPS if self.low < 0.0 else 0

    @property
    def highest(self) -> int:
        """The last one."""
        return STOPS if self.high > 0.0 else 0

    def value_at(self, stop: int) -> float:
        """The axis' value at a place."""
        return abs(self.low if stop < 0 else self.high) * stop / STOPS

    def stop_of(self, value: float) -> int:
        """The place nearest to a value."""
        end = self.low if value < 0.0 else self.high
        return max(self.lowest, min(self.highest, round(STOPS * value / abs(end)))) if end else 0


@dataclass(frozen=True)
class Preview:
    """The film that shows a setting."""

    film: PreviewFilm
    exact: bool
    """Whether it was made of exactly this setting; else it is the nearest there is."""


def sliders_of(study: Study) -> Sequence[Slider]:
    """One for each axis of the study's task, in the task's order; none until the worker has filmed a preview."""
    axes = study.mode_axes or {}
    return [Slider(name, float(low), float(high)) for name, (low, high) in axes.items()]


def newest(session: Session, participant_id: int) -> SelfSetting | None:
    """The setting that counts; None before anything was moved."""
    theirs = select(SelfSetting).where(SelfSetting.participant_id == participant_id)
    return session.scalar(theirs.order_by(SelfSetting.revision.desc()).limit(1))


def stops_of(sliders: Sequence[Slider], mode: Mapping[str, Any]) -> dict[str, int]:
    """Where the sliders stand in a mode."""
    return {each.name: each.stop_of(float(mode.get(each.name, 0.0))) for each in sliders}


def mode_at(sliders: Sequence[Slider], stops: Mapping[str, int]) -> dict[str, float]:
    """The mode that is set. Raises SettingInvalid."""
    if {each.name for each in sliders} != set(stops) or not sliders:
        raise SettingInvalid
    if not all(each.lowest <= stops[each.name] <= each.highest for each in sliders):
        raise SettingInvalid
    return {each.name: each.value_at(stops[each.name]) for each in sliders}


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
    mode = mode_at(sliders_of(participant.study), stops)
    known = newest(session, participant.id)
    revision = known.revision + 1 if known else 1
    if revision > MOST_REVISIONS and not goes_on:
        raise SettingChangedTooOften
    shown = preview_of(session, store, participant, mode)
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


def preview_of(
    session: Session, store: ArtefactStore, participant: Participant, mode: Mapping[str, float]
) -> Preview | None:
    """The film of this mode, or the nearest one whose file is there; None while there is none. The study is loaded.

    Near by the Euclidean distance with every axis in shares of its range; of equals the first that was made.
    """
    sliders = sliders_of(participant.study)
    mine = select(SelfSetting.id).where(SelfSetting.participant_id == participant.id)
    films = select(PreviewFilm).where(PreviewFilm.study_id == participant.study_id)
    films = films.where(or_(PreviewFilm.self_setting_id.is_(None), PreviewFilm.self_setting_id.in_(mine)))
    ranked = sorted(
        session.scalars(films.order_by(PreviewFilm.id)), key=lambda film: distance(sliders, film.mode, mode)
    )
    for film in ranked:
        if store.seems_whole(film.video_sha256) and store.seems_whole(film.poster_sha256):
            return Preview(film, are_same(sliders, film.mode, mode))
    return None


def distance(sliders: Sequence[Slider], one: Mapping[str, float], other: Mapping[str, float]) -> float:
    """Between two modes, with every axis in shares of its range."""
    shares = (
        (float(one.get(each.name, 0.0)) - float(other.get(each.name, 0.0))) / (each.high - each.low)
        for each in sliders
        if each.high > each.low
    )
    return float(sum(share * share for share in shares)) ** 0.5


def are_same(sliders: Sequence[Slider], one: Mapping[str, float], other: Mapping[str, float]) -> bool:
    """Whether two modes are one setting."""
    return distance(sliders, one, other) < _SAME


def is_set(study: Study) -> bool:
    """Whether people set a robot themselves in this study."""
    settings = evaluation_plan.settings_of(study)
    return settings is not None and settings.has_sliders


def who_have_set(session: Session, study: Study) -> set[int]:
    """Ids of participants who are through with the sliders."""
    through = select(StageRecord.participant_id).join(Participant, Participant.id == StageRecord.participant_id)
    through = through.where(Participant.study_id == study.id, StageRecord.stage == Stage.SELF_SETTING)
    return set(session.scalars(through.where(StageRecord.finished_at.is_not(None))))


def _was_sent(session: Session, participant: Participant, client_uuid: UUID) -> bool:
    """Whether this very setting is stored already. Raises SettingInvalid for somebody else's."""
    known = session.scalar(select(SelfSetting).where(SelfSetting.client_uuid == str(client_uuid)))
    if known is not None and known.participant_id != participant.id:
        raise SettingInvalid
    return known is not None
