"""A dataset that LeRobot itself has written becomes a study, and a hostile one is refused with words."""

import io
import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.studies import Study
from app.services.participants import enrolment
from app.storage import ArtefactStore
from tests.worker.at_hand import AtHand
from worker.jobs.clips.import_clips import ClipsInvalid, import_clips
from worker.jobs.clips.lerobot_folder import LerobotFolder
from worker.jobs.clips.own_clips import Choices, OwnClip
from worker.jobs.learning import dataset, query_selection
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext

WRITTEN = Path(__file__).resolve().parents[2] / "recordings" / "lerobot-0.4.4.zip"
"""By tests/benchmarks/in_lerobot.py: nine episodes of two tasks, of 12 to 20 steps, with two cameras."""
DATA, EPISODES, INFO = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet", "meta/info.json"
FRONT = Choices(camera="front")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    zipfile.ZipFile(WRITTEN).extractall(tmp_path)
    return tmp_path / "handover"


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


def imported(context: WorkerContext, folder: Path, choices: Choices = FRONT) -> Study:
    slug = import_clips(context.database, context.store, folder, choices)
    with context.database.reading() as session:
        return session.scalars(select(Study).where(Study.slug == slug)).one()


def test_episodes_become_clips_with_their_arrays(context: WorkerContext, folder: Path) -> None:
    study = imported(context, folder)
    assert (study.slug, study.task) == ("handover", "own_clips")
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, study.id)
    assert [clip.step_count for clip in clips] == list(range(12, 21))
    assert [clip.rollout.mode["imported"]["label"] for clip in clips[:2]] == ["hand over the cup", "put it down"]
    recorded = dataset.stretch(context.store, clips[3]).trajectory
    assert np.array_equal(recorded.actions, [[3, step % 2] for step in range(15)])
    assert np.array_equal(recorded.observations[:-1], [[step, 3, 0] for step in range(15)])
    assert dataset.signal_names(study) == [
        "time_s", "speed", "speed_squared", "acceleration_squared", "action_change_squared",
    ]  # fmt: skip
    assert np.allclose(recorded.signals[5], [0.1, 10, 100, 0, 1])


