"""Bring your own clips: a folder or zip of recordings and videos becomes a study (docs/own_clips.md has the layout).

Everything is read and checked before anything is kept, and a message says in which file what is wrong.
"""

import csv
import io
import json
import re
import zipfile
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.choices import RewardKind, Strategy
from app.domain.clips import Clip, Rollout
from app.domain.described import bounds_of
from app.domain.studies import NAME_LENGTH, Study
from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.services import audit
from app.services.archives import unpacking
from app.services.participants import withdrawal
from app.services.studies import studies
from app.storage import ArtefactStore
from worker.jobs.clips.stored_video import video_columns
from worker.jobs.learning.dataset import IMPORTED
from worker.jobs.runtime.context import NotingStore
from worker.sim.render.video import PlayableVideo, playable
from worker.trajectory import Recording
from worker.type_aliases import Float32Array

FORMAT, VERSION = "pbarl-studio-clips", 1
MANIFEST = "manifest.json"
LARGEST_MANIFEST_BYTES, LARGEST_TRAJECTORY_BYTES, LARGEST_VIDEO_BYTES = 8 << 20, 64 << 20, 256 << 20
LARGEST_UNPACKED_BYTES = 64 << 30
LONGEST_DIFFERENCE_S = 0.5
"""Between a video and its trajectory."""
FEWEST_STEPS = 2


class ClipsInvalid(AppError):
    """These clips cannot be imported."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Signal(_Entry):
    """Something that was measured at every step."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,59}$")
    unit: str = Field(max_length=20)
    meaning: str = Field(default="", max_length=200)


class OwnClip(_Entry):
    """One video with what was measured while it was filmed."""

    video: str
    trajectory: str
    scenario: int = Field(ge=0, le=10**9, description="Clips of the same number may be compared.")
    success: bool = True
    label: str = Field(default="", max_length=200)


class ClipManifest(_Entry):
    """manifest.json"""

    format: Literal["pbarl-studio-clips"]
    version: Literal[1]
    name: str = Field(min_length=1, max_length=NAME_LENGTH)
    task: str = Field(default="own_clips", pattern=r"^[a-z][a-z0-9_]{0,39}$")
    rate_hz: float = Field(gt=0, le=1000)
    signals: tuple[Signal, ...] = Field(min_length=1, max_length=200)
    clips: tuple[OwnClip, ...] = Field(min_length=2, max_length=5000)
    settings: dict[str, Any] = Field(default_factory=dict)


class Source(ABC):
    """Where files come from; names are relative, with slashes."""

    @abstractmethod
    def read(self, name: str, most_bytes: int) -> bytes:
        """The file of that name. Raises ClipsInvalid when there is none, or when it is larger than that."""


class Folder(Source):
    """A directory; nothing outside it is read."""

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()

    def read(self, name: str, most_bytes: int) -> bytes:
        """See Source."""
        path = (self._root / name).resolve()
        if not path.is_relative_to(self._root) or not path.is_file():
            raise ClipsInvalid(f"There is no file {name} in this folder.")
        if path.stat().st_size > most_bytes:
            raise ClipsInvalid(f"{name} is larger than {most_bytes / 1e6:.0f} MB.")
        return path.read_bytes()


