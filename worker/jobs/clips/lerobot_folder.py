"""A LeRobotDataset of version 3 as recordings: Parquet, MP4 and their metadata, of which one camera is shown.

Layout: huggingface/lerobot, src/lerobot/datasets/utils.py. Paths are made here from numbers, whatever templates the
metadata name, so nothing outside the folder is read.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from app.domain.described import bounds_of
from app.domain.studies import NAME_LENGTH
from app.domain.study_settings import StudySettings
from worker.domain.trajectory import Recording
from worker.domain.type_aliases import Float32Array
from worker.jobs.clips import derived_signals, parquet_columns
from worker.jobs.clips.own_clips import (
    FEWEST_STEPS,
    MOST_STEPS,
    Choices,
    ClipsInvalid,
    Material,
    OwnClip,
    Recordings,
    Signal,
    in_words,
    naming,
)
from worker.jobs.clips.parquet_columns import ParquetRefused
from worker.sim.render.video_cutting import cut_by_time

INFO = "meta/info.json"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
STATE, ACTION, SIGNALS, SUCCESS = "observation.state", "action", "signals", "next.success"
"""Features; those named signals are ours, of a study that was exported."""
SCENARIO = "scenario"
"""Column of the episodes in our exports: which may be compared."""
LARGEST_INFO_BYTES = 8 << 20
MOST_EPISODES_FILES = 1000
MOST_EPISODES = 4000
WIDEST = 200
LARGEST_NUMBER = 10**9
NUMERIC = re.compile(r"(float|u?int)(8|16|32|64)|bool")


class Feature(BaseModel):
    """What info.json says of a column."""

    model_config = ConfigDict(frozen=True)

    dtype: str
    shape: tuple[int, ...] = ()
    names: Any = None
    units: Any = None

    @property
    def width(self) -> int | None:
        """Numbers a row; None for what is no vector of numbers."""
        one = len(self.shape) == 1 and 1 <= self.shape[0] <= WIDEST and NUMERIC.fullmatch(self.dtype)
        return self.shape[0] if one else None


class Info(BaseModel):
    """meta/info.json, as far as it is used."""

    model_config = ConfigDict(frozen=True)

    codebase_version: str = Field(max_length=20)
    fps: int = Field(ge=1, le=240)
    features: dict[str, Feature] = Field(max_length=1000)
    data_path: str = DATA_PATH
    video_path: str | None = None


@dataclass(frozen=True)
class Episode:
    """One row of meta/episodes."""

    index: int
    length: int
    task: str
    data: tuple[int, int]
    """chunk and file"""
    video: tuple[int, int]
    from_s: float
    scenario: int | None

    def check(self) -> None:
        """Raises ParquetRefused for numbers that cannot be."""
        numbers = (*self.data, *self.video, self.index, self.scenario or 0)
        if not all(0 <= each < LARGEST_NUMBER for each in numbers) or not 0 <= self.from_s < LARGEST_NUMBER:
            raise ParquetRefused(f"episode {self.index} has numbers that cannot be: {numbers}, {self.from_s} s")
        if not FEWEST_STEPS <= self.length <= MOST_STEPS:
            raise ParquetRefused(
                f"episode {self.index} has {self.length} steps; {FEWEST_STEPS} to {MOST_STEPS} are read. "
                "Leave it out with --episodes FIRST:END"
            )


class LerobotFolder(Recordings):
    """Episodes of one dataset."""

    def __init__(self, root: Path, choices: Choices) -> None:
        """Raises ClipsInvalid."""
        self._root = root.resolve()
        self._info = _info(self._inside(INFO))
        self._camera = _camera(self._info, choices.camera)
        self._signals = _signal_features(self._info, choices.signals)
        self._vectors = [each for each in (STATE, ACTION) if self._width(each)]
        named = [signal for each in self._signals for signal in _signals(each, self._info.features[each])]
        derived = derived_signals.signals(STATE in self._vectors, ACTION in self._vectors)
        name = choices.name or root.resolve().name
        self.material = Material(name[:NAME_LENGTH], self._info.fps, tuple(named) or derived)
        self._episodes = self._chosen(choices.episodes)

    @staticmethod
    def is_one(root: Path) -> bool:
        """Whether a folder has this layout."""
        return (root / INFO).is_file()

    def clips(self) -> Iterator[OwnClip]:
        """See Recordings."""
        groups = _groups(self._episodes)
        at_hand: tuple[tuple[int, int], Mapping[str, Float32Array]] | None = None
        for episode in sorted(self._episodes, key=lambda each: (each.data, each.index)):
            if at_hand is None or at_hand[0] != episode.data:
                at_hand = episode.data, self._columns(episode.data)
            yield self._clip(episode, at_hand[1], groups[episode.index])

    def _inside(self, name: str) -> Path:
        path = (self._root / name).resolve()
        if not path.is_relative_to(self._root) or not path.is_file():
            raise ClipsInvalid(f"There is no file {name} in this folder.")
        return path

    def _width(self, name: str) -> int | None:
        feature = self._info.features.get(name)
        return feature.width if feature else None

    def _chosen(self, wanted: range | None) -> Sequence[Episode]:
        files = sorted((self._root / "meta/episodes").glob("chunk-*/file-*.parquet"))[: MOST_EPISODES_FILES + 1]
        if not 1 <= len(files) <= MOST_EPISODES_FILES:
            raise ClipsInvalid(f"meta/episodes has {len(files)} Parquet files, expected 1 to {MOST_EPISODES_FILES}.")
        found: list[Episode] = []
        for file in files:
            name = str(file.relative_to(self._root))
            with naming(name, ParquetRefused):
                found += _episodes(self._inside(name), self._camera)
        chosen = [each for each in found if wanted is None or each.index in wanted]
        if len({each.index for each in chosen}) < len(chosen):
            raise ClipsInvalid("meta/episodes names an episode twice.")
        if not 2 <= len(chosen) <= MOST_EPISODES:
            raise ClipsInvalid(
                f"{len(chosen)} of {len(found)} episodes are chosen; 2 to {MOST_EPISODES} make a study. "
                "Choose with --episodes FIRST:END."
            )
        with naming("meta/episodes", ParquetRefused):
            for each in chosen:
                each.check()
        return chosen

    def _columns(self, data: tuple[int, int]) -> Mapping[str, Float32Array]:
        """Of one file of data, all that is needed."""
        name = DATA_PATH.format(chunk_index=data[0], file_index=data[1])
        extra = [SUCCESS] if self._width(SUCCESS) == 1 else []
        wanted = list(dict.fromkeys([*self._vectors, *self._signals, *extra]))
        path = self._inside(name)
        with naming(name, ParquetRefused):
            table = parquet_columns.read(path, ["episode_index", "frame_index", *wanted])
            widths = {each: self._width(each) or 1 for each in wanted}
            columns = {each: parquet_columns.numbers(table, each, width) for each, width in widths.items()}
            columns |= {each: _whole_numbers(table, each) for each in ("episode_index", "frame_index")}
            return columns

    def _clip(self, episode: Episode, columns: Mapping[str, Float32Array], scenario: int) -> OwnClip:
        name = f"episode {episode.index}"
        with naming(name, ValueError):
            recording = self._recording(episode, columns)
        chunk, file = episode.video
        video = VIDEO_PATH.format(video_key=self._camera, chunk_index=chunk, file_index=file)
        path = self._inside(video)
        with naming(f"{video}, {name}", ValueError):
            shown = cut_by_time(path, episode.from_s, episode.length, self._info.fps)
        origin = {"dataset": self._root.name, "episode": str(episode.index), "camera": self._camera}
        return OwnClip(scenario, recording, shown, {**origin, "label": episode.task[:200]})

    def _recording(self, episode: Episode, columns: Mapping[str, Float32Array]) -> Recording:
        rows = np.flatnonzero(columns["episode_index"] == episode.index)
        if len(rows) != episode.length or not np.array_equal(columns["frame_index"][rows], np.arange(len(rows))):
            raise ValueError(f"has {len(rows)} rows in its file, in order or not; meta/episodes says {episode.length}")
        nothing = np.zeros((len(rows), 0), np.float32)
        states, actions = (columns[each][rows] if each in self._vectors else nothing for each in (STATE, ACTION))
        signals = (
            np.concatenate([columns[each][rows] for each in self._signals], axis=1)
            if self._signals
            else derived_signals.of_steps(states, actions, self._info.fps)
        )
        succeeded = bool(columns[SUCCESS][rows].any()) if SUCCESS in columns else True
        # Nothing is observed after the last step: the last is the best guess.
        return Recording(signals, np.concatenate([states, states[-1:]]), actions, succeeded)


def _info(path: Path) -> Info:
    if path.stat().st_size > LARGEST_INFO_BYTES:
        raise ClipsInvalid(f"{INFO} is larger than {LARGEST_INFO_BYTES / 1e6:.0f} MB.")
    try:
        info = Info.model_validate(json.loads(path.read_bytes()))
    except ValidationError as error:
        raise ClipsInvalid(f"{INFO}: {in_words(error)}") from error
    except (ValueError, RecursionError) as error:
        raise ClipsInvalid(f"{INFO} is not JSON: {error}.") from error
    if not re.fullmatch(r"v?3\.\d+(\.\d+)?", info.codebase_version):
        raise ClipsInvalid(
            f"{INFO} is of version {info.codebase_version!r}; version 3 is read. Convert it with LeRobot: "
            "python -m lerobot.datasets.v30.convert_dataset_v21_to_v30 --repo-id=..."
        )
    if info.data_path != DATA_PATH or info.video_path not in (None, VIDEO_PATH):
        raise ClipsInvalid(f"{INFO}: data_path and video_path are not the usual ones ({DATA_PATH}, {VIDEO_PATH}).")
    return info


def _camera(info: Info, said: str | None) -> str:
    """The feature whose videos are shown, by its name or the end of it. Raises ClipsInvalid."""
    cameras = [name for name, each in info.features.items() if each.dtype == "video"]
    if not cameras:
        raise ClipsInvalid(f"{INFO} has no feature of dtype video. Pictures in Parquet are not read; encode them.")
    found = [each for each in cameras if said is None or each == said or each.endswith(f".{said}")]
    if len(found) != 1 or not re.fullmatch(r"[\w.-]{1,200}", found[0]) or ".." in found[0]:
        raise ClipsInvalid(f"Say which camera is shown, with --camera: {', '.join(cameras)[:1000]}.")
    return found[0]


def _signal_features(info: Info, said: Sequence[str]) -> Sequence[str]:
    """Features whose columns are signals; those of our own exports are known. Raises ClipsInvalid."""
    known = [name for name, each in info.features.items() if each.width]
    unknown = [each for each in said if each not in known]
    if unknown:
        raise ClipsInvalid(f"There is no feature {unknown[0]} of numbers. There are: {', '.join(known)[:1000]}.")
    return said or ([SIGNALS] if SIGNALS in known else [])


def _signals(name: str, feature: Feature) -> list[Signal]:
    """A signal for every column of a feature, named as the feature says, or numbered."""
    width = feature.width or 0
    names = feature.names if isinstance(feature.names, list) and len(feature.names) == width else range(width)
    units = feature.units if isinstance(feature.units, list) and len(feature.units) == width else [""] * width
    prefix = "" if name == SIGNALS else f"{name}_"
    found = [
        Signal(name=_as_name(f"{prefix}{each}"), unit=str(unit)[:20], meaning=f"{name}, {each}"[:200])
        for each, unit in zip(names, units, strict=True)
    ]
    if len({each.name for each in found}) < width:
        raise ClipsInvalid(f"{INFO}: {name} has two columns of one name.")
    return found


def _as_name(text: str) -> str:
    plain = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")
    return (plain if re.match("[a-z]", plain) else f"signal_{plain}")[:60]


def _episodes(path: Path, camera: str) -> list[Episode]:
    of_video = [f"videos/{camera}/{each}" for each in ("chunk_index", "file_index", "from_timestamp")]
    names = ["episode_index", "length", "data/chunk_index", "data/file_index", *of_video]
    kinds: dict[str, type] = {**dict.fromkeys(names, int), of_video[2]: float, "tasks": list}
    schema = parquet_columns.names_in(path)
    kinds |= {SCENARIO: int} if SCENARIO in schema else {}
    rows = parquet_columns.records(parquet_columns.read(path, list(kinds)), kinds)
    return [_episode(row, of_video) for row in rows]


def _episode(row: Mapping[str, Any], of_video: Sequence[str]) -> Episode:
    return Episode(
        index=row["episode_index"],
        length=row["length"],
        task=str(row["tasks"][0]) if row["tasks"] else "",
        data=(row["data/chunk_index"], row["data/file_index"]),
        video=(row[of_video[0]], row[of_video[1]]),
        from_s=row[of_video[2]],
        scenario=row.get(SCENARIO),
    )


def _whole_numbers(table: pa.Table, name: str) -> Float32Array:
    column = table.column(name).combine_chunks()
    if column.null_count or not pa.types.is_integer(column.type):
        raise ParquetRefused(f"{name} holds something else than whole numbers")
    return column.to_numpy(zero_copy_only=False)  # type: ignore[no-any-return]  # pyarrow is untyped


def _groups(episodes: Sequence[Episode]) -> Mapping[int, int]:
    """Scenario by episode: as the dataset says, or episodes of one task, at most eight at a time."""
    if all(each.scenario is not None for each in episodes):
        return {each.index: each.scenario or 0 for each in episodes}
    _, most = bounds_of(StudySettings, "behaviours_per_scenario")
    found: dict[int, int] = {}
    number = 0
    for task in dict.fromkeys(each.task for each in episodes):
        indices = sorted(each.index for each in episodes if each.task == task)
        if len(indices) < 2:
            raise ClipsInvalid(
                f"Only episode {indices[0]} is of the task {task[:80]!r}; two of a task are compared. "
                "Choose others with --episodes FIRST:END."
            )
        for part in np.array_split(indices, math.ceil(len(indices) / most)):
            found |= dict.fromkeys((int(each) for each in part), number)
            number += 1
    return found
