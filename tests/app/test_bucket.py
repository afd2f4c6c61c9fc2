"""Stored files in a bucket: machines without a common disk, large files, a server that is away."""

import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select

from app.db import Database
from app.domain.clips import Clip
from app.domain.models import ModelKind
from app.domain.preferences import count_labels
from app.domain.studies import Participant, Study
from app.files import bucket, lost
from app.files.bucket import Bucket, BucketRefused
from app.files.interface import PIECE_BYTES, StorageUnavailable
from app.settings import Settings
from app.storage import ArtefactDamaged, ArtefactMissing, ArtefactStore
from tests import factories, on_s3, stored_files
from tests.app.conftest import TakingPart
from tests.waiting import free_port, until

LARGE = os.urandom(1 << 20) * 9 + b"the end"


@pytest.fixture(scope="module")
def server() -> Iterator[dict[str, str]]:
    with on_s3.serving() as environment:
        yield environment


@pytest.fixture
def settings(tmp_path: Path, server: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> Settings:
    """Of one machine."""
    for name, value in server.items():
        monkeypatch.setenv(name, value)
    url = f"s3://{on_s3.BUCKET}/{uuid4().hex}"
    return Settings(_env_file=None, data_dir=tmp_path, public_url=None, storage_url=url)


@pytest.fixture
def other(settings: Settings, tmp_path: Path) -> ArtefactStore:
    """The store as another machine sees it."""
    return ArtefactStore.of(settings.model_copy(update={"data_dir": tmp_path / "of another machine"}))


@pytest.fixture
def away(store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Makes the server unreachable from now on."""

    def go_away() -> None:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
        assert isinstance(store.files, Bucket)
        store.files._s3 = Bucket(store.files.url)._s3
        store.files._known.clear()

    return go_away


@pytest.fixture
def large(store: ArtefactStore, settings: Settings) -> str:
    """A file that is too large to be kept in memory."""
    store.unfinished.root.mkdir()
    path = store.unfinished.root / "export.zip"
    path.write_bytes(LARGE)
    sha256 = store.take(path)
    assert not path.exists()
    return sha256


def test_what_one_machine_stores_another_reads(store: ArtefactStore, other: ArtefactStore) -> None:
    sha256 = store.put(b"a clip")
    assert other.read(sha256) == b"a clip"
    other.delete(sha256)
    with pytest.raises(ArtefactMissing):
        ArtefactStore(store.root, Bucket(store.files.url)).read(sha256)  # type: ignore[attr-defined]


def test_nothing_is_kept_in_the_data_directory(store: ArtefactStore, settings: Settings, large: str) -> None:
    store.read(store.put(b"a clip"))
    list(store.verified(large).pieces())
    assert {path.name for path in settings.data_dir.rglob("*") if path.is_file()} <= {"studio.sqlite3"}


def test_a_large_file_comes_in_pieces_and_is_never_kept(store: ArtefactStore, large: str) -> None:
    pieces = list(store.verified(large).pieces())
    assert max(map(len, pieces)) == PIECE_BYTES
    assert b"".join(pieces) == LARGE
    assert isinstance(store.files, Bucket)
    assert store.files._kept_bytes == 0


def test_what_is_kept_in_memory_has_a_bound(store: ArtefactStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bucket, "KEPT_BYTES", 1000)
    kept = [store.put(os.urandom(400)) for _ in range(5)]
    assert all(len(store.read(sha256)) == 400 for sha256 in (*kept, *kept))
    assert isinstance(store.files, Bucket)
    assert store.files._kept_bytes == 800 == sum(len(each.content or b"") for each in store.files._known.values())


def test_damage_is_found_on_every_machine_and_known_to_all(store: ArtefactStore, other: ArtefactStore) -> None:
    sha256, missing = store.put(b"a clip"), store.put(b"another")
    stored_files.damage(other, sha256)
    stored_files.lose(other, missing)
    with pytest.raises(ArtefactDamaged):
        store.read(sha256)
    assert not store.has(missing)
    assert not store.seems_whole(sha256)
    assert until(lambda: other.lost().keys() == {sha256, missing})
    other.put(b"a clip")
    assert store.read(sha256) == b"a clip"
    assert other.lost().keys() == {missing}


def test_what_was_seen_whole_is_asked_for_again_after_a_while(
    store: ArtefactStore, other: ArtefactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    sha256 = store.put(b"a clip")
    assert store.has(sha256)
    other.delete(sha256)
    monkeypatch.setattr(bucket, "TRUSTED_S", -1.0)
    assert not store.has(sha256)


class TestOnline:
    """Pages of a studio whose files lie in a bucket."""

    @pytest.fixture
    def clip(self, taking_part: TakingPart, store: ArtefactStore) -> Clip:
        """One that is larger than what is kept."""
        with taking_part.database.writing() as session:
            clip = session.get_one(Clip, taking_part.queries[0].left_clip_id)
            store.unfinished.root.mkdir(exist_ok=True)
            (store.unfinished.root / "video").write_bytes(LARGE)
            clip.video_sha256 = store.take(store.unfinished.root / "video")
        return clip

    @pytest.mark.parametrize(
        ("asked", "status", "span"),
        [
            (None, 200, slice(None)),
            ("bytes=0-99", 206, slice(0, 100)),
            ("bytes=5000000-", 206, slice(5_000_000, None)),
            ("bytes=-50", 206, slice(-50, None)),
            ("bytes=4194300-4194310", 206, slice(4194300, 4194311)),
            ("bytes=0-1,5-6", 200, slice(None)),
            ("bytes=9-5", 200, slice(None)),
            ("bytes=999999999-", 416, slice(0, 0)),
        ],
    )
    def test_large_videos_are_sent_in_ranges(
        self, taking_part: TakingPart, clip: Clip, asked: str | None, status: int, span: slice
    ) -> None:
        headers = {"Range": asked} if asked else {}
        answer = taking_part.browser.get(f"/media/{clip.video_sha256}.mp4", headers=headers)
        assert (answer.status_code, answer.content) == (status, LARGE[span])
        assert answer.headers["etag"] == f'"{clip.video_sha256}"'
        if status == 206:
            first, end, _ = span.indices(len(LARGE))
            assert answer.headers["content-range"] == f"bytes {first}-{end - 1}/{len(LARGE)}"
        asked_head = taking_part.browser.head(f"/media/{clip.video_sha256}.mp4", headers=headers)
        assert asked_head.headers.get("content-length", "0") == str(len(LARGE[span]))

    def test_a_damaged_video_is_not_sent(self, taking_part: TakingPart, clip: Clip, store: ArtefactStore) -> None:
        stored_files.damage(store, clip.video_sha256)
        assert taking_part.browser.get(f"/media/{clip.video_sha256}.mp4").status_code == 404
        assert clip.video_sha256 in store.lost()

    def test_answers_are_kept_while_the_server_is_away(
        self, taking_part: TakingPart, clip: Clip, away: Callable[[], None], database: Database
    ) -> None:
        away()
        query = taking_part.queries[0]
        video = taking_part.browser.get(f"/media/{clip.video_sha256}.mp4")
        assert video.status_code == 503
        assert "Nothing that was answered is lost" in video.text
        assert taking_part.turn().json()["pair"]["query_id"] == query.id
        said = taking_part.answer(query)
        assert said.json()["pair"]["query_id"] != query.id, "and the next pair is there as well"
        with database.reading() as session:
            assert list(count_labels(session, select(Participant.id)).values()) == [1]

    def test_nothing_of_somebody_who_has_withdrawn_is_left(
        self, taking_part: TakingPart, clip: Clip, store: ArtefactStore, database: Database
    ) -> None:
        """Pool clips are nobody's."""
        with database.writing() as session:
            study = session.get_one(Study, taking_part.study.id)
            person = session.get_one(Participant, taking_part.participant.id)
            model = factories.make_model(session, study, person, ModelKind.FILTER, factories.filter_metrics())
            theirs = factories.make_bundle(session, store, model).artefact_sha256
        folder = store.unfinished.folder(taking_part.participant.id) / "run-1"
        folder.mkdir(parents=True)
        (folder / "state.safetensors").write_bytes(b"half way")
        store.unfinished.keep(folder)
        assert store.has(theirs)
        taking_part.browser.post("/p/withdraw")
        assert not store.holds(theirs)
        assert store.holds(clip.video_sha256)
        assert list(store.files.found("unfinished")) == []

    def test_dashboards_are_drawn_while_the_server_is_away(
        self, experimenter: TestClient, taking_part: TakingPart, away: Callable[[], None]
    ) -> None:
        away()
        assert experimenter.get("/studies").status_code == 200
        assert taking_part.browser.get("/p/next").status_code == 200

    def test_dashboards_say_so(
        self,
        experimenter: TestClient,
        taking_part: TakingPart,
        store: ArtefactStore,
        away: Callable[[], None],
        monkeypatch: pytest.MonkeyPatch,
    ) -> None:
        monkeypatch.setattr(lost, "LOOK_AGAIN_S", 0.2)
        assert isinstance(store.files, Bucket)
        there, nowhere = store.files._s3, Bucket("s3://no-such-bucket/part")._s3
        pages = ["/studies", f"/studies/{taking_part.study.slug}"]

        def all_say(words: str) -> bool:
            return all(words in experimenter.get(page).text for page in pages)

        def none_complains() -> bool:
            return not any("Stored files cannot be used" in experimenter.get(page).text for page in pages)

        assert none_complains()
        away()
        assert until(lambda: all_say("Stored files cannot be reached at the moment"))
        store.files._s3 = there
        assert until(none_complains)
        store.files._s3 = nowhere
        assert until(lambda: all_say("There is no bucket"))
        store.files._s3 = there
        assert until(none_complains)


def test_a_wrong_name_or_key_is_refused_at_the_start_and_a_server_that_is_away_is_not(
    store: ArtefactStore, away: Callable[[], None], server: dict[str, str]
) -> None:
    store.files.require_usable()
    with pytest.raises(BucketRefused, match="no bucket"):
        Bucket("s3://no-such-bucket/part").require_usable()
    away()
    store.files.require_usable()
    with pytest.raises(StorageUnavailable):
        store.put(b"a clip")


def test_only_the_person_s_own_folder_is_forgotten(store: ArtefactStore) -> None:
    for participant_id in (7, 70):
        folder = store.unfinished.folder(participant_id) / "run-1"
        folder.mkdir(parents=True)
        (folder / "state.safetensors").write_bytes(b"half way")
        store.unfinished.keep(folder)
    store.unfinished.forget(store.unfinished.folder(7))
    assert [name for name, _ in store.files.found("unfinished")] == ["participant-70/run-1/state.safetensors"]


def test_a_training_goes_on_at_another_machine(store: ArtefactStore, other: ArtefactStore) -> None:
    here, there = store.unfinished.folder(7) / "run-3", other.unfinished.folder(7) / "run-3"
    for folder in (here, there):
        folder.mkdir(parents=True)
    for content in (b"half way", b"nearly done"):
        (here / "state.safetensors").write_bytes(content)
        os.utime(here / "state.safetensors", ns=(time.time_ns(), time.time_ns()))
        (here / "share").write_text("0.5")
        store.unfinished.keep(here)
    other.unfinished.bring(there)
    assert {path.name: path.read_bytes() for path in there.iterdir()} == {"state.safetensors": b"nearly done"}
    other.unfinished.forget(other.unfinished.folder(7))
    assert not there.exists()
    assert list(store.files.found("unfinished")) == []


@pytest.mark.parametrize(
    "url", ["s3:/studio", "http://server/studio", "s3://Studio", "s3://studio/../other", "gs://x/y"]
)
def test_only_buckets_are_addresses(url: str) -> None:
    with pytest.raises(ValueError, match="s3://bucket"):
        Settings(_env_file=None, storage_url=url)


def test_names_say_what_lies_in_the_bucket(store: ArtefactStore) -> None:
    sha256 = store.put(b"a clip")
    assert [name for name, _ in store.files.found(lost.ARTEFACTS)] == [f"{sha256[:2]}/{sha256}"]


def test_a_server_that_answers_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch, settings: Settings) -> None:
    """It is given ten seconds, not the three minutes that are usual: somebody may be waiting."""
    monkeypatch.setattr(bucket, "REQUEST_S", 1)
    monkeypatch.setattr(bucket, "RETRIES", 1)
    with ExitStack() as stack:
        deaf = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{deaf.getsockname()[1]}")
        with pytest.raises(StorageUnavailable):
            Bucket(settings.storage_url or "").put("artefacts/xx/y", b"a clip")
