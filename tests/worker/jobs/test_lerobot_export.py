"""A study as a LeRobotDataset: Hugging Face's datasets opens it, and it comes back as the same study.

That LeRobot itself reads it is measured by tests/benchmarks/in_lerobot.py.
"""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
import yaml
from sqlalchemy import select
from sqlalchemy.orm import joinedload

from app.db import Database
from app.domain.clips import Clip
from app.domain.preferences import Query, Response
from app.domain.studies import Study
from app.paths import DOCS
from app.services.exports import export_requests
from app.services.exports.export_requests import ExportKind
from app.storage import ArtefactStore
from tests.worker.conftest import filmed
from worker.compute.pools import Compute
from worker.domain.trajectory import SIGNALS
from worker.jobs.clips.import_clips import import_clips
from worker.jobs.learning import dataset
from worker.jobs.publishing import export_files
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.tasks import registry

AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


@pytest.fixture
def clips(context: WorkerContext, add_clips: AddClips, answer: Answer) -> list[Clip]:
    """Four ways to do each of two situations, and three answers."""
    add_clips(1), add_clips(2)
    with context.database.writing() as session:
        filmed(session, context.store)
        found = list(session.scalars(select(Clip).order_by(Clip.id).options(joinedload(Clip.rollout))))
    answer(found[0], found[1], Response.LEFT)
    answer(found[2], found[1], Response.RIGHT)
    answer(found[3], found[2], Response.SKIP)
    return found


@pytest.fixture
def exported(context: WorkerContext, study: Study, clips: list[Clip], tmp_path: Path) -> Path:
    """The unpacked dataset."""
    with context.database.writing() as session:
        export_requests.request(session, session.get_one(Study, study.id), ExportKind.LEROBOT, "experimenter")
    with context.database.reading() as session:
        (job,) = export_files.due(session, session.get_one(Study, study.id))
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    export_files.make(context, job, run_id, lambda _name, function, *arguments: function(*arguments))
    with context.database.reading() as session:
        export = export_requests.of_study(session, session.get_one(Study, study.id))[0]
    assert export.artefact_sha256 is not None
    assert export.missing is None
    folder = tmp_path / "exported"
    with zipfile.ZipFile(io.BytesIO(context.store.read(export.artefact_sha256))) as file:
        file.extractall(folder)
    return folder


@pytest.mark.filterwarnings("default")
def test_hugging_face_opens_every_part(
    exported: Path, clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from datasets import disable_progress_bars, load_dataset

    disable_progress_bars()

    def part(name: str) -> Any:
        return load_dataset(str(exported), name, split="train", cache_dir=str(tmp_path / "cache"))

    preferences = part("preferences")
    assert preferences["response"] == ["left", "right", "skip"]
    assert preferences["target"] == [0.0, 1.0, None]
    episode = {clip.id: number for number, clip in enumerate(clips)}
    assert preferences["left_episode"] == [episode[clips[each].id] for each in (0, 2, 3)]
    frames = part("default")
    assert len(frames) == sum(clip.step_count for clip in clips)
    assert np.shape(frames[0]["signals"]) == (len(SIGNALS),)
    head = (exported / "README.md").read_text().split("---\n")[1]
    for config in yaml.safe_load(head)["configs"]:
        assert len(part(config["config_name"])) > 0


@pytest.mark.filterwarnings("default")
def test_minari_has_the_same_episodes_by_the_example_of_the_manual(
    exported: Path, clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, context: WorkerContext
) -> None:
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    import minari
    from datasets import disable_progress_bars

    disable_progress_bars()
    first, example = (DOCS / "recordings.md").read_text().split("```python\n")[1:3]
    code = first.splitlines()[0] + "\n" + example.split("```")[0]
    exec(code.replace('"unpacked"', repr(str(exported))), {})  # noqa: S102  (the manual's example)
    opened = minari.load_dataset("studio/study-v0")
    assert opened.total_episodes == len(clips)
    for episode, clip in zip(opened.iterate_episodes(), clips, strict=True):
        stretch = dataset.stretch(context.store, clip)
        np.testing.assert_array_equal(episode.observations, stretch.cut("observations"))
        np.testing.assert_array_equal(episode.actions, stretch.cut("actions")[:-1])
        np.testing.assert_array_equal(episode.infos["signals"], stretch.cut("signals"))


def test_columns_are_called_as_the_task_calls_them(exported: Path, study: Study) -> None:
    features = json.loads((exported / "meta/info.json").read_text())["features"]
    task = registry.task(study.task)
    assert features["observation.state"]["names"][:4] == [
        *(f"tool_position_m_{axis}" for axis in range(3)),
        "tool_forward_0",
    ]
    for name, space in {"observation.state": task.observation, "action": task.action}.items():
        assert len(features[name]["names"]) == features[name]["shape"][0] == space.size
    assert features["signals"]["names"] == list(task.signals)


def test_a_film_has_one_picture_for_every_row(exported: Path, clips: list[Clip]) -> None:
    info = json.loads((exported / "meta/info.json").read_text())
    assert (info["fps"], info["total_episodes"]) == (10, len(clips))
    for number, clip in enumerate(clips):
        film = exported / f"videos/observation.images.clip/chunk-000/file-{number:03d}.mp4"
        with av.open(str(film), "r") as container:
            times = [each.time for each in container.decode(video=0)]
        assert np.allclose(times, np.arange(clip.step_count) / 10)
        assert (exported / f"clips/{clip.video_sha256}.mp4").exists()


def test_the_same_study_comes_back(exported: Path, context: WorkerContext, study: Study, clips: list[Clip]) -> None:
    slug = import_clips(context.database, context.store, exported)
    with context.database.reading() as session:
        again = session.scalars(select(Study).where(Study.slug == slug)).one()
        returned = dataset.pool_clips(session, again.id)
    assert list(dataset.signal_names(again)) == list(SIGNALS)
    assert [clip.rollout.scenario for clip in returned] == [clip.rollout.scenario for clip in clips]
    assert [clip.rollout.success for clip in returned] == [clip.rollout.success for clip in clips]
    for before, after in zip(clips, returned, strict=True):
        for array in ("signals", "actions", "observations"):
            theirs, ours = (dataset.stretch(context.store, each).cut(array) for each in (after, before))
            assert np.array_equal(theirs, ours)
