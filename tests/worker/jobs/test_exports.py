"""The whole data of a study as one file that pandas, R's arrow and other learning libraries read."""

import csv
import io
import json
import re
import sys
import types
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as parquet
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db import Database
from app.domain.clips import Clip, Rollout
from app.domain.models import Export
from app.domain.preferences import Query, Response
from app.domain.studies import Participant, Study
from app.services.exports import export_requests, export_tables
from app.services.exports.export_requests import ExportKind
from app.storage import ArtefactStore
from tests import stored_files
from tests.worker.conftest import filmed
from worker.compute.pools import Compute
from worker.domain.trajectory import SIGNALS
from worker.jobs import reconcile
from worker.jobs.learning import dataset
from worker.jobs.publishing import export_files
from worker.jobs.runtime import records
from worker.jobs.runtime.context import WorkerContext

DOCS = Path(__file__).resolve().parents[3] / "docs"
AddClips = Callable[..., list[Clip]]
Answer = Callable[[Clip, Clip, Response], Query]
SAID = (Response.LEFT, Response.RIGHT, Response.EQUAL, Response.SKIP)


@pytest.fixture
def context(database: Database, store: ArtefactStore) -> WorkerContext:
    return WorkerContext(database, store, Compute(1))


@pytest.fixture
def pairs(add_clips: AddClips, answer: Answer) -> list[tuple[Clip, Clip]]:
    """Four answered pairs, one of each kind of answer."""
    clips = add_clips(1)
    shown = [(clips[0], clips[1]), (clips[2], clips[1]), (clips[2], clips[3]), (clips[3], clips[0])]
    for (left, right), response in zip(shown, SAID, strict=True):
        answer(left, right, response)
    return shown


def make_export(context: WorkerContext, study: Study, kind: ExportKind = ExportKind.DATA) -> zipfile.ZipFile:
    with context.database.writing() as session:
        export_requests.request(session, session.get_one(Study, study.id), kind, "experimenter")
    with context.database.reading() as session:
        (job,) = export_files.due(session, session.get_one(Study, study.id))
        assert job.key in {each.key for each, _ in reconcile.due(session)}
    with context.database.writing() as session:
        run_id = records.begin_run(session, job, seed=1)
    export_files.make(context, job, run_id, lambda _name, function, *arguments: function(*arguments))
    with context.database.reading() as session:
        export = session.scalars(select(Export).order_by(Export.id.desc())).first()
        assert export is not None
        assert export_files.due(session, session.get_one(Study, study.id)) == []
    assert export.artefact_sha256 is not None
    return zipfile.ZipFile(io.BytesIO(context.store.read(export.artefact_sha256)))


def test_all_formats_have_the_same_rows(context: WorkerContext, study: Study, pairs: list[tuple[Clip, Clip]]) -> None:
    archive = make_export(context, study)
    for table in export_tables.TABLES:
        plain = list(csv.DictReader(io.TextIOWrapper(archive.open(f"csv/{table.name}.csv"))))
        lines = archive.read(f"jsonl/{table.name}.jsonl").decode().splitlines()
        frame = pd.read_parquet(io.BytesIO(archive.read(f"parquet/{table.name}.parquet")))
        assert len(plain) == len(lines) == len(frame)
        assert list(frame.columns) == [column.name for column in table.all_columns]
    frame = pd.read_parquet(io.BytesIO(archive.read("parquet/queries.parquet")))
    assert list(frame["response"]) == ["left", "right", "equal", "skip"]
    assert str(frame["answered_at"].dtype).startswith("datetime64")


def test_the_file_explains_itself(context: WorkerContext, study: Study, pairs: list[tuple[Clip, Clip]]) -> None:
    archive = make_export(context, study)
    assert "not locked" in archive.read("README.md").decode()
    about = json.loads(archive.read("provenance.json"))
    assert (about["lock_hash"], about["deviations"], about["settings"]) == ("not locked", [], study.stored_settings)
    described = {
        (row["table"], row["column"]) for row in csv.DictReader(io.TextIOWrapper(archive.open("dictionary.csv")))
    }
    assert described == {(table.name, column.name) for table in export_tables.TABLES for column in table.all_columns}
    assert archive.testzip() is None


