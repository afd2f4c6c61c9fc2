"""An archive that somebody has changed brings nothing in that an export does not write, and fills no memory."""

import hashlib
import io
import json
import random
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import func, select

from app.db import Base, Database
from app.domain.studies import Deviation, Study
from app.services.archives import archive, archive_reading, study_import, unpacking
from app.services.archives.archive import ArchiveInvalid
from app.services.studies import locking
from app.storage import ArtefactStore
from tests import databases, stored_files
from tests.databases import make_tables
from tests.finished_study import make_finished_study

Row = dict[str, Any]
Change = Callable[[dict[str, list[Row]]], None]
MEGABYTE = 1 << 20
MOST_MEMORY = 24 * MEGABYTE
"""For whatever is sent."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of a locked study with everything in it, from another installation."""
    folder = tmp_path_factory.mktemp("elsewhere")
    with databases.lent(folder) as url:
        there = Database(url)
        make_tables(there)
        _fill(there, folder)
        there.dispose()
    return folder / "study.zip"


def _fill(there: Database, folder: Path) -> None:
    with there.writing() as session:
        store = ArtefactStore(folder / "artefacts")
        study = make_finished_study(session, store, people=2, labels=3)
        locking.lock(session, study, study.slug, "experimenter")
        study.join_token = "somebody"
        session.add(
            Deviation(study_id=study.id, actor="Ada", reason="More time", before={"seed": 1}, after={"seed": 7})
        )
        session.flush()
        archive.write(session, store, study, folder / "study.zip")


@pytest.fixture
def packed(written: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(written, tmp_path / "study.zip"))


def forged(packed: Path, change: Change, manifest: Callable[[dict[str, Any]], Any] = lambda each: each) -> Path:
    """The archive with other rows, and a manifest that fits them."""
    target = packed.with_name("forged.zip")
    with zipfile.ZipFile(packed) as source:
        said = json.loads(source.read("manifest.json"))
        rows = {name: _rows(source.read(f"rows/{name}.jsonl")) for name in said["tables"]}
        change(rows)
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as copy:
            for name, each in rows.items():
                content = b"".join(_line(row) for row in each)
                copy.writestr(f"rows/{name}.jsonl", content)
                said["tables"][name] = {"rows": len(each), "sha256": hashlib.sha256(content).hexdigest()}
            said["lock_hash"] = rows["study"][0].get("lock_hash")
            for sha256 in said["files"]:
                copy.writestr(f"files/{sha256}", source.read(f"files/{sha256}"))
            copy.writestr("manifest.json", json.dumps(manifest(said)))
    return target


BEYOND = "a number beyond all numbers"


def _line(row: Row) -> bytes:
    return json.dumps(row).replace(f'"{BEYOND}"', "1e999").encode() + b"\n"


def _rows(content: bytes) -> list[Row]:
    return [json.loads(line) for line in content.split(b"\n") if line]


def bring(database: Database, store: ArtefactStore, path: Path) -> study_import.Imported:
    with database.writing() as session:
        return study_import.read(session, store, path, "experimenter")


def everything(database: Database, store: ArtefactStore) -> tuple[dict[str, int], set[str]]:
    with database.reading() as session:
        counted = {
            table.name: session.scalar(select(func.count()).select_from(table)) or 0
            for table in Base.metadata.sorted_tables
        }
    return counted, stored_files.names(store)


def test_what_nobody_has_changed_is_brought_in(database: Database, store: ArtefactStore, packed: Path) -> None:
    """Or the refusals below would say nothing."""
    assert bring(database, store, forged(packed, lambda rows: None)).study.name == "Feeding, finished"


ELSEWHERE: dict[str, Row] = {
    "experimenter": {"id": 1, "name": "Mallory", "password_hash": "x", "role": "owner", "must_change_password": False},
    "api_token": {"id": 1, "experimenter_id": 1, "name": "x", "token_sha256": "0" * 64},
    "audit_event": {"id": 1, "actor": "experimenter", "action": "study unblinded", "subject": "feeding"},
    "browser_session": {"id": 1, "cookie_sha256": "0" * 64, "experimenter_id": 1},
    "worker_presence": {"name": "worker"},
    "report": {"id": 1, "study_id": 1, "run_id": 1, "basis": "", "contents": {}, "figures": {}},
    "export": {"id": 1, "study_id": 1, "kind": "data", "requested_by": "x"},
    "alembic_version": {"id": 1},
}


@pytest.mark.parametrize("table", ELSEWHERE)
def test_a_table_that_no_export_writes_is_refused_by_its_name(
    database: Database, store: ArtefactStore, packed: Path, table: str
) -> None:
    before = everything(database, store)
    path = forged(packed, lambda rows: rows.update({table: [ELSEWHERE[table]]}))
    with pytest.raises(ArchiveInvalid, match=table):
        bring(database, store, path)
    assert everything(database, store) == before


