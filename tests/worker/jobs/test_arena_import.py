"""Paired evaluations in RoboArena's layout become a study, without running what their files have pickled."""

import io
import os
import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from sqlalchemy import func, select

from app.db import Database
from app.domain.studies import Study
from app.storage import ArtefactStore
from tests import stored_files
from tests.worker.at_hand import AtHand
from worker.jobs.clips import plain_pickle
from worker.jobs.clips.arena_folder import ArenaFolder
from worker.jobs.clips.import_clips import ClipsInvalid, import_clips
from worker.jobs.clips.own_clips import Choices
from worker.jobs.clips.plain_pickle import PickleRefused
from worker.jobs.learning import dataset
from worker.jobs.runtime.context import WorkerContext
from worker.sim.render.video import encode_mp4

STEPS = 15
POLICIES = {"A": ("pi0_droid", 1.0), "B": ("pi0_fast_droid", 0.25), "C": ("paligemma_vq_droid", 0.0)}
LEFT = Choices(camera="left")


def objects(rows: list[dict[str, Any]]) -> Any:
    """As the evaluation client collects them: an array of dictionaries."""
    found = np.empty(len(rows), object)
    found[:] = rows
    return found


def steps(pace: float) -> list[dict[str, Any]]:
    return [
        {
            "cartesian_position": np.array([pace * step, 0, 0.3, 0, 0, 0]),
            "joint_position": np.zeros(7),
            "gripper_position": np.array([0.5]),
            "action": np.full(8, pace, np.float32),
        }
        for step in range(STEPS)
    ]


