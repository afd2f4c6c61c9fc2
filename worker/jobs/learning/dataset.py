"""From rows to arrays: what was shown and said, as the learning code wants it."""

import hashlib
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from sqlalchemy import select
from sqlalchemy.orm import Session, contains_eager, joinedload

from app.domain.clips import Clip, Rollout
from app.domain.hints import hints_of
from app.domain.preferences import Label, Query, count_labels, current_labels
from app.domain.studies import Participant, Study
from app.errors import AppError
from app.files.interface import Files
from app.installed_tasks import hints, qualities
from app.services.participants import visits
from app.storage import ArtefactStore
from worker.domain.responses import TARGETS
from worker.domain.trajectory import OutdatedTrajectory, Recorded, Recording, Trajectory
from worker.domain.type_aliases import Float32Array, FloatArray
from worker.ml import acquisition
from worker.ml.rewards.hint_directions import direction
from worker.ml.rewards.segments import SegmentPairs, Stretch
from worker.ml.rewards.signal_scale import SignalScale
from worker.tasks import registry


class RecordedByAnOlderVersion(AppError):
    """This study's clips were recorded by an older version in another simulation. Make a new study to go on."""


IMPORTED = "imported"
"""In a rollout's mode: it was recorded elsewhere, and this says where it came from."""

CLIPS_AND_ROLLOUTS = (
    joinedload(Query.left_clip).joinedload(Clip.rollout),
    joinedload(Query.right_clip).joinedload(Clip.rollout),
)


@dataclass(frozen=True)
class Preferences:
    """Everything one participant has said that a reward model may learn from."""

    pairs: SegmentPairs | None
    """None while nothing with a target has been said."""
    targets: Float32Array
    """(N,) in {0, 1/2, 1}"""
    mattered: npt.NDArray[np.bool_]
    """(N, S) which signals made the difference, as far as somebody said so"""
    hints: FloatArray
    """(H, S) which way this person wishes the signals, see worker.ml.rewards.hint_directions"""
    label_count: int
    """How many labels were given at this visit, those without a target and those that were excluded included."""
    label_hash: str


def label_hash(labels: Sequence[Label], given: Sequence[str] = ()) -> str:
    """A fingerprint of who was shown what and said what: the same labels give the same hash on any machine.

    ``given``: the names of hints.
    """
    lines = [
        f"{each.query.ordinal} {each.query.left_clip.video_sha256} {each.query.right_clip.video_sha256} {each.response}"
        + (f" {each.event.mattered}" if each.event.mattered else "")
        for each in labels
    ]
    lines += [f"hint {name}" for name in given]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def labels_with_clips(session: Session, participant_id: int) -> Sequence[Label]:
    """The participant's current labels that are not excluded, each with its clips and their rollouts loaded."""
    return current_labels(session, participant_id, *CLIPS_AND_ROLLOUTS)


def load_preferences(
    session: Session, store: ArtefactStore, participant_id: int, first: int | None = None
) -> Preferences:
    """The participant's labels as arrays; pairs without a target, and excluded ones, are left out.

    Those of the visits before come first; hints are the newest that were given. ``first``: of this visit's, only so
    many.
    """
    given = count_labels(session, select(Participant.id).where(Participant.id == participant_id))
    people = [*visits.before(session, participant_id), participant_id]
    before = [label for each in people[:-1] for label in labels_with_clips(session, each)]
    labels = [*before, *labels_with_clips(session, participant_id)[:first]]
    said = [(label, target) for label in labels if (target := TARGETS[label.response]) is not None]
    study = session.get_one(Study, session.get_one(Participant, participant_id).study_id)
    hinted = next(filter(None, (hints_of(session, each) for each in reversed(people))), ())
    return Preferences(
        pairs=segment_pairs(store, [(each.query.left_clip, each.query.right_clip) for each, _ in said])
        if said
        else None,
        targets=np.array([target for _, target in said], np.float32),
        mattered=named_signals(study, [label.event.mattered for label, _ in said]),
        label_count=min(given.get(participant_id, 0), sys.maxsize if first is None else first),
        hints=directions(study, hinted),
        label_hash=label_hash(labels, hinted),
    )


def named_signals(study: Study, said: Sequence[str | None]) -> npt.NDArray[np.bool_]:
    """(N, S) the signals that each named quality is about; none where nothing was said."""
    known, groups = list(signal_names(study)), qualities.of_task(study.task)
    return np.array([np.isin(known, groups.get(name or "", ())) for name in said], bool).reshape(len(said), len(known))


