"""What every kind of recordings becomes: checked clips, and a study of them."""

import io
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from sqlalchemy.orm import Session

from app.domain.choices import Strategy
from app.domain.clips import Clip, Rollout
from app.domain.described import bounds_of
from app.domain.studies import Study
from app.domain.study_settings import StudySettings
from app.errors import AppError
from app.services import audit
from app.services.studies import studies, task_limits
from app.storage import ArtefactStore
from worker.domain.trajectory import Recording
from worker.jobs.clips.stored_video import video_columns
from worker.jobs.learning.dataset import IMPORTED
from worker.sim.render.video import PlayableVideo

TASK = "own_clips"
"""What the robot does, where the recordings do not say it."""
FEWEST_STEPS = 2
MOST_STEPS = 20_000


class ClipsInvalid(AppError):
    """These clips cannot be imported."""

    status = HTTPStatus.UNPROCESSABLE_ENTITY


@contextmanager
def naming(file: object, *what: type[Exception]) -> Iterator[None]:
    """Whatever of ``what`` is raised becomes ClipsInvalid, with the file that is wrong."""
    try:
        yield
    except what as error:
        raise ClipsInvalid(f"{file}: {str(error).strip(chr(39)) or type(error).__name__}") from error


class Signal(BaseModel):
    """Something that was measured at every step."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[a-z][a-z0-9_]{0,59}$")
    unit: str = Field(max_length=20)
    meaning: str = Field(default="", max_length=200)


@dataclass(frozen=True)
class Material:
    """What all clips of a study have in common."""

    name: str
    rate_hz: float
    signals: Sequence[Signal]
    task: str = TASK
    settings: Mapping[str, Any] = field(default_factory=dict)
    """those of the study that are not as usual"""


@dataclass(frozen=True)
class OwnClip:
    """One video with what was measured while it was filmed."""

    scenario: int
    """clips of the same number may be compared"""
    recording: Recording
    video: PlayableVideo
    origin: Mapping[str, str]
    """where it came from, and a label for experimenters to know it by"""


@dataclass(frozen=True)
class Choices:
    """What is said with the command, for layouts that have no manifest to say it in."""

    name: str | None = None
    """of the study; as a rule the folder's"""
    camera: str | None = None
    episodes: range | None = None
    """those that are imported; as a rule all"""
    signals: Sequence[str] = ()
    """features whose columns are what people may judge by; as a rule what follows from states and actions"""
    rate_hz: int = 15
    """steps per second, where the recordings do not say it; DROID's robots take 15"""


NOTHING_SAID = Choices()


class Recordings(ABC):
    """A folder of recordings in one of the layouts that are known."""

    material: Material

    @abstractmethod
    def clips(self) -> Iterator[OwnClip]:
        """One after the other, each checked. Raises ClipsInvalid, which names the file."""


@dataclass(frozen=True)
class Ready:
    """A clip whose files were looked at and stored, with the columns of its rollout and of itself."""

    scenario: int
    rollout: Mapping[str, Any]
    clip: Mapping[str, Any]
    steps: int
    columns: tuple[int, int]
    """of observations and of actions"""


def stored(store: ArtefactStore, own: OwnClip) -> Ready:
    """The clip, with its files in the store."""
    file = io.BytesIO()
    own.recording.save(file)
    rollout = {
        "mode": {IMPORTED: dict(own.origin)},
        "trajectory_sha256": store.put(file.getvalue()),
        "success": own.recording.success,
    }
    clip = {"first_step": 0, "step_count": len(own.recording), **video_columns(store, own.video)}
    columns = own.recording.observations.shape[1], own.recording.actions.shape[1]
    return Ready(own.scenario, rollout, clip, len(own.recording), columns)


def check_observations(ready: Sequence[Ready]) -> None:
    """All trajectories must have the same columns, or no model could read them all. Raises ClipsInvalid."""
    shapes = {each.columns for each in ready}
    if len(shapes) > 1:
        raise ClipsInvalid(f"Trajectories differ in how many observations and actions they have: {sorted(shapes)}.")


def settings_of(material: Material, ready: Sequence[Ready]) -> StudySettings:
    """What was said; the rest follows from the clips. Raises ClipsInvalid for what needs a simulator."""
    per_scenario = Counter(each.scenario for each in ready)
    pairs = sum(map(_pairs, per_scenario.values()))
    alone = [scenario for scenario, count in per_scenario.items() if count < 2]
    if alone:
        raise ClipsInvalid(f"Scenario {alone[0]} has one clip only; clips are compared within a scenario.")
    longest = max(each.steps for each in ready)
    fewest_steps, most_steps = bounds_of(StudySettings, "clip_steps")
    _, most_behaviours = bounds_of(StudySettings, "behaviours_per_scenario")
    _, most_scenarios = bounds_of(StudySettings, "pool_scenarios")
    scenarios = min(most_scenarios, len(per_scenario))
    # Scenarios may have different numbers of clips; the settings know one, and promise no pair that is not there.
    behaviours = max(each for each in range(2, most_behaviours + 1) if each == 2 or scenarios * _pairs(each) <= pairs)
    most_labels = StudySettings.model_fields["labels_per_participant"].default
    usual: dict[str, Any] = {
        "strategy": Strategy.UNIFORM,
        "pool_scenarios": scenarios,
        "behaviours_per_scenario": behaviours,
        "clip_steps": min(max(longest, fewest_steps), most_steps),
        "labels_per_participant": min(most_labels, scenarios * _pairs(behaviours)),
        "filter_milestones": (),
    }
    try:
        settings = StudySettings.model_validate({**usual, **material.settings})
    except ValidationError as error:
        raise ClipsInvalid(f"settings: {in_words(error)} The clips make {pairs} pairs.") from error
    wrong = task_limits.needing_a_simulator(settings)
    if wrong:
        raise ClipsInvalid(f"settings: {', '.join(wrong)} need the simulator and cannot be had with own clips.")
    return settings


def _pairs(clips: int) -> int:
    return clips * (clips - 1) // 2


def in_words(error: ValidationError) -> str:
    """The first thing that is wrong, with its place."""
    first = error.errors()[0]
    place = ".".join(str(part) for part in first["loc"]) or "it"
    return f"{place}: {first['msg']}."


def save(session: Session, material: Material, settings: StudySettings, ready: Sequence[Ready], actor: str) -> Study:
    """The study with all its clips."""
    study = Study(
        slug=studies.free_slug(session, material.name),
        name=material.name,
        task=material.task,
        stored_settings=settings.model_dump(mode="json"),
        seed=studies.new_seed(),
        material={"rate_hz": material.rate_hz, "signals": [signal.model_dump() for signal in material.signals]},
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
