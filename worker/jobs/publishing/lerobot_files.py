"""A study as a LeRobotDataset of version 3 that is a dataset folder of Hugging Face as well (docs/recordings.md).

An episode is what a clip shows. Layout: huggingface/lerobot, src/lerobot/datasets/utils.py.
"""

import io
import json
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from sqlalchemy import select
from sqlalchemy.orm import Session, contains_eager

from app.domain.clips import Clip, Rollout
from app.domain.studies import Study
from app.errors import AppError
from app.services.exports import export_formats, export_tables, parquet_file, whose_rows
from app.storage import ArtefactMissing
from worker.domain.responses import TARGETS
from worker.jobs.learning import dataset
from worker.jobs.publishing import lerobot_card, lerobot_statistics
from worker.jobs.runtime.context import WorkerContext
from worker.ml.rewards.segments import Stretch
from worker.sim.render import video, video_cutting
from worker.tasks import registry

CAMERA, STATE, ACTION, SIGNALS = "observation.images.clip", "observation.state", "action", "signals"
CHUNK = 1000
"""Files in a folder."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
PREFERENCES = "preferences/preferences.parquet"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")


class NoWholeRate(AppError):
    """A LeRobotDataset has a whole number of frames a second, and this study's recordings have not. Export its data."""


class NothingToShow(AppError):
    """No clip of this study has its film and its recording, so there is nothing that a LeRobotDataset could hold."""


@dataclass
class _Writing:
    """What is known of the dataset while its episodes are written one after the other."""

    target: zipfile.ZipFile
    rate_hz: int
    size: tuple[int, int]
    """width and height of all films"""
    task: str
    column_names: Mapping[str, Sequence[str]]
    """of the features whose columns have names"""
    episodes: list[dict[str, Any]] = field(default_factory=list)
    place: dict[int, int] = field(default_factory=dict)
    """episode by the id of the clip"""
    frames: int = 0
    vectors: dict[str, list[Any]] = field(default_factory=dict)
    pixels: list[Any] = field(default_factory=list)