class Zip(Source):
    """A zip file, whose contents may lie in one folder of their own."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        inside = [PurePosixPath(name) for name in archive.namelist()]
        self._prefix = next((path.parent for path in inside if path.name == MANIFEST), PurePosixPath())

    def read(self, name: str, most_bytes: int) -> bytes:
        """See Source."""
        try:
            return unpacking.content(self._archive, str(self._prefix / name), most_bytes)
        except unpacking.UNREADABLE as error:
            raise ClipsInvalid(f"There is no file {name} in this zip file, or it is damaged.") from error


@dataclass(frozen=True)
class _Ready:
    """A clip whose files were looked at and stored, with the columns of its rollout and of itself."""

    scenario: int
    rollout: Mapping[str, Any]
    clip: Mapping[str, Any]
    steps: int
    columns: tuple[int, int]
    """of observations and of actions"""


def import_clips(database: Database, store: ArtefactStore, path: Path, actor: str = audit.SYSTEM) -> str:
    """Make a study of a folder or zip file; returns its slug. Raises ClipsInvalid."""
    if path.is_dir():
        return _import(database, store, Folder(path), actor)
    try:
        with unpacking.opened(path, LARGEST_UNPACKED_BYTES) as archive:
            return _import(database, store, Zip(archive), actor)
    except unpacking.ZipRefused as error:
        raise ClipsInvalid(f"{path} is not read: {error}.") from error
    except (OSError, zipfile.BadZipFile) as error:
        raise ClipsInvalid(f"{path} is neither a folder nor a zip file.") from error


def _import(database: Database, store: ArtefactStore, source: Source, actor: str) -> str:
    """Files are stored one clip after the other, and go again when one of them is wrong."""
    noted = set[str]()
    shelf = NotingStore(store, noted)
    try:
        manifest = _manifest(source)
        ready = [_read(shelf, source, manifest, clip) for clip in manifest.clips]
        _check_observations(ready)
        settings = _settings(manifest, ready)
        with database.writing() as session:
            return _save(session, manifest, settings, ready, actor).slug
    except BaseException:
        with database.writing() as session:  # nobody can begin to refer to one of them meanwhile
            for sha256 in noted - withdrawal.in_use(session, noted):
                store.delete(sha256)
        raise


def _manifest(source: Source) -> ClipManifest:
    try:
        return ClipManifest.model_validate(json.loads(source.read(MANIFEST, LARGEST_MANIFEST_BYTES)))
    except ValidationError as error:
        raise ClipsInvalid(f"{MANIFEST}: {_in_words(error)}") from error
    except (ValueError, RecursionError) as error:
        raise ClipsInvalid(f"{MANIFEST} is not JSON: {error}.") from error


def _in_words(error: ValidationError) -> str:
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"]) or "it"
    return f"{place}: {first['msg']}."


def _read(store: ArtefactStore, source: Source, manifest: ClipManifest, clip: OwnClip) -> _Ready:
    recording = _recording(source.read(clip.trajectory, LARGEST_TRAJECTORY_BYTES), manifest, clip)
    try:
        video = playable(source.read(clip.video, LARGEST_VIDEO_BYTES))
    except ValueError as error:
        raise ClipsInvalid(f"{clip.video} is {error}.") from error
    lasts_s = len(recording) / manifest.rate_hz
    if abs(lasts_s - video.duration_ms / 1000) > LONGEST_DIFFERENCE_S:
        raise ClipsInvalid(
            f"{clip.trajectory} lasts {lasts_s:.1f} s ({len(recording)} steps at {manifest.rate_hz:g} Hz), but "
            f"{clip.video} lasts {video.duration_ms / 1000:.1f} s. They must be of the same stretch of time."
        )
    return _stored(store, clip, recording, video)


def _recording(content: bytes, manifest: ClipManifest, clip: OwnClip) -> Recording:
    read = _from_csv if clip.trajectory.lower().endswith(".csv") else _from_npz
    names = [signal.name for signal in manifest.signals]
    try:
        signals, observations, actions = read(content, names)
        if len(signals) < FEWEST_STEPS:
            raise ValueError(f"only {len(signals)} steps")
        if len(observations) == len(signals):  # nothing was observed after the last step: the last is the best guess
            observations = np.concatenate([observations, observations[-1:]])
        return Recording(signals, observations, actions, clip.success)
    except (ValueError, MemoryError, csv.Error, *unpacking.UNREADABLE) as error:
        raise ClipsInvalid(f"{clip.trajectory}: {str(error).strip(chr(39))}") from error


def _from_csv(content: bytes, names: Sequence[str]) -> tuple[Float32Array, Float32Array, Float32Array]:
    """A row per step. Columns by name: the signals, and observations obs_0.. and actions act_0.. if there are any."""
    rows = list(csv.reader(io.StringIO(content.decode("utf-8-sig"), newline="")))
    if not rows:
        raise ValueError("the file is empty")
    header = [cell.strip() for cell in rows[0]]
    missing = [name for name in names if name not in header]
    if missing:
        raise ValueError(f"the column {missing[0]} is missing")
    if any(len(row) != len(header) for row in rows[1:]):
        raise ValueError("rows are not all as long as the header")
    values = np.array([[float(cell) for cell in row] for row in rows[1:]], np.float32).reshape(-1, len(header))
    return (
        values[:, [header.index(name) for name in names]],
        values[:, _numbered(header, "obs")],
        values[:, _numbered(header, "act")],
    )


def _numbered(header: Sequence[str], prefix: str) -> list[int]:
    """Places of the columns prefix_0, prefix_1, ... in the order of their numbers."""
    found = [
        (int(match[1]), place) for place, name in enumerate(header) if (match := re.fullmatch(rf"{prefix}_(\d+)", name))
    ]
    return [place for _, place in sorted(found)]


def _from_npz(content: bytes, names: Sequence[str]) -> tuple[Float32Array, Float32Array, Float32Array]:
    """signals (T, S) in the manifest's order, and observations (T or T + 1, D) and actions (T, A) if there are any."""
    with unpacking.opened(io.BytesIO(content), LARGEST_TRAJECTORY_BYTES):
        pass  # what it would unpack to is looked at before numpy does that
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        signals = np.asarray(stored["signals"], np.float32)
        if signals.ndim != 2 or signals.shape[1] != len(names):
            raise ValueError(f"signals has shape {signals.shape}, expected (steps, {len(names)})")
        nothing = np.zeros((len(signals), 0), np.float32)
        observations = np.asarray(stored["observations"], np.float32) if "observations" in stored else nothing
        actions = np.asarray(stored["actions"], np.float32) if "actions" in stored else nothing
    return signals, observations, actions


