"""Watching a clip: ranges, caching, and who may."""

import os
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

from app.db import Database
from app.domain.clips import Clip
from app.files import lost
from app.storage import ArtefactStore
from tests import factories
from tests.app.conftest import TakingPart


@pytest.fixture
def clip(taking_part: TakingPart) -> Clip:
    with taking_part.database.reading() as session:
        return session.get_one(Clip, taking_part.queries[0].left_clip_id)


def test_a_clip_is_served_whole_and_kept_for_ever(taking_part: TakingPart, clip: Clip, store: ArtefactStore) -> None:
    answer = taking_part.browser.get(f"/media/{clip.video_sha256}.mp4")
    assert answer.status_code == 200
    assert answer.content == store.read(clip.video_sha256)
    assert answer.headers["content-type"] == "video/mp4"
    assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
    assert answer.headers["accept-ranges"] == "bytes"
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_poster_is_a_jpeg(taking_part: TakingPart, clip: Clip) -> None:
    answer = taking_part.browser.get(f"/media/{clip.poster_sha256}.jpg")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/jpeg")
    assert answer.content.startswith(b"\xff\xd8")


@pytest.mark.parametrize(
    ("asked", "span"),
    [("bytes=0-99", slice(0, 100)), ("bytes=100-", slice(100, None)), ("bytes=-50", slice(-50, None))],
)
def test_a_range_is_answered_with_that_range(
    taking_part: TakingPart, clip: Clip, store: ArtefactStore, asked: str, span: slice
) -> None:
    answer = taking_part.browser.get(f"/media/{clip.video_sha256}.mp4", headers={"Range": asked})
    assert answer.status_code == 206
    assert answer.content == store.read(clip.video_sha256)[span]


def test_a_range_beyond_the_end_is_refused(taking_part: TakingPart, clip: Clip) -> None:
    answer = taking_part.browser.get(f"/media/{clip.video_sha256}.mp4", headers={"Range": "bytes=99999999-"})
    assert answer.status_code == 416


def test_when_a_clip_was_made_is_not_told(taking_part: TakingPart, store: ArtefactStore, clip: Clip) -> None:
    """Films of a blinded evaluation are made in an order, and some are made again."""
    address = f"/media/{clip.video_sha256}.mp4"
    told = []
    for made_at_s in (1_700_000_000, 1_800_000_000):
        if path := store.files.local(lost.place(clip.video_sha256)):
            os.utime(path, (made_at_s, made_at_s))
        told.append({**taking_part.browser.get(address).headers} | {"date": "", "x-request-id": ""})
    assert told[0] == told[1]


def test_a_known_clip_is_not_sent_again(taking_part: TakingPart, clip: Clip) -> None:
    path = f"/media/{clip.video_sha256}.mp4"
    etag = taking_part.browser.get(path).headers["etag"]
    answer = taking_part.browser.get(path, headers={"If-None-Match": etag})
    assert (answer.status_code, answer.content) == (304, b"")
    resumed = taking_part.browser.get(path, headers={"Range": "bytes=0-9", "If-Range": etag})
    assert resumed.status_code == 206


def test_head_tells_the_size_without_the_content(taking_part: TakingPart, clip: Clip) -> None:
    answer = taking_part.browser.head(f"/media/{clip.video_sha256}.mp4")
    assert (answer.status_code, answer.content) == (200, b"")
    assert int(answer.headers["content-length"]) == clip.byte_count


def test_a_clip_of_another_study_does_not_exist(
    taking_part: TakingPart, clip: Clip, database: Database, new_browser: Callable[[], TestClient]
) -> None:
    with database.writing() as session:
        _, token = factories.make_participant(session, factories.make_study(session, "Another"))
    other = new_browser()
    other.get(f"/p/{token}")
    forbidden = other.get(f"/media/{clip.video_sha256}.mp4")
    unknown = other.get(f"/media/{'0' * 64}.mp4")
    assert (forbidden.status_code, unknown.status_code) == (404, 404)
    assert forbidden.text == unknown.text


def test_a_clip_that_was_made_for_somebody_exists_for_nobody_else_who_takes_part(
    taking_part: TakingPart, store: ArtefactStore, new_browser: Callable[[], TestClient], experimenter: TestClient
) -> None:
    with taking_part.database.writing() as session:
        made = factories.make_clip(session, store, taking_part.study, made_for=taking_part.participant)
        _, token = factories.make_participant(session, taking_part.study)
    other = new_browser()
    other.get(f"/p/{token}")
    for name in (f"{made.video_sha256}.mp4", f"{made.poster_sha256}.jpg"):
        watching = [each.get(f"/media/{name}").status_code for each in (taking_part.browser, experimenter, other)]
        assert watching == [200, 200, 404]


def test_without_a_cookie_no_clip_exists(taking_part: TakingPart, clip: Clip, client: TestClient) -> None:
    assert client.get(f"/media/{clip.video_sha256}.mp4").status_code == 404


def test_an_experimenter_may_watch_every_clip(taking_part: TakingPart, clip: Clip, experimenter: TestClient) -> None:
    assert experimenter.get(f"/media/{clip.video_sha256}.mp4").status_code == 200


def test_only_clips_are_served_and_no_other_artefact(taking_part: TakingPart, store: ArtefactStore) -> None:
    secret = store.put(b"a model")
    assert taking_part.browser.get(f"/media/{secret}.mp4").status_code == 404


def test_a_clip_whose_file_is_lost_is_not_found(taking_part: TakingPart, clip: Clip, store: ArtefactStore) -> None:
    store.delete(clip.video_sha256)
    assert taking_part.browser.get(f"/media/{clip.video_sha256}.mp4").status_code == 404