def _set(table: str, column: str, value: Any, place: int = 0) -> Change:
    def change(rows: dict[str, list[Row]]) -> None:
        rows[table][place][column] = value

    return change


def _joined(rows: dict[str, list[Row]]) -> None:
    """A pair of one participant, foreseen by the model of another: withdrawing would fail."""
    owners = {row["id"]: row["participant_id"] for row in rows["model"]}
    query = rows["query"][0]
    query["predicted_by_model_id"] = next(each for each, owner in owners.items() if owner != query["participant_id"])


def _repeated(rows: dict[str, list[Row]]) -> None:
    first, *_, last = rows["query"]
    assert first["participant_id"] != last["participant_id"]
    last["repeats_query_id"] = first["id"]


def _nested(depth: int) -> Row:
    return {"in": _nested(depth - 1)} if depth else {}


def _twice(table: str) -> Change:
    return lambda rows: rows[table].append(dict(rows[table][0]))


FORGERIES: dict[str, Change] = {
    "a way in for anybody": _set("study", "join_token", "known-to-me"),
    "a link of a participant": _set("participant", "token_sha256", hashlib.sha256(b"mine").hexdigest()),
    "a second study": _twice("study"),
    "the same participant twice": _twice("participant"),
    "a preview": _set("participant", "is_preview", True),
    "a number of previews": _set("participant", "number", 900_001),
    "a participant of another study": _set("participant", "study_id", 77),
    "donors that are no numbers": _set("donor_draw", "stored_donors", {"people": ["P01"]}),
    "donors with more to say": _set("donor_draw", "stored_donors", {"people": [1], "name": "Ada"}),
    "a rule that there is not": _set("donor_draw", "rule", "the best one"),
    "a film of somebody else": _set("trial", "film_id", 77),
    "an answer to somebody else's pair": _set("label_event", "query_id", 777),
    "a model of another participant": _joined,
    "a repeat of another participant's pair": _repeated,
    "a run that makes reports": _set("run", "kind", "report"),
    "a run of no known kind": _set("run", "kind", "shell"),
    "a task that leads out of its folder": _set("study", "task", "../../etc"),
    "settings that nobody can read": _set("study", "stored_settings", {"labels_per_participant": "many"}),
    "a secret that can be guessed": _set("study", "key_secret", "0"),
    "a study that was deleted": _set("study", "deleted_at", "2026-01-01T00:00:00+00:00"),
    "material without signals": _set("study", "material", {"rate_hz": 10}),
    "hints that are no names": _set("hint_event", "hints", "<b>"),
    "an answer that cannot be given": _set("label_event", "response", "both"),
    "a letter that is none": _set("trial", "letter", "<"),
    "a number as text": _set("query", "ordinal", "1"),
    "a truth as a number": _set("rollout", "success", 1),
    "a truth as an id": _set("query", "id", True),
    "a number that no database holds": _set("query", "ordinal", 2**70),
    "nothing where something must be": _set("query", "propensity", None),
    "no number": _set("query", "propensity", float("nan")),
    "half a character": _set("form_answer", "value", "\ud800"),
    "a text that is too long": _set("study", "name", "x" * 121),
    "half a character in an object": _set("participant_event", "detail", {"note": [{"text": "\ud800"}]}),
    "half a character as a name": _set("model", "metrics", {"\ud800": 1}),
    "a number beyond all numbers": _set("allocation", "considered", {"arms": [BEYOND]}),
    "a number that is none to others": _set("model", "metrics", {"accuracy": 10**400}),
    "a way that is no number": _set("self_setting", "mode", {"speed": 10**400}),
    "an object in an object and so on": _set("participant_event", "detail", _nested(200)),
    "a change of something else": _set("deviation", "after", {"name": "x"}),
    "a list for an object": _set("participant_event", "detail", [1]),
    "a time without its zone": _set("participant", "created_at", "2026-01-31T12:00:00"),
    "no time": _set("participant", "created_at", "yesterday"),
    "a column that there is not": _set("study", "owner", "me"),
    "no id": lambda rows: rows["query"][0].pop("id"),
    "no row": lambda rows: rows["rating"].append([]),  # type: ignore[arg-type]
    "a file outside of the store": _set("clip", "video_sha256", "../../../etc/passwd"),
    "a longer row than anybody writes": _set("form_answer", "value", "x" * (archive.LARGEST_ROW_BYTES + 1)),
}


@pytest.mark.parametrize("forgery", FORGERIES)
def test_rows_that_no_export_writes_are_refused_in_words(
    database: Database, store: ArtefactStore, packed: Path, forgery: str
) -> None:
    before = everything(database, store)
    with pytest.raises(ArchiveInvalid) as refused:
        bring(database, store, forged(packed, FORGERIES[forgery]))
    assert "Nothing was imported" in refused.value.message
    assert refused.value.message != (ArchiveInvalid.__doc__ or ""), "it says what was refused"
    assert everything(database, store) == before