def test_an_export_that_somebody_withdraws_from_while_it_is_made_is_made_again_without_them(
    context: WorkerContext,
    study: Study,
    participant: Participant,
    pairs: list[tuple[Clip, Clip]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from app.services.participants import withdrawal

    write, held = export_files.write_data, list[str]()

    def withdrawing(session: Session, context: WorkerContext, study: Study, path: Path) -> Any:
        missing = write(session, context, study, path)
        with zipfile.ZipFile(path) as made:
            held.append(made.read("csv/labels.csv").decode())
        with context.database.writing() as another:
            withdrawal.withdraw(another, context.store, another.get_one(Participant, participant.id), "P01")
        return missing

    monkeypatch.setattr(export_files, "write_data", withdrawing)
    made = make_export(context, study)
    assert ["P01," in each for each in held] == [True, False], "made twice"
    assert "withdrawn" in made.read("csv/participants.csv").decode()
    assert "P01" not in made.read("csv/labels.csv").decode()
    assert list(context.store.unfinished.root.iterdir()) == []
    with context.database.reading() as session:
        kept = {each.artefact_sha256 for each in session.scalars(select(Export))}
    assert stored_files.names(context.store) - withdrawal_keeps(context) == kept


def withdrawal_keeps(context: WorkerContext) -> set[str]:
    """Files of the pool, which belongs to nobody."""
    with context.database.reading() as session:
        clips = session.scalars(select(Clip)).all()
        rollouts = session.scalars(select(Rollout)).all()
    return {
        *(each.trajectory_sha256 for each in rollouts),
        *(each.video_sha256 for each in clips),
        *(each.poster_sha256 for each in clips),
    }


@pytest.mark.parametrize("damage", [stored_files.lose, stored_files.damage])
@pytest.mark.parametrize("kind", ExportKind)
def test_a_lost_or_damaged_recording_is_left_out_and_said_to_be(
    context: WorkerContext,
    study: Study,
    pairs: list[tuple[Clip, Clip]],
    kind: ExportKind,
    damage: Callable[[ArtefactStore, str], None],
    experimenter: TestClient,
) -> None:
    with context.database.writing() as session:
        session.get_one(Study, study.id).unblinded_at = study.created_at
        filmed(session, context.store)
        lost = session.get_one(Rollout, pairs[0][0].rollout_id).trajectory_sha256
        others = len(session.scalars(select(Rollout.trajectory_sha256).distinct()).all()) - 1
    damage(context.store, lost)
    made = make_export(context, study, kind)
    if kind is ExportKind.DATA:
        arrays = np.load(io.BytesIO(made.read("pairs/P01.npz")), allow_pickle=False)
        assert list(arrays["ordinals"]) == [2, 3]
        assert lost in made.read("README.md").decode()
        assert lost in json.dumps(json.loads(made.read("provenance.json"))["missing"])
    elif kind is ExportKind.LEROBOT:
        assert json.loads(made.read("meta/info.json"))["total_episodes"] == others
        assert len(parquet.read_table(io.BytesIO(made.read("preferences/preferences.parquet")))) == 2
    else:
        manifest = json.loads(made.read("manifest.json"))
        assert lost in manifest["missing"]
        assert len([each for each in manifest["files"] if each in _trajectories(context)]) == others
    page = experimenter.get(f"/studies/{study.slug}/export").text
    assert re.search(r"Without \d+ stored files? that (is|are) missing or damaged", page)
    assert lost[:12] in page


def _trajectories(context: WorkerContext) -> set[str]:
    with context.database.reading() as session:
        return set(session.scalars(select(Rollout.trajectory_sha256)))


# --- other libraries ---


@dataclass(frozen=True)
class TrajectoryWithRew:
    """What imitation.data.types.TrajectoryWithRew checks."""

    obs: Any
    acts: Any
    infos: Any
    terminal: bool
    rews: Any

    def __post_init__(self) -> None:
        assert len(self.obs) == len(self.acts) + 1
        assert self.rews.shape == (len(self.acts),)


@pytest.fixture
def snippet(
    context: WorkerContext,
    study: Study,
    pairs: list[tuple[Clip, Clip]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Callable[[str], dict[str, Any]]]:
    """Runs one piece of code of docs/arrays.md beside the exported files; gives what it has made."""
    make_export(context, study).extract("pairs/P01.npz", tmp_path)
    monkeypatch.chdir(tmp_path)
    module = types.ModuleType("imitation.data.types")
    module.TrajectoryWithRew = TrajectoryWithRew  # type: ignore[attr-defined]
    for name in ("imitation", "imitation.data"):
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
    monkeypatch.setitem(sys.modules, "imitation.data.types", module)

    def run(name: str) -> dict[str, Any]:
        code = re.search(rf"```python {name}\n(.*?)```", (DOCS / "arrays.md").read_text(), re.DOTALL)
        assert code is not None
        exec(code[1], made)  # noqa: S102  (our own documentation)
        return made

    made: dict[str, Any] = {}
    yield run
    made["file"].close()


def test_arrays_have_the_documented_layout(
    context: WorkerContext, study: Study, pairs: list[tuple[Clip, Clip]], tmp_path: Path
) -> None:
    file = np.load(io.BytesIO(make_export(context, study).read("pairs/P01.npz")), allow_pickle=False)
    documented = set(re.findall(r"^\| `(\w+)`(?:, `(\w+)`)?", (DOCS / "arrays.md").read_text(), re.MULTILINE))
    assert set(file) == {name for names in documented for name in names if name}
    count, steps = 3, 20
    assert file["observations"].shape == (count, 2, steps, 28)
    assert file["actions"].shape == (count, 2, steps, 7)
    assert file["signals"].shape == (count, 2, steps, len(SIGNALS))
    assert file["masks"].shape == (count, 2, steps)
    assert list(file["signal_names"]) == list(SIGNALS)
    assert list(file["targets"]) == [0.0, 1.0, 0.5], "left, right, equal; can't tell is left out"
    left, right = (dataset.shown(context.store, _with_rollout(context, clip)) for clip in pairs[1])
    assert np.array_equal(file["signals"][1, 0], left.signals[:20])
    assert np.array_equal(file["actions"][1, 1], right.actions[:20])
    about = json.loads(str(file["about"]))
    assert (about["participant"], about["lock_hash"], about["deviations"]) == ("P01", None, "none")


def _with_rollout(context: WorkerContext, clip: Clip) -> Clip:
    with context.database.reading() as session:
        return next(each for each in dataset.pool_clips(session, 1) if each.id == clip.id)


def test_imitation_reads_preferences_for_the_first_fragment(snippet: Callable[[str], dict[str, Any]]) -> None:
    made = snippet("imitation")
    assert list(made["preferences"]) == [1.0, 0.0, 0.5], "left was preferred first: the first fragment, so 1"
    assert made["preferences"].dtype == np.float32
    first, second = made["fragments"][0]
    assert np.array_equal(first.acts, made["file"]["actions"][0, 0])
    assert np.array_equal(second.obs[-1], made["file"]["last_observations"][0, 1])


def test_b_pref_reads_labels_for_the_second_segment(snippet: Callable[[str], dict[str, Any]]) -> None:
    made = snippet("b-pref")
    assert made["labels"].tolist() == [[0], [1], [-1]]
    assert made["sa_t_1"].shape == made["sa_t_2"].shape == (3, 20, 35)
    assert np.array_equal(made["act_2"], made["file"]["actions"][:, 1])


def test_the_preference_transformer_reads_one_hot_labels(snippet: Callable[[str], dict[str, Any]]) -> None:
    made = snippet("preference-transformer")["batch"]
    assert made["labels"].tolist() == [[1, 0], [0, 1], [0.5, 0.5]]
    assert made["observations_2"].shape == (3, 20, 28)
    assert made["timestep_1"][0, 0] == 1
