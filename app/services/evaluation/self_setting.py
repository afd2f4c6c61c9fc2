"""A robot set with sliders: where its sliders can stand, and which film shows a setting.

A slider has STOPS places on either side of the reference policy's own way, so an eighth of an axis' range lies between
two of them; people tell two executions apart from about half of it (worker.compute.behaviours.DIFFERENT_ENOUGH).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from app.domain.participation import StageRecord
from app.domain.protocol import Stage
from app.domain.self_setting import PreviewFilm, SelfSetting
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.services.evaluation import evaluation_plan
from app.storage import ArtefactStore

STOPS = 4
"""Places of a slider on either side of the middle."""
_SAME = 1e-6
"""Of an axis' range: settings that differ by less are one."""


class SettingInvalid(AppError):
    """Some slider is missing, or stands where it cannot stand. Please reload the page and set the robot again."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


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
    return math.sqrt(sum(share * share for share in shares))


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