def write(session: Session, context: WorkerContext, study: Study, path: Path) -> Mapping[str, Sequence[str]]:
    """The dataset as a zip file; hashes of stored files that could not be had. Raises NoWholeRate and NothingToShow."""
    lost: set[str] = set()
    clips = _clips(session, study)
    if not clips:
        raise NothingToShow
    task = study.task.replace("_", " ")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        size = (clips[0].width // 2 * 2, clips[0].height // 2 * 2)
        writing = _Writing(target, _rate_hz(study), size, task, _column_names(study))
        with _unfinished(path.parent) as data:
            _write_episodes(context, writing, clips, data, lost)
            target.write(data, DATA_PATH.format(chunk_index=0, file_index=0))
        _write_metadata(writing)
        pairs = _preferences(session, study, writing.place)
        _write_parquet(target, PREFERENCES, pa.Table.from_pylist(pairs, _PREFERENCE))
        tables = _write_tables(session, target, study)
        target.writestr("README.md", lerobot_card.card(session, study, tables, bool(pairs)))
    return {"clips": sorted(lost)} if lost else {}


def _clips(session: Session, study: Study) -> Sequence[Clip]:
    wanted = select(Clip).join(Rollout).where(Rollout.study_id == study.id).order_by(Clip.id)
    return session.scalars(wanted.options(contains_eager(Clip.rollout))).all()


def _rate_hz(study: Study) -> int:
    rate = study.material["rate_hz"] if study.material else 1.0 / registry.task(study.task).control_step_s
    if abs(rate - round(rate)) > 1e-6:
        raise NoWholeRate
    return round(rate)


def _column_names(study: Study) -> Mapping[str, Sequence[str]]:
    """As the task or the laboratory calls them; of recordings only the signals are known by name."""
    signals = {SIGNALS: dataset.signal_names(study)}
    if study.material is not None:
        return signals
    task = registry.task(study.task)
    return signals | {STATE: task.observation.column_names, ACTION: task.action.column_names}


@contextmanager
def _unfinished(folder: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir=folder) as inside:
        yield Path(inside) / "data.parquet"


def _write_episodes(
    context: WorkerContext, writing: _Writing, clips: Sequence[Clip], data: Path, lost: set[str]
) -> None:
    """Films and arrays, one row group an episode."""
    writer: parquet.ParquetWriter | None = None
    try:
        for clip in clips:
            try:
                film, stretch = context.store.read(clip.video_sha256), dataset.stretch(context.store, clip)
            except (ArtefactMissing, dataset.RecordedByAnOlderVersion):
                both = clip.video_sha256, clip.rollout.trajectory_sha256
                lost |= {each for each in both if not context.store.has(each)} or {both[1]}
                continue
            rows = _rows(writing, stretch)
            writer = writer or parquet.ParquetWriter(data, rows.schema)
            writer.write_table(rows)
            _write_films(writing, clip, film)
            writing.place[clip.id] = len(writing.episodes)
            writing.episodes.append(_episode(writing, clip, rows))
            writing.frames += len(rows)
    finally:
        if writer is not None:
            writer.close()
    if writer is None:
        raise NothingToShow


def _rows(writing: _Writing, stretch: Stretch) -> pa.Table:
    """A row per step, with the columns that LeRobot counts by."""
    steps, episode = stretch.step_count, len(writing.episodes)
    cuts = {STATE: "observations", ACTION: "actions", SIGNALS: "signals"}
    vectors = {name: stretch.cut(array) for name, array in cuts.items()}
    columns: dict[str, pa.Array] = {name: _vectors(each) for name, each in vectors.items() if each.shape[1]}
    for name, each in vectors.items():
        writing.vectors.setdefault(name, []).append(each)
    ends = np.arange(steps) == steps - 1
    counted = (np.arange(steps), np.full(steps, episode), writing.frames + np.arange(steps), np.zeros(steps))
    return pa.table(
        columns
        | {"next.done": pa.array(ends), "next.success": pa.array(ends & stretch.trajectory.success)}
        | {"timestamp": pa.array((np.arange(steps) / writing.rate_hz).astype(np.float32))}
        | {name: pa.array(each.astype(np.int64)) for name, each in zip(COUNTERS, counted, strict=True)}
    )


def _vectors(values: Any) -> pa.Array:
    flat = pa.array(np.ascontiguousarray(values, np.float32).reshape(-1))
    return flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _write_films(writing: _Writing, clip: Clip, film: bytes) -> None:
    """The clip as it was shown, and with one picture a step, as LeRobot wants it."""
    width, height = writing.size
    shown = f"clips/{clip.video_sha256}.mp4"
    if shown not in writing.target.namelist():
        writing.target.writestr(shown, film, zipfile.ZIP_STORED)
    pixels: list[Any] = []

    def pictures() -> Iterator[video.Frame]:
        for each in video_cutting.at_steps(film, clip.step_count, writing.rate_hz, width, height):
            pixels.append(lerobot_statistics.sampled(each, clip.step_count))
            yield each

    name = VIDEO_PATH.format(video_key=CAMERA, **_file(len(writing.episodes)))
    writing.target.writestr(name, video.encode_mp4(pictures(), width, height, writing.rate_hz), zipfile.ZIP_STORED)
    writing.pixels.append(np.concatenate(pixels))


def _file(number: int) -> dict[str, int]:
    return {"chunk_index": number // CHUNK, "file_index": number % CHUNK}


def _episode(writing: _Writing, clip: Clip, rows: pa.Table) -> dict[str, Any]:
    """The episode's row in the metadata."""
    number, steps = len(writing.episodes), len(rows)
    statistics = {name: lerobot_statistics.of_vectors(found[-1]) for name, found in _with_columns(writing).items()}
    statistics[CAMERA] = lerobot_statistics.of_pixels(writing.pixels[-1], steps)
    film = {f"videos/{CAMERA}/{name}": value for name, value in _file(number).items()}
    return {
        "episode_index": number,
        "tasks": [writing.task],
        "length": steps,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": writing.frames,
        "dataset_to_index": writing.frames + steps,
        **film,
        f"videos/{CAMERA}/from_timestamp": 0.0,
        f"videos/{CAMERA}/to_timestamp": steps / writing.rate_hz,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
        "scenario": clip.rollout.scenario,
        "behaviour": clip.rollout.behaviour,
        "success": clip.rollout.success,
        "clip": clip.video_sha256,
        **lerobot_statistics.as_columns(statistics),
    }


def _with_columns(writing: _Writing) -> dict[str, list[Any]]:
    return {name: found for name, found in writing.vectors.items() if found[-1].shape[1]}


def _write_metadata(writing: _Writing) -> None:
    """info.json, stats.json, tasks and episodes."""
    import pandas as pd  # takes long, and a worker that exports nothing starts without

    vectors = {name: np.concatenate(found) for name, found in _with_columns(writing).items()}
    statistics = {name: lerobot_statistics.of_vectors(each) for name, each in vectors.items()}
    statistics[CAMERA] = lerobot_statistics.of_pixels(np.concatenate(writing.pixels), writing.frames)
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(writing.episodes),
        "total_frames": writing.frames,
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": writing.rate_hz,
        "splits": {"train": f"0:{len(writing.episodes)}"},
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH,
        "features": _features(writing, {name: each.shape[1] for name, each in vectors.items()}),
    }
    writing.target.writestr("meta/info.json", json.dumps(info, indent=2))
    writing.target.writestr("meta/stats.json", json.dumps(statistics, indent=2))
    tasks = io.BytesIO()
    pd.DataFrame({"task_index": [0]}, index=pd.Index([writing.task], name="task")).to_parquet(tasks)
    writing.target.writestr("meta/tasks.parquet", tasks.getvalue())
    _write_parquet(writing.target, EPISODES, pa.Table.from_pylist(writing.episodes))


def _features(writing: _Writing, widths: Mapping[str, int]) -> dict[str, Any]:
    width, height = writing.size
    found: dict[str, Any] = {
        name: {
            "dtype": "float32",
            "shape": [columns],
            "names": _names(writing.column_names.get(name, ()), name, columns),
        }
        for name, columns in widths.items()
    }
    found[CAMERA] = {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": writing.rate_hz,
            "video.channels": 3,
            "has_audio": False,
        },
    }
    plain = {"next.done": "bool", "next.success": "bool", "timestamp": "float32", **dict.fromkeys(COUNTERS, "int64")}
    return found | {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in plain.items()}


