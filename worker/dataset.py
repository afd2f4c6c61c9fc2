"""From rows to arrays: what was shown and said, as the learning code wants it.

``target_of`` is the one place where a response becomes a number.
"""

import hashlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session, joinedload

from app.domain.clips import Clip, Rollout
from app.domain.preferences import Label, Query, Response, current_labels
from app.storage import ArtefactStore
from worker.trajectory import Array, Trajectory

_TARGETS = {Response.LEFT: 0.0, Response.EQUAL: 0.5, Response.RIGHT: 1.0, Response.SKIP: None}


def target_of(response: Response) -> float | None:
    """The paper's y: P(right preferred), left being sigma^0 and right sigma^1. "Can't tell" says nothing: None."""
    return _TARGETS[response]


@dataclass(frozen=True)
class PairArrays:
    """N pairs of segments of T steps; index 0 of the second axis is the left one."""

    observations: Array
    """(N, 2, T, D)"""
    actions: Array
    """(N, 2, T, 7)"""
    signals: Array
    """(N, 2, T, S)"""


@dataclass(frozen=True)
class Preferences:
    """Everything one participant has said that a reward model may learn from."""

    pairs: PairArrays
    targets: Array
    """(N,) in {0, 1/2, 1}"""
    label_count: int
    """How many answers were given, those without a target included."""
    label_hash: str


@dataclass(frozen=True)
class PoolClip:
    """A clip that can be shown, with the scenario it must share with its partner."""

    clip_id: int
    scenario: int


def label_hash(labels: Sequence[Label]) -> str:
    """A fingerprint of who was shown what and said what: the same labels give the same hash on any machine."""
    lines = [
        f"{each.query.ordinal} {each.query.left_clip.video_sha256} {each.query.right_clip.video_sha256} {each.response}"
        for each in labels
    ]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def labels_with_clips(session: Session, participant_id: int) -> Sequence[Label]:
    """The participant's current labels, each with its clips and their rollouts loaded."""
    clips = (joinedload(Query.left_clip), joinedload(Query.right_clip))
    session.scalars(
        select(Query)
        .where(Query.participant_id == participant_id)
        .options(*(clip.joinedload(Clip.rollout) for clip in clips))
    ).all()
    return current_labels(session, participant_id)


def load_preferences(session: Session, store: ArtefactStore, participant_id: int) -> Preferences:
    """The participant's labels as arrays; pairs without a target are left out."""
    labels = labels_with_clips(session, participant_id)
    said = [(label, target) for label in labels if (target := target_of(label.response)) is not None]
    return Preferences(
        pairs=pair_arrays(store, [(label.query.left_clip, label.query.right_clip) for label, _ in said]),
        targets=np.array([target for _, target in said], np.float32),
        label_count=len(labels),
        label_hash=label_hash(labels),
    )


def pair_arrays(store: ArtefactStore, pairs: Sequence[tuple[Clip, Clip]]) -> PairArrays:
    """The segments of N pairs of clips. All clips of one study show equally many steps."""
    segments = [[_segment(store, clip) for clip in pair] for pair in pairs]

    def stacked(name: str) -> Array:
        return np.array([[getattr(segment, name) for segment in pair] for pair in segments], np.float32)

    return PairArrays(stacked("observations"), stacked("actions"), stacked("signals"))


def pool_clips(session: Session, study_id: int) -> Sequence[PoolClip]:
    """Every clip of the study's pool."""
    rows = session.execute(
        select(Clip.id, Rollout.scenario).join(Rollout).where(Rollout.study_id == study_id).order_by(Clip.id)
    )
    return [PoolClip(clip_id, scenario) for clip_id, scenario in rows]


@dataclass(frozen=True)
class _Segment:
    observations: Array
    actions: Array
    signals: Array


def _segment(store: ArtefactStore, clip: Clip) -> _Segment:
    trajectory = _trajectory(store.path(clip.rollout.trajectory_sha256))
    steps = slice(clip.first_step, clip.first_step + clip.step_count)
    return _Segment(trajectory.observations[steps], trajectory.actions[steps], trajectory.signals[steps])


@lru_cache(maxsize=1024)
def _trajectory(path: Path) -> Trajectory:
    return Trajectory.load(io.BytesIO(path.read_bytes()))