def test_a_file_of_another_study_cannot_be_had_by_its_hash(
    database: Database, store: ArtefactStore, packed: Path
) -> None:
    theirs = store.put(b"the bundle of somebody in another study")
    with pytest.raises(ArchiveInvalid, match="does not hold"):
        bring(database, store, forged(packed, _set("clip", "video_sha256", theirs)))


def test_whatever_stands_in_a_column_an_archive_is_read_or_refused_in_words(
    store: ArtefactStore, packed: Path, tmp_path: Path
) -> None:
    odd: list[Any] = [None, "", "x", "\ud800", "\0", -1, 0, 2**63, 0.5, True, [], {}, {"a": [None]}]
    with zipfile.ZipFile(packed) as source:
        columns = {
            name: [*_rows(source.read(f"rows/{name}.jsonl"))[0]]
            for name in json.loads(source.read("manifest.json"))["tables"]
            if source.read(f"rows/{name}.jsonl")
        }
    for number, (table, column) in enumerate((table, each) for table, names in columns.items() for each in names):
        path = forged(packed, _set(table, column, odd[number % len(odd)]))
        with suppress(ArchiveInvalid):
            archive_reading.verify(path, tmp_path / "work", "")


# --- what was locked ---


def _another_document(rows: dict[str, list[Row]]) -> None:
    rows["study"][0]["lock_document"]["planned_tests"] = ["wilcoxon"]


def _another_hash(rows: dict[str, list[Row]]) -> None:
    rows["study"][0]["lock_hash"] = "0" * 64


def _documented(document: Row | None = None, **changes: Any) -> Change:
    """What was locked, with its hash, which anybody can compute."""

    def change(rows: dict[str, list[Row]]) -> None:
        (study,) = rows["study"]
        study["lock_document"] = changed = (study["lock_document"] if document is None else document) | changes
        study["lock_hash"] = locking.hash_of(changed)

    return change


@pytest.mark.parametrize(
    "change",
    [
        _documented({"a": 1}),
        _documented(stop_rule=[1]),
        _documented(study={"name": "x"}),
        _documented(settings={"labels_per_participant": "many"}),
        _documented(planned_tests="all"),
        _documented(plan_of_pairs=None),
    ],
)
def test_a_locked_document_that_no_page_could_show_is_refused(
    database: Database, store: ArtefactStore, packed: Path, change: Change
) -> None:
    with pytest.raises(ArchiveInvalid, match="what was locked"):
        bring(database, store, forged(packed, change))


def _no_document(rows: dict[str, list[Row]]) -> None:
    rows["study"][0]["lock_document"] = None


def _no_hash(rows: dict[str, list[Row]]) -> None:
    rows["study"][0]["lock_hash"] = None


@pytest.mark.parametrize("change", [_another_document, _another_hash, _no_document, _no_hash])
def test_a_lock_hash_that_is_not_that_of_what_was_locked_is_refused(
    database: Database, store: ArtefactStore, packed: Path, change: Change
) -> None:
    with pytest.raises(ArchiveInvalid, match="lock hash"):
        bring(database, store, forged(packed, change))


# --- manifests ---


@pytest.mark.parametrize("content", [b"[]", b'"text"', b"null", b"{}", b"{", b"[" * 100_000, b"\xff", b"1" * 5000])
def test_a_manifest_that_is_none_is_refused_on_the_page(experimenter: TestClient, content: bytes) -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as packed:
        packed.writestr("manifest.json", content)
    answer = experimenter.post("/import", files={"file": ("study.zip", file.getvalue(), "application/zip")})
    assert answer.status_code == 422
    assert "not an archive of a study" in answer.text


@pytest.mark.parametrize(
    "broken",
    [
        {"tables": []},
        {"tables": {"study": 1}},
        {"tables": {"study": {"rows": 1, "sha256": 5}}},
        {"files": ["x"]},
        {"files": {"x": "y"}},
        {"files": {"../../x": 1}},
        {"version": "2"},
        {"version": True, "tables": None},
        {"version": None},
        {"tables": {}},
    ],
)
def test_a_manifest_with_something_else_in_it_is_refused(
    database: Database, store: ArtefactStore, packed: Path, broken: dict[str, Any]
) -> None:
    with pytest.raises(ArchiveInvalid):
        bring(database, store, forged(packed, lambda rows: None, lambda said: said | broken))


# --- memory ---


