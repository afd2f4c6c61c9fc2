"""A lab without our simulator: own recordings become a study in which people are asked and models learn."""

import io
import json
import re
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select

from app.db import Database, now
from app.domain.clips import Clip, Rollout
from app.domain.models import Model, ModelKind, RunKind
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.services.participants import enrolment
from app.storage import ArtefactStore
from tests import factories, stored_files
from tests.worker.at_hand import AtHand
from worker.jobs import reconcile
from worker.jobs.clips.import_clips import ClipsInvalid, import_clips
from worker.jobs.learning import dataset, query_selection
from worker.jobs.learning.reward_models import train_reward
from worker.jobs.publishing import preference_arrays
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext
from worker.jobs.runtime.records import Job
from worker.ml.rewards.loading import load_reward_model
from worker.ml.rewards.reward_models import StructuredReward
from worker.sim.render.video import encode_mp4, playable

DOCS = Path(__file__).resolve().parents[3] / "docs"
WAYS = ("slow_far", "slow_near", "fast_far", "fast_near")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The worked example of the documentation."""
    root = tmp_path / "my-clips"
    (root / "videos").mkdir(parents=True)
    for number, name in enumerate(f"{way}_{scenario}" for scenario in (1, 2) for way in WAYS):
        (root / "videos" / f"{name}.mp4").write_bytes(factories.moving_picture(number)[0])
    monkeypatch.chdir(root)
    code = re.search(r"```python example\n(.*?)```", (DOCS / "own_clips.md").read_text(), re.DOTALL)
    assert code is not None
    exec(code[1], {})  # noqa: S102  (our own documentation)
    return root


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


@pytest.fixture
def own(context: WorkerContext, folder: Path) -> Study:
    slug = import_clips(context.database, context.store, folder)
    with context.database.reading() as session:
        return session.scalars(select(Study).where(Study.slug == slug)).one()


def edit(folder: Path, change: Callable[[dict[str, Any]], None]) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def test_the_documented_example_becomes_a_study(context: WorkerContext, own: Study) -> None:
    assert (own.slug, own.task) == ("handover-with-our-arm", "handover")
    assert own.settings.labels_per_participant == 12
    assert own.material is not None
    assert [each["unit"] for each in own.material["signals"]] == ["m/s", "m"]
    with context.database.reading() as session:
        clips = dataset.pool_clips(session, own.id)
        assert len(clips) == 8
        assert len(dataset.matched_pairs(clips)) == 12
        assert all(context.store.has(clip.video_sha256) and context.store.has(clip.poster_sha256) for clip in clips)
        assert clips[0].rollout.mode["imported"]["label"] == "slow, far"


def test_the_same_as_a_zip_file(context: WorkerContext, folder: Path) -> None:
    path = folder.parent / "my-clips.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in folder.rglob("*.*"):
            archive.write(file, Path("my-clips") / file.relative_to(folder))
    assert import_clips(context.database, context.store, path) == "handover-with-our-arm"


def test_nothing_is_simulated_for_it(context: WorkerContext, own: Study) -> None:
    with context.database.reading() as session:
        assert list(reconcile.due(session)) == []


def test_people_are_asked_and_a_reward_model_learns_what_they_want_in_the_labs_own_signals(
    context: WorkerContext, own: Study
) -> None:
    person = _answer_everything(context, own)
    with context.database.reading() as session:
        due = [job for job, _ in reconcile.due(session) if job.kind is RunKind.REWARD]
        assert len(due) == 1
    _train(context, due[0])
    with context.database.reading() as session:
        model = session.scalars(select(Model).where(Model.kind == ModelKind.REWARD)).one()
    assert set(model.metrics["weights"]) == {"speed_m_s", "distance_m"}
    assert model.metrics["weights"]["speed_m_s"]["mean"] < 0, "this person likes it slow"
    learned = load_reward_model(context.store.read(model.artefact_sha256))
    assert isinstance(learned, StructuredReward)
    assert learned.weights.shape[1] == 2
    with context.database.writing() as session:
        factories.make_run(session, own, session.get_one(Participant, person)).workflow_id = due[0].key + "/x"
        run = session.scalars(select(Model.run_id)).one()
        records.finish_run(session, run)
    with context.database.reading() as session:
        kinds = {job.kind for job, _ in reconcile.due(session)}
    assert kinds <= {RunKind.REPORT}, "no filter, no method, no film: there is no simulator to make them in"


def _answer_everything(context: WorkerContext, own: Study) -> int:
    """A person who prefers the slower clip, and what is near where both are equally fast."""
    with context.database.writing() as session:
        participant, _ = enrolment.add_participant(session, own)
        person = participant.id
    for _ in range(3):
        query_selection.refill_queries(context, person)
        with context.database.writing() as session:
            for query in records.unanswered(session, person, *dataset.CLIPS_AND_ROLLOUTS):
                left, right = (
                    dataset.stretch(context.store, clip).cut("signals").sum(axis=0)
                    for clip in (query.left_clip, query.right_clip)
                )
                says = Response.LEFT if tuple(left) < tuple(right) else Response.RIGHT
                factories.make_label(session, query, says, response_time_ms=900)
    with context.database.reading() as session:
        assert session.scalar(select(func.count(Query.id))) == 12
    return person


def _train(context: WorkerContext, job: Job) -> None:
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=5)
    train_reward(context, job, run_id, lambda _name, function, *arguments: function(*arguments))


def test_exports_hold_the_labs_own_signals_and_actions(context: WorkerContext, own: Study) -> None:
    person = _answer_everything(context, own)
    with context.database.reading() as session:
        stored = preference_arrays.arrays_of(session, context.store, own, session.get_one(Participant, person), set())
    assert stored is not None
    file = np.load(io.BytesIO(stored))
    assert list(file["signal_names"]) == ["speed_m_s", "distance_m"]
    assert file["signals"].shape == (12, 2, 20, 2)
    assert (file["actions"].shape[-1], file["observations"].shape[-1]) == (1, 0)


def test_npz_files_are_read_as_well(context: WorkerContext, folder: Path) -> None:
    signals = np.full((20, 2), 0.5, np.float32)
    np.savez(folder / "trajectories" / "one.npz", signals=signals, actions=np.zeros((20, 1)))
    edit(folder, lambda manifest: manifest["clips"][0].update(trajectory="trajectories/one.npz"))
    import_clips(context.database, context.store, folder)
    with context.database.reading() as session:
        clip = dataset.pool_clips(session, 1)[0]
        assert np.array_equal(dataset.stretch(context.store, clip).cut("signals"), signals)


def test_videos_that_browsers_cannot_play_are_converted(tmp_path: Path) -> None:
    import av

    path = tmp_path / "old.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for value in range(10):
            frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 20 * value, np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    made = playable(path.read_bytes())
    with av.open(io.BytesIO(made.video), "r") as container:
        assert container.streams.video[0].codec_context.name == "h264"
    assert (made.width, made.height, made.fps, made.duration_ms) == (64, 48, 10, 1000)


PLAYLISTS = {
    "concat": "ffconcat version 1.0\nfile secret.mp4\n",
    "pictures": "ffconcat version 1.0\nfile %d.png\noption format image2\n",
    "stream": "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nsecret.mp4\n#EXT-X-ENDLIST\n",
    "words": "a text, which FFmpeg would otherwise draw as a video of letters\n" * 99,
}


@pytest.mark.parametrize("name", PLAYLISTS)
def test_a_video_that_names_other_files_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "secret.mp4").write_bytes(encode_mp4(np.zeros((20, 48, 64, 3), np.uint8), 64, 48, 10))
    (tmp_path / name).write_text(PLAYLISTS[name])
    with pytest.raises(ValueError, match="not a video"):
        playable((tmp_path / name).read_bytes())


WRONG: list[tuple[str, Callable[[dict[str, Any]], None], str]] = [
    ("no such file", lambda m: m["clips"][0].update(video="videos/none.mp4"), "no file videos/none.mp4"),
    ("outside", lambda m: m["clips"][0].update(video="../../secret.mp4"), "no file"),
    ("another rate", lambda m: m.update(rate_hz=5), "same stretch of time"),
    ("unknown signal", lambda m: m["signals"][0].update(name="force_n"), "column force_n is missing"),
    ("alone", lambda m: m["clips"][0].update(scenario=9), "Scenario 9 has one clip only"),
    ("too many labels", lambda m: m["settings"].update(labels_per_participant=50), "12 pairs"),
    ("evaluation", lambda m: m["settings"].update(evaluation={}), "evaluation need the simulator"),
    ("following", lambda m: m["settings"].update(following_share=0.2), "following_share need the simulator"),
    ("unknown key", lambda m: m.update(secret=1), "secret"),
    ("no video", lambda m: m["clips"][0].update(video="manifest.json"), "not a video"),
]


@pytest.mark.parametrize(("change", "words"), [each[1:] for each in WRONG], ids=[each[0] for each in WRONG])
def test_what_is_wrong_is_said_and_nothing_is_imported(
    context: WorkerContext, folder: Path, change: Callable[[dict[str, Any]], None], words: str
) -> None:
    edit(folder, change)
    with pytest.raises(ClipsInvalid, match=re.escape(words)):
        import_clips(context.database, context.store, folder)
    with context.database.reading() as session:
        assert session.scalar(select(func.count(Study.id))) == 0
        assert session.scalar(select(func.count(Rollout.id))) == 0
        assert session.scalar(select(func.count(Clip.id))) == 0
    assert stored_files.names(context.store) == set()


@pytest.mark.parametrize("cell", ["nan", "", "inf", "fast"])
def test_numbers_that_are_none_are_refused(context: WorkerContext, folder: Path, cell: str) -> None:
    path = folder / "trajectories" / "slow_far_1.csv"
    path.write_text(path.read_text().replace("0.1,0.51", f"{cell},0.51", 1))
    with pytest.raises(ClipsInvalid, match=re.escape("trajectories/slow_far_1.csv")):
        import_clips(context.database, context.store, folder)


def _zipped(folder: Path, name: str, content: bytes) -> Path:
    """The example as a zip file, with something else in one of its files."""
    target = folder.with_name("swollen.zip")
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in folder.rglob("*.*"):
            inside = str(path.relative_to(folder))
            archive.writestr(inside, content if inside == name else path.read_bytes())
    return target


def _swollen_arrays() -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, signals=np.zeros((25_000_000, 2), np.float32))
    return file.getvalue()


def _boundless_arrays() -> bytes:
    """An array that says of itself that it has a billion rows."""
    member, file = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": "<f4", "fortran_order": False, "shape": (10**12, 2)})
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("signals.npy", member.getvalue())
    return file.getvalue()


@pytest.mark.parametrize("name", ["manifest.json", "videos/slow_far_1.mp4", "trajectories/slow_far_1.csv"])
def test_noughts_in_a_zip_file_fill_no_memory(context: WorkerContext, folder: Path, name: str) -> None:
    path = _zipped(folder, name, bytes(200 << 20))
    assert path.stat().st_size < 2 << 20
    _refused_within_memory(context, path)


def test_arrays_that_swell_fill_no_memory(context: WorkerContext, folder: Path) -> None:
    (folder / "trajectories" / "one.npz").write_bytes(_swollen_arrays())
    edit(folder, lambda manifest: manifest["clips"][0].update(trajectory="trajectories/one.npz"))
    _refused_within_memory(context, folder)


def test_an_array_that_says_it_is_boundless_is_refused(context: WorkerContext, folder: Path) -> None:
    """numpy asks for all that memory, and never touches it."""
    (folder / "trajectories" / "one.npz").write_bytes(_boundless_arrays())
    edit(folder, lambda manifest: manifest["clips"][0].update(trajectory="trajectories/one.npz"))
    with pytest.raises(ClipsInvalid, match=re.escape("trajectories/one.npz")):
        import_clips(context.database, context.store, folder)


def _refused_within_memory(context: WorkerContext, path: Path) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(ClipsInvalid):
            import_clips(context.database, context.store, path)
        assert tracemalloc.get_traced_memory()[1] < 48 << 20
    finally:
        tracemalloc.stop()
    assert stored_files.names(context.store) == set()


def test_a_table_with_the_line_ends_of_any_machine_is_read(context: WorkerContext, folder: Path) -> None:
    for path, end in zip(sorted((folder / "trajectories").iterdir()), (b"\r", b"\r\n", b"\n") * 3, strict=False):
        path.write_bytes(path.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", end))
    assert import_clips(context.database, context.store, folder)


def test_a_long_video_is_looked_at_picture_by_picture() -> None:
    long = encode_mp4((np.zeros((480, 640, 3), np.uint8) for _ in range(200)), 640, 480, 10)
    tracemalloc.start()
    try:
        assert playable(long).duration_ms == 20_000
        assert tracemalloc.get_traced_memory()[1] < 20 << 20, "two hundred pictures take 184 MB"
    finally:
        tracemalloc.stop()


def test_pairs_whose_videos_are_lost_make_room_for_others(context: WorkerContext, own: Study) -> None:
    with context.database.writing() as session:
        participant, _ = enrolment.add_participant(session, own)
    query_selection.refill_queries(context, participant.id)

    def waiting() -> list[Query]:
        with context.database.reading() as session:
            return list(records.unanswered(session, participant.id, *dataset.CLIPS_AND_ROLLOUTS))

    before = waiting()
    lost = before[0].left_clip
    with context.database.writing() as session:
        session.get_one(Query, before[0].id).served_at = now()
    stored_files.overwrite(context.store, lost.video_sha256, b"no video")
    assert not context.store.has(lost.video_sha256)
    with context.database.reading() as session:
        assert reconcile.with_lost_queries(session, context.store.lost()) != []
        assert list(reconcile.due(session, context.store.lost())) == [], "nobody can film another lab's robot again"
    query_selection.refill_queries(context, participant.id)
    after = waiting()
    showing = [query.id for query in after if lost.id in (query.left_clip_id, query.right_clip_id)]
    assert showing == [before[0].id], "the one in front of the participant may still be answered"
    with context.database.writing() as session:
        session.get_one(Query, before[0].id).served_at = now() - records.LIES_OPEN
    query_selection.refill_queries(context, participant.id)
    with context.database.reading() as session:
        shown = [clip for clip in dataset.pool_clips(session, own.id) if clip.id != lost.id]
        left_over = {frozenset((left.id, right.id)) for left, right in dataset.matched_pairs(shown)}
    assert {frozenset((query.left_clip_id, query.right_clip_id)) for query in waiting()} == left_over, "all there is"
    with context.database.reading() as session:
        assert reconcile.with_lost_queries(session, context.store.lost()) == []
