"""A study's settings after it was made: changed freely, until they are locked; then only with a reason that is kept.

What is locked is written down as one document, and the hash of that document goes into every export.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.db import now
from app.domain.clips import Rollout
from app.domain.described import Use, settings_of
from app.domain.evaluation import Assignment
from app.domain.preferences import Query
from app.domain.studies import Deviation, Participant, Study
from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.services import audit
from app.services.exports import export_formats
from app.services.participants import withdrawal
from app.services.participants.enrolment import participant_seed
from app.services.studies import task_limits
from app.storage import ArtefactStore

SEEDS_LISTED = 50
"""Of participants; those of later ones follow by the same rule."""

FIXED_BY: Mapping[str, Use] = {
    **dict.fromkeys(("task", "seed"), Use.CLIPS),
    **{name: shown.fixed_by for name, _, shown in settings_of(StudySettings) if shown.fixed_by},
}
"""What settles a setting, or task and seed of the study, for good."""


class AlreadyLocked(AppError):
    """This study is locked already."""

    status = HTTPStatus.CONFLICT


class NotConfirmed(AppError):
    """What was typed is not the short name of this study. Nothing was locked."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class ReasonMissing(AppError):
    """This study is locked. Say why it has to change: the reason goes into every export."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class SettingsFixed(AppError):
    """Some of these settings cannot be changed any more."""

    status = HTTPStatus.CONFLICT


def fixed_settings(session: Session, study: Study) -> Mapping[str, str]:
    """Names of settings, and of ``task`` and ``seed``, that nothing may change any more, each with the reason why."""
    real = select(Participant.id).where(Participant.study_id == study.id, Participant.is_preview.is_(False))
    signs = {
        Use.CLIPS: select(Rollout.id).where(Rollout.study_id == study.id),
        Use.PAIRS: select(Query.id).where(Query.participant_id.in_(real)),
        Use.EVALUATION: select(Assignment.id).where(Assignment.participant_id.in_(real)),
        Use.ARMS: real.where(Participant.arm.is_not(None)),
    }
    happened = {use for use, sign in signs.items() if session.scalar(sign.limit(1)) is not None}
    return {name: use.label for name, use in FIXED_BY.items() if use in happened}


def change(
    session: Session,
    store: ArtefactStore,
    study: Study,
    *,
    name: str,
    task: str,
    seed: int | None,
    settings: StudySettings,
    actor: str,
    reason: str = "",
) -> Sequence[str]:
    """Store other settings; of a locked study they become a deviation. Returns the names of what has changed.

    ``seed`` None: as it is. Previews whose pairs would not fit any more are ended.
    Raises SettingsFixed, TaskCannot and ReasonMissing.
    """
    before = _everything(study.name, study.task, study.seed, study.settings.model_dump(mode="json"))
    seed = study.seed if seed is None else seed
    after = _everything(name, task, seed, settings.model_dump(mode="json"))
    changed = [key for key in after if before.get(key) != after[key]]
    fixed = fixed_settings(session, study)
    refused = [key for key in changed if key in fixed]
    if refused:
        raise SettingsFixed(" ".join(sorted({f"{key.replace('_', ' ')}: {fixed[key]}" for key in refused})))
    if not changed:
        return []
    task_limits.require(task, settings, recorded=study.material is not None)
    if study.lock_hash is not None:
        _note_deviation(session, study, before, after, changed, actor, reason)
    study.name, study.task, study.seed = name, task, seed
    study.stored_settings = settings.model_dump(mode="json")
    audit.record(session, actor, "settings changed", f"{study.slug}: {', '.join(changed)}", study=study)
    if FIXED_BY.keys() & {*changed}:
        _end_previews(session, store, study, actor)
    return changed


def document(study: Study) -> dict[str, Any]:
    """What locking fixes: whoever has it can say later what was planned."""
    settings = study.settings
    return {
        "format": 1,
        "study": {"name": study.name, "slug": study.slug, "task": study.task, "seed": study.seed},
        "settings": study.settings.model_dump(mode="json"),
        "plan_of_pairs": {
            "rule": "worker.jobs.learning.query_plan.plan(settings, seed of the participant)",
            "practice": settings.practice_pairs,
            "introduction": settings.introduction_count,
            "preference": settings.labels_per_participant - settings.introduction_count,
            "repeat": settings.repeated_pairs,
            "catch": settings.catch_pairs,
            "participant_seeds": [participant_seed(study.seed, number + 1) for number in range(SEEDS_LISTED)],
        },
        "stop_rule": _stop_rule(settings),
        "evaluation_key_sha256": hashlib.sha256(study.key_secret.encode()).hexdigest(),
        "planned_tests": [test.value for test in settings.planned_tests],
        "software_version": export_formats.software_version(),
    }


class LockedStudy(BaseModel):
    """What is read of the study in a locked document."""

    seed: int


class Locked(BaseModel):
    """What is read of a locked document, by whichever version it was written."""

    study: LockedStudy
    settings: dict[str, Any]
    plan_of_pairs: dict[str, Any]
    stop_rule: str
    planned_tests: list[str]
    software_version: str


def planned_settings(contents: Mapping[str, Any]) -> StudySettings:
    """The settings in a locked document; an earlier version perhaps had some that are no more."""
    locked = contents["settings"]
    return StudySettings.model_validate({name: locked[name] for name in StudySettings.model_fields if name in locked})


def canonical(contents: Mapping[str, Any]) -> bytes:
    """A document as bytes that are the same wherever it is written: JSON, keys sorted, no spaces, UTF-8."""
    return json.dumps(contents, sort_keys=True, separators=(",", ":"), ensure_ascii=False).encode()


def hash_of(contents: Mapping[str, Any]) -> str:
    """The SHA-256 of the canonical bytes."""
    return hashlib.sha256(canonical(contents)).hexdigest()


def lock(session: Session, study: Study, typed: str, actor: str) -> str:
    """Lock the study and return the hash. Raises AlreadyLocked, and NotConfirmed unless its short name was typed."""
    if study.lock_hash is not None:
        raise AlreadyLocked
    if typed.strip().lower() != study.slug:
        raise NotConfirmed
    study.lock_document = document(study)
    study.lock_hash = hash_of(study.lock_document)
    study.locked_at = now()
    audit.record(session, actor, "study locked", f"{study.slug} {study.lock_hash}", study=study)
    return study.lock_hash


def deviations(session: Session, study: Study) -> Sequence[Deviation]:
    """Every change since the study was locked, in order."""
    return session.scalars(select(Deviation).where(Deviation.study_id == study.id).order_by(Deviation.id)).all()


def previews(session: Session, study: Study) -> Sequence[Participant]:
    """The previews that have not ended."""
    theirs = select(Participant).where(Participant.study_id == study.id, Participant.is_preview.is_(True))
    return session.scalars(theirs.where(Participant.withdrawn_at.is_(None)).order_by(Participant.number)).all()


def participants(session: Session, study: Study) -> int:
    """How many people are in the study, those who withdrew included, previews not."""
    real = select(func.count(Participant.id)).where(Participant.study_id == study.id)
    return session.scalar(real.where(Participant.is_preview.is_(False))) or 0


def _everything(name: str, task: str, seed: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """With what was not stored, because the setting is younger than the study, as it is read."""
    return {"name": name, "task": str(task), "seed": seed, **_complete(settings)}


def _complete(settings: Mapping[str, Any]) -> dict[str, Any]:
    return StudySettings.model_validate(settings).model_dump(mode="json")


def _note_deviation(
    session: Session,
    study: Study,
    before: Mapping[str, Any],
    after: Mapping[str, Any],
    changed: Sequence[str],
    actor: str,
    reason: str,
) -> None:
    if not reason.strip():
        raise ReasonMissing
    session.add(
        Deviation(
            study_id=study.id,
            actor=actor,
            reason=reason.strip(),
            before={key: before.get(key) for key in changed},
            after={key: after[key] for key in changed},
        )
    )


def _end_previews(session: Session, store: ArtefactStore, study: Study, actor: str) -> None:
    for preview in previews(session, study):
        withdrawal.withdraw(session, store, preview, actor)


def _stop_rule(settings: StudySettings) -> str:
    return (
        f"Every participant is asked {settings.question_count} pairs, of which {settings.labels_per_participant} are "
        "learned from; nobody is stopped earlier, and the advisor stops nobody."
    )