def _with(packed: Path, name: str, size: int, compression: int = zipfile.ZIP_DEFLATED) -> Path:
    """The archive with one member that unpacks to so many noughts."""
    target = packed.with_name("swollen.zip")
    with zipfile.ZipFile(packed) as source, zipfile.ZipFile(target, "w", compression, compresslevel=1) as copy:
        for each in source.namelist():
            if each != name:
                copy.writestr(each, source.read(each))
        with copy.open(name, "w", force_zip64=True) as swollen:
            for _ in range(size // MEGABYTE):
                swollen.write(bytes(MEGABYTE))
    return target


def _refused_within_memory(database: Database, store: ArtefactStore, path: Path) -> None:
    with pytest.raises(ArchiveInvalid):
        _peak(lambda: bring(database, store, path))


def _peak(act: Callable[[], Any]) -> int:
    """Bytes held at worst."""
    tracemalloc.start()
    try:
        act()
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < MOST_MEMORY, f"{peak >> 20} MB"
    return peak


@pytest.mark.parametrize("name", ["manifest.json", "rows/study.jsonl", "files/" + "0" * 64, "sealed", "letter.txt"])
@pytest.mark.parametrize(
    "compression", [zipfile.ZIP_DEFLATED, pytest.param(zipfile.ZIP_STORED, marks=pytest.mark.long), zipfile.ZIP_LZMA]
)
def test_noughts_by_the_hundred_megabytes_fill_no_memory(
    database: Database, store: ArtefactStore, packed: Path, name: str, compression: int
) -> None:
    size = 200 * MEGABYTE if compression == zipfile.ZIP_DEFLATED else 50 * MEGABYTE
    path = _with(packed, name, size, compression)
    assert compression == zipfile.ZIP_STORED or path.stat().st_size < 5 * MEGABYTE
    _refused_within_memory(database, store, path)


def test_a_list_of_contents_that_is_far_too_long_is_not_read(
    database: Database, store: ArtefactStore, tmp_path: Path
) -> None:
    with zipfile.ZipFile(tmp_path / "long.zip", "w") as archive_of_names:
        archive_of_names.writestr("files/first", b"")
        for number in range(120_000):
            again = zipfile.ZipInfo(f"files/{number:064}")
            again.header_offset = again.CRC = 0
            archive_of_names.filelist.append(again)
    _refused_within_memory(database, store, tmp_path / "long.zip")


def test_members_that_lie_over_each_other_are_refused(database: Database, store: ArtefactStore, tmp_path: Path) -> None:
    """Each of them unpacks to a hundred times its size at most; all of them together to far more than the file."""
    path = tmp_path / "overlapping.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("first", (b"abcdefgh" * 13 + bytes(range(256))) * 20_000)
        (first,) = packed.filelist
        for number in range(200):
            again = zipfile.ZipInfo(f"files/{number}")
            for name in ("header_offset", "compress_type", "compress_size", "file_size", "CRC"):
                setattr(again, name, getattr(first, name))
            packed.filelist.append(again)
            packed.NameToInfo[again.filename] = again
    with pytest.raises(unpacking.ZipRefused), unpacking.opened(path, 1 << 40):
        pass
    _refused_within_memory(database, store, path)


def test_two_members_of_one_name_are_refused(database: Database, store: ArtefactStore, packed: Path) -> None:
    with zipfile.ZipFile(packed, "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("manifest.json", "{}")
    with pytest.raises(ArchiveInvalid, match="two files of one name"):
        bring(database, store, packed)


@pytest.mark.long
def test_a_large_study_takes_little_memory_both_ways(
    database: Database, store: ArtefactStore, packed: Path, tmp_path: Path
) -> None:
    def grow(rows: dict[str, list[Row]]) -> None:
        (one, *_), drawn = rows["participant_event"], random.Random(1)  # noqa: S311
        rows["participant_event"] = [
            one | {"id": number, "detail": {"note": f"{drawn.getrandbits(2000):x}" * 4}} for number in range(1, 15_000)
        ]

    path = forged(packed, grow)
    with zipfile.ZipFile(path) as large:
        assert large.getinfo("rows/participant_event.jsonl").file_size > 30 * MEGABYTE
    _peak(lambda: bring(database, store, path))
    with database.reading() as session:
        study = session.scalars(select(Study).order_by(Study.id.desc())).one()
        _peak(lambda: archive.write(session, store, study, tmp_path / "again.zip"))


def test_a_long_text_that_everybody_agreed_to_is_no_bomb(
    database: Database, store: ArtefactStore, packed: Path
) -> None:
    def grow(rows: dict[str, list[Row]]) -> None:
        (one, *_), drawn = rows["consent_record"], random.Random(1)  # noqa: S311
        text = " ".join(f"{drawn.getrandbits(24):x}" for _ in range(3500))
        rows["consent_record"] = [one | {"id": number, "text": text} for number in range(1, 1000)]

    bring(database, store, forged(packed, grow))