def directions(study: Study, given: Sequence[str]) -> FloatArray:
    """(H, S) of the hints with these names; of what the task does not know any more, nothing."""
    known, names = hints.of_task(study.task), signal_names(study)
    found = [direction(names, known[name]) for name in given if name in known]
    return np.array(found).reshape(len(found), len(names))


def segment_pairs(store: ArtefactStore, pairs: Sequence[tuple[Clip, Clip]]) -> SegmentPairs:
    """The segments shown by one or more pairs of clips, left first; whole trajectories may be among them."""
    return SegmentPairs.of([(stretch(store, left), stretch(store, right)) for left, right in pairs])


def stretch(store: ArtefactStore, clip: Clip) -> Stretch:
    """What a clip shows, simulated here or recorded elsewhere."""
    trajectory = _recorded(store, clip.rollout.trajectory_sha256, IMPORTED in clip.rollout.mode)
    return Stretch(trajectory, clip.first_step, clip.step_count)


def pool_clips(session: Session, study_id: int) -> Sequence[Clip]:
    """Every clip of the study's pool with its rollout; of imported clips all, whatever their length. What was made for
    one person is not among them."""
    study = session.get_one(Study, study_id)
    return _clips(session, study, study.settings.clip_steps)


def whole_clips(session: Session, study_id: int) -> Sequence[Clip]:
    """Clips of whole episodes with their rollouts; of imported clips all."""
    study = session.get_one(Study, study_id)
    return _clips(session, study, study.whole_clip_steps)


def made_clips(session: Session, participant_id: int, since: datetime) -> Sequence[Clip]:
    """Clips that were made for one person since a moment, with their rollouts; two of each scenario, a pair."""
    theirs = select(Clip).join(Rollout).where(Rollout.participant_id == participant_id, Rollout.created_at >= since)
    return session.scalars(theirs.order_by(Clip.id).options(contains_eager(Clip.rollout))).all()


def _clips(session: Session, study: Study, step_count: int | None) -> Sequence[Clip]:
    of_study = select(Clip).join(Rollout).where(Rollout.study_id == study.id, Rollout.participant_id.is_(None))
    if study.material is None:
        of_study = of_study.where(Clip.step_count == step_count)
    return session.scalars(of_study.order_by(Clip.id).options(contains_eager(Clip.rollout))).all()


def matched_pairs(clips: Sequence[Clip]) -> list[tuple[Clip, Clip]]:
    """Every pair of clips of the same scenario, with their rollouts loaded."""
    rows = acquisition.matched_pairs([clip.rollout.scenario for clip in clips])
    return [(clips[first], clips[second]) for first, second in rows]


def signal_scale(session: Session, store: ArtefactStore, study_id: int) -> SignalScale:
    """What the signals are like in the study's pool: in the clips that can be asked about, and in their episodes."""
    clips = pool_clips(session, study_id)
    episodes = [stretch(store, clip).trajectory for clip in clips]
    means = [each.signals.mean(axis=0, dtype=np.float64) for each in episodes]
    return SignalScale.of(segment_pairs(store, matched_pairs(clips)), means)


def shown(store: ArtefactStore, clip: Clip) -> Trajectory:
    """The whole simulated trajectory that a clip shows a stretch of."""
    return _trajectory(store.root, store.files, clip.rollout.trajectory_sha256)


def signal_names(study: Study) -> Sequence[str]:
    """Names, with units, of the columns of signals in the study's trajectories."""
    return (
        registry.task(study.task).signals
        if study.material is None
        else [each["name"] for each in study.material["signals"]]
    )


def stored_trajectory(store: ArtefactStore, sha256: str) -> Trajectory:
    """A trajectory by the hash of its file."""
    return _trajectory(store.root, store.files, sha256)


def _recorded(store: ArtefactStore, sha256: str, imported: bool) -> Recorded:
    return (_recording if imported else _trajectory)(store.root, store.files, sha256)


@lru_cache(maxsize=1024)
def _recording(root: Path, files: Files, sha256: str) -> Recording:
    return Recording.load(io.BytesIO(ArtefactStore(root, files).read(sha256)))


@lru_cache(maxsize=1024)
def _trajectory(root: Path, files: Files, sha256: str) -> Trajectory:
    try:
        return Trajectory.load(io.BytesIO(ArtefactStore(root, files).read(sha256)))
    except OutdatedTrajectory as error:
        raise RecordedByAnOlderVersion from error