def _check_observations(ready: Sequence[_Ready]) -> None:
    """All trajectories must have the same columns, or no model could read them all."""
    shapes = {each.columns for each in ready}
    if len(shapes) > 1:
        raise ClipsInvalid(f"Trajectories differ in how many observations and actions they have: {sorted(shapes)}.")


def _settings(manifest: ClipManifest, ready: Sequence[_Ready]) -> StudySettings:
    """What the manifest says; the rest follows from the clips. Raises ClipsInvalid for what needs a simulator."""
    per_scenario = Counter(each.scenario for each in ready)
    pairs = sum(count * (count - 1) // 2 for count in per_scenario.values())
    alone = [scenario for scenario, count in per_scenario.items() if count < 2]
    if alone:
        raise ClipsInvalid(f"Scenario {alone[0]} has one clip only; clips are compared within a scenario.")
    longest = max(each.steps for each in ready)
    fewest_steps, most_steps = bounds_of(StudySettings, "clip_steps")
    _, most_behaviours = bounds_of(StudySettings, "behaviours_per_scenario")
    usual: dict[str, Any] = {
        "strategy": Strategy.UNIFORM,
        "pool_scenarios": len(per_scenario),
        "behaviours_per_scenario": min(most_behaviours, *per_scenario.values()),
        "clip_steps": min(max(longest, fewest_steps), most_steps),
        "labels_per_participant": min(StudySettings.model_fields["labels_per_participant"].default, pairs),
        "filter_milestones": (),
    }
    try:
        settings = StudySettings.model_validate({**usual, **manifest.settings})
    except ValidationError as error:
        raise ClipsInvalid(f"{MANIFEST}, settings: {_in_words(error)} The clips make {pairs} pairs.") from error
    needs_a_simulator = {
        "evaluation": settings.evaluation is not None,
        "debrief": settings.debrief,
        "catch_pairs": settings.catch_pairs > 0,
        "reward_kind": settings.reward_kind is not RewardKind.STRUCTURED,
        "pooled_prior": settings.pooled_prior,
        "strategy": settings.strategy is Strategy.CONTESTED,
    }
    wrong = [name for name, needed in needs_a_simulator.items() if needed]
    if wrong:
        raise ClipsInvalid(
            f"{MANIFEST}, settings: {', '.join(wrong)} need the simulator and cannot be had with own clips."
        )
    return settings


def _stored(store: ArtefactStore, own: OwnClip, recording: Recording, video: PlayableVideo) -> _Ready:
    file = io.BytesIO()
    recording.save(file)
    mode = {IMPORTED: {"video": own.video, "trajectory": own.trajectory, "label": own.label}}
    rollout = {"mode": mode, "trajectory_sha256": store.put(file.getvalue()), "success": recording.success}
    clip = {"first_step": 0, "step_count": len(recording), **video_columns(store, video)}
    columns = recording.observations.shape[1], recording.actions.shape[1]
    return _Ready(own.scenario, rollout, clip, len(recording), columns)


def _save(
    session: Session,
    manifest: ClipManifest,
    settings: StudySettings,
    ready: Sequence[_Ready],
    actor: str,
) -> Study:
    study = Study(
        slug=studies.free_slug(session, manifest.name),
        name=manifest.name,
        task=manifest.task,
        stored_settings=settings.model_dump(mode="json"),
        seed=studies.new_seed(),
        material={"rate_hz": manifest.rate_hz, "signals": [signal.model_dump() for signal in manifest.signals]},
    )
    session.add(study)
    session.flush()
    behaviours: Counter[int] = Counter()
    for each in ready:
        behaviour = behaviours[each.scenario]
        known = Rollout(study_id=study.id, scenario=each.scenario, behaviour=behaviour, **each.rollout)
        behaviours[each.scenario] += 1
        session.add(known)
        session.flush()
        session.add(Clip(rollout_id=known.id, **each.clip))
    audit.record(session, actor, "clips imported", f"{study.slug} ({len(ready)} clips)", study=study)
    return study