def _names(known: Sequence[str], feature: str, columns: int) -> list[str]:
    """Those that are known, unless it was recorded when the task had others."""
    return list(known) if len(known) == columns else [f"{feature.rpartition('.')[2]}_{each}" for each in range(columns)]


_PREFERENCE = pa.schema(
    [
        ("participant", pa.string()),
        ("ordinal", pa.int64()),
        ("purpose", pa.string()),
        ("response", pa.string()),
        ("target", pa.float32()),
        ("left_episode", pa.int64()),
        ("right_episode", pa.int64()),
    ]
)


def _preferences(session: Session, study: Study, place: Mapping[int, int]) -> list[dict[str, Any]]:
    """A row per answer that counts, with the episodes that were side by side; target is P(right preferred)."""
    return [
        {
            "participant": person.code,
            "ordinal": label.query.ordinal,
            "purpose": label.query.purpose,
            "response": label.response.value,
            "target": TARGETS[label.response],
            "left_episode": place[label.query.left_clip_id],
            "right_episode": place[label.query.right_clip_id],
        }
        for person in whose_rows.everybody(session, study)
        for label in dataset.labels_with_clips(session, person.id)
        if {label.query.left_clip_id, label.query.right_clip_id} <= place.keys()
    ]


def _write_tables(session: Session, target: zipfile.ZipFile, study: Study) -> list[str]:
    """Every table of the export that has rows; returns their names."""
    provenance, written = export_formats.provenance_of(session, study), []
    for table in export_tables.TABLES:
        if next(iter(table.rows(session, study)), None) is not None:
            content = parquet_file.content(table, session, study, provenance)
            target.writestr(f"tables/{table.name}.parquet", content)
            written.append(table.name)
    return written


def _write_parquet(target: zipfile.ZipFile, name: str, table: pa.Table) -> None:
    with target.open(name, "w") as stream:
        parquet.write_table(table, stream)