@cache
def film() -> bytes:
    """A picture per step, at another pace than the robot's."""
    return encode_mp4((np.full((48, 64, 3), 9 * step, np.uint8) for step in range(STEPS)), 64, 48, 10)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four sessions of three policies; files are named in both ways that dumps have had."""
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "DataDump"
    for session in range(4):
        place = root / "evaluation_sessions" / f"session-{session}"
        for number, (letter, (name, _)) in enumerate(POLICIES.items()):
            inside = place / f"{letter}_{name}"
            inside.mkdir(parents=True)
            np.savez(inside / "proprio_and_actions.npz", data=objects(steps(0.01 * (number + 1))))
            prefix = f"{name}_2025_04_29_video_" if session % 2 else ""
            for camera in ("left", "right", "wrist"):
                (inside / f"{prefix}{camera}.mp4").write_bytes(film())
        said = {
            "language_instruction": "put the cup on the plate",
            "policies": {key: {"policy_name": name, "partial_success": done} for key, (name, done) in POLICIES.items()},
        }
        (place / "metadata.yaml").write_text(yaml.safe_dump(said))
    return root


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, AtHand())


def test_policies_of_one_session_are_compared(context: WorkerContext, folder: Path) -> None:
    slug = import_clips(context.database, context.store, folder, LEFT)
    with context.database.reading() as session:
        study = session.scalars(select(Study).where(Study.slug == slug)).one()
        clips = dataset.pool_clips(session, study.id)
    assert len(dataset.matched_pairs(clips)) == 12
    assert {clip.rollout.mode["imported"]["policy"] for clip in clips} == {name for name, _ in POLICIES.values()}
    assert [clip.rollout.success for clip in clips[:3]] == [True, False, False]
    assert {clip.duration_ms for clip in clips} == {1000}, "fifteen steps at fifteen a second, whatever the film says"
    second = dataset.stretch(context.store, clips[1])
    assert second.trajectory.observations.shape == (STEPS + 1, 7)
    assert np.allclose(second.cut("signals")[3], [1 / 15, 0.02 * 15, (0.02 * 15) ** 2, 0, 0], atol=1e-4)


@pytest.mark.parametrize("protocol", range(2, 6))
def test_what_numpy_pickles_is_read_as_numpy_reads_it(protocol: int) -> None:
    rows = [
        {"a": (np.arange(6) % 2).astype(kind), "b": 0.5, "c": [1, 2.0, np.float32(3)]}
        for kind in ("f8", "f4", "i2", "?")
    ]
    content = io.BytesIO()
    header = np.lib.format.header_data_from_array_1_0(objects(rows))
    np.lib.format.write_array_header_1_0(content, header)
    pickle.dump(objects(rows), content, protocol=protocol)
    read = plain_pickle.rows(content.getvalue())
    assert [list(each["a"]) for each in read] == [list(np.asarray(row["a"], float)) for row in rows]
    assert [list(each["c"]) for each in read] == [[1, 2, 3]] * 4


class _Calls:
    """Pickled, this is a call of whatever it was made with."""

    def __init__(self, what: Callable[..., Any], *arguments: Any) -> None:
        self._said = what, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self._said


MEMO = b"\x80\x04K\x01r\xff\xff\xff\x7f."
"""Puts one number at place two thousand million of a table."""
HOSTILE: dict[str, Any] = {
    "a command": (_Calls(os.system, "touch was-run"), "it wants to call"),
    "a file": (_Calls(open, "/etc/hostname"), "it wants to call"),
    "another part of NumPy": (_Calls(np.fromfile, "/etc/hostname"), "it wants to call"),
    "our own class": (_Calls(plain_pickle.PickleRefused, "x"), "it wants to call"),
    "no array": ([1, 2], "something else"),
    "no dictionaries": (objects([[1], [2]]), "something else"),  # type: ignore[list-item]  # that is what is wrong
    "a table of gigabytes": (MEMO, "something else"),
    "half a file": (pickle.dumps(objects([{"a": np.zeros(9)}]))[:-20], "damaged"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_pickle_runs_nothing_and_fills_no_memory(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    value, words = HOSTILE[name]
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": "|O", "fortran_order": False, "shape": (1,)})
    content.write(value if isinstance(value, bytes) else pickle.dumps(value))
    with pytest.raises(PickleRefused, match=words):
        plain_pickle.rows(content.getvalue())
    assert not Path("was-run").exists()


def _first(folder: Path) -> Path:
    return folder / "evaluation_sessions" / "session-0" / "A_pi0_droid"


def _saved(**arrays: Any) -> Callable[[Path], None]:
    return lambda folder: np.savez(_first(folder) / "proprio_and_actions.npz", **arrays)


def _policy(folder: Path) -> None:
    (folder / "evaluation_sessions/session-0/metadata.yaml").write_text("policies: {B: {}, C: {}}")


def _code(folder: Path) -> None:
    text = "policies: !!python/object/apply:os.system ['touch was-run']"
    (folder / "evaluation_sessions/session-0/metadata.yaml").write_text(text)


def _linked(folder: Path) -> None:
    film = _first(folder) / "left.mp4"
    film.rename(folder / "left.mp4")
    film.symlink_to(folder / "left.mp4")


WRONG: dict[str, tuple[Callable[[Path], None], str]] = {
    "no policy": (_policy, "says nothing about policy 'A'"),
    "code": (_code, "metadata.yaml: could not determine a constructor"),
    "a link": (_linked, "has not one *.mp4 that fits"),
    "no film": (
        lambda folder: (_first(folder) / "left.mp4").unlink(),
        "that fits, but: right, wrist",
    ),
    "no arrays": (lambda folder: (_first(folder) / "proprio_and_actions.npz").unlink(), "has not one *.npz"),
    "another length": (_saved(data=objects(steps(1.0) * 2)), "left.mp4: a video that has 15 pictures for the 30 steps"),
    "a number is missing": (_saved(data=objects([*steps(1.0)[:-1], {}])), "cartesian_position is missing"),
    "not a number": (_saved(cartesian_position=np.full((15, 6), np.nan), action=np.zeros((15, 8))), "not finite"),
    "other lengths": (_saved(cartesian_position=np.zeros((15, 6)), action=np.zeros((9, 8))), "of different lengths"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said(name: str, folder: Path) -> None:
    spoil, words = WRONG[name]
    spoil(folder)
    with pytest.raises(ClipsInvalid) as refused:
        list(ArenaFolder(folder, LEFT).clips())
    assert words in str(refused.value)
    assert not Path("was-run").exists()


def test_nothing_is_kept_of_what_is_wrong_at_its_end(context: WorkerContext, folder: Path) -> None:
    (folder / "evaluation_sessions/session-3/C_paligemma_vq_droid/proprio_and_actions.npz").write_bytes(b"PK")
    with pytest.raises(ClipsInvalid, match="session-3/C_paligemma"):
        import_clips(context.database, context.store, folder, LEFT)
    with context.database.reading() as session:
        assert session.scalar(select(func.count(Study.id))) == 0
    assert stored_files.names(context.store) == set()


def test_which_camera_must_be_said(folder: Path) -> None:
    with pytest.raises(ClipsInvalid, match=r"left, right, wrist. Say which camera is shown, with --camera"):
        list(ArenaFolder(folder, Choices()).clips())
