"""The studio's own layout of recordings: a folder or zip with a manifest (docs/own_clips.md)."""

import csv
import io
import json
import re
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.domain.studies import NAME_LENGTH
from app.services.archives import unpacking
from worker.domain.trajectory import Recording
from worker.domain.type_aliases import Float32Array
from worker.jobs.clips.own_clips import (
    FEWEST_STEPS,
    TASK,
    ClipsInvalid,
    Material,
    OwnClip,
    Recordings,
    Signal,
    in_words,
)
from worker.sim.render.video import playable

MANIFEST = "manifest.json"
LARGEST_MANIFEST_BYTES, LARGEST_TRAJECTORY_BYTES, LARGEST_VIDEO_BYTES = 8 << 20, 64 << 20, 256 << 20
LONGEST_DIFFERENCE_S = 0.5
"""Between a video and its trajectory."""


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class ClipEntry(_Entry):
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
    task: str = Field(default=TASK, pattern=r"^[a-z][a-z0-9_]{0,39}$")
    rate_hz: float = Field(gt=0, le=1000)
    signals: tuple[Signal, ...] = Field(min_length=1, max_length=200)
    clips: tuple[ClipEntry, ...] = Field(min_length=2, max_length=5000)
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


class Manifested(Recordings):
    """Recordings that a manifest lists."""

    def __init__(self, source: Source) -> None:
        """Raises ClipsInvalid for a manifest that is not as documented."""
        self._source = source
        self._manifest = _manifest(source)
        said = self._manifest
        self.material = Material(said.name, said.rate_hz, said.signals, said.task, said.settings)

    def clips(self) -> Iterator[OwnClip]:
        """See Recordings."""
        for each in self._manifest.clips:
            yield _read(self._source, self._manifest, each)


def _manifest(source: Source) -> ClipManifest:
    try:
        return ClipManifest.model_validate(json.loads(source.read(MANIFEST, LARGEST_MANIFEST_BYTES)))
    except ValidationError as error:
        raise ClipsInvalid(f"{MANIFEST}: {in_words(error)}") from error
    except (ValueError, RecursionError) as error:
        raise ClipsInvalid(f"{MANIFEST} is not JSON: {error}.") from error


def _read(source: Source, manifest: ClipManifest, clip: ClipEntry) -> OwnClip:
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
    origin = {"video": clip.video, "trajectory": clip.trajectory, "label": clip.label}
    return OwnClip(clip.scenario, recording, video, origin)


def _recording(content: bytes, manifest: ClipManifest, clip: ClipEntry) -> Recording:
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
