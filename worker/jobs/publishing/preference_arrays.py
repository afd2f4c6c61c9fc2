"""Preference pairs as plain arrays, one .npz file per participant, for other learning libraries (docs/arrays.md)."""

import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy.orm import Session

from app.domain.preferences import Label
from app.domain.studies import Participant, Study
from app.services.exports import export_formats
from app.storage import ArtefactMissing, ArtefactStore
from worker.domain.responses import TARGETS
from worker.domain.type_aliases import Float32Array
from worker.jobs.learning import dataset
from worker.ml.rewards.segments import SegmentPairs, Stretch

LAYOUT = 1
"""Version of the layout in docs/arrays.md."""


def arrays_of(
    session: Session, store: ArtefactStore, study: Study, participant: Participant, lost: set[str]
) -> bytes | None:
    """The participant's labels as one .npz file; None when nothing with a target was said.

    Pairs whose recordings cannot be read are left out, and the recordings' hashes added to ``lost``.
    """
    labels = dataset.labels_with_clips(session, participant.id)
    answered = [(each, target) for each in labels if (target := TARGETS[each.response]) is not None]
    said = [(each, target, both) for each, target in answered if (both := _stretches(store, each, lost))]
    if not said:
        return None
    stretches = [both for _, _, both in said]
    pairs = SegmentPairs.of(stretches)
    about = {
        "layout": LAYOUT,
        "study": study.slug,
        "participant": participant.code,
        "lock_hash": study.lock_hash,
        "deviations": export_formats.provenance_of(session, study).deviations,
        "target": "P(right preferred); left is index 0 of the second axis, right is index 1",
    }
    file = io.BytesIO()
    np.savez_compressed(
        file,
        allow_pickle=False,
        observations=pairs.observations,
        last_observations=_last_observations(stretches),
        actions=pairs.actions,
        signals=pairs.signals,
        masks=pairs.shown,
        targets=np.array([value for _, value, _ in said], np.float32),
        ordinals=np.array([label.query.ordinal for label, _, _ in said], np.int64),
        purposes=_texts([label.query.purpose for label, _, _ in said]),
        responses=_texts([label.response.value for label, _, _ in said]),
        clip_ids=np.array([_clip_ids(label) for label, _, _ in said]),
        signal_names=_texts(dataset.signal_names(study)),
        about=np.array(json.dumps(about)),
    )
    return file.getvalue()


def _stretches(store: ArtefactStore, label: Label, lost: set[str]) -> tuple[Stretch, Stretch] | None:
    """Left and right; None when one of them cannot be read."""
    found = []
    for clip in (label.query.left_clip, label.query.right_clip):
        try:
            found.append(dataset.stretch(store, clip))
        except (ArtefactMissing, dataset.RecordedByAnOlderVersion):
            lost.add(clip.rollout.trajectory_sha256)
    return (found[0], found[1]) if len(found) == 2 else None


def _last_observations(pairs: Sequence[tuple[Stretch, Stretch]]) -> Float32Array:
    """(N, 2, D) what was observed after the last step that was shown."""
    return np.array(
        [[side.trajectory.observations[side.first_step + side.step_count] for side in pair] for pair in pairs],
        np.float32,
    )


def _clip_ids(label: Label) -> list[str]:
    return [label.query.left_clip.video_sha256, label.query.right_clip.video_sha256]


def _texts(values: Sequence[str]) -> npt.NDArray[Any]:
    return np.array(list(values), dtype=str)