@pytest.mark.parametrize(("camera", "brightness"), [("front", 1), ("wrist", -1)])
def test_the_chosen_camera_shows_each_episode_at_its_own_steps(
    camera: str, brightness: int, context: WorkerContext, folder: Path
) -> None:
    """Episode e's picture of step t is grey, 20 e + t, and of the wrist 255 less that."""
    study = imported(context, folder, Choices(camera=camera))
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, study.id)
    for episode, clip in enumerate(clips):
        with av.open(io.BytesIO(context.store.read(clip.video_sha256)), "r") as container:
            assert container.streams.video[0].codec_context.name == "h264"
            shown = [each.to_ndarray(format="rgb24").mean() for each in container.decode(video=0)]
        steps = np.repeat(np.arange(clip.step_count), len(shown) // clip.step_count)
        level = 20 * episode + steps
        expected = level if brightness > 0 else 255 - level
        assert np.abs(np.array(shown) - expected).max() < 3, "three steps or one episode aside is further"
        assert clip.duration_ms == 100 * clip.step_count


def test_features_can_be_what_people_judge_by(context: WorkerContext, folder: Path) -> None:
    study = imported(context, folder, Choices(camera="front", signals=("effort",)))
    assert dataset.signal_names(study) == ["effort_newton"]
    with context.database.reading() as session:
        clip = dataset.pool_clips(session, study.id)[2]
    assert np.allclose(dataset.stretch(context.store, clip).cut("signals")[:, 0], 2 + np.arange(14) / 10)


def episode_of(clip: Clip) -> int:
    return int(clip.rollout.mode["imported"]["episode"])


def test_only_episodes_of_one_task_are_compared(context: WorkerContext, folder: Path) -> None:
    study = imported(context, folder)
    with context.database.writing() as session:
        person, _ = enrolment.add_participant(session, session.get_one(Study, study.id))
    query_selection.refill_queries(context, person.id)
    with context.database.reading() as session:
        waiting = list(records.unanswered(session, person.id, *dataset.CLIPS_AND_ROLLOUTS))
    sides = [[episode_of(query.left_clip), episode_of(query.right_clip)] for query in waiting]
    assert len(sides) > 3
    assert all(left % 2 == right % 2 for left, right in sides), "odd ones are of the other task"


def test_episodes_can_be_chosen(folder: Path) -> None:
    assert [len(clip.recording) for clip in read(folder, Choices(camera="front", episodes=range(2, 6)))] == [
        14,
        15,
        16,
        17,
    ]
    with pytest.raises(ClipsInvalid, match="Only episode 1 is of the task 'put it down'"):
        read(folder, Choices(camera="front", episodes=range(3)))


def rewritten(path: Path, change: Callable[[pa.Table], pa.Table]) -> None:
    parquet.write_table(change(parquet.read_table(path)), path)


def column(name: str, values: Callable[[list[Any]], list[Any]]) -> Callable[[pa.Table], pa.Table]:
    """The table with other values in one column."""

    def change(table: pa.Table) -> pa.Table:
        place = table.column_names.index(name)
        return table.set_column(place, name, pa.array(values(table.column(name).to_pylist())))

    return change


def info(**said: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / INFO
        path.write_text(json.dumps({**json.loads(path.read_text()), **said}))

    return change


def table(name: str, change: Callable[[pa.Table], pa.Table]) -> Callable[[Path], None]:
    return lambda folder: rewritten(folder / name, change)


def first(value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [value, *values[1:]]


def _elsewhere(folder: Path) -> None:
    (folder.parent / "secret.parquet").write_bytes((folder / DATA).read_bytes())
    (folder / DATA).unlink()
    (folder / DATA).symlink_to(folder.parent / "secret.parquet")


VIDEOS = "videos/observation.images.front"
VIDEO = f"{VIDEOS}/chunk-000/file-000.mp4"
STARTS = f"{VIDEOS}/from_timestamp"
WRONG: dict[str, tuple[Callable[[Path], None], str]] = {
    "version 2.1": (info(codebase_version="v2.1"), "Convert it with LeRobot"),
    "no JSON": (lambda folder: _write(folder / INFO, b"{" * 100_000), "is not JSON"),
    "a rate of nought": (info(fps=0), "fps"),
    "paths of its own": (info(data_path="../../{chunk_index:0999999999d}"), "not the usual ones"),
    "a link to elsewhere": (_elsewhere, "There is no file data/"),
    "no Parquet": (lambda folder: _write(folder / DATA, b"PAR1" + bytes(99)), f"{DATA}: not a Parquet file"),
    "half a Parquet file": (lambda folder: _cut(folder / DATA), f"{DATA}: not a Parquet file"),
    "not a number": (
        table(DATA, column("action", first([float("nan"), 0.0]))),
        "episode 0: actions has values that are missing",
    ),
    "no value": (table(DATA, column("action", first(None))), "action has rows without a value"),
    "a wide row": (table(DATA, column("action", first([0.0] * 3))), "action has rows that are not of 2"),
    "texts": (table(DATA, column("effort", lambda values: ["1"] * len(values))), "effort holds something else"),
    "no column": (table(DATA, lambda t: t.drop_columns(["action"])), "the column action is missing"),
    "fewer rows": (table(DATA, lambda t: t.slice(1)), "episode 0: has 11 rows"),
    "rows in disorder": (table(DATA, column("frame_index", first(7))), "episode 0: has 12 rows in its file, in order"),
    "a far file": (table(EPISODES, column("data/file_index", first(10**12))), "numbers that cannot be"),
    "before the beginning": (table(EPISODES, column(STARTS, first(-1.0))), "numbers that cannot be"),
    "after the end": (table(EPISODES, column(STARTS, first(1e6))), "ends before this episode"),
    "an endless episode": (table(EPISODES, column("length", first(10**9))), "Leave it out with --episodes"),
    "an episode twice": (table(EPISODES, column("episode_index", first(1))), "names an episode twice"),
    "no video": (lambda folder: _write(folder / VIDEO, b"no video"), f"{VIDEO}, episode 0: not an MP4"),
    "a list of other files": (
        lambda folder: _write(folder / VIDEO, b"ffconcat version 1.0\nfile '/etc/hostname'\n"),
        "not an MP4",
    ),
    "half a video": (lambda folder: _cut(folder / VIDEO), "not an MP4"),
}  # fmt: skip


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def read(folder: Path, choices: Choices) -> list[OwnClip]:
    return list(LerobotFolder(folder, choices).clips())


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said(name: str, folder: Path) -> None:
    spoil, words = WRONG[name]
    spoil(folder)
    with pytest.raises(ClipsInvalid) as refused:
        read(folder, Choices(camera="front", signals=("effort",)))
    assert words in str(refused.value)


@pytest.mark.parametrize("camera", [None, "top", "images"])
def test_which_camera_must_be_said(camera: str | None, folder: Path) -> None:
    with pytest.raises(ClipsInvalid, match=r"--camera: observation.images.front, observation.images.wrist"):
        read(folder, Choices(camera=camera))


def test_the_command_needs_no_studio_that_has_run_before_and_says_what_is_wrong(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from worker.__main__ import main

    monkeypatch.setenv("DATA_DIR", str(tmp_path / "data"))
    assert main(["import-clips", str(folder), "--camera", "front", "--episodes", "0:9"]) == 0
    assert "Imported: " in capsys.readouterr().out
    shutil.rmtree(folder / "meta/episodes")
    assert main(["import-clips", str(folder), "--camera", "front", "--episodes", "0:9"]) == 1
    assert "meta/episodes has 0 Parquet files" in capsys.readouterr().err
